"""Continue a logged rollout from an instant on with another renderer, policy or seed.

Up to that instant the rollout is replayed with its own parts and compared with its log, component
by component, bit for bit. The replay restores the whole state: the ego's speed and steering,
reactive actors, the policy's memory, the renderer's history. A log alone does not hold it (its
poses are float32, and it has no policy state). If the replay differs from the log, an error names
the component and the step.

The new parts get the same inputs before the instant, so that they have the same history: a renderer
renders every request, unless it has none, and a policy gets every query. Their outputs before the
instant are discarded.
"""

import os
import shutil
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from alpasim_plugin.core.errors import InfrastructureError, InputError, PolicyError, SimrunError
from alpasim_plugin.core.interfaces import Controller, Policy, Renderer, complete
from alpasim_plugin.core.parts import digest, resolve, resolve_renderer
from alpasim_plugin.core.types import (
    EgoState,
    Frame,
    Observation,
    Plan,
    RenderRequest,
    Route,
    Scenario,
    SensorSpec,
    Trajectory,
)
from alpasim_plugin.log.run_folder.manifests import read_run_json, write_manifest
from alpasim_plugin.log.run_folder.records import Fork, Manifest
from alpasim_plugin.log.run_folder.schema import MANIFEST, RUN_INFO
from alpasim_plugin.log.run_folder.writer import writing
from alpasim_plugin.log.trace import first_difference
from alpasim_plugin.runs.cell import (
    RolloutParts,
    build_parts,
    failed_manifest,
    run_cell,
    users_parts,
)
from alpasim_plugin.runs.execute import Threads, thread_budget
from alpasim_plugin.runs.guards import calling
from alpasim_plugin.runs.local_executor import apart
from alpasim_plugin.runs.logged_rollout import LoggedRollout
from alpasim_plugin.runs.plan import Cell, RunOptions, RunPlan, score_key
from alpasim_plugin.runs.repeat import log_trace
from alpasim_plugin.runs.run import RunResult, finish_run, write_run_info
from alpasim_plugin.runs.summary import pool_of


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
                f"{first.block or 'frames one by one'} and {then.block or 'frames one by one'}: the two have different query times of the policy",
                "choose the mode 'speculative' for both",
            )
        self.lookahead = max(first.lookahead, then.lookahead)

    def render(self, request: RenderRequest) -> Frame:
        """Render one frame."""
        return self.render_batch([request])[0]

    def render_batch(self, requests: Sequence[RenderRequest]) -> Sequence[Frame]:
        """Render the frames of an instant or of a block; the end of a block decides which part
        renders it.
        """
        early = max(request.t_us for request in requests) < self.at_us
        used = self.first if early else self.then
        frames = used.render_batch(requests)
        self.stage_ms = dict(used.stage_ms)
        if early and self.then is not self.first and self.then.has_history:
            self.then.render_batch(requests)
        return frames

    def facts(self) -> dict[str, Any]:
        """Return the fixer facts of the second part, or of the first if the second has none."""
        return dict(self.then.facts() or self.first.facts())


class OwnFrames(Policy):
    """A policy that sees the frames of its own cameras at its own periods, as if it drove alone,
    where another one shares its cameras at a shorter period. What it raises is its fault, by name.

    Args:
        policy: The policy.
        scenario: Its cameras' periods are meant by a sensor's interval of 0.
    """

    def __init__(self, policy: Policy, scenario: Scenario) -> None:
        self.policy = complete(policy, Policy)
        self.sensors = policy.sensors
        self.sees_road_users = self.policy.sees_road_users
        self._start_us = scenario.start_us
        self._period_us = {
            sensor.camera: scenario.period_us(sensor) for sensor in self.policy.sensors
        }
        self._frames: dict[str, Frame] = {}

    def reset(self, seed: int, route: Route) -> None:
        """Reset the policy, which has seen nothing."""
        self._frames = {}
        with calling(self.policy, "reset", PolicyError):
            self.policy.reset(seed, route)

    def act(self, observation: Observation) -> Plan:
        """Return the plan of the policy for what it sees of an observation."""
        frames = self._own(observation.frames)
        cameras = {name: observation.cameras[name] for name in self._period_us}
        images = {
            name: image
            for name, image in observation.images.items()
            if name in frames and frames[name] is observation.frames[name]
        }
        told = observation.road_users if self.sees_road_users else None
        view = replace(observation, frames=frames, cameras=cameras, images=images, road_users=told)
        with calling(self.policy, "act", PolicyError):
            return self.policy.act(view)

    def end(self, frames: Mapping[str, Frame]) -> None:
        """End the rollout of the policy."""
        with calling(self.policy, "end", PolicyError):
            self.policy.end(self._own(frames))

    def close(self) -> None:
        """Close the policy."""
        with calling(self.policy, "close", PolicyError):
            self.policy.close()

    def facts(self) -> dict[str, Any]:
        """Return the facts of the policy."""
        with calling(self.policy, "facts", PolicyError):
            return dict(self.policy.facts())

    def _own(self, frames: Mapping[str, Frame]) -> dict[str, Frame]:
        """Return the newest frames that the policy asked for, among these and earlier ones."""
        for name, period_us in self._period_us.items():
            frame = frames.get(name)
            if frame is not None and (frame.t_us - self._start_us) % period_us == 0:
                self._frames[name] = frame
        return dict(self._frames)


class SwitchedPolicy(Policy):
    """Plan with ``first`` before ``at_us`` and with ``then`` from it on; each sees its own cameras
    at its own periods.

    Args:
        first: Reset with the rollout's seed.
        then: Reset with ``then_seed``.
        at_us: When to switch.
        then_seed: Seed of the second policy.
        scenario: Its cameras' periods count.

    Raises:
        InputError: The two share a camera at periods of which neither can be shown beside the other.
    """

    def __init__(
        self, first: Policy, then: Policy, at_us: int, then_seed: int, scenario: Scenario
    ) -> None:
        self.first: Policy = OwnFrames(first, scenario)
        self.then = self.first if then is first else OwnFrames(then, scenario)
        self.at_us = at_us
        self.then_seed = then_seed
        self.sensors: Sequence[SensorSpec] = merge_sensors(first.sensors, then.sensors, scenario)
        self.sees_road_users = self.first.sees_road_users or self.then.sees_road_users

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

    def end(self, frames: Mapping[str, Frame]) -> None:
        """End the rollout of both."""
        for policy in self._both:
            policy.end(frames)

    def close(self) -> None:
        """Close both, the second one also where the first one fails."""
        with ExitStack() as stack:
            for policy in self._both:
                stack.callback(policy.close)

    def facts(self) -> dict[str, Any]:
        """Return the facts of the second policy, or of the first if the second has none."""
        return dict(self.then.facts() or self.first.facts())

    @property
    def _both(self) -> tuple[Policy, ...]:
        return (self.first,) if self.then is self.first else (self.first, self.then)


class SwitchedController(Controller):
    """Drive with ``first`` before ``at_us`` and with ``then`` from it on; the first call of
    ``then`` gives it the state to begin with.
    """

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


def merge_sensors(
    first: Sequence[SensorSpec], then: Sequence[SensorSpec], scenario: Scenario
) -> tuple[SensorSpec, ...]:
    """Return the cameras of two policies; a camera of both has the shorter of its periods.

    Args:
        first: Cameras of one.
        then: Cameras of the other.
        scenario: Its cameras' periods are meant by a sensor's interval of 0.

    Raises:
        InputError: A camera's longer period is no multiple of the shorter one, or frames at the
            shorter one come between queries: then a frame of the longer one would not be drawn.
    """
    joined = {sensor.camera: sensor for sensor in first}
    for sensor in then:
        earlier = joined.get(sensor.camera)
        if earlier is None:
            joined[sensor.camera] = sensor
            continue
        before_us = scenario.period_us(earlier)
        then_us = scenario.period_us(sensor)
        shorter_us = min(before_us, then_us)
        longer_us = max(before_us, then_us)
        is_shown = longer_us % shorter_us == 0 and shorter_us % scenario.rates.policy_us == 0
        if before_us != then_us and not is_shown:
            raise InputError(
                f"camera {sensor.camera!r}: the logged policy sees it every {before_us} us, the new "
                f"one every {then_us} us: not both can be shown what they would see alone",
                "Name a policy with the same period; where the longer period is a multiple of the "
                "shorter one, and that of the period of plans, two periods are fine.",
            )
        if then_us < before_us:
            joined[sensor.camera] = sensor
    return tuple(joined.values())


@dataclass(frozen=True)
class Change:
    """Which parts are replaced ``after_us`` after the first frame; None keeps the logged one."""

    after_us: int
    renderer: str | None = None
    policy: str | None = None
    seed: int | None = None

    @property
    def label(self) -> str:
        """Name the continuation in tables, in the column of renderers."""
        parts = [
            self.renderer or "",
            self.policy or "",
            f"seed {self.seed}" if self.seed is not None else "",
        ]
        return f"{', '.join(part for part in parts if part)} from {self.after_us * 1e-6:g} s"

    def apply(self, cell: Cell, options: RunOptions) -> Cell:
        """Return the rollout with the replaced parts.

        A new policy brings its own controller, unless the run named one for all of its policies.

        Args:
            cell: The logged rollout.
            options: Of its run.
        """
        fixer = options.fixer
        renderer = (
            cell.renderer if self.renderer is None else resolve_renderer(self.renderer, fixer)
        )
        policy = cell.policy if self.policy is None else resolve("policy", self.policy)
        controller = cell.controller
        if self.policy is not None and not options.controller:
            controller = resolve("controller", policy.controller)
        return replace(
            cell,
            renderer=renderer,
            policy=policy,
            controller=controller,
            seed=cell.seed if self.seed is None else self.seed,
        )


def fork_rollout(
    past: LoggedRollout, change: Change, root: Path, command: Sequence[str]
) -> RunResult:
    """Continue a rollout and write a run folder with the original and the continuation side by
    side.

    In the tables the continuation is a renderer of its own (`Change.label`), paired with the
    original: same policy name, scene and seed. ``fork`` in ``run.json`` and in the manifest holds
    the change.

    Args:
        past: The logged rollout.
        change: Which parts are replaced, and when.
        root: Run folder to write; must not hold a run.
        command: For ``run.json``.

    Raises:
        InputError: Nothing changes, the instant lies outside the rollout, its latency is measured,
            or ``root`` holds a run.
        InfrastructureError: The replay is not equal to the log up to the instant, or a part failed.
    """
    if change == Change(change.after_us):
        raise InputError(
            f"--at {change.after_us * 1e-06:g}: nothing changes there",
            "Name a --renderer, a --policy or a --seed; `simrun --repeat` drives a rollout twice.",
        )
    length_us = (past.manifest.steps or 0) * past.scenario.rates.control_us
    if not 0 <= change.after_us < length_us:
        raise InputError(
            f"--at {change.after_us * 1e-06:g}: the rollout lasts {length_us * 1e-06:g} s",
            "Choose an instant within it, in seconds after the first frame.",
        )
    past.check_repeatable()
    if os.path.exists(root / RUN_INFO):
        raise InputError(f"--out {root}: it holds a run already", "Choose another --out.")
    with writing(root):
        return _fork(past, change, root, command)


def _fork(past: LoggedRollout, change: Change, root: Path, command: Sequence[str]) -> RunResult:
    began = time.perf_counter()
    options = replace(past.options, baseline=past.cell.renderer.name)
    threads = thread_budget(1, 1)
    original = _copied_original(past, root)
    then = change.apply(past.cell, options)
    fork = _fork_cell(past.cell, then, change, options)
    continuation = _driven(past, then, change, fork, options, root, threads)
    if continuation.ok:
        _check_replay(past, past.scenario.start_us + change.after_us, root / fork.folder)
        continuation = replace(
            continuation, fork=Fork(**vars(change), of=past.name, replay="equal")
        )
        write_manifest(root / fork.folder, continuation)
    plan = RunPlan(
        cells=(past.cell, fork),
        scenarios={past.cell.scene: past.scenario},
        renderers=(past.cell.renderer, fork.renderer),
        policies=(past.cell.policy,),
        seeds=(past.cell.seed,),
        options=options,
    )
    write_run_info(root, plan, command, threads)
    manifests = [original, continuation]
    info = replace(
        read_run_json(root),
        kind="fork",
        fork=continuation.fork,
        pool=pool_of(manifests, threads, time.perf_counter() - began, None),
    )
    summary = finish_run(root, info, manifests)
    return RunResult(root, summary, 2, summary.failures.n_failed)


def _copied_original(past: LoggedRollout, root: Path) -> Manifest:
    """Copy the folder of the logged rollout into the run and return its manifest there."""
    folder = root / past.cell.folder
    shutil.copytree(past.folder, folder, dirs_exist_ok=True)
    manifest = replace(past.manifest, path=past.cell.folder.as_posix(), reused=True)
    write_manifest(folder, manifest)
    return manifest


def _fork_cell(original: Cell, then: Cell, change: Change, options: RunOptions) -> Cell:
    """Return the continuation's place in the tables: the original's, but for a renderer that is
    named after the change, and keys of its own.
    """
    key = digest(
        [
            original.rollout_key,
            asdict(change),
            then.renderer.digest,
            then.policy.digest,
            then.controller.digest,
        ]
    )
    return replace(
        original,
        renderer=replace(then.renderer, name=change.label),
        rollout_key=key,
        score_key=score_key(key, options.preset, original.evaluators),
    )


def _driven(
    past: LoggedRollout,
    then: Cell,
    change: Change,
    fork: Cell,
    options: RunOptions,
    root: Path,
    threads: Threads,
) -> Manifest:
    """Drive the continuation and return its manifest, which holds the error where it failed."""
    work = partial(
        run_cell,
        options=options,
        root=root.absolute(),
        threads=threads.per_worker,
        builder=partial(_parts, past.cell, then, change),
    )
    parts = users_parts(past.cell) or users_parts(then)
    try:
        return apart(work, fork, parts, threads.per_worker)
    except SimrunError as error:
        manifest = failed_manifest(fork, error)
        write_manifest(root / fork.folder, manifest)
        return manifest


def _parts(
    original: Cell,
    then: Cell,
    change: Change,
    fork: Cell,
    options: RunOptions,
    scenario: Scenario,
    threads: int,
) -> RolloutParts:
    """Build the original's parts and those that replace them, switched at the instant; an unchanged
    part is one object.
    """
    at_us = scenario.start_us + change.after_us
    before = build_parts(original, options, scenario, threads, is_shown=True)
    after = (
        before if then == original else build_parts(then, options, scenario, threads, is_shown=True)
    )
    same_renderer = (then.renderer, then.seed) == (original.renderer, original.seed)
    same_policy = (then.policy, then.seed) == (original.policy, original.seed)
    next_policy = before.policy if same_policy else after.policy
    return RolloutParts(
        SwitchedRenderer(
            before.renderer, before.renderer if same_renderer else after.renderer, at_us
        ),
        SwitchedPolicy(before.policy, next_policy, at_us, then.seed, scenario),
        fork.rollout_key,
        after.names,
        SwitchedController(before.controller, after.controller, at_us),
    )


def _check_replay(past: LoggedRollout, at_us: int, folder: Path) -> None:
    """Compare the replay with the log up to the instant.

    Raises:
        InfrastructureError: They differ before the instant.
    """
    logged_trace = log_trace(past.folder)
    replayed_trace = log_trace(folder)
    # Another policy may have more cameras; their frames before the instant have no logged
    # counterpart.
    replayed_trace = {
        key: value
        for key, value in replayed_trace.items()
        if key in logged_trace or key[1] != "frames"
    }
    # The pose at the instant follows from the original parts; its frames and its plan come from the
    # new ones.
    until = {"ego": at_us + 1, "actors": at_us + 1, "frames": at_us, "plans": at_us}
    step_us = past.scenario.rates.control_us
    difference = first_difference(
        logged_trace, replayed_trace, past.scenario.start_us, step_us, until
    )
    if difference is not None:
        (folder / MANIFEST).unlink()
        raise InfrastructureError(
            f"{past.name}: its replay differs from the log before the change: "
            f"{difference['component']} at step {difference['step']}, {difference['what']}",
            "use the machine and the versions in run.json, or run the rollout again",
        )
