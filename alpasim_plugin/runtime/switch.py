"""Parts that switch at an instant: the first is active before it, the second from it on.

Before the instant the second part runs with the same inputs, so that it has the same history: its renderer renders every request, its
policy gets every query. Its outputs before the instant are discarded.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import (
    Controller,
    EgoState,
    Frame,
    Observation,
    Plan,
    Policy,
    Renderer,
    RenderRequest,
    Route,
    SensorSpec,
    Trajectory,
)


class SwitchedRenderer(Renderer):
    """Render with ``first`` before ``at_us`` and with ``then`` from it on.

    Raises:
        InputError: Their block rules differ.
    """

    def __init__(self, first: Renderer, then: Renderer, at_us: int) -> None:
        self.first, self.then, self.at_us = first, then, at_us
        self.block = first.block
        if first.block != then.block:
            raise InputError(
                "switching to another renderer",
                f"{first.block or 'frames one by one'} and {then.block or 'frames one by one'}",
                "the two have different query times of the policy",
                "choose the mode 'speculative' for both",
            )
        self.lookahead = max(first.lookahead, then.lookahead)

    def render(self, request: RenderRequest) -> Frame:
        """Render one frame."""
        return self.render_batch([request])[0]

    def render_batch(self, requests: Sequence[RenderRequest]) -> Sequence[Frame]:
        """Render the frames of an instant or of a block; the end of a block decides which part renders it."""
        early = max(request.t_us for request in requests) < self.at_us
        used = self.first if early else self.then
        frames = used.render_batch(requests)
        self.stage_ms = dict(used.stage_ms)
        if early and self.then is not self.first:
            self.then.render_batch(requests)
        return frames

    def facts(self) -> dict[str, Any]:
        """Return the fixer facts of the second part, or of the first if the second has none."""
        return dict(self.then.facts() or self.first.facts())


class SwitchedPolicy(Policy):
    """Plan with ``first`` before ``at_us`` and with ``then`` from it on.

    Args:
        first: Reset with the rollout's seed.
        then: Reset with ``then_seed``.
        at_us: When to switch.
        then_seed: Seed of the second policy.
        camera_us: The scenario's camera period.
    """

    def __init__(self, first: Policy, then: Policy, at_us: int, then_seed: int, camera_us: int) -> None:
        self.first, self.then, self.at_us, self.then_seed = first, then, at_us, then_seed
        self.sensors: Sequence[SensorSpec] = merge_sensors(first.sensors, then.sensors, camera_us)

    def reset(self, seed: int, route: Route) -> None:
        """Reset both."""
        self.first.reset(seed, route)
        if self.then is not self.first:
            self.then.reset(self.then_seed, route)

    def act(self, observation: Observation) -> Plan:
        """Return the plan of the active policy."""
        early = observation.t_us < self.at_us
        plan = (self.first if early else self.then).act(observation)
        if early and self.then is not self.first:
            self.then.act(observation)
        return plan


class SwitchedController(Controller):
    """Drive with ``first`` before ``at_us`` and with ``then`` from it on; the first call of ``then`` gives it the state to begin with."""

    def __init__(self, first: Controller, then: Controller, at_us: int) -> None:
        self.first, self.then, self.at_us = first, then, at_us
        self.grounds = first.grounds and then.grounds

    def close(self) -> None:
        """Close both."""
        self.first.close()
        if self.then is not self.first:
            self.then.close()

    def advance(self, state: EgoState, plan: Trajectory | None, to_us: int) -> EgoState:
        """Return the state at ``to_us``."""
        return (self.first if state.t_us < self.at_us else self.then).advance(state, plan, to_us)


def merge_sensors(first: Sequence[SensorSpec], then: Sequence[SensorSpec], camera_us: int) -> tuple[SensorSpec, ...]:
    """Return the cameras of two policies; a camera of both has the shorter of its periods.

    Args:
        first: Cameras of one.
        then: Cameras of the other.
        camera_us: The scenario's camera period, meant by a sensor's interval of 0.
    """
    joined = {sensor.camera: sensor for sensor in first}
    for sensor in then:
        known = joined.get(sensor.camera)
        if known is None or (sensor.interval_us or camera_us) < (known.interval_us or camera_us):
            joined[sensor.camera] = sensor
    return tuple(joined.values())
