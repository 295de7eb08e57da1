"""Parts that change over at an instant: until then the first of two is in force while the second one looks on, from then on the second.

The second part sees everything that the first one saw, so that it has a history when its turn comes: a renderer has rendered every
request, a policy has answered every question. What it answered before its turn is not used.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from alpasim_plugin.control import Controller
from alpasim_plugin.errors import InputError
from alpasim_plugin.runtime.offers import batch_of, chunk_of, facts_of, lookahead_of, spent_by
from alpasim_plugin.types import EgoState, Frame, Observation, Plan, Policy, Renderer, RenderRequest, Route, SensorSpec, Trajectory


class SwitchedRenderer:
    """Render with ``first`` before ``at_us`` and with ``then`` from it on.

    Raises:
        InputError: One of them renders in blocks of frames and the other does not, or in other blocks.
    """

    def __init__(self, first: Renderer, then: Renderer, at_us: int) -> None:
        self.first, self.then, self.at_us = first, then, at_us
        self.chunk, other = chunk_of(first), chunk_of(then)
        if self.chunk != other:
            raise InputError(
                "changing over to another renderer",
                f"blocks of {self.chunk or 'one frame'} and of {other or 'one frame'}",
                "the policy is asked at other times under each of them",
                "choose the mode 'speculative' for both",
            )
        self.lookahead = max(lookahead_of(first), lookahead_of(then))
        self.stage_ms: Mapping[str, float] = {}

    def render(self, request: RenderRequest) -> Frame:
        """Render one frame."""
        return self.render_batch([request])[0]

    def render_batch(self, requests: Sequence[RenderRequest]) -> Sequence[Frame]:
        """Render the frames of an instant or of a block; a block belongs to the part in whose time it ends."""
        early = max(request.t_us for request in requests) < self.at_us
        used = self.first if early else self.then
        frames = batch_of(used)(requests)
        self.stage_ms = dict(spent_by(used))
        if early and self.then is not self.first:
            batch_of(self.then)(requests)
        return frames

    def facts(self) -> dict[str, Any]:
        """Return what the fixer of the part that took over, or else of the first, has to say."""
        return facts_of(self.then) or facts_of(self.first)


class SwitchedPolicy:
    """Answer with ``first`` before ``at_us`` and with ``then`` from it on.

    Args:
        first: Reset with the rollout's seed.
        then: Reset with ``then_seed``.
        at_us: When to change over.
        then_seed: Seed of the second policy.
        camera_us: The scenario's camera period.
    """

    def __init__(self, first: Policy, then: Policy, at_us: int, then_seed: int, camera_us: int) -> None:
        self.first, self.then, self.at_us, self.then_seed = first, then, at_us, then_seed
        self.sensors: Sequence[SensorSpec] = joined_sensors(first.sensors, then.sensors, camera_us)

    def reset(self, seed: int, route: Route) -> None:
        """Start both."""
        self.first.reset(seed, route)
        if self.then is not self.first:
            self.then.reset(self.then_seed, route)

    def act(self, observation: Observation) -> Plan:
        """Return the plan of the policy in force."""
        early = observation.t_us < self.at_us
        plan = (self.first if early else self.then).act(observation)
        if early and self.then is not self.first:
            self.then.act(observation)
        return plan


class SwitchedController:
    """Drive with ``first`` before ``at_us`` and with ``then`` from it on. Controllers are pure: there is no history to keep."""

    def __init__(self, first: Controller, then: Controller, at_us: int) -> None:
        self.first, self.then, self.at_us = first, then, at_us

    def advance(self, state: EgoState, plan: Trajectory | None, to_us: int) -> EgoState:
        """Return the state at ``to_us``."""
        return (self.first if state.t_us < self.at_us else self.then).advance(state, plan, to_us)


def joined_sensors(first: Sequence[SensorSpec], then: Sequence[SensorSpec], camera_us: int) -> tuple[SensorSpec, ...]:
    """Return the cameras of two policies; one that both take comes at the shorter of its periods.

    Args:
        first: Cameras of one.
        then: Cameras of the other.
        camera_us: The scenario's period, for which a sensor's 0 stands.
    """
    joined = {sensor.camera: sensor for sensor in first}
    for sensor in then:
        known = joined.get(sensor.camera)
        if known is None or (sensor.interval_us or camera_us) < (known.interval_us or camera_us):
            joined[sensor.camera] = sensor
    return tuple(joined.values())
