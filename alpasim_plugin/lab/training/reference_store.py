"""The recorded frames of a sequence of training pairs, beside its channels, and what carries them
into a frame's view.

ROOT/SPLIT/SEQUENCE/depth.npy                (T, H, W)    float16  metres as the render sees it; 0 where no surface is
                    actors.npy               (T, A, 4, 4) float64  T_world_box of every frame; NaN where an actor is absent
                    boxes.npy                (A, 3)       float64  length, width, height, metres
                    references/rgb.npy       (R, H, W, 3) uint8    recorded frames
                    references/depth.npy     (R, H, W)    float16  as the renderer sees it from their believed poses
                    references/T_world_camera.npy, t_us.npy, actors.npy
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.arrays import open_npy
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import F64, I64, U8, Actor, Box, RecordedFrame
from alpasim_plugin.fixers.ground import carry, with_users
from alpasim_plugin.fixers.references import ReferenceIndex
from alpasim_plugin.fixers.warp import RecordedImage, WarpTarget
from alpasim_plugin.lab.training.pair_store import PairSequence

FOLDER = "references"
F16 = npt.NDArray[np.float16]


class FrameGeometry(NamedTuple):
    """Depth ``(H, W)`` of a frame and the poses of the actors present."""

    depth: F16
    actors: Mapping[str, F64]


@dataclass(frozen=True, eq=False)
class SequenceReferences:
    """The recorded frames of one sequence, as memory maps."""

    K: F64
    T_rig_camera: F64  # (4, 4)
    T_world_camera: F64  # (T, 4, 4) of the frames
    t_us: I64
    depth: F16  # (T, H, W)
    actors: F64  # (T, A, 4, 4)
    boxes: F64  # (A, 3)
    rgb: U8  # (R, H, W, 3)
    rgb_depth: F16
    rgb_T_world_camera: F64
    rgb_t_us: I64
    rgb_actors: F64

    def index(self) -> ReferenceIndex:
        """Return the recorded frames by pose and time."""
        poses = zip(self.rgb_t_us, self.rgb_T_world_camera, strict=True)
        return ReferenceIndex([RecordedFrame(int(t), "", self.K, T, {}, _unread) for t, T in poses])

    def warped(self, frames: int, count: int, past: bool = False) -> Iterator[tuple[U8, ...]]:
        """Yield the references of the first frames, at most ``count`` each, as the closed loop
        gives them.
        """
        index = self.index()
        whole = slice(None)
        last: Sequence[int] = ()
        # Most are those of the frame before, as in a drive
        picture = lru_cache(count + 1)(self.picture)
        for i in range(frames):
            last = index.choose(self.T_world_camera[i], int(self.t_us[i]), count, last, past)
            target = self.target(i, self.K, whole, whole)
            yield carry([picture(j) for j in last], target, self.T_world_rig(i))

    def target(self, i: int, K: F64, rows: slice, columns: slice) -> WarpTarget:
        """Return a crop of frame ``i`` as a view; ``K`` is that of the crop."""
        depth = self.depth[i, rows, columns].astype(np.float32)
        return WarpTarget(K, self.T_world_camera[i], depth, _named(self.actors[i]), self.sizes)

    def T_world_rig(self, i: int) -> F64:
        """Return the pose of the rig at frame ``i``."""
        return self.T_world_camera[i] @ inverse(self.T_rig_camera)

    def picture(self, i: int) -> RecordedImage:
        """Return recorded frame ``i``."""
        depth = self.rgb_depth[i].astype(np.float32)
        picture = RecordedImage(
            self.K,
            self.rgb_T_world_camera[i],
            np.ascontiguousarray(self.rgb[i]),
            depth,
            _named(self.rgb_actors[i]),
        )
        return with_users(picture, self.sizes)

    @cached_property
    def sizes(self) -> dict[str, Box]:
        """Return the actors' boxes."""
        return {str(a): Box(*map(float, size)) for a, size in enumerate(self.boxes)}


def write_references(
    folder: Path,
    frames: Sequence[FrameGeometry],
    recorded: Sequence[RecordedFrame],
    actors: Sequence[Actor],
) -> None:
    """Write the recorded frames of a sequence into its folder.

    Args:
        folder: ROOT/SPLIT/SEQUENCE, being written.
        frames: Of the sequence, in order.
        recorded: What the renderer of the degraded frames declares, of the sequence's camera.
        actors: The scenario's.
    """
    (folder / FOLDER).mkdir()
    names = [actor.actor_id for actor in actors]
    boxes = [[a.box.length_m, a.box.width_m, a.box.height_m] for a in actors]
    read = [frame.read() for frame in recorded]
    arrays: dict[str, Any] = {
        "depth": np.stack([frame.depth for frame in frames]),
        "actors": _poses([frame.actors for frame in frames], names),
        "boxes": np.array(boxes, dtype=np.float64).reshape(-1, 3),
        f"{FOLDER}/rgb": np.stack([rgb for rgb, _ in read]),
        f"{FOLDER}/depth": np.stack([depth for _, depth in read]).astype(np.float16),
        f"{FOLDER}/T_world_camera": np.stack([frame.T_world_camera for frame in recorded]),
        f"{FOLDER}/t_us": np.array([frame.t_us for frame in recorded], dtype=np.int64),
        f"{FOLDER}/actors": _poses([frame.actors for frame in recorded], names),
    }
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array)


def open_references(sequence: PairSequence) -> SequenceReferences | None:
    """Return the recorded frames of a sequence; None where it has none.

    Raises:
        InputError: An array that is missing, or lengths that do not agree.
    """
    folder = sequence.folder
    if not (folder / FOLDER).is_dir():
        return None
    names = (
        "depth",
        "actors",
        "boxes",
        *(f"{FOLDER}/{name}" for name in ("rgb", "depth", "T_world_camera", "t_us", "actors")),
    )
    # Plain: faster
    opened = [
        np.asarray(open_npy(folder / f"{name}.npy", "run 'simrun train pairs' again"))
        for name in names
    ]
    clip = sequence.clip
    if len(opened[0]) < len(clip) or len({len(array) for array in opened[3:]}) != 1:
        raise InputError(
            f"{folder / FOLDER}: {len(opened[0])} depths of {len(clip)} frames, recorded frames {[len(array) for array in opened[3:]]}",
            "remove the folder and run 'simrun train pairs' again",
        )
    K, T_rig_camera = (
        np.array(sequence.info["camera"][name], dtype=np.float64) for name in ("K", "T_rig_camera")
    )
    return SequenceReferences(K, T_rig_camera, np.asarray(clip.T_world_camera), clip.t_us, *opened)


def _poses(frames: Sequence[Mapping[str, F64]], names: Sequence[str]) -> F64:
    absent = np.full((4, 4), np.nan)
    return np.array(
        [[frame.get(name, absent) for name in names] for frame in frames], dtype=np.float64
    ).reshape(-1, len(names), 4, 4)


def _named(poses: F64) -> dict[str, F64]:
    return {str(a): T for a, T in enumerate(poses) if np.isfinite(T[0, 0])}


def _unread() -> Any:
    raise AssertionError("the pixels of a sequence's recorded frames are read from its arrays")
