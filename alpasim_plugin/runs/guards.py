"""Checks of what renderers and policies return; an error names the part that broke its contract."""

from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any

import numpy as np

from alpasim_plugin.core.errors import PolicyError, RendererError, RendererFault, SimrunError
from alpasim_plugin.core.image_metrics import is_black
from alpasim_plugin.core.interfaces import Policy, Renderer
from alpasim_plugin.core.parts.blame import blaming, defined, is_own, runs_users_code
from alpasim_plugin.core.plan_check import plan_problem, sensors_problem
from alpasim_plugin.core.types import (
    Frame,
    Observation,
    Plan,
    RenderRequest,
    Route,
    SensorSpec,
    read_only,
)

# Largest values of a frame's planes.
ALPHA = 1.0
DEPTH_M = 1e6
ROUNDING = 1e-3
CHECK = "simrun check policy finds all faults of a policy"


def calling(part: object, method: str, kind: type[SimrunError]) -> AbstractContextManager[None]:
    """Return a context in which a part is blamed for what its method raises.

    Args:
        part: The part.
        method: Which of its methods is called.
        kind: Its error.
    """
    name = type(part).__name__
    return blaming(kind, f"{name}.{method}", defined(part, method), runs_users_code(part, method))


def checked_frames(
    renderer: Renderer, requests: Sequence[RenderRequest], on_device: bool = False
) -> list[Frame]:
    """Render and check the frames of one instant, or of one block; an all-black frame passes but
    carries the event ``black``, unless it may stay ``on_device``, which its fixer looks at.

    Raises:
        RendererError: The renderer raised, or its frames do not match the requests in number, size,
            type, time or camera; of a renderer of the user's own a `RendererFault`.
    """
    if not requests:
        return []
    kind = RendererError if is_own(renderer) else RendererFault
    name = f"{type(renderer).__name__}, camera {requests[0].camera.name!r} at {requests[0].t_us} us"
    location = defined(renderer, "render")
    request_views = requests
    if not is_own(renderer):
        request_views = [
            replace(read_only(request), camera=read_only(request.camera)) for request in requests
        ]
    with blaming(kind, name, location, not is_own(renderer)):
        frames = list(renderer.render_batch(request_views))
    problem = f"{len(frames)} frames for {len(requests)} requests"
    if len(frames) == len(requests):
        problem = "; ".join(filter(None, map(_frame_problem, frames, requests)))
    if problem:
        raise kind(
            f"{name}: {problem}{location}", "Correct the renderer; its contract is types.Frame."
        )
    return [
        replace(frame, events=(*frame.events, "black"))
        if "black" not in frame.events and not (on_device and frame.pending) and is_black(frame.rgb)
        else frame
        for frame in frames
    ]


def _frame_problem(frame: Any, request: RenderRequest) -> str:
    """Say what is wrong with what a renderer returned for a request; empty if nothing."""
    if not isinstance(frame, Frame):
        return f"render returned {type(frame).__name__}, not a Frame"
    size = request.camera.height, request.camera.width
    problem = _rgb_problem(frame, (*size, 3))
    if problem:
        return problem
    if (frame.t_us, frame.camera) != (request.t_us, request.camera.name):
        return f"the frame is stamped {frame.camera!r} at {frame.t_us} us"
    for label, high in (("alpha", ALPHA), ("depth", DEPTH_M)):
        plane = None if frame.is_pending(label) else getattr(frame, label)
        if plane is None:
            continue
        shape = getattr(plane, "shape", None)
        dtype = getattr(plane, "dtype", None)
        if shape != size or np.dtype(dtype).kind != "f":
            return f"{label} is {dtype or type(plane).__name__} {shape or ''}, not float {size}"
        if not (plane.min() >= -ROUNDING and plane.max() <= high + ROUNDING):
            return f"{label} is not finite, or not between 0 and {high:g}"
    return ""


def _rgb_problem(frame: Frame, due: tuple[int, int, int]) -> str:
    """Say why a frame's image is not uint8 of the shape ``due``; empty if it is."""
    shape: Any
    dtype: Any
    if frame.pending:
        shape = (*frame.size, 3)
        dtype = np.dtype(np.uint8)
    else:
        shape = getattr(frame.rgb, "shape", None)
        dtype = getattr(frame.rgb, "dtype", None)
    if shape == due and dtype == np.uint8:
        return ""
    guess = ""
    if shape == (3, *due[:2]):
        guess = "; the channels come last"
    elif shape == due:
        guess = "; multiply 0..1 by 255"
    return f"rgb is {dtype or type(frame.rgb).__name__} {shape or ''}, not uint8 {due}{guess}"


def checked_sensors(policy: Policy) -> Sequence[SensorSpec]:
    """Return the policy's sensors.

    Raises:
        PolicyError: They are not a sequence of `SensorSpec`.
    """
    name = type(policy).__name__
    with blaming(PolicyError, f"{name}, its sensors", "", runs_users_code(policy, "act")):
        sensors = policy.sensors
        problem = sensors_problem(sensors)
    if problem:
        raise PolicyError(f"{name}: {problem}", CHECK)
    return sensors


def reset_policy(policy: Policy, seed: int, route: Route) -> None:
    """Begin a rollout.

    Raises:
        PolicyError: The policy raised.
    """
    with calling(policy, "reset", PolicyError):
        policy.reset(seed, read_only(route))


def checked_plan(policy: Policy, observation: Observation) -> Plan:
    """Query the policy and check its plan.

    Raises:
        PolicyError: The policy raised, or its plan is empty, not finite, not ordered in time or
            does not start now.
    """
    name = f"{type(policy).__name__} at {observation.t_us} us"
    location = defined(policy, "act")
    with blaming(PolicyError, name, location, runs_users_code(policy, "act")):
        plan = policy.act(observation)
        problem = plan_problem(plan, observation.t_us)
    if problem:
        raise PolicyError(f"{name}: {problem}{location}", CHECK)
    return plan
