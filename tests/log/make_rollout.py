"""A small rollout in every kind of entry, for the tests of the log."""

import numpy as np

from alpasim_plugin.core.geometry import quat_from_yaw, se2, se3
from alpasim_plugin.core.types import (
    Actor,
    Box,
    CameraSpec,
    EgoState,
    Frame,
    RenderRequest,
    Trajectory,
    Vehicle,
)
from alpasim_plugin.log import AslWriter, RolloutHeader

T0_US = 1_689_697_803_493_732  # a Unix-epoch time: too large for any float
STEP_US = 100_000
CAMERA = CameraSpec(
    "camera_front_wide_120fov",
    64,
    40,
    np.array([[32.0, 0, 32], [0, 32, 20], [0, 0, 1]]),
    se3([1.7, 0.1, 1.5], [0.5, -0.5, 0.5, -0.5]),
    shutter_us=30_000,
)


def straight(n, speed_mps=10.0, first_us=T0_US, y_m=0.0, yaw_rad=0.3):
    t_us = first_us + STEP_US * np.arange(n, dtype=np.int64)
    s = speed_mps * (t_us - first_us) / 1e6
    xyz = np.column_stack([s * np.cos(yaw_rad), y_m + s * np.sin(yaw_rad), np.full(n, 0.25)])
    return Trajectory(t_us, xyz, np.tile(quat_from_yaw(yaw_rad), (n, 1)))


ACTORS = (
    Actor("7", "automobile", Box(4.6, 1.9, 1.6), straight(12, 8.0, y_m=3.5)),
    Actor(
        "late",
        "person",
        Box(0.6, 0.7, 1.8),
        straight(5, 1.0, first_us=T0_US + 4 * STEP_US, y_m=-4.0),
    ),
    Actor("wall", "other", Box(9.0, 0.4, 1.0), straight(12, 0.0, y_m=-8.0), is_static=True),
)
HEADER = RolloutHeader(
    scene_id="test-scene",
    session_uuid="00000000-0000-5000-8000-000000000001",
    vehicle=Vehicle(),
    actors=ACTORS,
    ego_log=straight(12),
    render_start_us=T0_US + STEP_US,
    force_gt_us=3 * STEP_US,
    control_us=STEP_US,
    n_steps=4,
    seed=41,
    versions={"sensorsim": "clean", "egodriver": "lane-camera"},
)


def present(t_us):
    out = {}
    for actor in ACTORS:
        i = np.flatnonzero(actor.track.t_us == t_us)
        if len(i):
            out[actor.actor_id] = se3(actor.track.xyz[i[0]], actor.track.quat[i[0]])
    return out


def ego_at(step):
    log = HEADER.ego_log
    return EgoState(
        int(log.t_us[step]),
        se3(log.xyz[step], log.quat[step]),
        10.0,
        accel_mps2=0.5,
        yaw_rate_radps=0.1,
    )


def picture(step):
    y, x = np.mgrid[:40, :64]
    return np.stack([x * 3, y * 5, np.full_like(x, 20 * step)], axis=-1).astype(np.uint8)


def plan_at(step):
    log = HEADER.ego_log
    return Trajectory(
        log.t_us[step : step + 6], log.xyz[step : step + 6], log.quat[step : step + 6]
    )


def write_rollout(path, encoding="png"):
    """Write four steps in the order of AlpaSim's runtime; the driver's first answer is empty."""
    with AslWriter(path, HEADER) as log:
        log.begin([CAMERA])
        log.actor_poses(
            HEADER.render_start_us, ego_at(1).T_world_rig, present(HEADER.render_start_us)
        )
        for step in range(1, 5):
            state = ego_at(step)
            following = ego_at(step + 1)
            _frame(log, state, encoding)
            log.ego_trajectory([ego_at(0), state] if step == 1 else [state])
            log.route(
                state.t_us,
                np.concatenate([np.arange(54.0).reshape(18, 3), np.full((2, 3), np.nan)]),
            )
            log.driver_request(state.t_us, following.t_us)
            plan = (
                plan_at(step)
                if step > 1
                else Trajectory(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 4)))
            )
            log.driver_return(plan, [plan, plan_at(step)] if step > 2 else [])
            log.controller_request(state, plan, following.t_us, forced=step < 3)
            log.controller_return(following)
            log.actor_poses(following.t_us, following.T_world_rig, present(following.t_us))
        _frame(log, ego_at(5), encoding)
    return path


def _frame(log, state, encoding):
    T = state.T_world_rig @ CAMERA.T_rig_camera
    T_start = state.T_world_rig @ se2(-0.3, 0, 0) @ CAMERA.T_rig_camera
    poses = np.stack([T_start, T])
    log.render_request(RenderRequest(state.t_us, CAMERA, poses, present(state.t_us)), encoding)
    step = int((state.t_us - T0_US) // STEP_US)
    log.camera_image(Frame(state.t_us, CAMERA.name, picture(step)), encoding, CAMERA.shutter_us)
