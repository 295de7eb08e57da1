"""What the learned policy's network receives, made of images as tensors where they are."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.core.devices import implementation, upload
from alpasim_plugin.core.types import F32, CameraSpec
from policies.learned_input import GREY, MEAN, STD, View, level_view, sampled_at

PARTS = 32  # of a pixel, between which OpenCV interpolates


Cut = Callable[[Tensor], Tensor]  # a view of an image (H, W, 3) uint8: whole levels (3, h, w)


def cutter(camera: CameraSpec, view: View, device: torch.device) -> Cut:
    """Return what cuts a level view from a camera's images on a device: on the CPU
    `learned_input.level_view`, on which the network was trained, on a card the same within two grey
    levels.
    """
    make: Any = implementation(device, HostView, DeviceView)
    cut: Cut = make(camera, view, device)
    return cut


@dataclass(frozen=True, eq=False)
class HostView:
    """A level view that is cut from a camera's images on the CPU; see `cutter`."""

    camera: CameraSpec
    view: View
    device: torch.device

    def __call__(self, image: Tensor) -> Tensor:
        """Cut the view."""
        shown = level_view(image.numpy(), self.camera, view=self.view)
        return torch.from_numpy(shown).permute(2, 0, 1).float()


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
        shown = F.grid_sample(
            whole.round()[None], self.shares, padding_mode="border", align_corners=True
        )
        return shown[0].round()


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
