"""Pictures of a video or a folder of photographs that show where a car drives: the world moves in them, and the car itself is cut off."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import av
import cv2
import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F32, U8
from alpasim_plugin.drives.source import FEWEST
from alpasim_plugin.io.atomic import write_bytes
from alpasim_plugin.io.limits import SOURCE_BYTES
from alpasim_plugin.io.reading.files import check_regular, parsing, read_bytes
from alpasim_plugin.io.reading.images import check_image, decode_image, picture_fault

DOING = "finding the poses of photographs"
VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")
PHOTOGRAPHS = (".png", ".jpg", ".jpeg")
MOST, WIDTH_PX = 80, 1280  # pictures that are kept; their greatest width
SMALL_PX = 320  # width at which pictures are compared
BLACK = 8.0  # mean grey of a picture that shows nothing
MOVED_PX = 0.6  # at `SMALL_PX`, by which four of ten corners must have moved since the picture before
PERIOD_US = 100_000
KEPT_EDGE, WINDOW_PX = 0.8, 9  # share of its contrast that an edge of the own car keeps in the mean of all pictures; where it is looked for
CAR_SHARE, ROW_SHARE = 0.25, 0.03  # of the width that the own car covers where it is widest, and in its uppermost row
LOWEST = 0.5  # of the height: the own car ends below
Report = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class Frames:
    """Pictures that were written.

    Attributes:
        times: File name to microseconds.
        middle: ``(x, y)`` of the whole picture, pixels of the written ones: where a lens has its axis.
        notes: What was left out or assumed.
    """

    times: dict[str, int]
    middle: tuple[float, float]
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Shot:
    """A picture, small and grey, and what it is called."""

    number: int
    t_us: int
    small: U8


def files_of(path: Path) -> tuple[list[Path], bool]:
    """Return the videos, or else the photographs, that a path names, in order by name, and whether they are videos."""
    inside = sorted(path.iterdir()) if path.is_dir() else [path]
    videos = [one for one in inside if one.suffix.lower() in VIDEOS]
    return videos or [one for one in inside if path.is_dir() and one.suffix.lower() in PHOTOGRAPHS], bool(videos)


def write_frames(path: Path, out: Path, tell: Report) -> Frames:
    """Write the pictures that a way can be found from: at most `MOST`, in which the world moves, cut above the own car.

    Args:
        path: A video, or a folder of videos that follow each other, or of photographs.
        out: Receives the pictures.
        tell: Called as the work goes on.

    Raises:
        InputError: A file is damaged, photographs differ in size, or fewer than `FEWEST` pictures are left.
    """
    files, films = files_of(path)
    chosen, notes = _moving(files, films, tell)
    if len(chosen) < FEWEST:
        found = f"{len(chosen)} pictures that show something and in which the world moves"
        raise InputError(DOING, str(path), found, f"give at least {FEWEST}, of a car that drives: depth comes from moving")
    share = car_begins([one.small for one in chosen])
    if share < 1:
        notes.append(f"pictures are cut at {100 * share:.0f} % of their height: below is the own car, which moves with the camera")
    if not films:
        notes.append(f"no times: {1_000_000 // PERIOD_US} photographs a second are assumed")
    elif len(files) > 1:
        notes.append(f"{len(files)} videos in order by name, each taken to begin where the one before ends")
    times = {one.number: one.t_us for one in chosen}
    out.mkdir(parents=True, exist_ok=True)
    names: dict[str, int] = {}
    middle = (0.0, 0.0)
    for number, _, file, image in _pictures(files, films):
        if number in times:
            tell("writing frames", len(names), len(times))
            scale = min(1.0, WIDTH_PX / image.shape[1])
            middle = (scale * image.shape[1] / 2, scale * image.shape[0] / 2)
            names[_write(out, number, None if films else file, image, scale, share)] = times[number]
    return Frames(names, middle, tuple(notes))


def _write(out: Path, number: int, file: Path | None, image: U8, scale: float, share: float) -> str:
    """Write a picture, and return its name; a photograph that stays as it is keeps its file, which may say what lens took it."""
    if file is not None and scale == share == 1:
        shutil.copyfile(file, out / file.name)
        return file.name
    cut = image[: round(image.shape[0] * share)]
    small = cv2.resize(cut, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else cut
    name = f"{number:06d}.png" if file is None else f"{file.stem}.png"
    write_bytes(out / name, cv2.imencode(".png", small)[1].tobytes(), DOING)
    return name


def _moving(files: Sequence[Path], films: bool, tell: Report) -> tuple[list[_Shot], list[str]]:
    """Return at most `MOST` pictures between which the world moves, and what was left out."""
    chosen: list[_Shot] = []
    last: U8 | None = None
    black, standing, moving, every = 0, 0, 0, 1
    for number, t_us, _, image in _pictures(files, films):
        tell("reading frames", number, 0)
        small = np.asarray(cv2.cvtColor(_reduced(image), cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        if small.mean() < BLACK:
            black += 1
        elif last is not None and moved_px(last, small) < MOVED_PX:
            standing += 1
        else:
            last = small
            if moving % every == 0:
                chosen.append(_Shot(number, t_us, small))
            moving += 1
            if len(chosen) > 2 * MOST:  # a long film is thinned as it goes by, so that memory is bounded
                chosen, every = chosen[::2], 2 * every
    if len(chosen) > MOST:
        chosen, every = chosen[::2], 2 * every
    left_out = {"that are black": black, "in which the world hardly moves": standing}
    notes = [f"{count} pictures {which} were left out" for which, count in left_out.items() if count]
    return chosen, notes + [f"every {every}. picture of {moving} is used"] * (every > 1)


def _reduced(image: U8) -> U8:
    height = max(1, round(image.shape[0] * SMALL_PX / image.shape[1]))
    return np.asarray(cv2.resize(image, (SMALL_PX, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)


def moved_px(before: U8, after: U8) -> float:
    """Return how far, pixels, all but the four tenths of the corners that moved most have moved; far where none is found again."""
    corners = cv2.goodFeaturesToTrack(before, 200, 0.01, 6)
    if before.shape != after.shape or corners is None:
        return np.inf
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, corners.copy())
    steps = np.linalg.norm(there - corners, axis=2)[found > 0]
    return float(np.percentile(steps, 60)) if len(steps) else np.inf


def car_begins(shots: Sequence[U8]) -> float:
    """Return the share of the height above the own car: its edges stay where they are while the world moves; 1 where there is none.

    Args:
        shots: Grey pictures ``(H, W)`` of one size, between which the world moves.
    """
    stack = np.array(shots, dtype=np.float32)
    each = np.mean([_contrast(one) for one in stack], axis=0)
    kept = (_contrast(stack.mean(axis=0)) > KEPT_EDGE * each) & (each > BLACK)
    dense = cv2.boxFilter(kept.astype(np.float32), -1, (WINDOW_PX, WINDOW_PX)) > 0.5
    rows = dense.mean(axis=1)
    first = int(LOWEST * len(rows))
    if rows[first:].max() < CAR_SHARE:
        return 1.0
    top = first + int(np.argmax(rows[first:] > CAR_SHARE))
    while top > first and rows[top - 1] > ROW_SHARE:
        top -= 1
    return max(top - WINDOW_PX // 2, first) / len(rows)


def _contrast(image: F32) -> F32:
    return np.asarray(np.hypot(cv2.Sobel(image, cv2.CV_32F, 1, 0), cv2.Sobel(image, cv2.CV_32F, 0, 1)), dtype=np.float32)


def _pictures(files: Sequence[Path], films: bool) -> Iterator[tuple[int, int, Path, U8]]:
    """Yield number, microseconds, file and pixels (BGR) of all pictures."""
    if films:
        yield from _filmed(files)
        return
    first: tuple[int, int] | None = None
    for number, file in enumerate(files):
        data = read_bytes(file, DOING, SOURCE_BYTES)
        size = check_image(data, file, DOING)
        first = first or size
        fault = picture_fault(data) or (f"{size[0]}x{size[1]} pixels, others have {first[0]}x{first[1]}" if size != first else None)
        if fault:
            raise InputError(DOING, str(file), fault, "give whole photographs of one camera, PNG or JPEG in grey or RGB, as they were")
        yield number, number * PERIOD_US, file, decode_image(data, file, DOING, flag=cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)


def _filmed(files: Sequence[Path]) -> Iterator[tuple[int, int, Path, U8]]:
    number, start_us, last_us, step_us = 0, 0, 0, 0
    for file in files:
        check_regular(file, DOING)
        with parsing(DOING, file, "give a whole video that ffmpeg reads", "no readable video"), av.open(str(file)) as container:
            begins: float | None = None
            for frame in container.decode(container.streams.video[0]):
                begins = float(frame.time or 0.0) if begins is None else begins
                t_us = start_us + round(1e6 * (float(frame.time or 0.0) - begins))
                step_us, last_us = t_us - last_us, t_us
                yield number, t_us, file, np.asarray(frame.to_ndarray(format="bgr24"), dtype=np.uint8)
                number += 1
        start_us = last_us + step_us
