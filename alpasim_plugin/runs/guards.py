"""Checks of what renderers and policies return; an error names the part that broke its contract."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from alpasim_plugin.core.blame import raised
from alpasim_plugin.core.errors import PolicyError, RendererError, SimrunError
from alpasim_plugin.core.image_metrics import is_black
from alpasim_plugin.core.interfaces import Policy, Renderer
from alpasim_plugin.core.plan_check import plan_problem, sensors_problem
from alpasim_plugin.core.types import Frame, Observation, Plan, RenderRequest, Route, SensorSpec

CHECK = "simrun check policy finds all faults of a policy"
TRACEBACK = "see the traceback in output.log of the rollout"


def checked_frames(renderer: Renderer, requests: Sequence[RenderRequest]) -> list[Frame]:
    """Render and check the frames of one instant, or of one block; an all-black frame passes but
    carries the event ``black``.

    Raises:
        RendererError: The renderer raised, or its frames do not match the requests in number, size,
            type, time or camera.
    """
    if not requests:
        return []
    name = f"{type(renderer).__name__}, camera {requests[0].camera.name!r} at {requests[0].t_us} us"
    try:
        frames = list(renderer.render_batch(requests))
    except SimrunError:
        raise
    except Exception as error:
        raise RendererError(f"{name}: {raised(error)}", TRACEBACK) from error
    if len(frames) != len(requests):
        raise RendererError(
            f"{name}: {len(frames)} frames for {len(requests)} requests",
            "return one frame for each request",
        )
    return [
        _checked(type(renderer).__name__, frame, request)
        for frame, request in zip(frames, requests, strict=True)
    ]


def _checked(renderer: str, frame: Frame, request: RenderRequest) -> Frame:
    wanted = (request.camera.height, request.camera.width, 3)
    problems = []
    if frame.rgb.shape != wanted or frame.rgb.dtype != np.uint8:
        problems.append(f"rgb is {frame.rgb.dtype} {frame.rgb.shape}, not uint8 {wanted}")
    if (frame.t_us, frame.camera) != (request.t_us, request.camera.name):
        problems.append(f"it is stamped {frame.camera!r} at {frame.t_us} us")
    for label, plane in (("alpha", frame.alpha), ("depth", frame.depth)):
        if plane is not None and (plane.shape != wanted[:2] or not np.isfinite(plane).all()):
            problems.append(f"{label} has shape {plane.shape} or is not finite")
    if problems:
        raise RendererError(
            f"{renderer}, camera {request.camera.name!r} at {request.t_us} us: {'; '.join(problems)}",
            "fix the renderer; its contract is types.Frame",
        )
    if "black" not in frame.events and is_black(frame.rgb):
        return replace(frame, events=(*frame.events, "black"))
    return frame


def checked_sensors(policy: Policy) -> Sequence[SensorSpec]:
    """Return the policy's sensors.

    Raises:
        PolicyError: They are not a sequence of `SensorSpec`.
    """
    found = sensors_problem(policy.sensors)
    if found:
        raise PolicyError(f"{type(policy).__name__}: {found}", CHECK)
    return policy.sensors


def reset_policy(policy: Policy, seed: int, route: Route) -> None:
    """Begin a rollout.

    Raises:
        PolicyError: The policy raised.
    """
    try:
        policy.reset(seed, route)
    except SimrunError:
        raise
    except Exception as error:  # whatever a foreign policy raises
        raise PolicyError(f"{type(policy).__name__}: {raised(error)}", TRACEBACK) from error


def checked_plan(policy: Policy, observation: Observation) -> Plan:
    """Query the policy and check its plan.

    Raises:
        PolicyError: The policy raised, or its plan is empty, not finite, not ordered in time or
            does not start now.
    """
    name = f"{type(policy).__name__} at {observation.t_us} us"
    try:
        plan = policy.act(observation)
    except SimrunError:
        raise
    except Exception as error:
        raise PolicyError(f"{name}: {raised(error)}", TRACEBACK) from error
    found = plan_problem(plan, observation.t_us)
    if found:
        raise PolicyError(f"{name}: {found}", CHECK)
    return plan
