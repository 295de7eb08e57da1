"""Sample training clips from pairs and from driving videos. Clip i depends on i and the seed
only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import U8
from alpasim_plugin.lab.training.pair_store import PairClip, PairSequence


@dataclass(frozen=True)
class CropSize:
    """Frames, and the height and width of the crop, pixels; sides are multiples of 16."""

    frames: int
    height: int
    width: int


@dataclass(frozen=True)
class Clip:
    """A clip as tensors ``(C, T, H, W)``: images in [-1, 1], opacity 0 to 1 with one channel. None:
    the source has no such channel.
    """

    target: Tensor
    render: Tensor | None = None
    opacity: Tensor | None = None
    sdmap: Tensor | None = None


def draw_pair_clip(
    sequences: Sequence[PairSequence], size: CropSize, seed: int, index: int
) -> Clip:
    """Sample a clip from pairs: random sequence, start, crop and horizontal flip."""
    rng = stream("training", seed, "clips.pairs", index)
    clip = sequences[int(rng.integers(len(sequences)))].clip
    start, rows, columns = _window(rng, clip.rgb_gt.shape, size)
    cut: PairClip = clip.cut(start, size.frames)
    flip = bool(rng.random() < 0.5)

    def tensor(x: U8) -> Tensor:
        return to_tensor(x[:, rows, columns], flip)

    return Clip(
        tensor(cut.rgb_gt),
        tensor(cut.rgb_input),
        (tensor(cut.opacity[..., None]) + 1) / 2,
        tensor(cut.sdmap),
    )


def draw_video_clip(videos: Sequence[U8], size: CropSize, seed: int, index: int) -> Clip:
    """Sample a clip from videos ``(T, H, W, 3)``: random start, crop, time reversal and horizontal
    flip.
    """
    rng = stream("training", seed, "clips.videos", index)
    lengths = np.array([len(v) for v in videos], dtype=np.float64)
    video = videos[int(rng.choice(len(videos), p=lengths / lengths.sum()))]
    start, rows, columns = _window(rng, video.shape, size)
    cut = video[start : start + size.frames, rows, columns]
    return Clip(to_tensor(cut[::-1] if rng.random() < 0.3 else cut, bool(rng.random() < 0.5)))


def fitted(frames: U8, width: int, height: int) -> U8:
    """Scale frames ``(T, H, W, 3)`` to cover ``width x height`` and cut that from the centre."""
    h, w = frames.shape[1:3]
    scale = max(width / w, height / h)
    wide = round(w * scale)
    high = round(h * scale)
    left = (wide - width) // 2
    top = (high - height) // 2
    small = [
        cv2.resize(f, (wide, high), interpolation=cv2.INTER_AREA)[
            top : top + height, left : left + width
        ]
        for f in frames
    ]
    return np.stack(small)


def to_tensor(frames: U8, flip: bool = False) -> Tensor:
    """Map ``(T, H, W, C)`` uint8 to ``(C, T, H, W)`` float32 in [-1, 1], flipped horizontally if
    asked.
    """
    # A copy, since memory maps are read-only
    array = np.array(frames[:, :, ::-1] if flip else frames)
    return torch.from_numpy(array).permute(3, 0, 1, 2).float() / 127.5 - 1


def _window(
    rng: np.random.Generator, shape: tuple[int, ...], size: CropSize
) -> tuple[int, slice, slice]:
    free = [shape[0] - size.frames, shape[1] - size.height, shape[2] - size.width]
    if min(free) < 0:
        raise InputError(
            f"frames {list(shape[:3])}: no room for {size}",
            "make larger sequences, or draw smaller clips",
        )
    start, top, left = (int(rng.integers(f + 1)) for f in free)
    return start, slice(top, top + size.height), slice(left, left + size.width)
