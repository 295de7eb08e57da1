"""Differences between a predicted render request and the true one: whether a frame rendered ahead of time may be shown."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.types import F64, RenderRequest

NEAR_M = 10.0  # beyond this distance an actor's displacement counts in proportion to its size in the image
ARM_M = 2.5  # an actor's rotation counts as the displacement of a point this far from its centre
BEHIND_M = 10.0  # an actor whose centre lies further than this behind the camera is not in the image


@dataclass(frozen=True)
class Deviation:
    """Pose errors of a predicted request."""

    camera_m: float  # displacement of the camera, the larger of shutter start and end
    camera_deg: float  # its rotation
    actor_m: float  # largest displacement of an actor in view, scaled to a distance of `NEAR_M`; infinite if one appeared or left

    def within(self, tolerance_m: float, tolerance_deg: float) -> bool:
        """Return whether camera and actors are within tolerance."""
        return max(self.camera_m, self.actor_m) <= tolerance_m and self.camera_deg <= tolerance_deg


def deviation(predicted: RenderRequest, true: RenderRequest) -> Deviation:
    """Compare two requests of one camera and instant."""
    a, b = predicted.T_world_camera, true.T_world_camera
    moved = float(np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1).max())
    turned = max(rotation_rad(a[i], b[i]) for i in range(len(a)))
    return Deviation(moved, math.degrees(turned), _actors(predicted, true))


def same_view(predicted: RenderRequest, true: RenderRequest) -> bool:
    """Return whether two requests give the same image, bit for bit."""
    return (
        np.array_equal(predicted.T_world_camera, true.T_world_camera)
        and predicted.actors.keys() == true.actors.keys()
        and all(np.array_equal(pose, true.actors[key]) for key, pose in predicted.actors.items())
    )


def rotation_rad(a: F64, b: F64) -> float:
    """Return the angle between the rotations of two transforms ``(4, 4)``, exact to rounding for small angles too."""
    chord = float(np.linalg.norm(a[:3, :3] - b[:3, :3]))
    return 2.0 * math.asin(min(1.0, chord / math.sqrt(8.0)))


def _actors(predicted: RenderRequest, true: RenderRequest) -> float:
    camera = true.T_world_camera[-1]
    worst = 0.0
    for key in predicted.actors.keys() | true.actors.keys():
        one, two = predicted.actors.get(key), true.actors.get(key)
        there = two if two is not None else predicted.actors[key]
        seen = there[:3, 3] - camera[:3, 3]
        if float(seen @ camera[:3, 2]) < -BEHIND_M:
            continue
        if one is None or two is None:
            return math.inf
        moved = float(np.linalg.norm(one[:3, 3] - two[:3, 3])) + ARM_M * rotation_rad(one, two)
        worst = max(worst, moved * NEAR_M / max(NEAR_M, float(np.linalg.norm(seen))))
    return worst
