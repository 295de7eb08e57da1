"""What all readers of recorded data share: source files, what a reader returns before it becomes a
`Scenario`, trajectories and actors.

Every failure names the file, and every byte read enters one hash.
"""

import hashlib
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pyarrow as pa

from alpasim_plugin.core import files as reading
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.arrow import read_arrow
from alpasim_plugin.core.files.fields import met_in
from alpasim_plugin.core.files.limits import COORDINATE_M, SOURCE_BYTES
from alpasim_plugin.core.files.reading import parse_xml
from alpasim_plugin.core.files.tables import Kind, check_columns
from alpasim_plugin.core.types import (
    F64,
    I64,
    Actor,
    Box,
    CameraSpec,
    HeightField,
    LaneMap,
    PathEndKind,
    Photograph,
    Route,
    Standing,
    Trajectory,
    Vehicle,
)

MAX_REACH_M = COORDINATE_M.high

MAX_GAP_US = 500_000  # a track is not interpolated across a longer hole: it becomes two actors
# Largest distance from the median position.
STATIC_REACH_M = {
    "pedestrian": 0.5,
    "cyclist": 0.5,
    "motorcycle": 0.75,
}
STATIC_REACH_DEFAULT_M = 1.0  # annotated boxes of far parked cars drift by up to 0.8 m in 15 s
STATIC_SPEED_MPS = 0.3


def near(location: Path | str, xyz: F64) -> F64:
    """Return local points ``(..., 3)`` after checking that they are finite and within `MAX_REACH_M`
    of the origin.
    """
    distance = float(np.abs(xyz).max(initial=0.0))  # NaN stays NaN
    if not distance <= MAX_REACH_M:
        fault = f"a point {distance / 1000:.1f} km from the drive"
        raise InputError(f"{location}: {fault}", "repair the coordinates of this file")
    return xyz


class SourceFiles:
    """Reads the files of one recorded log and hashes what it read.

    Attributes:
        met: Names of the fields of the files that were read, for `Fields.notes`.
    """

    def __init__(self) -> None:
        self._hash = hashlib.sha256()
        self.met: list[str] = []

    @property
    def content_hash(self) -> str:
        """Return the sha256 over names and bytes of all files read so far, in reading order."""
        return self._hash.hexdigest()

    def only(self, folder: Path, patterns: tuple[str, ...], description: str) -> Path:
        """Return the one file of a folder that matches one of the glob patterns, the first pattern
        with a match deciding.

        Raises:
            InputError: There is none, or more than one.
        """
        if not os.path.isdir(folder):
            raise InputError(
                f"{folder}: no such folder", f"give the folder that holds {description}"
            )
        for pattern in patterns:
            matches = sorted(folder.glob(pattern))
            if len(matches) == 1:
                return matches[0]
            if matches:
                names = ", ".join(f.name for f in matches[:3])
                raise InputError(
                    f"{folder}: {len(matches)} files match {pattern}: {names}",
                    f"keep exactly one file with {description}",
                )
        raise InputError(
            f"{folder}: no file {' or '.join(patterns)}", f"add the file with {description}"
        )

    def read_bytes(self, path: Path) -> bytes:
        """Read a whole file.

        Raises:
            InputError: It is missing, no file, empty, too large or unreadable.
        """
        data = reading.read_bytes(path, SOURCE_BYTES)
        if not data:
            raise InputError(f"{path}: an empty file", "fetch the file again")
        self.note_bytes(path.name, data)
        return data

    def note_bytes(self, name: str, data: bytes) -> None:
        """Enter bytes that were read under a name into the hash."""
        self._hash.update(f"{name}:{len(data)}\n".encode())
        self._hash.update(data)

    def read_json(self, path: Path) -> Any:
        """Read a JSON document."""
        return reading.parse_json(self.read_bytes(path), path)

    def read_feather(
        self, path: Path, columns: Mapping[str, Kind], holder: str = ""
    ) -> dict[str, np.ndarray[Any, Any]]:
        """Read columns of a feather file (Arrow IPC).

        Args:
            path: The file.
            columns: Columns that must be there, by type.
            holder: Name under which the file's columns are entered into `met`; nothing enters none.

        Raises:
            InputError: The file is damaged or truncated, lacks a column, or has one of another type
                or with empty values.
        """
        data = self.read_bytes(path)
        do = "fetch the file again; it may be truncated"
        with reading.parsing(path, do, "no readable Arrow IPC file"):
            table = read_arrow(pa.py_buffer(data), path)
        check_columns(table, columns, path, "use a file of the Argoverse 2 sensor set")
        if holder:
            self.met += met_in(holder, table.column_names)
        nulls = next((name for name in columns if table.column(name).null_count), None)
        if nulls is not None:
            raise InputError(
                f"{path}: column {nulls!r} with empty values", "repair or drop these rows"
            )
        return {column: table.column(column).to_numpy(zero_copy_only=False) for column in columns}

    def read_xml(self, path: Path) -> ElementTree.Element:
        """Parse an XML document; a DOCTYPE is refused, so no entity can be defined or expanded.

        Raises:
            InputError: The document is malformed or truncated, or declares a DOCTYPE.
        """
        return parse_xml(self.read_bytes(path), path)


@dataclass(frozen=True)
class RecordedLog:
    """A map, a drive and the traffic around it, in metres around a local origin.

    The reader has subtracted ``world_origin`` from every coordinate, converted time to integer
    microseconds and put the ego's pose at the rear axle on the ground. ``notes`` says what it
    assumed or left out.
    """

    scene_id: str
    source: str  # yaml | argoverse | commonroad | drive | osi | usdz
    lane_map: LaneMap
    ground: HeightField
    ego_log: Trajectory  # rig poses, world
    vehicle: Vehicle
    actors: tuple[Actor, ...]
    cameras: tuple[CameraSpec, ...]  # empty where the source has no usable calibration
    world_origin: tuple[float, float, float]
    content_hash: str  # sha256 over the bytes that were read
    notes: tuple[str, ...] = ()
    first_frame_us: int | None = (
        None  # when the first recorded camera frame ends, where the source says it
    )
    alpasim_map: LaneMap | None = (
        None  # the same road as AlpaSim's own loader reads it, where that differs
    )
    route: Route | None = None  # None: the recorded path, carried on along the lanes
    recording: tuple[Photograph, ...] = ()  # see `Scenario.recording`
    model: str | None = None  # see `Scenario.model`
    standing: Standing = "known"
    path_beyond: F64 | None = None  # None: what the lanes of the map behind the drive say
    path_end: PathEndKind = "record"
    # last time of the scene, up to which its traffic is known, where the ego's drive has ended before
    # at its goal; None: the scene ends with that drive
    goes_on_until_us: int | None = None


def checked_trajectory(
    path: Path | str, t_us: I64, xyz: F64, quat: F64, least: int = 1
) -> Trajectory:
    """Build a trajectory after checking what every stage relies on; quaternions are normalised.

    Args:
        path: The file the values came from.
        t_us: ``(T,)`` microseconds.
        xyz: ``(T, 3)`` metres.
        quat: ``(T, 4)`` wxyz.
        least: Fewest poses that make sense here.

    Raises:
        InputError: Too few poses, times that do not increase, values that are not finite, or
            quaternions far from unit length.
    """
    if len(t_us) < least:
        fault = f"{len(t_us)} pose" + ("" if len(t_us) == 1 else "s")
        raise InputError(f"{path}: {fault}", f"use a recording with at least {least} poses")
    norms = np.linalg.norm(quat, axis=1)
    checks = {
        "a position that is not finite": ~np.isfinite(xyz).all(axis=1),
        "a rotation that is not finite": ~np.isfinite(norms),
        "a time that is not after the one before it": np.diff(t_us, prepend=t_us[:1] - 1) <= 0,
        "a quaternion that is not of unit length": np.abs(norms - 1.0) > 1e-2,
    }
    for fault, bad in checks.items():
        if bad.any():
            row = int(np.argmax(bad))
            raise InputError(f"{path}: {fault} in row {row}", "repair or drop these rows")
    return Trajectory(
        np.ascontiguousarray(t_us, dtype=np.int64), np.ascontiguousarray(xyz), quat / norms[:, None]
    )


def stands_still(t_us: I64, xyz: F64, label: str, fixed: bool) -> bool:
    """Return whether a track is that of a standing object, given the noise of annotated boxes.

    It stands if it never leaves its median position by more than its class's reach and that reach,
    over its duration, is slower than `STATIC_SPEED_MPS`; a glimpse too short to tell counts as
    moving. ``fixed`` classes (bollards, signs) stand whatever their duration.
    """
    reach = float(np.linalg.norm(xyz[:, :2] - np.median(xyz[:, :2], axis=0), axis=1).max())
    duration_s = float(t_us[-1] - t_us[0]) * 1e-6
    if reach > STATIC_REACH_M.get(label, STATIC_REACH_DEFAULT_M):
        return False
    return fixed or (duration_s > 0 and 2 * reach / duration_s < STATIC_SPEED_MPS)


def actors_of_track(
    actor_id: str, label: str, box: Box, track: Trajectory, fixed: bool = False
) -> list[Actor]:
    """Make the actors of one recorded track: one, or one a run where the track has holes longer
    than `MAX_GAP_US`.

    Runs after the first are called ``ID~2``, ``ID~3``, ... so that no actor is interpolated across
    a gap in the recording.
    """
    cuts = np.nonzero(np.diff(track.t_us) > MAX_GAP_US)[0] + 1
    columns = (np.split(column, cuts) for column in (track.t_us, track.xyz, track.quat))
    actors = []
    for run, (t, xyz, quat) in enumerate(zip(*columns, strict=True), start=1):
        name = actor_id if run == 1 else f"{actor_id}~{run}"
        part = Trajectory(t, xyz, quat)
        still = stands_still(t, xyz, label, fixed)
        actors.append(Actor(name, label, box, part, is_static=still))
    return actors
