"""A semantic map that is wrong by a constant: lanes moved aside, boxes moved, the render and the
truth left as they are.

The paper's 45 configurations (its robustness figure): lanes by -0.5 to 0.5 m, boxes by (dx, dy) in
{-0.25, 0, 0.25}^2 m. The paper does not say along which axes; here lanes move along the vehicle's
left axis, boxes along its front and left axes, the same over a whole clip.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import F64, I64, U8, CameraSpec, Scenario
from alpasim_plugin.fixers.semantic_map.draw import draw_map
from alpasim_plugin.fixers.semantic_map.prepare import ActorBox, actor_boxes, prepare_map
from alpasim_plugin.gaussians.scene.degrade import log_actors

LANES_M = (-0.5, -0.25, 0.0, 0.25, 0.5)
BOXES_M = (-0.25, 0.0, 0.25)


@dataclass(frozen=True)
class MapShift:
    """How far a map is off, metres in the vehicle's axes.

    Args:
        lanes_left_m: Everything that belongs to the road, to the left.
        boxes_ahead_m, boxes_left_m: Every road user, ahead and to the left.
    """

    lanes_left_m: float = 0.0
    boxes_ahead_m: float = 0.0
    boxes_left_m: float = 0.0

    @property
    def boxes_m(self) -> float:
        """Distance by which boxes are moved."""
        return float(np.hypot(self.boxes_ahead_m, self.boxes_left_m))

    @property
    def label(self) -> str:
        """Short and unique, for names of folders."""
        return f"l{self.lanes_left_m:+.2f}x{self.boxes_ahead_m:+.2f}y{self.boxes_left_m:+.2f}"


CONFIGURATIONS = tuple(
    MapShift(lanes, ahead, left) for lanes, ahead, left in product(LANES_M, BOXES_M, BOXES_M)
)


def shifted_maps(
    scenario: Scenario,
    camera: CameraSpec,
    T_world_camera: F64,
    t_us: I64,
    shift: MapShift,
    threads: int = 1,
) -> U8:
    """Draw the map of every frame, off by a constant.

    Moving the road by d is drawing it from a camera moved by -d; boxes then move by their own shift
    and -d.

    Args:
        scenario: Whose road and logged road users are drawn.
        camera: Lens and mounting.
        T_world_camera: ``(T, 4, 4)``.
        t_us: ``(T,)``.
        shift: How far off.
        threads: Of the drawing.

    Returns:
        ``(T, H, W, 3)``.
    """
    layers, T_camera_rig = prepare_map(scenario.lane_map), inverse(camera.T_rig_camera)
    frames = []
    for t, T in zip(t_us.tolist(), T_world_camera, strict=True):
        axes = (T @ T_camera_rig)[:3, :3]  # columns: the vehicle's front, left and up
        road = shift.lanes_left_m * axes[:, 1]
        boxes = shift.boxes_ahead_m * axes[:, 0] + shift.boxes_left_m * axes[:, 1]
        actors = actor_boxes(log_actors(scenario, t), scenario.actors)
        frames.append(
            draw_map(
                layers,
                camera,
                _moved(T, -road),
                [_box_moved(a, boxes - road) for a in actors],
                threads=threads,
            )
        )
    return np.stack(frames)


def _moved(T: F64, by: F64) -> F64:
    out = T.copy()
    out[:3, 3] += by
    return out


def _box_moved(actor: ActorBox, by: F64) -> ActorBox:
    return replace(actor, T_world_box=_moved(actor.T_world_box, by))
