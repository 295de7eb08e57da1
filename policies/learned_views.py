"""How the learned policy's input is made of images as tensors: on the CPU by `learned_input`, on
another device there, within two grey levels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.core.devices import implementation, upload
from alpasim_plugin.core.types import F32, U8, CameraSpec
from policies.learned_input import GREY, MEAN, STD, View, level_view, network_input, sampled_at

PARTS = 32  # of a pixel, between which OpenCV interpolates


class HostView:
    """A view that is cut from a camera's images on the CPU.

    Args:
        camera: Whose images.
        view: What is cut.
        device: Where the images are.
    """

    def __init__(self, camera: CameraSpec, view: View, device: torch.device) -> None:
        self.camera, self.view = camera, view

    def cut(self, image: Tensor) -> U8:
        """Return the view of an image ``(H, W, 3)`` uint8, to be given to `network_input`."""
        return level_view(image.numpy(), self.camera, view=self.view)

    def network_input(self, now: U8, before: U8) -> Tensor:
        """Return the network's input ``(1, 4, h, w)`` from a view now and before."""
        return torch.from_numpy(network_input(now, before))[None]


class DeviceView:
    """The same on another device; see `HostView`."""

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
        self.grey = upload(GREY, device)

    def cut(self, image: Tensor) -> Tensor:
        """Return whole levels ``(3, h, w)``."""
        whole = image.permute(2, 0, 1).float()
        reduced = (self.rows @ whole @ self.columns.T).round()[None]
        shown = F.grid_sample(reduced, self.shares, padding_mode="border", align_corners=True)
        return shown[0].round()

    def network_input(self, now: Tensor, before: Tensor) -> Tensor:
        """See `HostView.network_input`."""
        grey = torch.tensordot(self.grey, before, dims=1)
        return (torch.cat([now, grey[None]])[None] - MEAN) / STD


def _means(size: int, smaller: int) -> F32:
    """Return the matrix ``(smaller, size)`` that averages pixels over larger ones."""
    ends = np.arange(smaller + 1)[:, None] * (size / smaller)
    pixels = np.arange(size)
    shared = np.minimum(ends[1:], pixels + 1) - np.maximum(ends[:-1], pixels)
    return (np.maximum(shared, 0) * (smaller / size)).astype(np.float32)


def view_on(device: torch.device, camera: CameraSpec, view: View) -> Any:
    """Return what cuts a view from images on a device."""
    return implementation(device, HostView, DeviceView)(camera, view, device)
