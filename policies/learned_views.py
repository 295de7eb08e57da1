"""What the learned policy's network receives, made of images as tensors where they are."""

from collections.abc import Callable

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.core.devices import implementation, upload
from alpasim_plugin.core.types import F32, U8, CameraSpec
from policies.learned_input import View, level_view, sampled_at

PARTS = 32  # of a pixel, between which OpenCV interpolates
# Grey levels
MEAN = 115.0
STD = 64.0
GREY = np.array([0.299, 0.587, 0.114], dtype=np.float32)  # ITU-R BT.601


Cut = Callable[[Tensor], Tensor]  # a view of an image (H, W, 3) uint8: whole levels (3, h, w)


def cutter(camera: CameraSpec, view: View, device: torch.device) -> Cut:
    """Return what cuts a level view from a camera's images on a device: on the CPU
    `learned_input.level_view`, on which the network was trained, on a card the same within two grey
    levels.
    """
    return implementation(device, _host_view, DeviceView)(camera, view, device)


def _host_view(camera: CameraSpec, view: View, _: torch.device) -> Cut:
    return lambda image: in_planes(level_view(image.numpy(), camera, view=view))


def in_planes(levels: U8) -> Tensor:
    """Return an image ``(h, w, 3)`` as whole levels ``(3, h, w)``."""
    return torch.from_numpy(levels).permute(2, 0, 1).float()


class DeviceView:
    """A level view that is cut from a camera's images on a card; see `cutter`."""

    def __init__(self, camera: CameraSpec, view: View, device: torch.device) -> None:
        (width, height), to_camera = sampled_at(camera, view)
        self.rows, self.columns = (
            upload(_means(*sizes), device)
            for sizes in ((camera.height, height), (camera.width, width))
        )
        x, y = np.meshgrid(np.arange(view.width), np.arange(view.height))
        u, v, w = np.tensordot(to_camera, np.stack([x, y, np.ones_like(x)]), axes=1)
        places = np.rint(PARTS * np.stack([u / w, v / w], axis=-1)) / PARTS
        shares = 2 * places[None] / (np.array([width, height]) - 1) - 1
        self.shares = upload(shares.astype(np.float32), device)

    def __call__(self, image: Tensor) -> Tensor:
        """Cut the view."""
        whole = self.rows @ image.permute(2, 0, 1).float() @ self.columns.T
        view = F.grid_sample(
            whole.round()[None], self.shares, padding_mode="border", align_corners=True
        )
        return view[0].round()


def network_input(now: Tensor, before: Tensor) -> Tensor:
    """Return the network's input ``(1, 4, h, w)`` from a view now and before."""
    grey = torch.tensordot(upload(GREY, now.device), before, dims=1)
    return (torch.cat([now, grey[None]])[None] - MEAN) / STD


def _means(size: int, smaller: int) -> F32:
    """Return the matrix ``(smaller, size)`` that averages pixels over larger ones."""
    ends = np.arange(smaller + 1)[:, None] * (size / smaller)
    pixels = np.arange(size)
    shared = np.minimum(ends[1:], pixels + 1) - np.maximum(ends[:-1], pixels)
    return (np.maximum(shared, 0) * (smaller / size)).astype(np.float32)
