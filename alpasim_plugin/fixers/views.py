"""Frames of a block grouped by camera and size, checked, and stacked.

A *view* is one camera's frames of a block. Views of one size form a batch.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np

from alpasim_plugin.core.errors import InputError, RendererError
from alpasim_plugin.core.types import F32, U8, DevicePlanes, Frame

SLACK = 1e-3  # opacity outside [0, 1] by rounding is clipped; more is an error
HALF = 127.5  # grey levels from 0 to 1 on the scale of [-1, 1]


@dataclass(frozen=True)
class Views:
    """The frames of cameras of one size, oldest first."""

    cameras: tuple[str, ...]  # B of them, sorted
    index: tuple[tuple[int, ...], ...]  # per camera, positions of its T frames in the block
    t_us: tuple[tuple[int, ...], ...]  # per camera
    rgb: Any  # (B, T, H, W, 3) uint8, of the host or of a device
    alpha: Any  # (B, T, H, W) float32 beside it, 0 to 1; None where every pixel is opaque
    maps: Any  # (B, T, H, W, 3) uint8, of the host or of a device; None: nothing is drawn
    references: Any = (
        # (B, T, K, H, W, 4) uint8 recorded frames, of the host or of a device, 0 where a frame has
        # fewer than others; None: no frame has any
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
        if other is None:
            return False
        pairs = [(getattr(self, part.name), getattr(other, part.name)) for part in fields(self)]
        return all(
            (first is None) == (second is None)
            and np.array_equal(np.asarray(first), np.asarray(second))
            for first, second in pairs
        )


class Past(Protocol):
    """What a camera's history says of its last frame."""

    @property
    def t_us(self) -> int:
        """Its time."""
        ...

    @property
    def raw(self) -> Any:
        """Its render ``(H, W, 3)``."""
        ...


def group_views(
    block: Sequence[Frame], maps: Sequence[U8], frames_due: int, on_device: bool = False
) -> tuple[Views, ...]:
    """Sort a block by size, camera and time.

    Args:
        block: Frames of any cameras in any order.
        maps: Semantic maps of the same frames, or empty.
        frames_due: Most frames that a camera may have.
        on_device: Whether planes that a device drew may stay there.

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
    index: dict[str, list[int]] = {}
    for i in sorted(range(len(block)), key=lambda i: (block[i].camera, block[i].t_us)):
        index.setdefault(block[i].camera, []).append(i)
    counts = {camera: len(indices) for camera, indices in index.items()}
    if len(set(counts.values())) > 1 or max(counts.values()) > frames_due:
        raise InputError(
            f"frames by camera: {counts}",
            f"give each camera the same number of frames, at most {frames_due}",
        )
    sizes: dict[tuple[int, ...], list[str]] = {}
    for camera, indices in index.items():
        times = [block[i].t_us for i in indices]
        if len(set(times)) < len(times):
            raise InputError(
                f"camera {camera!r}: two frames at one time: {times}", "give every frame once"
            )
        shape = (*block[indices[0]].size, 3)
        for i in indices:
            _check_frame(block[i], maps[i] if maps else None, shape)
        sizes.setdefault(shape, []).append(camera)
    return tuple(_stack(block, maps, sizes[shape], index, on_device) for shape in sorted(sizes))


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


def _check_frame(frame: Frame, sdmap: U8 | None, shape: tuple[int, ...]) -> None:
    """Refuse a frame, its map and its references unless they have the size ``shape``."""
    subject = f"camera {frame.camera!r} at {frame.t_us} us"
    if frame.pending is None:
        rgb = frame.rgb
        if rgb.ndim != 3 or rgb.shape[2] != 3 or 0 in rgb.shape or rgb.dtype != np.uint8:
            raise InputError(
                f"{subject}: rgb is {rgb.dtype} {rgb.shape}", "give (height, width, 3) uint8"
            )
    if frame.size != shape[:2]:
        raise InputError(
            f"{subject}: rgb of {frame.size} after {shape[:2]} (height, width)",
            "keep a camera's image size for the whole rollout",
        )
    named_images = [("a reference", image, (*shape[:2], 4)) for image in frame.references]
    if sdmap is not None:
        named_images.append(("the map", sdmap, shape))
    for name, image, due in named_images:
        if image.shape != due or str(image.dtype).rpartition(".")[2] != "uint8":
            raise InputError(
                f"{subject}: {name} is {image.dtype} {image.shape}",
                f"give uint8 {due}, the size of the frame",
            )
    if frame.pending is None and frame.alpha is not None:
        _check_alpha(frame.alpha, shape, subject)


def _check_alpha(alpha: F32, shape: tuple[int, ...], subject: str) -> None:
    """Refuse an opacity of another size than the image, or outside of [0, 1]."""
    if alpha.shape != shape[:2]:
        raise InputError(
            f"{subject}: alpha of {alpha.shape} with rgb of {shape[:2]} (height, width)",
            "give both at one size",
        )
    low = float(alpha.min())
    high = float(alpha.max())
    if not (low >= -SLACK and high <= 1 + SLACK):  # also refuses NaN, which min and max propagate
        raise RendererError(
            f"{subject}: opacity from {low:.4g} to {high:.4g}",
            "repair the renderer: its opacity is accumulated alpha, 0 to 1",
        )


def _stacked_references(frames: Sequence[Frame], size: tuple[int, int]) -> U8 | None:
    """Return the references ``(F, K, H, W, 4)`` of frames, zeros where one has fewer than others;
    None where none has any.
    """
    frame_references = [frame.references_on_host() for frame in frames]
    count = max(map(len, frame_references), default=0)
    if not count:
        return None
    references: U8 = np.zeros((len(frames), count, *size, 4), dtype=np.uint8)
    for i, images in enumerate(frame_references):
        for k, image in enumerate(images):
            references[i, k] = image
    return references


def _stack(
    block: Sequence[Frame],
    maps: Sequence[U8],
    cameras: Sequence[str],
    index: dict[str, list[int]],
    on_device: bool,
) -> Views:
    """Stack the frames of cameras of one size.

    Args:
        block: All frames.
        maps: Semantic maps of the same frames, or empty.
        cameras: The cameras.
        index: Camera -> positions of its frames in the block, oldest first.
        on_device: Whether planes stay on the device if it drew all of these frames.
    """
    names = tuple(sorted(cameras))
    order = tuple(tuple(index[name]) for name in names)
    flat = [i for indices in order for i in indices]
    frames = [block[i] for i in flat]
    shape = (*frames[0].size, 3)
    lead = (len(names), len(order[0]))
    device_planes = planes_of(frames) if on_device else []
    references: Any = None
    if len(device_planes) == len(frames):
        rgb, alpha, references = stacked(device_planes)
    else:
        rgb = np.stack([frame.rgb for frame in frames])
        alpha = _opacity(frames)
    joined: Any = np.stack
    if maps and not isinstance(maps[0], np.ndarray):
        import torch

        joined = torch.stack
    if references is None:
        references = _stacked_references(frames, shape[:2])
    if references is not None:
        references = references.reshape(*lead, *references.shape[1:])
    return Views(
        names,
        order,
        tuple(tuple(block[i].t_us for i in indices) for indices in order),
        rgb.reshape(*lead, *shape),
        None if alpha is None else alpha.reshape(*lead, *shape[:2]),
        joined([maps[i] for i in flat]).reshape(*lead, *shape) if maps else None,
        references,
    )


def planes_of(frames: Sequence[Frame]) -> list[DevicePlanes]:
    """Return the planes of the frames that a device drew."""
    return [frame.pending for frame in frames if frame.pending is not None]


def stacked(frames: Sequence[DevicePlanes]) -> tuple[Any, Any, Any]:
    """Return images, opacities and references ``(N, K, H, W, 4)`` that a device drew as one tensor
    each; None where no view has a reference.
    """
    import torch

    rgb = torch.stack([planes.rgb for planes in frames])
    alpha = torch.stack([planes.alpha for planes in frames])
    counts = [0 if planes.references is None else len(planes.references) for planes in frames]
    if not any(counts):
        return rgb, alpha, None
    references = rgb.new_zeros((len(frames), max(counts), *rgb.shape[1:3], 4))
    for row, count, planes in zip(references, counts, frames, strict=True):
        if count:
            row[:count] = planes.references
    return rgb, alpha, references


def _opacity(frames: Sequence[Frame]) -> F32 | None:
    """Return the opacities of frames ``(N, H, W)``, None where every pixel is opaque."""
    if all(frame.alpha is None or frame.alpha.min() >= 1 for frame in frames):
        return None
    alpha = np.ones((len(frames), *frames[0].size), dtype=np.float32)
    for i, frame in enumerate(frames):
        if frame.alpha is not None:
            np.clip(frame.alpha, 0, 1, out=alpha[i])
    return alpha


@dataclass(frozen=True)
class ClipSize:
    """Frames, height and width of a clip before padding."""

    frames: int
    height: int
    width: int
