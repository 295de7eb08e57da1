"""Training pairs on disk: one folder per sequence, one array file per channel, memory-mapped,
readable while more are written.

    ROOT/SPLIT/SEQUENCE/rgb_input.npy        (T, H, W, 3) uint8   degraded render
                        rgb_gt.npy           (T, H, W, 3) uint8   clean frame
                        opacity.npy          (T, H, W)    uint8   accumulated opacity of the render, 255 is opaque
                        sdmap.npy            (T, H, W, 3) uint8   semantic map
                        T_world_camera.npy   (T, 4, 4)    float64
                        t_us.npy             (T,)         int64
                        sequence.json        scene, family, camera, recipe; written last: a folder without it is incomplete

Channels may differ in length; a sequence is as long as its shortest one.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import read_json_object
from alpasim_plugin.core.files.arrays import open_npy
from alpasim_plugin.core.files.atomic import atomic_folder, restore_folder, restore_folders
from alpasim_plugin.core.types import F64, I64, U8

SEQUENCE_FILE = "sequence.json"
CONTENT = "content"
OPEN_CLIPS = (
    100  # at a time; each holds a file for every channel, and a process may often open 1024
)


class Pair(NamedTuple):
    """One frame of a sequence: images ``(H, W, 3)``, opacity ``(H, W)`` uint8, pose ``(4, 4)``,
    microseconds.
    """

    rgb_input: U8
    rgb_gt: U8
    opacity: U8
    sdmap: U8
    T_world_camera: F64
    t_us: int


@dataclass(frozen=True)
class PairClip:
    """Consecutive frames; arrays as in the files, possibly read-only memory maps."""

    rgb_input: U8
    rgb_gt: U8
    opacity: U8
    sdmap: U8
    T_world_camera: F64
    t_us: I64

    def __len__(self) -> int:
        return len(self.t_us)

    def cut(self, start: int, frames: int) -> Self:
        """Return ``frames`` frames from ``start``.

        Raises:
            InputError: The clip is shorter.
        """
        if not 0 <= start <= len(self) - frames:
            raise InputError(
                f"frames {start} to {start + frames}: the sequence has {len(self)}",
                "ask for fewer frames",
            )
        return type(self)(
            **{f.name: getattr(self, f.name)[start : start + frames] for f in fields(self)}
        )


CHANNELS = tuple(f.name for f in fields(PairClip))
_FORMS: dict[str, tuple[int, str]] = {
    "rgb_input": (4, "uint8"),
    "rgb_gt": (4, "uint8"),
    "opacity": (3, "uint8"),
    "sdmap": (4, "uint8"),
    "T_world_camera": (3, "float64"),
    "t_us": (1, "int64"),
}


class PairSequence:
    """A complete sequence on disk; its arrays are opened on first use.

    Raises:
        InputError: A channel is missing, of another type or size, or empty.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        path = folder / SEQUENCE_FILE
        self.info: dict[str, Any] = read_json_object(
            path, do_this="give a folder that 'simrun train pairs' finished"
        )
        self._file = _identity(path)

    @property
    def is_current(self) -> bool:
        """Tell whether its folder is still the one that was read, not one that has replaced it."""
        return _identity(self.folder / SEQUENCE_FILE) == self._file

    @property
    def name(self) -> str:
        """Name of the sequence's folder."""
        return self.folder.name

    @cached_property
    def content(self) -> str:
        """Digest of its arrays, which identifies the data."""
        return str(self.info.get(CONTENT) or _content(self.folder))

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of its images, pixels."""
        height, width = self.clip.rgb_gt.shape[1:3]
        return width, height

    @property
    def clip(self) -> PairClip:
        """The frames that every channel has, as memory maps; they are closed when many other
        sequences have been used since.
        """
        return _opened(self)

    def _open(self, name: str) -> Any:
        path = self.folder / f"{name}.npy"
        axes, dtype = _FORMS[name]
        array = open_npy(path, "give a complete .npy file of this channel")
        if array.ndim != axes or array.dtype != np.dtype(dtype):
            raise InputError(
                f"{path}: {array.dtype} with {array.ndim} axes",
                f"give {dtype} with {axes} axes (docs/lab/training.md)",
            )
        return array


def _identity(path: Path) -> tuple[int, ...]:
    """Return what tells a file from one that has taken its place; nothing of one that is not there."""
    try:
        state = path.stat()
    except FileNotFoundError:
        return ()
    return state.st_dev, state.st_ino, state.st_mtime_ns


@lru_cache(maxsize=OPEN_CLIPS)
def _opened(sequence: PairSequence) -> PairClip:
    arrays = {name: sequence._open(name) for name in CHANNELS}
    size = arrays["rgb_gt"].shape[1:3]
    for name in ("rgb_input", "opacity", "sdmap"):
        if arrays[name].shape[1:3] != size:
            raise InputError(
                f"{sequence.folder}: {name} is {arrays[name].shape[1:3]}, rgb_gt {size}",
                "make all of one size",
            )
    length = min(len(a) for a in arrays.values())
    if length == 0:
        raise InputError(
            f"{sequence.folder}: no frame that every channel has",
            "remove the folder and run 'simrun train pairs' again",
        )
    return PairClip(**{name: a[:length] for name, a in arrays.items()})


def is_made(folder: Path, info: Mapping[str, Any]) -> bool:
    """Return whether a folder holds a complete sequence that was made in the same way: its
    sequence.json agrees with ``info``.
    """
    restore_folder(folder)
    path = folder / SEQUENCE_FILE
    if not path.exists():
        return False
    document = read_json_object(path, do_this=f"remove {folder}; it is made again")
    return all(document.get(key) == value for key, value in info.items())


class PairDataset:
    """The complete sequences of one split, in order of name; `refresh` finds new ones.

    Args:
        root: Folder of pairs.
        split: One of its folders.
        size: Width and height, pixels: sequences of other sizes are left out.

    Raises:
        InputError: No such split, no complete sequence in it, or none of that size.
    """

    def __init__(self, root: Path | str, split: str, size: tuple[int, int] | None = None) -> None:
        self.folder = Path(root) / split
        self.size = size
        self.sequences: tuple[PairSequence, ...] = ()
        self.refresh()

    def refresh(self) -> None:
        """Find new sequences, and those that were made again."""
        by_name = {s.name: s for s in self.sequences if s.is_current}
        restore_folders(self.folder)
        finished = sorted(
            p.parent
            for p in self.folder.glob(f"*/{SEQUENCE_FILE}")
            if not p.parent.name.startswith(".")
        )
        if not finished:
            raise InputError(
                f"{self.folder}: no finished sequence",
                "make some with 'simrun train pairs'",
            )
        complete = tuple(by_name.get(f.name) or PairSequence(f) for f in finished)
        self.sequences = tuple(s for s in complete if self.size in (None, s.size))
        if self.size is not None and not self.sequences:
            raise InputError(
                f"{self.folder}: no sequence of {self.size[0]}x{self.size[1]}; there are {listed_sizes(complete)}",
                "choose one of these sizes",
            )

    def __len__(self) -> int:
        return len(self.sequences)


def listed_sizes(sequences: Iterable[PairSequence]) -> str:
    """Return the image sizes of sequences with the number of each, the most frequent first, for
    errors.
    """
    counts = Counter(sequence.size for sequence in sequences)
    return ", ".join(f"{width}x{height} ({n})" for (width, height), n in counts.most_common())


def pairs_digest(sequences: Sequence[PairSequence]) -> str:
    """Return a digest of the names and arrays of sequences, in order."""
    return hashlib.blake2b(
        "\n".join(f"{s.name} {s.content}" for s in sequences).encode(), digest_size=8
    ).hexdigest()


def write_sequence(
    folder: Path,
    frames: Iterable[Pair],
    length: int,
    info: Mapping[str, Any],
    beside: Callable[[Path], None] | None = None,
) -> None:
    """Write a sequence atomically.

    Args:
        folder: ROOT/SPLIT/SEQUENCE; replaced if it exists.
        frames: At most ``length`` frames of one size, consumed one at a time.
        length: Frames to allocate.
        info: Contents of sequence.json.
        beside: Writes what lies beside the channels into the folder, after the last frame.

    Raises:
        InputError: No frame, or frames of changing size.
        InfrastructureError: The disk refuses.
    """
    with atomic_folder(folder) as partial:
        count = _write_arrays(partial, frames, length)
        if beside is not None:
            beside(partial)
        write_info(partial, {**info, "frames": count})


def write_info(folder: Path, info: Mapping[str, Any]) -> None:
    """Write sequence.json beside the arrays of a sequence, with their digest."""
    document = {**info, CONTENT: _content(folder)}
    (folder / SEQUENCE_FILE).write_text(
        json.dumps(document, indent=1, default=str) + "\n", encoding="utf-8"
    )


def _content(folder: Path) -> str:
    out = hashlib.blake2b(digest_size=16)
    for name in CHANNELS:
        try:
            with (folder / f"{name}.npy").open("rb") as file:
                out.update(hashlib.file_digest(file, "sha256").digest())
        except OSError as error:
            raise InputError(
                f"{folder / f'{name}.npy'}: {error}",
                "give a complete .npy file of this channel",
            ) from error
    return out.hexdigest()


def _write_arrays(folder: Path, frames: Iterable[Pair], length: int) -> int:
    arrays: dict[str, Any] = {}
    count = 0
    for count, frame in enumerate(frames, start=1):
        for name, value in frame._asdict().items():
            item = np.asarray(value)
            if name not in arrays:
                shape = (length, *item.shape)
                arrays[name] = np.lib.format.open_memmap(
                    folder / f"{name}.npy", mode="w+", dtype=_FORMS[name][1], shape=shape
                )
            if arrays[name].shape[1:] != item.shape or count > length:
                raise InputError(
                    f"{folder}: frame {count} of {length}: {name} {item.shape}, the first is {arrays[name].shape[1:]}",
                    "give frames of one size, no more than announced",
                )
            arrays[name][count - 1] = item
    if not count:
        raise InputError(f"{folder}: no frames", "give at least one")
    for name, array in arrays.items():
        array.flush()
        if count < length:  # the header has ``length``: write the array again with its true length
            short = np.array(array[:count])
            del array
            np.save(folder / f"{name}.npy", short)
    return count
