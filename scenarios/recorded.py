"""What a reader of recorded data returns, before it becomes a `Scenario`, and how recorded states become trajectories and actors."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from alpasim_plugin.core.types import (
    F64,
    I64,
    Actor,
    Box,
    CameraSpec,
    HeightField,
    LaneMap,
    Photograph,
    Route,
    Standing,
    Trajectory,
    Vehicle,
)
from scenarios.reading import SourceFiles


@dataclass(frozen=True)
class RecordedLog:
    """A map, a drive and the traffic around it, in metres around a local origin.

    The reader has subtracted ``world_origin`` from every coordinate, converted time to integer microseconds and put the ego's pose at
    the rear axle on the ground. ``notes`` says what it assumed or left out.
    """

    scene_id: str
    source: str  # yaml | argoverse | commonroad | cosmos | drive | usdz
    lane_map: LaneMap
    ground: HeightField
    ego_log: Trajectory  # rig poses, world
    vehicle: Vehicle
    actors: tuple[Actor, ...]
    cameras: tuple[CameraSpec, ...]  # empty where the source has no usable calibration
    world_origin: tuple[float, float, float]
    content_hash: str  # sha256 over the bytes that were read
    notes: tuple[str, ...] = ()
    first_frame_us: int | None = None  # when the first recorded camera frame ends, where the source says it
    alpasim_map: LaneMap | None = None  # the same road as AlpaSim's own loader reads it, where that differs
    route: Route | None = None  # None: the recorded path, carried on along the lanes
    recording: tuple[Photograph, ...] = ()  # see `Scenario.recording`
    model: str | None = None  # see `Scenario.model`
    standing: Standing = "known"


MAX_GAP_US = 500_000  # a track is not interpolated across a longer hole: it becomes two actors
STATIC_REACH_M = {"pedestrian": 0.5, "cyclist": 0.5, "motorcycle": 0.75}  # largest distance from the median position
STATIC_REACH_DEFAULT_M = 1.0  # annotated boxes of far parked cars drift by up to 0.8 m in 15 s
STATIC_SPEED_MPS = 0.3


def checked_trajectory(files: SourceFiles, path: Path | str, t_us: I64, xyz: F64, quat: F64, least: int = 1) -> Trajectory:
    """Build a trajectory after checking what every stage relies on; quaternions are normalised.

    Args:
        files: For the error's first part.
        path: The file the values came from.
        t_us: ``(T,)`` microseconds.
        xyz: ``(T, 3)`` metres.
        quat: ``(T, 4)`` wxyz.
        least: Fewest poses that make sense here.

    Raises:
        InputError: Too few poses, times that do not increase, values that are not finite, or quaternions far from unit length.
    """
    if len(t_us) < least:
        found = f"{len(t_us)} pose" + ("" if len(t_us) == 1 else "s")
        raise files.fail(path, found, f"use a recording with at least {least} poses")
    for name, values in (("positions", xyz), ("rotations", quat)):
        bad = ~np.isfinite(values).all(axis=1)
        if bad.any():
            raise files.fail(path, f"{name} that are not finite, first in row {int(np.argmax(bad))}", "repair or drop these rows")
    steps = np.diff(t_us)
    if (steps <= 0).any():
        row = int(np.argmax(steps <= 0)) + 1
        found = f"time {int(t_us[row])} us after {int(t_us[row - 1])} us in row {row}"
        raise files.fail(path, found, "sort the rows and drop repeated times")
    norms = np.linalg.norm(quat, axis=1)
    bad = np.abs(norms - 1.0) > 1e-2
    if bad.any():
        row = int(np.argmax(bad))
        raise files.fail(path, f"a quaternion of length {norms[row]:.3g} in row {row}", "give unit quaternions (w, x, y, z)")
    return Trajectory(np.ascontiguousarray(t_us, dtype=np.int64), np.ascontiguousarray(xyz), quat / norms[:, None])


def split_at_gaps(t_us: I64, max_gap_us: int = MAX_GAP_US) -> list[slice]:
    """Return the runs of a track's times ``(T,)`` that have no hole longer than ``max_gap_us``."""
    cuts = np.nonzero(np.diff(t_us) > max_gap_us)[0] + 1
    bounds = [0, *cuts.tolist(), len(t_us)]
    return [slice(a, b) for a, b in pairwise(bounds)]


def stands_still(t_us: I64, xyz: F64, label: str, fixed: bool = False) -> bool:
    """Return whether a track is that of a standing object, given the noise of annotated boxes.

    It stands if it never leaves its median position by more than its class's reach and that reach, over its duration, is slower than
    `STATIC_SPEED_MPS`; a glimpse too short to tell counts as moving. ``fixed`` classes (bollards, signs) stand whatever their duration.
    """
    reach = float(np.linalg.norm(xyz[:, :2] - np.median(xyz[:, :2], axis=0), axis=1).max())
    duration_s = float(t_us[-1] - t_us[0]) * 1e-6
    if reach > STATIC_REACH_M.get(label, STATIC_REACH_DEFAULT_M):
        return False
    return fixed or (duration_s > 0 and 2 * reach / duration_s < STATIC_SPEED_MPS)


def actors_of_track(actor_id: str, label: str, box: Box, track: Trajectory, fixed: bool = False) -> list[Actor]:
    """Make the actors of one recorded track: one, or one a run where the track has holes longer than `MAX_GAP_US`.

    Runs after the first are called ``ID~2``, ``ID~3``, ... so that no actor is interpolated across a gap in the recording.
    """
    actors: list[Actor] = []
    for run, part in enumerate(split_at_gaps(track.t_us), start=1):
        t, xyz, quat = track.t_us[part], track.xyz[part], track.quat[part]
        name = actor_id if run == 1 else f"{actor_id}~{run}"
        actors.append(Actor(name, label, box, Trajectory(t, xyz, quat), is_static=stands_still(t, xyz, label, fixed)))
    return actors
