"""How far what came differs from what was foretold: is a frame that was made beforehand still the right one?"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.types import F64, RenderRequest

NEAR_M = 10.0  # an actor further away than this may be off in proportion: what counts is where it stands in the picture
ARM_M = 2.5  # an actor's rotation counts as the displacement of a point this far from its centre
BEHIND_M = 10.0  # an actor whose centre lies further than this behind the camera is not in the picture


@dataclass(frozen=True)
class Deviation:
    """Between a request that was foretold and the one that came."""

    camera_m: float  # displacement of the camera, the larger of shutter start and end
    camera_deg: float  # its rotation
    actor_m: float  # largest displacement of an actor before the camera, as if seen from `NEAR_M`; infinite where one came or left

    def within(self, tolerance_m: float, tolerance_deg: float) -> bool:
        """Tell whether all of it is tolerable."""
        return max(self.camera_m, self.actor_m) <= tolerance_m and self.camera_deg <= tolerance_deg


def deviation(foretold: RenderRequest, came: RenderRequest) -> Deviation:
    """Compare two requests of one camera and instant."""
    a, b = foretold.T_world_camera, came.T_world_camera
    moved = float(np.linalg.norm(a[:, :3, 3] - b[:, :3, 3], axis=1).max())
    turned = max(rotation_rad(a[i], b[i]) for i in range(len(a)))
    return Deviation(moved, math.degrees(turned), _actors(foretold, came))


def same_view(foretold: RenderRequest, came: RenderRequest) -> bool:
    """Tell whether two requests ask for the same picture, bit for bit."""
    return (
        np.array_equal(foretold.T_world_camera, came.T_world_camera)
        and foretold.actors.keys() == came.actors.keys()
        and all(np.array_equal(pose, came.actors[key]) for key, pose in foretold.actors.items())
    )


def rotation_rad(a: F64, b: F64) -> float:
    """Return the angle between the rotations of two transforms ``(4, 4)``, exact to rounding for small angles too."""
    chord = float(np.linalg.norm(a[:3, :3] - b[:3, :3]))
    return 2.0 * math.asin(min(1.0, chord / math.sqrt(8.0)))


def _actors(foretold: RenderRequest, came: RenderRequest) -> float:
    camera = came.T_world_camera[-1]
    worst = 0.0
    for key in foretold.actors.keys() | came.actors.keys():
        one, two = foretold.actors.get(key), came.actors.get(key)
        there = two if two is not None else foretold.actors[key]
        seen = there[:3, 3] - camera[:3, 3]
        if float(seen @ camera[:3, 2]) < -BEHIND_M:
            continue
        if one is None or two is None:
            return math.inf
        moved = float(np.linalg.norm(one[:3, 3] - two[:3, 3])) + ARM_M * rotation_rad(one, two)
        worst = max(worst, moved * NEAR_M / max(NEAR_M, float(np.linalg.norm(seen))))
    return worst
