"""Import training pairs from videos, image folders or arrays of each channel, and camera poses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.reading import parsing, read_json
from alpasim_plugin.core.reading.arrays import open_npy
from alpasim_plugin.core.reading.images import read_image
from alpasim_plugin.core.types import F64, U8
from alpasim_plugin.lab.training.pair_store import Pair, write_sequence
from alpasim_plugin.log.video import VideoReader

DOING = "importing training pairs"
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")
CHANNELS = ("rgb_input", "rgb_gt", "opacity", "sdmap")
ORTHONORMAL = 1e-3  # tolerance of rotation matrices, for files with few digits


@dataclass(frozen=True)
class PairSources:
    """Paths of the channels of one sequence.

    Args:
        rgb_input: Degraded renders: an mp4 file, a folder of .png or .jpg (in order of name), or a
            .npy array.
        rgb_gt: Clean frames, likewise.
        opacity: Accumulated opacity with the sky filled (OneFixer, App. A), white is opaque,
            likewise.
        sdmap: Semantic map, likewise.
        poses: Camera poses in the world, OpenCV axes: a .npy array ``(T, 4, 4)``, or JSON: a list
            of 4 x 4 matrices, or of ``{"T_world_camera": [[...]], "t_us": 0}``.
    """

    rgb_input: Path
    rgb_gt: Path
    opacity: Path
    sdmap: Path
    poses: Path


def import_sequence(
    sources: PairSources,
    folder: Path,
    *,
    fps: float,
    size: tuple[int, int] | None = None,
    facts: Mapping[str, Any] | None = None,
) -> int:
    """Write one sequence of pairs; it is as long as its shortest channel.

    Args:
        sources: The files; frame i of each belongs to pose i.
        folder: ROOT/SPLIT/SEQUENCE; replaced if it exists.
        fps: Frames per second, for poses without times.
        size: (width, height) to which every image is scaled; None requires channels of one size.
        facts: Further entries of sequence.json.

    Returns:
        Frames written.

    Raises:
        InputError: An unreadable file, invalid poses, a channel without frames, or channels of
            different size without ``size``.
    """
    T, t_us = read_poses(sources.poses, fps)
    named = {name: getattr(sources, name) for name in CHANNELS}
    found = {
        name: (first, length)
        for name, path in named.items()
        for first, length in [_first_and_count(path)]
    }
    if size is None:
        shapes = {name: first.shape[1::-1] for name, (first, _) in found.items()}
        if len(set(shapes.values())) > 1:
            listed = ", ".join(f"{name} {w} x {h}" for name, (w, h) in shapes.items())
            raise InputError(
                f"{folder.name}: channels of different size: {listed}",
                "give --size WIDTHxHEIGHT to scale them to one",
            )
    length = min(len(T), *(count for _, count in found.values()))
    if length == 0:
        raise InputError(
            f"{folder.name}: no frame that every channel has", "give channels of the same drive"
        )
    counts = {**{name: count for name, (_, count) in found.items()}, "poses": len(T)}
    info = {
        "family": "imported",
        **(facts or {}),
        "sources": {n: str(p) for n, p in named.items()},
        "source_frames": counts,
    }
    write_sequence(folder, _pairs(named, T, t_us, length, size), length, info)
    return length


def read_poses(path: Path, fps: float) -> tuple[F64, list[int]]:
    """Return camera poses ``(T, 4, 4)`` in the world and their times, microseconds.

    Raises:
        InputError: Not a readable file of poses, or a matrix that is not a rigid transform.
    """
    if fps <= 0:
        raise InputError(f"--fps: {fps}", "give a positive rate")
    with parsing(path, "give .npy (T, 4, 4), or JSON with a 4 x 4 matrix a frame", "no poses"):
        if path.suffix == ".npy":
            T, times = np.asarray(open_npy(path), dtype=np.float64), None
        else:
            rows = read_json(path)
            with_times = bool(rows) and isinstance(rows[0], dict)
            T = np.array([r["T_world_camera"] if with_times else r for r in rows], dtype=np.float64)
            times = [int(r["t_us"]) for r in rows] if with_times and "t_us" in rows[0] else None
    if T.ndim != 3 or T.shape[1:] != (4, 4) or not len(T):
        raise InputError(f"{path}: an array of shape {T.shape}", "give one 4 x 4 matrix a frame")
    off = np.abs(T[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    bad = (
        ~np.isfinite(T).all(axis=(1, 2))
        | ~(off < ORTHONORMAL)
        | (np.linalg.det(np.nan_to_num(T[:, :3, :3])) < 0)
    )
    with np.errstate(invalid="ignore"):
        bad |= ~(
            np.abs(T[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1) < ORTHONORMAL
        )  # a transposed pose has its translation in this row
    if bad.any():
        raise InputError(
            f"{path}: pose {int(np.argmax(bad))} is not a rigid transform",
            "give T_world_camera (columns: axes, then position), metres, OpenCV axes",
        )
    if times is None:
        times = [round(i / fps * 1e6) for i in range(len(T))]
    if any(b <= a for a, b in pairwise(times)):
        raise InputError(
            f"{path}: times that do not increase",
            "sort the poses by time, or remove the times",
        )
    return T, times


def read_frames(path: Path) -> Iterator[U8]:
    """Yield the images ``(H, W, 3)`` of a channel one at a time.

    Raises:
        InputError: A missing path, or an unsupported format.
    """
    if path.is_dir():
        files = sorted(p for p in path.iterdir() if p.suffix.lower() in IMAGE_SUFFIXES)
        if not files:
            raise InputError(
                f"{path}: a folder without images",
                f"put {', '.join(IMAGE_SUFFIXES)} there, named in order",
            )
        for file in files:
            image = read_image(file, "write it again as PNG or JPEG")
            yield np.ascontiguousarray(image[..., ::-1]).astype(np.uint8)
    elif path.suffix == ".npy":
        yield from _array_frames(path)
    elif path.is_file():
        with VideoReader(path) as video:
            for frame in video:
                yield frame.image
    else:
        raise InputError(
            f"{path}: no such file or folder",
            "give a video, a folder of images or a .npy array",
        )


def _array_frames(path: Path) -> Iterator[U8]:
    array = open_npy(path, "give a complete .npy array")
    if (
        array.dtype != np.uint8
        or array.ndim not in (3, 4)
        or (array.ndim == 4 and array.shape[3] not in (1, 3))
    ):
        raise InputError(
            f"{path}: {array.dtype} {array.shape}", "give uint8 (T, H, W) or (T, H, W, 3)"
        )
    for image in array:
        colour = image if image.ndim == 3 else image[..., None]
        yield np.ascontiguousarray(np.broadcast_to(colour, (*colour.shape[:2], 3)))


def _first_and_count(path: Path) -> tuple[U8, int]:
    """Return the first image and the number of images; videos are decoded to the end to count
    frames.
    """
    frames = read_frames(path)
    first = next(frames, None)
    if first is None:
        raise InputError(f"{path}: no frame", "give a channel with images")
    return first, 1 + sum(1 for _ in frames)


def _pairs(
    named: Mapping[str, Path], T: F64, t_us: list[int], length: int, size: tuple[int, int] | None
) -> Iterator[Pair]:
    streams = {name: read_frames(path) for name, path in named.items()}
    for i in range(length):
        images = {name: _scaled(next(stream), size) for name, stream in streams.items()}
        opacity = cv2.cvtColor(images["opacity"], cv2.COLOR_RGB2GRAY)
        yield Pair(
            images["rgb_input"],
            images["rgb_gt"],
            np.asarray(opacity, dtype=np.uint8),
            images["sdmap"],
            T[i],
            t_us[i],
        )


def _scaled(image: U8, size: tuple[int, int] | None) -> U8:
    if size is None or image.shape[1::-1] == size:
        return image
    smaller = size[0] * size[1] < image.shape[0] * image.shape[1]
    return np.asarray(
        cv2.resize(image, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR),
        dtype=np.uint8,
    )
