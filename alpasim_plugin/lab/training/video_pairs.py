"""Recorded driving videos as sequences of pairs: the video is the clean channel, its damaged
version the degraded one.

The first part of every video belongs to the split ``train``, the last to ``held-out``, with a gap
between them. There is no map (black) and no pose (not a number).
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import I64, U8
from alpasim_plugin.lab.training.clips import fitted
from alpasim_plugin.lab.training.pair_store import Pair, is_made, write_sequence
from alpasim_plugin.lab.training.video_damage import damage_video, draw_damage
from alpasim_plugin.log.video import read_mp4

TRAIN = "train"
HELD_OUT = "held-out"


@dataclass(frozen=True)
class VideoRecipe:
    """How a video becomes sequences.

    Attributes:
        size: Width and height, pixels; frames are scaled to cover it and cut at the centre.
        variants: Sequences of each part, every one damaged in its own way.
        train_share: First share of the video, which is trained on.
        gap_share: Share after it that nobody uses, so that held-out frames are not next to trained
            ones.
        seed: Of the damage.
    """

    size: tuple[int, int] = (256, 144)
    variants: int = 2
    train_share: float = 0.7
    gap_share: float = 0.05
    seed: int = 0


def split_frames(count: int, recipe: VideoRecipe) -> dict[str, range]:
    """Return which of ``count`` frames belong to which split; every one to one at most.

    Raises:
        InputError: Shares without room for both parts, or a part without a frame.
    """
    first = round(recipe.train_share * count)
    last = round((recipe.train_share + recipe.gap_share) * count)
    if not 0 < first <= last < count:
        raise InputError(
            f"{count} frames, shares {recipe.train_share} and {recipe.gap_share}: a part without frames",
            "give a longer video or other shares",
        )
    return {TRAIN: range(first), HELD_OUT: range(last, count)}


def make_video_pairs(path: Path, folder: Path, recipe: VideoRecipe) -> Iterator[tuple[Path, bool]]:
    """Write the sequences of a video below ``folder/train`` and ``folder/held-out``.

    Yields:
        Each sequence's folder, and whether it was made now; equal ones are kept.

    Raises:
        InputError: Not a readable video, or too short.
    """
    with path.open("rb") as file:
        source = hashlib.file_digest(file, "sha256").hexdigest()
    video = read_mp4(path)
    width, height = recipe.size
    for split, part in split_frames(len(video.frames), recipe).items():
        frames = fitted(video.frames[part.start : part.stop], width, height)
        for variant in range(recipe.variants):
            name = f"{path.stem}-{source[:6]}-{width}x{height}-v{variant}"
            rng = stream(source, recipe.seed, f"training.video.{width}x{height}.{split}", variant)
            damage = draw_damage(rng, width)
            info = {
                "split": split,
                "family": "video",
                "source": path.name,
                "source_sha256": source,
                "first_frame": part.start,
            }
            info |= {
                "degradation": {"kind": "splats", **asdict(damage)},
                "recipe": {**asdict(recipe), "size": list(recipe.size)},
            }
            target = folder / split / name
            made = not is_made(target, info)
            if made:
                damaged = damage_video(frames, damage, rng)
                write_sequence(
                    target,
                    _pairs(damaged, frames, video.t_us[part.start : part.stop]),
                    len(frames),
                    info,
                )
            yield target, made


def _pairs(damaged: Iterator[tuple[U8, U8]], frames: U8, t_us: I64) -> Iterator[Pair]:
    for (image, opacity), frame, t in zip(damaged, frames, t_us.tolist(), strict=True):
        yield Pair(image, frame, opacity, np.zeros_like(frame), np.full((4, 4), np.nan), t)
