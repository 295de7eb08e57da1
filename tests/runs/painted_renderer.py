"""A renderer that paints a road of the recorded drive's curvature: a few milliseconds a frame, and
enough to see a lane by.
"""

from __future__ import annotations

import numpy as np

from alpasim_plugin.core.geometry import arc_lengths, interpolate, inverse, yaw_from_quat
from alpasim_plugin.core.types import Frame, RenderRequest, Scenario
from policies.painted_road import WHITE, YELLOW, Line, PaintedRoad

PAINTED = "tests.runs.painted_renderer:Painted"
BEND = """
version: 1
description: A long bend, of one curvature from its beginning on.
road: {lane_width_m: 3.6, shoulder_m: 0.5, segments: [{kind: arc, length_m: 170, curvature_per_m: 0.02}]}
ego: {speed_mps: 9, cruise_mps: 9, max_lateral_accel_mps2: 3}
environment: {buildings: 0, trees_per_100m: 0, poles_spacing_m: 0}
timing: {duration_us: 6_000_000}
"""


class Painted:
    """Shows a two-lane road along the recorded drive."""

    def __init__(self, scenario: Scenario) -> None:
        log = scenario.ego_log
        turned = float(np.ptp(np.unwrap(yaw_from_quat(log.quat))))
        k = turned / float(arc_lengths(log.xyz[:, :2])[-1])
        self.first = inverse(interpolate(log, [log.t_us[0]])[0])
        lines = (
            Line(1.8, dashed=True, colour=YELLOW),
            Line(-1.8, colour=WHITE),
            Line(5.4, colour=WHITE),
        )
        self.road = PaintedRoad(k, lines, (-2.3, 5.9))

    def render(self, request: RenderRequest) -> Frame:
        camera = request.camera
        rig = self.first @ request.T_world_camera[1] @ inverse(camera.T_rig_camera)
        return Frame(
            request.t_us,
            camera.name,
            self.road.image(camera, rig, seed=request.t_us, supersample=1),
        )
