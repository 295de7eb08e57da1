"""Frames of a block grouped by camera and size, checked, and stacked.

A *view* is one camera's frames of a block. Views of one size form a batch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Protocol

import numpy as np

from alpasim_plugin.core.errors import InputError, RendererError
from alpasim_plugin.core.types import F32, U8, Frame

DOING = "giving a block of frames to a fixer"
SLACK = 1e-3  # opacity outside [0, 1] by rounding is clipped; more is an error
HALF = 127.5  # grey levels from 0 to 1 on the scale of [-1, 1]


@dataclass(frozen=True)
class Views:
    """The frames of cameras of one size, oldest first."""

    cameras: tuple[str, ...]  # B of them, sorted
    index: tuple[tuple[int, ...], ...]  # per camera, positions of its T frames in the block
    t_us: tuple[tuple[int, ...], ...]  # per camera
    rgb: U8  # (B, T, H, W, 3)
    alpha: F32 | None  # (B, T, H, W), 0 to 1; None where every pixel is opaque
    maps: U8 | None  # (B, T, H, W, 3)
    references: U8 | None = (
        # (B, T, K, H, W, 4) recorded frames, 0 where a frame has fewer than others; None: no frame
        # has any
        None
    )

    @property
    def size(self) -> ClipSize:
        """Frames, height and width."""
        return ClipSize(*self.rgb.shape[1:4])

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width."""
        return self.size.height, self.size.width

    def equals(self, other: Views | None) -> bool:
        """Return whether two blocks are equal bit for bit."""
        return other is not None and all(
            _same(getattr(self, field.name), getattr(other, field.name)) for field in fields(self)
        )


class Past(Protocol):
    """What a camera's history says of its last frame."""

    @property
    def t_us(self) -> int:
        """Its time."""
        ...

    @property
    def raw(self) -> U8:
        """Its render ``(H, W, 3)``."""
        ...


def group_views(block: Sequence[Frame], maps: Sequence[U8], frames_due: int) -> tuple[Views, ...]:
    """Sort a block by size, camera and time.

    Args:
        block: Frames of any cameras in any order.
        maps: Semantic maps of the same frames, or empty.
        frames_due: Most frames that a camera may have.

    Returns:
        One batch of views per image size; pixels are copied.

    Raises:
        InputError: No frame, too many, cameras with different numbers of frames, two frames at one
            time, sizes that change within a camera, or maps that do not belong to the frames.
        RendererError: An opacity that is not a number or outside [0, 1].
    """
    if not block:
        raise InputError("the block: no frames", "give at least one frame per camera")
    if maps and len(maps) != len(block):
        raise InputError(
            f"semantic maps: {len(maps)} for {len(block)} frames",
            "give one per frame in the same order, or none",
        )
    order = sorted(
        range(len(block)), key=lambda i: (block[i].rgb.shape, block[i].camera, block[i].t_us)
    )
    index: dict[str, list[int]] = {}
    for i in order:
        index.setdefault(block[i].camera, []).append(i)
    counts = {camera: len(mine) for camera, mine in index.items()}
    if len(set(counts.values())) > 1 or max(counts.values()) > frames_due:
        raise InputError(
            f"frames by camera: {counts}",
            f"give each camera the same number of frames, at most {frames_due}",
        )
    for camera, mine in index.items():
        _check_view(camera, [block[i] for i in mine], [maps[i] for i in mine] if maps else [])
    sizes: dict[tuple[int, ...], list[str]] = {}
    for camera, mine in index.items():
        sizes.setdefault(block[mine[0]].rgb.shape, []).append(camera)
    return tuple(_stack(block, maps, cameras, index) for cameras in sizes.values())


def check_continues(view: Views, pasts: Mapping[str, Past]) -> None:
    """Raise `InputError` where a frame does not follow its camera's history in size and time."""
    for camera, times in zip(view.cameras, view.t_us, strict=True):
        past = pasts.get(camera)
        if past is None:
            continue
        if past.raw.shape[:2] != view.shape:
            raise InputError(
                f"camera {camera!r}: {view.shape} (height, width) after {past.raw.shape[:2]}",
                "keep a camera's image size for the whole rollout, or reset",
            )
        if times[0] <= past.t_us:
            raise InputError(
                f"camera {camera!r}: a frame at {times[0]} us after one at {past.t_us} us",
                "give frames in the order of time, or reset",
            )


def _check_view(camera: str, frames: Sequence[Frame], maps: Sequence[U8]) -> None:
    times = [frame.t_us for frame in frames]
    shape = frames[0].rgb.shape
    if len(set(times)) < len(times):
        raise InputError(
            f"camera {camera!r}: two frames at one time: {times}", "give every frame once"
        )
    for frame in frames:
        what = f"camera {camera!r} at {frame.t_us} us"
        if (
            frame.rgb.ndim != 3
            or frame.rgb.shape[2] != 3
            or 0 in frame.rgb.shape
            or frame.rgb.dtype != np.uint8
        ):
            raise InputError(
                f"{what}: rgb is {frame.rgb.dtype} {frame.rgb.shape}",
                "give (height, width, 3) uint8",
            )
        if frame.rgb.shape != shape:
            raise InputError(
                f"{what}: rgb of {frame.rgb.shape[:2]} after {shape[:2]} (height, width)",
                "keep a camera's image size for the whole rollout",
            )
        if frame.alpha is not None:
            _check_alpha(what, frame.alpha, shape[:2])
        for image in frame.references:
            if image.shape != (*shape[:2], 4) or image.dtype != np.uint8:
                raise InputError(
                    f"{what}: a reference of {image.dtype} {image.shape}",
                    f"give uint8 {(*shape[:2], 4)}, the size of the frame",
                )
    for t_us, image in zip(times, maps, strict=False):
        if image.shape != shape or image.dtype != np.uint8:
            raise InputError(
                f"map of camera {camera!r} at {t_us} us: {image.dtype} {image.shape}",
                f"give uint8 {shape}, the size of the frame",
            )


def _check_alpha(what: str, alpha: F32, shape: tuple[int, ...]) -> None:
    if alpha.shape != shape:
        raise InputError(
            f"{what}: alpha of {alpha.shape} with rgb of {shape} (height, width)",
            "give both at one size",
        )
    low, high = float(alpha.min()), float(alpha.max())
    if not (low >= -SLACK and high <= 1 + SLACK):  # also refuses NaN, which min and max propagate
        raise RendererError(
            f"{what}: opacity with {int(np.isnan(alpha).sum())} NaN, values from {np.nanmin(alpha):.4g} to {np.nanmax(alpha):.4g}",
            "repair the renderer: its opacity is accumulated alpha, 0 to 1",
        )


def _stack(
    block: Sequence[Frame], maps: Sequence[U8], cameras: Sequence[str], index: dict[str, list[int]]
) -> Views:
    names = tuple(sorted(cameras))
    order = tuple(tuple(index[name]) for name in names)
    shape = block[order[0][0]].rgb.shape
    lead = (len(names), len(order[0]))
    flat = [i for mine in order for i in mine]
    frames = [block[i] for i in flat]
    alpha = None
    if any(frame.alpha is not None and frame.alpha.min() < 1 for frame in frames):
        alphas = [
            np.ones(shape[:2], np.float32) if frame.alpha is None else frame.alpha
            for frame in frames
        ]
        alpha = np.stack(alphas, dtype=np.float32).clip(0, 1).reshape(*lead, *shape[:2])
    return Views(
        names,
        order,
        tuple(tuple(block[i].t_us for i in mine) for mine in order),
        np.stack([frame.rgb for frame in frames]).reshape(*lead, *shape),
        alpha,
        np.stack([maps[i] for i in flat]).reshape(*lead, *shape) if maps else None,
        _references(frames, lead),
    )


def _references(frames: Sequence[Frame], lead: tuple[int, int]) -> U8 | None:
    count = max(len(frame.references) for frame in frames)
    if not count:
        return None
    out = np.zeros((len(frames), count, *frames[0].rgb.shape[:2], 4), np.uint8)
    for i, frame in enumerate(frames):
        for k, image in enumerate(frame.references):
            out[i, k] = image
    return out.reshape(*lead, *out.shape[1:])


def _same(a: object, b: object) -> bool:
    if isinstance(a, np.ndarray) and isinstance(b, np.ndarray):
        return np.array_equal(a, b)
    return a is b if a is None or b is None else bool(a == b)


@dataclass(frozen=True)
class ClipSize:
    """Frames, height and width of a clip before padding."""

    frames: int
    height: int
    width: int
