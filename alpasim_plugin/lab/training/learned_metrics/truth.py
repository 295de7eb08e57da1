"""What the simulator knows about a frame: lane lines on the ground, and the boxes of vehicles, both
seen from the camera.

Lane lines are the painted lines of the map; a double line is one line. Their ends are joined where
they meet, so that a line that the map cuts at a junction of roads is one instance. A line that
turns back is cut where it does. Occlusion of lines is ignored.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from alpasim_plugin.core.geometry import inverse, resample, transform_points
from alpasim_plugin.core.types import F64, CameraSpec, LaneMap, Scenario
from alpasim_plugin.gaussians.scene.degrade import log_actors
from alpasim_plugin.lab.learned_metrics.types import (
    FORWARD_M,
    NEAREST_CORNER_M,
    Cuboid,
    Lane3D,
    hull_pixels,
)
from alpasim_plugin.world.paint import painted_lines

VEHICLES = ("car", "truck", "bus")
FARTHEST_M = 60.0  # of a labelled vehicle
LEAST_VISIBLE = 0.2  # share of a vehicle's outline
LEAST_PX = 8  # area of a labelled vehicle's outline
JOIN_M, JOIN_COS = 0.6, 0.9  # lines whose ends are this near and point the same way are one
STEP_M = 1.0


def world_lines(lane_map: LaneMap) -> list[F64]:
    """Return the painted lines of a map, each ``(N, 3)`` metres, world; ends that meet are
    joined.
    """
    lines = [xyz for xyz, _ in painted_lines(lane_map)]
    out: list[F64] = []
    while lines:
        line = lines.pop(0)
        while (found := _continuation(line, lines)) is not None:
            index, line = found
            del lines[index]
        out.append(line)
    return out


def _continuation(line: F64, others: Sequence[F64]) -> tuple[int, F64] | None:
    """Return which other line goes on where this one ends or begins, and the two as one."""
    for i, other in enumerate(others):
        for a, b in ((line, other), (line, other[::-1]), (other, line), (other[::-1], line)):
            if (
                np.linalg.norm(a[-1] - b[0]) < JOIN_M
                and _direction(a[-2:]) @ _direction(b[:2]) > JOIN_COS
            ):
                return i, np.concatenate([a, b[1:]])
    return None


def _direction(ends: F64) -> F64:
    step = ends[1, :2] - ends[0, :2]
    return np.asarray(step / max(float(np.linalg.norm(step)), 1e-9))


def lanes_seen(lines: Sequence[F64], T_world_rig: F64, camera: CameraSpec) -> list[Lane3D]:
    """Return the lane lines in a camera's field of view, in the rig frame, with score 1.

    Args:
        lines: As `world_lines` gives them.
        T_world_rig: Pose of the rig.
        camera: Its lens and mounting.
    """
    out = []
    for line in lines:
        if np.linalg.norm(line[:, :2] - T_world_rig[:2, 3], axis=1).min() > 2 * FORWARD_M[-1] + 80:
            continue
        length = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
        dense = resample(line, np.linspace(0.0, length, max(2, round(length / STEP_M) + 1)))
        at = transform_points(inverse(T_world_rig), dense)
        for part in _monotone(at):
            lateral = np.interp(FORWARD_M, part[:, 0], part[:, 1], left=np.nan, right=np.nan)
            height = np.interp(FORWARD_M, part[:, 0], part[:, 2])
            points = np.stack([FORWARD_M, np.nan_to_num(lateral), height], axis=1)
            visible = np.isfinite(lateral) & in_view(points, camera)
            if visible.any():
                out.append(Lane3D(np.where(visible, lateral, np.nan), 1.0))
    return out


def _monotone(at: F64) -> list[F64]:
    """Cut a line ``(N, 3)`` in the rig frame where its forward direction turns; parts run away from
    the rig.
    """
    sign = np.sign(np.diff(at[:, 0]))
    cuts = np.flatnonzero(np.diff(sign) != 0) + 1
    parts = [at[a : b + 1] for a, b in zip([0, *cuts], [*cuts, len(at) - 1], strict=True)]
    return [
        part if part[-1, 0] > part[0, 0] else part[::-1]
        for part in parts
        if abs(part[-1, 0] - part[0, 0]) > 1e-6
    ]


def in_view(points: F64, camera: CameraSpec) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Return which points ``(N, 3)`` of the rig frame fall into the image."""
    at = transform_points(inverse(camera.T_rig_camera), points)
    ahead = at[:, 2] > NEAREST_CORNER_M
    uv = (at @ camera.K.T)[:, :2] / np.where(ahead, at[:, 2], 1.0)[:, None]
    return np.asarray(
        ahead & (uv >= 0).all(axis=1) & (uv[:, 0] < camera.width) & (uv[:, 1] < camera.height)
    )


def vehicles_seen(
    scenario: Scenario, t_us: int, T_world_camera: F64, camera: CameraSpec
) -> list[Cuboid]:
    """Return the vehicles inside 60 m of which the camera sees at least a fifth, with score 1;
    nearer ones hide farther ones.
    """
    return visible_cuboids(
        vehicle_cuboids(scenario, log_actors(scenario, t_us), T_world_camera), camera
    )


def vehicle_cuboids(
    scenario: Scenario, poses: Mapping[str, F64], T_world_camera: F64
) -> list[Cuboid]:
    """Return the boxes of all vehicles in the camera's axes."""
    T_camera_world, out = inverse(T_world_camera), []
    for actor in scenario.actors:
        if actor.actor_id not in poses or actor.label not in VEHICLES:
            continue
        T = T_camera_world @ poses[actor.actor_id]
        x, y, z = (float(v) for v in T[:3, 3])
        yaw = float(np.arctan2(-T[2, 0], T[0, 0]))
        box = actor.box
        out.append(Cuboid(actor.label, 1.0, x, y, z, box.length_m, box.height_m, box.width_m, yaw))
    return out


def visible_cuboids(cuboids: Sequence[Cuboid], camera: CameraSpec) -> list[Cuboid]:
    """Return the boxes inside 60 m, in order of depth, of whose outline at least a fifth is in the
    image and not behind another box.
    """
    size = camera.height, camera.width
    taken = np.zeros(size, dtype=bool)
    out = []
    for cuboid in sorted(cuboids, key=lambda c: c.z_m):
        hull = hull_pixels(cuboid, camera.K)
        if hull is None or cuboid.z_m > FARTHEST_M:
            continue
        mask = np.zeros(size, dtype=np.uint8)
        cv2.fillConvexPoly(mask, np.rint(hull - 0.5).astype(np.int32), 1)
        seen = int((mask.astype(bool) & ~taken).sum())
        taken |= mask.astype(bool)
        if seen >= max(LEAST_PX, LEAST_VISIBLE * float(cv2.contourArea(hull.astype(np.float32)))):
            out.append(cuboid)
    return out
