"""Collect the evidence of how a rollout failed: what its run stored, and a replay of the rollout
that shows what every renderer of the run gives at the same poses.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from alpasim_plugin.core.errors import InfrastructureError, InputError, PolicyError, RendererError
from alpasim_plugin.core.interfaces import Policy, Renderer
from alpasim_plugin.core.parts import resolve_renderer
from alpasim_plugin.core.places import temporary_folder
from alpasim_plugin.core.types import Frame, Observation, Plan, RenderRequest, Route, SensorSpec
from alpasim_plugin.log.run_folder.rows import Rollout
from alpasim_plugin.log.run_folder.schema import cell_name
from alpasim_plugin.log.trace import first_difference
from alpasim_plugin.runs.cell import build_parts
from alpasim_plugin.runs.execute import thread_budget
from alpasim_plugin.runs.guards import checked_frames, checked_plan
from alpasim_plugin.runs.logged_rollout import LoggedRollout, find_rollout
from alpasim_plugin.runs.recorder import Recorder
from alpasim_plugin.runs.repeat import log_trace
from alpasim_plugin.runs.reports import divergences_of
from alpasim_plugin.runs.rollout import run_rollout
from evaluators.metrics.outcomes import OUTCOMES, outcomes_of
from evaluators.opening import Run
from evaluators.viewer.cause import Cause, Look, cause_of_log, chosen
from evaluators.viewer.drive_data import MAX_SAMPLES, half_seconds


def worst_failure(run: Run) -> Rollout:
    """Return the rollout of a run that failed worst: one that broke off, then the gravest outcome.

    Raises:
        InputError: No rollout failed.
    """
    gravity = {name: number for number, name in enumerate(OUTCOMES)}

    def rank(rollout: Rollout) -> int:
        if not rollout.ok:
            return -1
        return min((gravity[name] for name in outcomes_of(rollout)), default=len(gravity))

    worst = min(run.rollouts, key=rank, default=None)
    if worst is None or rank(worst) == len(gravity):
        raise InputError(
            f"{run.folder}: no rollout of this run failed",
            "Name a rollout: simrun why RUN/RENDERER/POLICY/SCENE/SEED.",
        )
    return worst


def explain(run: Run, rollout: Rollout) -> Cause | None:
    """Return the evidence of how a rollout ended; None where the run stored no log of it.

    The rollout is replayed if its parts allow it. Otherwise the evidence is what the log holds, and
    a note says why.

    Raises:
        InputError: The run's files are damaged.
    """
    cause = cause_of_log(run, rollout, divergences_of(run, rollout))
    if cause is None or not rollout.ok:
        return cause
    others = [
        other.renderer
        for other in run.rollouts
        if other.cell[1:] == rollout.cell[1:] and other.renderer != rollout.renderer
    ]
    try:
        past = find_rollout(run.folder, cell_name(*rollout.cell))
        looks = replay(past, others)
    except (InputError, InfrastructureError, RendererError, PolicyError) as error:
        note = f"The rollout was not replayed, so this page shows the log alone: {error.message}."
        return replace(cause, notes=(*cause.notes, note))
    return replace(cause, looks=chosen(looks, cause.failed_us, [look.t_us for look in looks]))


def replay(past: LoggedRollout, renderers: Sequence[str]) -> list[Look]:
    """Drive a logged rollout again and return what its policy saw and planned at every query, behind
    its own renderer and, at the same poses, behind others.

    Raises:
        InputError: The latency was measured, or the renderers work in different blocks.
        InfrastructureError: The replay is not equal to the log.
        RendererError: A renderer failed.
        PolicyError: The policy failed behind another renderer.
    """
    past.check_repeatable()
    own = past.cell
    threads = thread_budget(1, 1).per_worker
    specs = {own.renderer.name: own.renderer}
    specs |= {name: resolve_renderer(name, past.options.fixer) for name in renderers}
    parts = {
        name: build_parts(replace(own, renderer=spec), past.options, past.scenario, threads)
        for name, spec in specs.items()
    }
    renderer = _Renderers({name: part.renderer for name, part in parts.items()}, own.renderer.name)
    policy = _Policies({name: part.policy for name, part in parts.items()}, renderer)
    with temporary_folder("simrun-why-") as folder:
        images = past.options.images
        with Recorder(past.scenario, own.seed, Path(folder), own.rollout_key, images) as recorder:
            controller = parts[own.renderer.name].controller
            run_rollout(past.scenario, renderer, policy, own.seed, recorder, controller)
        logged = log_trace(past.folder)
        repeated = log_trace(Path(folder))
    difference = first_difference(
        logged, repeated, past.scenario.start_us, past.scenario.rates.control_us
    )
    if difference is not None:
        raise InfrastructureError(
            f"{past.name}: the replay differs from the log: {difference}",
            "Use the machine and the versions in run.json, or run the rollout again.",
        )
    return policy.looks


class _Renderers(Renderer):
    """Renders every request with all renderers and returns the frames of the one that drove."""

    def __init__(self, renderers: Mapping[str, Renderer], driver: str) -> None:
        self.renderers = renderers
        self.driver = driver
        self.block = renderers[driver].block
        if any(renderer.block != self.block for renderer in renderers.values()):
            raise InputError(
                "the run's renderers work in different blocks of frames",
                "Choose the mode 'speculative' for all.",
            )
        self.lookahead = max(renderer.lookahead for renderer in renderers.values())
        self.latest: dict[str, dict[str, Frame]] = {name: {} for name in renderers}

    def render(self, request: RenderRequest) -> Frame:
        return self.render_batch([request])[0]

    def render_batch(self, requests: Sequence[RenderRequest]) -> Sequence[Frame]:
        driven: Sequence[Frame] = ()
        for name, renderer in self.renderers.items():
            frames = checked_frames(renderer, requests)
            self.latest[name] |= {frame.camera: frame for frame in frames}
            if name == self.driver:
                driven = frames
                self.stage_ms = dict(renderer.stage_ms)
        return driven


class _Policies(Policy):
    """Asks one policy per renderer, each with its renderer's frames, and returns the plan of the
    one that drove.
    """

    def __init__(self, policies: Mapping[str, Policy], renderer: _Renderers) -> None:
        self.policies = policies
        self.renderer = renderer
        self.looks: list[Look] = []
        self.sensors: Sequence[SensorSpec] = policies[renderer.driver].sensors

    def reset(self, seed: int, route: Route) -> None:
        for policy in self.policies.values():
            policy.reset(seed, route)

    def act(self, observation: Observation) -> Plan:
        latest = self.renderer.latest
        plans = {
            name: checked_plan(policy, replace(observation, frames=dict(latest[name])))
            for name, policy in self.policies.items()
        }
        shown: dict[str, Frame] = {}
        if self.sensors:
            shown = {name: latest[name][self.sensors[0].camera] for name in self.policies}
        driven = plans[self.renderer.driver]
        lines = {
            name: [half_seconds(plan.times_us, xy) for xy in (plan.xy, *plan.samples[:MAX_SAMPLES])]
            for name, plan in plans.items()
        }
        self.looks.append(
            Look(
                t_us=observation.t_us,
                T_world_rig=observation.ego.T_world_rig,
                speed_mps=observation.ego.speed_mps,
                route=observation.route_rig[:, :2],
                plans=lines,
                frames={name: (frame.t_us, frame.rgb) for name, frame in shown.items()},
                debug=driven.debug,
            )
        )
        return driven
