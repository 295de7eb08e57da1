"""What a reader of recorded data returns, before it becomes a `Scenario`."""

from __future__ import annotations

from dataclasses import dataclass

from alpasim_plugin.core.types import Actor, CameraSpec, HeightField, LaneMap, Trajectory, Vehicle


@dataclass(frozen=True)
class RecordedLog:
    """A map, a drive and the traffic around it, in metres around a local origin.

    The reader has subtracted ``world_origin`` from every coordinate, converted time to integer microseconds and put the ego's pose at
    the rear axle on the ground. ``notes`` says what it assumed or left out.
    """

    scene_id: str
    source: str  # argoverse | commonroad | cosmos | usdz
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
