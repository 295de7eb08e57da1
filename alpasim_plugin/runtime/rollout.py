"""One closed-loop rollout: scenario -> world -> renderer -> policy -> vehicle -> log, once per tick."""

from __future__ import annotations

import time

from alpasim_plugin.clock import Clock
from alpasim_plugin.control import make_controller
from alpasim_plugin.parts import complete
from alpasim_plugin.runtime.cadence import make_cadence
from alpasim_plugin.runtime.cameras import CameraRig
from alpasim_plugin.runtime.forecast import Forecaster
from alpasim_plugin.runtime.guards import checked_frames, checked_plan, checked_sensors, reset_policy
from alpasim_plugin.runtime.latency import PlanQueue
from alpasim_plugin.runtime.loop_state import LoopState
from alpasim_plugin.runtime.path_end import PathEnd
from alpasim_plugin.runtime.recorder import Recorder
from alpasim_plugin.types import Controller, Policy, Renderer, Scenario
from alpasim_plugin.world.actors import Actors, make_actors


def run_rollout(
    scenario: Scenario,
    renderer: Renderer,
    policy: Policy,
    seed: int = 0,
    recorder: Recorder | None = None,
    controller: Controller | None = None,
    actors: Actors | None = None,
) -> Recorder:
    """Drive one scenario once and return its recorder.

    Until ``start_us + warmup_us`` the logged ego pose is forced while renderer and policy run; then the loop is closed. It ends at
    ``end_us``, or, if the scenario says so, where the ego passes the end of the recorded path (`alpasim_plugin.runtime.path_end`).

    Args:
        scenario: The scenario.
        renderer: A session for this rollout alone; see `make_renderer`.
        policy: Plans from the frames; see `make_policy`.
        seed: Rollout seed: the policy's sampling noise; see `alpasim_plugin.seeding`.
        recorder: Records the rollout; by default into a temporary folder.
        controller: Vehicle model; by default the policy's, else the bicycle with a tracker.
        actors: Road users at their beginning; by default those of the scenario.

    Raises:
        PolicyError: The policy raised or broke its contract.
        RendererError: The renderer raised, or a frame does not match its request.
    """
    clock = Clock(scenario.start_us, scenario.end_us, scenario.rates)
    recorder = recorder or Recorder(scenario, seed)
    renderer, policy = complete(renderer, Renderer), complete(policy, Policy)
    controller = complete(controller or make_controller(policy.controller, scenario.vehicle), Controller)
    actors = actors or make_actors(scenario)
    plans = PlanQueue(scenario.latency)
    state = LoopState.at_start(scenario, clock.n_steps)
    sensors = checked_sensors(policy)
    watched = () if sensors else recorder.watch(scenario)  # what a policy without cameras does can be seen all the same
    cadence = make_cadence(clock, scenario, sensors, renderer.block)
    path_end = PathEnd(scenario.ego_log, scenario.stop_at_path_end)
    forecaster = Forecaster(scenario, controller, plans, actors, state)
    rig = CameraRig(scenario, sensors or watched, clock, cadence, forecaster, renderer.lookahead)
    reset_policy(policy, seed, scenario.route)
    recorder.start(clock, rig.specs)
    seen = {} if watched else rig.specs

    for tick in clock.ticks():
        with recorder.stage("actors"):
            others = actors.step(tick.t_us, state.ego)
        recorder.poses(state.ego, others)
        requests = rig.requests(tick, state.history, others)
        with recorder.rendering(renderer, len(requests)):
            frames = checked_frames(renderer, requests)
        if frames and not watched:
            plans.frames(tick.t_us, renderer.stage_ms)
        for frame, request in zip(frames, requests, strict=True):
            if frame.camera in seen:
                state.frames[frame.camera] = frame
            recorder.frame(frame, request)
        if path_end.ends_rollout(state.ego.T_world_rig[:2, 3]) or tick.is_last:
            policy.end(dict(state.frames))
            break
        if cadence.queries_at(tick.t_us):
            observation = state.observe(seen)
            recorder.policy_query(observation, clock)
            began = time.perf_counter()
            with recorder.stage("policy"):
                plan = checked_plan(policy, observation)
            recorder.plan_motion.add(plan, state.ego)
            plan_world, *samples = state.to_world(plan)
            plans.submit(plan_world, tick.t_us, int((time.perf_counter() - began) * 1e6))
            recorder.policy_plan(plan_world, samples)
        before, active = state.ego, plans.active(tick.t_us)
        with recorder.stage("control"):
            forced = state.advance(controller, active, tick.t_us + clock.rates.control_us)
        recorder.control_step(before, active, state.ego, forced)
    recorder.finish(path_end)
    return recorder
