"""A view that a device drew: its planes stay there until they are asked for."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self, cast

import torch
from torch import Tensor

from alpasim_plugin.core.devices import download, upload
from alpasim_plugin.core.types import Bool, DevicePlanes, FloatArray, Frame
from alpasim_plugin.gaussians.raster.output import RasterOutput

PLANES = ("rgb", "alpha", "depth")


@dataclass(frozen=True, eq=False, kw_only=True)
class DeviceOutput(RasterOutput):
    """One rendered view, its planes as tensors.

    Attributes:
        pairs: ``()`` int64, pairs of splat and tile; the planes are whole if the device had room
            for them.
        had_room: Whether there was room for a number of pairs; makes room for the next frame.
        again: Draws the view once more.
        references: See `DevicePlanes`.
    """

    rgb: Any
    alpha: Any
    depth: Any
    pairs: Tensor
    had_room: Callable[[int], bool]
    again: Callable[[], DeviceOutput]
    references: Any = None

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self.alpha.shape[0], self.alpha.shape[1]

    @cached_property
    def arrays(self) -> Mapping[str, Any]:
        """All planes by name, brought to the host in one copy when they are first read; a view
        that lacks splats is drawn again.
        """
        *planes, pairs = download(self.rgb, self.alpha, self.depth, self.pairs)
        if not self.had_room(int(pairs)):
            return self.again().arrays
        return dict(zip(PLANES, planes, strict=True))

    def on_host(self) -> RasterOutput:
        """Return the view with arrays."""
        return RasterOutput(**self.arrays)

    def blank(
        self, height: int, width: int, parts: Sequence[Any], again: Callable[[], Any]
    ) -> DeviceOutput:
        """See `RasterOutput.blank`; there is room for all parts if there is for the largest."""
        return replace(
            self,
            rgb=self.rgb.new_zeros((height, width, 3)),
            alpha=self.alpha.new_ones((height, width)),
            depth=self.depth.new_zeros((height, width)),
            pairs=torch.stack([part.pairs for part in parts]).amax(),
            again=lambda: again()[0],
        )

    def beside(self, array: FloatArray | Bool) -> Tensor:
        """Return an array as a tensor of the device."""
        return upload(array, self.alpha.device)

    def frame(self, t_us: int, camera: str) -> Frame:
        """Return the view as a camera's frame, whose planes stay on the device."""
        planes = self.changed(lambda out: {"rgb": (out.rgb * 255 + 0.5).to(torch.uint8)})
        return Frame(t_us, camera, on_device=cast(DevicePlanes, planes))

    def changed(self, change: Callable[[Any], Mapping[str, Any]]) -> Self:
        """Return the view with other planes, which it also has when it is drawn again."""
        return replace(self, **change(self), again=lambda: self.again().changed(change))
