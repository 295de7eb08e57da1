"""Drive from the pixels of one front camera: lane markings and obstacles."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from alpasim_plugin.core.geometry import interpolate, inverse, yaw_of
from alpasim_plugin.core.interfaces import Policy
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F64, Frame, Observation, Plan, Route, Scenario, SensorSpec
from policies.base import (
    Path,
    camera_frame,
    curve_speeds,
    extended,
    follow,
    front_camera,
    plan_times,
    route_left,
    seconds,
    shifted,
    smooth_line,
)
from policies.lane_filter import LaneState, predict, search, shift, update
from policies.lane_plan import (
    NOISE_SPEED,
    PATH_M,
    Blend,
    RoutePrior,
    blend,
    correlated_noise,
    fuse,
    idm_progress,
    route_prior,
    sample_sigma_m,
    sampled,
)
from policies.obstacle_vision import (
    ObstacleTrack,
    RoadColour,
    anomaly,
    find_foot,
    learn_road,
    track_obstacle,
)
from policies.road_vision import GroundGrid, PaintPoints, RidgeFilter, find_paint, make_grid

# A satellite receiver knows the lane, not the place in it
NAVIGATION_SIGMA_M = 0.7
NAVIGATION_LIMIT_M = 1.0
MIN_CRUISE_MPS = 8.0
MAX_HEADING_RAD = 0.45  # a lane that points further away is not the ego's any more
UNCERTAIN_M = 1.2
UNCERTAIN_PAINT_M = 3.0
LOST_SIGMA_M = 0.9
LOST_BLIND_M = 25.0
OTHER_LANE = 0.55  # the route is in the next lane when it lies this share of a width off the centre
OTHER_LANE_FRAMES = 5
SAME_HEADING_RAD = 0.25
TURN_OFF_RAD = 0.3
CHOOSE_AT_M = 12.0
CHOOSE_AT_S = 1.2
SIGMA_AT_M = 10.0
OBSTACLE_RANGE_M = 48.0


class LaneCamera(Policy):
    """Keep the lane that lane markings show and stop for what stands on it.

    It reads the newest frame of one camera, its own motion, and the route. The lateral position
    comes from lane markings: the route's weight is its variance against theirs, which near the car
    is below one percent. The route decides which lane, where to turn, and everything when no lane
    marking is seen for long. ``Plan.debug["mode"]`` names the source of the plan: ``lane`` (lane
    markings in this frame), ``memory`` (the estimate of earlier frames), ``route`` or ``straight``
    (neither).
    """

    def __init__(self, scenario: Scenario) -> None:
        self.camera = front_camera(scenario)
        self.sensors: Sequence[SensorSpec] = (SensorSpec(self.camera.name),)
        self.scene_id = scenario.scene_id
        self.bumper_m = scenario.vehicle.rear_axle_to_centre_m + scenario.vehicle.box.length_m / 2
        self.grid: GroundGrid = make_grid(self.camera)
        self.ridges = RidgeFilter(self.grid)
        self.reset(0, scenario.route)

    def reset(self, seed: int, route: Route) -> None:
        """Forget everything of the drive before."""
        self.seed = seed
        self.step = 0
        error_m = NAVIGATION_SIGMA_M * float(
            stream(self.scene_id, seed, "policy/navigation").normal()
        )
        self.navigation_error_m = float(np.clip(error_m, -NAVIGATION_LIMIT_M, NAVIGATION_LIMIT_M))
        self.noise: F64 | None = None  # the samples' errors, which last for seconds
        self.acted_us = 0
        self.cruise_mps: float | None = None
        self.lane: LaneState | None = None
        self.road: RoadColour | None = None
        self.obstacle: ObstacleTrack | None = None
        self.seen_us: int | None = None  # time of the frame that the memory belongs to
        self.seen_pose: F64 = np.eye(4)
        self.other_lane_frames = 0

    def act(self, observation: Observation) -> Plan:
        """Return a plan from the newest frame.

        Raises:
            PolicyError: The observation has no frame of the camera, or one of another size.
        """
        frame = camera_frame(observation, self.camera, "lane-camera")
        route = None
        left = route_left(observation.route_rig)
        if left is not None:  # with a lateral navigation error that is constant over the drive
            route = shifted(smooth_line(left), self.navigation_error_m)
        speed = observation.ego.speed_mps
        if self.cruise_mps is None:
            self.cruise_mps = max(speed, MIN_CRUISE_MPS)
        pose_now = observation.ego.T_world_rig
        if self.seen_us is None or frame.t_us > self.seen_us:
            self._look(frame, _pose_at(observation, frame.t_us), route, pose_now, speed)
        lane = None if self.lane is None else _moved(self.lane, self.seen_pose, pose_now)
        blended = blend(lane, route, speed)
        random = stream(self.scene_id, self.seed, "policy", self.step)
        self.noise = correlated_noise(self.noise, (observation.t_us - self.acted_us) * 1e-6, random)
        self.step = self.step + 1
        self.acted_us = observation.t_us
        wanted_mps = self.cruise_mps * (1.0 + NOISE_SPEED * float(self.noise[0, 1]))
        times = plan_times(observation.t_us)
        limits = curve_speeds(blended.path, wanted_mps)
        obstacle = self._obstacle_now(observation)
        progress = idm_progress(speed, limits, seconds(times), obstacle, self.bumper_m, wanted_mps)
        lane_sigma_m = 0.0 if lane is None else float(lane.sigma(np.array([SIGMA_AT_M]))[0])
        sigma_m = sample_sigma_m(lane_sigma_m)
        line = shifted(blended.path.xy, sigma_m * float(self.noise[0, 0]))
        xy, yaw = follow(Path(line, blended.path.curvature), progress, max(speed, 0.0))
        others = sampled(xy, yaw, self.noise, sigma_m)[1:]
        debug = self._debug(lane, route, blended)
        return Plan(observation.t_us, times, xy, yaw, tuple(others), debug)

    def _look(
        self, frame: Frame, pose: F64, route: F64 | None, pose_now: F64, speed: float
    ) -> None:
        """Update lane, road colour and obstacle from a new frame."""
        dt_s = 0.0 if self.seen_us is None else (frame.t_us - self.seen_us) * 1e-6
        if self.lane is not None:
            self.lane = _moved(self.lane, self.seen_pose, pose)
        self.seen_us = frame.t_us
        self.seen_pose = pose
        ground = self.grid.warp(frame.rgb)
        lab = cv2.cvtColor(ground, cv2.COLOR_RGB2LAB)
        not_road = None if self.road is None else anomaly(lab, self.road, self.grid)
        points, crosswalk = find_paint(ground, self.grid, self.ridges, not_road)
        route_points = None if route is None else _points_in(route, pose_now, pose)
        self._look_for_lane(points, route_points, speed)
        path = extended(fuse(self.lane, route_points)[0], PATH_M)
        centre_y = np.interp(self.grid.x_m, *_increasing(path))
        foot = None
        if not_road is not None:
            not_road[crosswalk] = 0
            reach = min(OBSTACLE_RANGE_M, float(_increasing(path[1:])[0][-1]))
            foot = find_foot(not_road, self.grid, centre_y, float(self.grid.x_m[0]), reach)
        self.obstacle = track_obstacle(self.obstacle, foot, speed, dt_s, float(self.grid.x_m[0]))
        free_m = self.obstacle.distance_m if self.obstacle is not None else np.inf
        self.road = learn_road(self.road, lab, self.grid, centre_y, free_m)

    def _look_for_lane(self, points: PaintPoints, route: F64 | None, speed: float) -> None:
        row_m = np.interp(points.x_m, self.grid.x_m, self.grid.row_m)
        guess = route_prior(np.array([[0.0, 0.0], [20.0, 0.0]]) if route is None else route)

        def seen(lane: LaneState | None) -> LaneState | None:
            updated = None if lane is None else update(lane, points, row_m)
            return (
                None
                if updated is None or self._is_lost(updated, None if route is None else guess)
                else updated
            )

        lane = seen(self.lane)
        if lane is None:
            lane = seen(
                search(points, row_m, guess.offset_m, guess.heading_rad, guess.curvature_1pm)
            )
        self.lane = (
            lane
            if lane is None or route is None
            else self._choose_lane(lane, route, points, row_m, speed)
        )

    def _choose_lane(
        self, lane: LaneState, route: F64, points: PaintPoints, row_m: F64, speed: float
    ) -> LaneState | None:
        """Change to the lane that the route is in, once it has run beside the present one over
        several frames.

        A route that points elsewhere than the lane does not run beside it: it turns off, which
        `blend` sees to.
        """
        x, y = _increasing(route)
        probe = np.array([max(CHOOSE_AT_M, CHOOSE_AT_S * speed)])
        lateral_offset_m = float((np.interp(probe, x, y) - lane.centre(probe))[0])
        turn = float(
            np.arctan2(np.interp(probe + 2, x, y) - np.interp(probe - 2, x, y), 4.0)[0]
            - np.arctan(lane.slope(probe))[0]
        )
        is_other_lane = (
            abs(lateral_offset_m) > OTHER_LANE * lane.mean[4]
            and abs(turn) < SAME_HEADING_RAD
            and x[-1] > probe[0] + 2
        )
        self.other_lane_frames = self.other_lane_frames + 1 if is_other_lane else 0
        if self.other_lane_frames < OTHER_LANE_FRAMES:
            return lane
        self.other_lane_frames = 0
        lane_found = search(
            points,
            row_m,
            float(lane.mean[0]) + lateral_offset_m,
            float(lane.mean[1]),
            float(lane.mean[2]),
        )
        if lane_found is not None:
            return lane_found
        lanes = round(lateral_offset_m / float(lane.mean[4]))
        return (
            shift(lane, lanes)
            if abs(lateral_offset_m - lanes * lane.mean[4]) < 0.3 * lane.mean[4]
            else None
        )

    def _is_lost(self, lane: LaneState, route: RoutePrior | None) -> bool:
        if route is not None:
            ahead_m = 6.0
            turn = route.heading_rad + ahead_m * route.curvature_1pm - float(lane.slope(ahead_m))
            if abs(turn) > TURN_OFF_RAD:
                return True
            # Beside the route, a lane needs both borders: a single line is ambiguous.
            lateral_offset_m = (
                route.offset_m
                + ahead_m * route.heading_rad
                + ahead_m**2 / 2 * route.curvature_1pm
                - float(lane.centre(np.array([ahead_m]))[0])
            )
            if (
                abs(lateral_offset_m) > UNCERTAIN_M
                and min(lane.left_m, lane.right_m) < UNCERTAIN_PAINT_M
            ):
                return True
        sigma = float(lane.sigma(np.array([5.0]))[0])
        heading = float(lane.mean[1])
        width = float(lane.mean[4])
        return (
            sigma > LOST_SIGMA_M
            or lane.blind_m > LOST_BLIND_M
            or abs(heading) > MAX_HEADING_RAD
            or not 2.4 < width < 4.8
        )

    def _obstacle_now(self, observation: Observation) -> ObstacleTrack | None:
        """Return the confirmed obstacle ahead, moved from the frame's time to now."""
        if self.obstacle is None or not self.obstacle.confirmed or self.seen_us is None:
            return None
        age_s = (observation.t_us - self.seen_us) * 1e-6
        if age_s <= 0:
            return self.obstacle
        return track_obstacle(self.obstacle, None, observation.ego.speed_mps, age_s)

    def _debug(self, lane: LaneState | None, route: F64 | None, blended: Blend) -> dict[str, Any]:
        mode = (
            ("straight" if route is None else "route")
            if lane is None
            else ("lane" if lane.blind_m == 0 else "memory")
        )
        out: dict[str, Any] = {
            "mode": mode,
            "route_weight": blended.route_weight,
            "route_leaves_m": blended.route_leaves_m,
        }
        out["line_path"] = blended.path.xy  # the page of causes draws it on the road
        if lane is not None:
            names = (
                "lane_offset_m",
                "lane_heading_rad",
                "lane_curvature_1pm",
                "lane_bend_1pm2",
                "lane_width_m",
            )
            out.update({name: float(value) for name, value in zip(names, lane.mean, strict=True)})
            out.update(lane_sigma_m=float(np.sqrt(lane.cov[0, 0])), blind_m=lane.blind_m)
        if self.lane is not None:
            out.update(paint_left_m=self.lane.left_m, paint_right_m=self.lane.right_m)
        if self.obstacle is not None:
            o = self.obstacle
            out.update(
                obstacle_m=o.distance_m, obstacle_mps=o.speed_mps, obstacle_confirmed=o.confirmed
            )
        return out


def _pose_at(observation: Observation, t_us: int) -> F64:
    """Return the rig pose at a frame's time, from the ego's own history."""
    if t_us >= observation.t_us or len(observation.history) < 2:
        return observation.ego.T_world_rig
    return interpolate(observation.history, max(t_us, int(observation.history.t_us[0])))


def _moved(lane: LaneState, T_world_old: F64, T_world_new: F64) -> LaneState:
    step = inverse(T_world_old) @ T_world_new
    return predict(lane, float(step[0, 3]), float(step[1, 3]), yaw_of(step))


def _points_in(points: F64, T_world_a: F64, T_world_b: F64) -> F64:
    """Return points (M, 2) given in rig pose a as seen from rig pose b, in the plane."""
    T = inverse(T_world_b) @ T_world_a
    return points @ T[:2, :2].T + T[:2, 3]


def _increasing(points: F64) -> tuple[F64, F64]:
    """Return x and y of the leading points ``(M, 2)`` whose x increases, for interpolation over
    x.
    """
    x = points[:, 0]
    back = x[1:] - x[:-1] <= 0.05
    stop = int(np.argmax(back)) + 1 if back.any() else len(x)
    return x[:stop], points[:stop, 1]
