"""Policies by name, and what policies share: the times of a plan, the camera to look through and its newest frame."""

from __future__ import annotations

import numpy as np

from alpasim_plugin.core.errors import InputError, PolicyError
from alpasim_plugin.core.types import F64, I64, CameraSpec, Frame, Observation, Scenario
from alpasim_plugin.plugins.interfaces import Policy
from alpasim_plugin.plugins.parts import build, unidentified

PLAN_HORIZON_S = 5.0  # AlpaSim's minADE needs samples that reach its longest horizon, 5 s; shorter ones lose all four metrics
PLAN_STEP_US = 100_000


def make_policy(name: str, scenario: Scenario) -> Policy:
    """Return a policy for a scenario.

    Args:
        name: A policy as `alpasim_plugin.plugins.parts.resolve` takes it: a registered name, ``package.module:Class`` or ``file.py:Class``.
        scenario: What the policy will drive in. A policy under test should take no more from it than its cameras.

    Raises:
        InputError: The name is unknown, the import fails, or what it makes is not a policy.
        PolicyError: The policy raised while it was made.
    """
    policy: Policy = build(unidentified("policy", name), scenario=scenario)
    return policy


def plan_times(t_us: int, horizon_s: float = PLAN_HORIZON_S) -> I64:
    """Return the times ``(T,)`` of a plan made at ``t_us``: now and every 0.1 s up to the horizon."""
    n = round(horizon_s * 1_000_000 / PLAN_STEP_US)
    return t_us + PLAN_STEP_US * np.arange(n + 1, dtype=np.int64)


def seconds(times_us: I64) -> F64:
    """Return the seconds ``(T,)`` from the first of the times; the difference is taken in integers."""
    return np.asarray((times_us - times_us[0]).astype(np.float64) * 1e-6)


def front_camera(scenario: Scenario, policy: str = "lane-camera") -> CameraSpec:
    """Return the camera to look through: the first one with "front" in its name, else the first one that looks ahead.

    Raises:
        InputError: No camera looks ahead.
    """
    ahead = [camera for camera in scenario.cameras if camera.T_rig_camera[0, 2] > 0.7]
    for camera in sorted(ahead, key=lambda c: "front" not in c.name):
        return camera
    raise InputError(
        f"making the policy {policy!r}",
        f"scene {scenario.scene_id!r}",
        f"no camera looks ahead among {[camera.name for camera in scenario.cameras]}",
        "add a front camera to the scenario or choose another policy",
    )


def camera_frame(observation: Observation, camera: CameraSpec, policy: str) -> Frame:
    """Return the newest frame of a camera.

    Args:
        observation: What the policy is given.
        camera: Which camera, and at which size.
        policy: Name of the policy, for the error.

    Raises:
        PolicyError: The observation has no frame of the camera, or one of another size.
    """
    frame = observation.frames.get(camera.name)
    expected = (camera.height, camera.width, 3)
    if frame is None or frame.rgb.shape != expected:
        found = f"frames of {sorted(observation.frames)}" if frame is None else f"a frame of shape {frame.rgb.shape}"
        raise PolicyError(
            "planning by camera",
            f"policy {policy!r} at {observation.t_us} us",
            f"{found}; needed is {camera.name!r} of shape {expected}",
            "render the cameras that the policy names in `sensors`, at the scenario's size",
        )
    return frame
