"""Footprints of recorded drives, written out plainly for tests."""

from __future__ import annotations

import numpy as np
import shapely

from alpasim_plugin.core.geometry import interpolate, inverse
from alpasim_plugin.world.route import LaneIndex


def rectangles(centres, yaw, length, width):
    corners = np.array([[length, width], [length, -width], [-length, -width], [-length, width]]) / 2
    c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    x = centres[:, :1] + c * corners[:, 0] - s * corners[:, 1]
    y = centres[:, 1:2] + s * corners[:, 0] + c * corners[:, 1]
    return shapely.polygons(np.stack([x, y], axis=-1))


def footprint(poses, vehicle, size=None):
    """Plan-view footprints of rig poses (T, 4, 4), centred below the box centre; ``size``: length
    and width other than the vehicle's.
    """
    centres = poses @ np.array([vehicle.rear_axle_to_centre_m, 0.0, vehicle.box.height_m / 2, 1.0])
    length, width = size or (vehicle.box.length_m, vehicle.box.width_m)
    return rectangles(centres, np.arctan2(poses[:, 1, 0], poses[:, 0, 0]), length, width)


def boxes_at(actors, t_us, frame=None):
    """Footprints of the actors present at a time, in the world's plane or in that of ``frame``
    (T_world_frame).
    """
    here = [a for a in actors if a.track.t_us[0] <= t_us <= a.track.t_us[-1]]
    poses = np.array([interpolate(a.track, t_us) for a in here])
    if frame is not None:
        poses = inverse(frame) @ poses
    yaw = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    shapes = [
        rectangles(poses[i : i + 1, :3, 3], yaw[i : i + 1], a.box.length_m, a.box.width_m)[0]
        for i, a in enumerate(here)
    ]
    return np.array(shapes, dtype=object)


def ruling(log, times, size=(4.855, 1.88), radius_m=6.0):
    """The off-road rule of the paper step by step: (held by one lane, held by the union, neither,
    neither and touching an edge).
    """
    index = LaneIndex(log.lane_map)
    area = dict(zip(index.ids, index.polygons, strict=True))
    edges = [shapely.linestrings(e[:, :2]) for e in log.lane_map.road_edges]
    poses = interpolate(log.ego_log, times)
    lift = np.array([log.vehicle.rear_axle_to_centre_m, 0.0, log.vehicle.box.height_m / 2, 1.0])
    one = []
    union = []
    neither = []
    off = []
    for k, (pose, shape) in enumerate(zip(poses, footprint(poses, log.vehicle, size), strict=True)):
        near = [area[i] for i in index.within((pose @ lift)[:3], radius_m)]
        if any(shapely.contains(a, shape) for a in near):
            one.append(k)
        elif near and shapely.contains(shapely.union_all(near), shape):
            union.append(k)
        else:
            neither.append(k)
            if min(shapely.distance(e, shape) for e in edges) < 0.001:
                off.append(k)
    return one, union, neither, off
