"""One closed-loop rollout: scenario -> world -> renderer -> policy -> vehicle -> log, once per
tick.
"""

import time
from collections.abc import Generator, Mapping, Sequence

from alpasim_plugin.control import make_controller
from alpasim_plugin.core.clock import Clock
from alpasim_plugin.core.errors import PolicyError
from alpasim_plugin.core.interfaces import Controller, Policy, Renderer
from alpasim_plugin.core.parts import complete
from alpasim_plugin.core.path_end import PathEnd
from alpasim_plugin.core.types import F64, Observation, Plan, Scenario, SensorSpec
from alpasim_plugin.runs.cameras import CameraRig, make_cadence
from alpasim_plugin.runs.guards import (
    calling,
    checked_frames,
    checked_plan,
    checked_sensors,
    reset_policy,
)
from alpasim_plugin.runs.loop_state import Forecaster, LoopState, PlanQueue
from alpasim_plugin.runs.recorder import Recorder
from alpasim_plugin.world.actors import make_actors


def run_rollout(
    scenario: Scenario,
    renderer: Renderer,
    policy: Policy,
    seed: int = 0,
    recorder: Recorder | None = None,
    controller: Controller | None = None,
) -> Recorder:
    """Drive one scenario once and return its recorder.

    Until ``start_us + warmup_us`` the logged ego pose is forced while renderer and policy run; then
    the loop is closed. It ends at ``end_us``, or, unless the scenario says else, where the ego passes
    the end of its path: a goal, or where the road ends (`alpasim_plugin.core.path_end`).

    Args:
        scenario: The scenario.
        renderer: A session for this rollout alone; see `make_renderer`.
        policy: Plans from the frames; see `make_policy`.
        seed: Rollout seed: the policy's sampling noise; see `alpasim_plugin.core.seeding`.
        recorder: Records the rollout; by default into a temporary folder.
        controller: Vehicle model; by default the policy's, else the bicycle with a tracker.

    Raises:
        PolicyError: The policy raised or broke its contract.
        RendererError: The renderer raised, or a frame does not match its request.
    """
    recorder = recorder or Recorder(scenario, seed)
    policy = complete(policy, Policy)
    controller = complete(
        controller or make_controller(policy.controller, scenario.vehicle), Controller
    )
    sensors = checked_sensors(policy)
    loop = Loop(scenario, renderer, sensors, controller, recorder, policy.sees_road_users)
    reset_policy(policy, seed, scenario.route)
    driving = loop.drive()
    try:
        observation = next(driving)
        while True:
            observation = driving.send(checked_plan(policy, observation))
    except StopIteration:  # the rollout has ended
        pass
    with calling(policy, "end", PolicyError):
        policy.end(dict(loop.state.frames))
    recorder.finish(loop.path_end)
    return recorder


class Loop:
    """The closed loop of one rollout, which stops wherever a plan is needed: for a policy
    (`run_rollout`), or for whoever steps it.

    Args:
        scenario: The scenario.
        renderer: A session for this rollout alone.
        sensors: Cameras to render.
        controller: Vehicle model.
        recorder: Records the rollout. Whoever drives calls its ``finish``.
        tells_road_users: Whether observations say where the other road users are.

    Attributes:
        state: The ego and the newest frames.
        actors: Poses of the other road users at the present instant, by id.
        path_end: Whether the end of the path was passed.
    """

    def __init__(
        self,
        scenario: Scenario,
        renderer: Renderer,
        sensors: Sequence[SensorSpec],
        controller: Controller,
        recorder: Recorder,
        tells_road_users: bool = False,
    ) -> None:
        self._tells_road_users = tells_road_users
        self._clock = clock = Clock(scenario.start_us, scenario.end_us, scenario.rates)
        self._renderer, self._controller, self._recorder = (
            complete(renderer, Renderer),
            controller,
            recorder,
        )
        self._recorded_until_us = scenario.recorded_until_us
        self._sensors = sensors
        self._world = make_actors(scenario)
        self._plans = PlanQueue(scenario.latency)
        self.state = LoopState.at_start(scenario, clock.n_steps)
        self.actors: Mapping[str, F64] = {}
        self._cadence = make_cadence(clock, scenario, sensors, self._renderer.block)
        self.path_end = PathEnd(scenario, scenario.stop_at_path_end)
        forecaster = Forecaster(scenario, controller, self._plans, self._world, self.state)
        self._rig = CameraRig(
            scenario,
            sensors,
            clock,
            self._cadence,
            forecaster,
            self._renderer.lookahead,
        )

    def drive(self) -> Generator[Observation, Plan, None]:
        """Yield an observation at every policy query and take the plan for it; end with the
        rollout.

        Raises:
            RendererError: The renderer raised, or a frame does not match its request.
        """
        clock = self._clock
        renderer = self._renderer
        recorder = self._recorder
        plans = self._plans
        state = self.state
        recorder.start(clock, self._rig.specs)
        for tick in clock.ticks():
            with recorder.stage("actors"):
                self.actors = self._world.step(tick.t_us, state.ego)
            recorder.poses(state.ego, self.actors)
            requests = self._rig.requests(tick, state.history, self.actors)
            with recorder.rendering(renderer, len(requests)):
                frames = checked_frames(renderer, requests)
            if frames:
                plans.frames(tick.t_us, renderer.stage_ms)
            for frame, request in zip(frames, requests, strict=True):
                state.frames[frame.camera] = frame
                recorder.frame(frame, request)
            if self._has_ended(tick.t_us) or tick.is_last:
                return
            if self._cadence.queries_at(tick.t_us):
                told = self.actors if self._tells_road_users else None
                observation = state.observe(self._rig.specs, self._sensors, told)
                recorder.policy_query(observation, clock)
                began = time.perf_counter()
                with recorder.stage("policy"):
                    plan = yield observation
                plan_world, *samples = state.to_world(plan)
                plans.submit(plan_world, tick.t_us, int((time.perf_counter() - began) * 1e6))
                recorder.policy_plan(plan_world, samples, plan.debug)
            before = state.ego
            active = plans.active(tick.t_us)
            with recorder.stage("control"):
                forced = state.advance(self._controller, active, tick.t_us + clock.rates.control_us)
            recorder.control_step(before, active, state.ego, forced)

    def _has_ended(self, t_us: int) -> bool:
        """Tell whether the ego has passed the end of its path, or is lost when the time of the
        recorded drive is over: the time beyond it is for those who are on their way.
        """
        axle_xy = self.state.ego.T_world_rig[:2, 3]
        if self.path_end.ends_rollout(axle_xy):
            return True
        is_on_its_way = t_us < self._recorded_until_us or self.path_end.passed
        return not is_on_its_way and self.path_end.is_lost(axle_xy)
