"""The plan of a run: its rollouts, renderer x policy x scene x seed, with resolved parts and content
keys.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal

from alpasim_plugin.control import make_controller
from alpasim_plugin.core.clock import Clock
from alpasim_plugin.core.devices import require_device
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.flags import Flag
from alpasim_plugin.core.parts import PartSpec, RendererSpec, digest, resolve, resolve_renderer
from alpasim_plugin.core.parts.grammar import split_label
from alpasim_plugin.core.parts.source import package_digest
from alpasim_plugin.core.types import Scenario
from alpasim_plugin.log.run_folder.records import RunConfig, SceneRef
from alpasim_plugin.log.run_folder.schema import rollout_folder
from alpasim_plugin.renderers.background import background_note
from evaluators import resolve_evaluators
from evaluators.metrics.presets import DEFAULT, preset
from scenarios.load import code_digest_of, load_scenario
from scenarios.suite import ScenarioRef

SIMRUN = "simrun"  # its code, among what a rollout is made of


@dataclass(frozen=True)
class RunOptions:
    """Everything except the rollouts that determines a run's results."""

    preset: str = DEFAULT
    images: Annotated[Literal["none", "jpeg", "png"], Flag("Camera frames in rollout.asl.")] = (
        "jpeg"
    )
    video: Annotated[
        Literal["none", "failures", "all"], Flag("Write front.mp4, of all cameras.")
    ] = "failures"
    device: Annotated[str, Flag("Where renderers compute: cpu, cuda or cuda:N.")] = "cpu"
    baseline: Annotated[
        str | None, Flag("RENDERER, POLICY or RENDERER/POLICY to compare with.", names="renderer")
    ] = None
    fixer: tuple[str, ...] = ()  # KEY=VALUE of the fixers' settings
    controller: Annotated[
        str | None,
        Flag("Controller of the plans; default: the policy's.", names="controller"),
    ] = None
    evaluators: Annotated[
        tuple[str, ...],
        Flag("A further evaluator, package.module:Class. Repeatable.", "--evaluator"),
    ] = ()


def options_of(config: RunConfig) -> RunOptions:
    """Return the options of an earlier run, as its ``run.json`` states them."""
    return RunOptions(
        preset=config.preset,
        images=config.images,
        video=config.video,
        device=config.device,
        baseline=config.baseline,
        fixer=config.fixer,
        controller=config.controller,
        evaluators=config.evaluators,
    )


def ref_of(stated: SceneRef) -> ScenarioRef:
    """Return how a scenario was named when it was driven, as ``run.json`` states it."""
    return ScenarioRef(stated.path, stated.seed, stated.overrides, stated.source)


@dataclass(frozen=True)
class Cell:
    """One rollout to run: its parts and its identity."""

    renderer: RendererSpec
    policy: PartSpec
    controller: PartSpec
    scene: str  # scene id
    seed: int
    ref: ScenarioRef
    evaluators: tuple[PartSpec, ...]
    made_of: Mapping[str, str | None]  # digest by name of everything that determines the log
    content_hash: str  # of the scene
    rollout_key: str  # digest of ``made_of``
    score_key: str  # digest of rollout_key and of everything that determines the scores
    # as scenario and preset say; not in the key, since it matters only to a rollout that passes it
    stops_at_path_end: bool = True
    most_steps: int | None = None  # of a rollout that ends by time; in no key, like the one above
    # parts without a digest (remote services): the rollout is reused on request only
    undigested: tuple[str, ...] = ()

    @property
    def folder(self) -> Path:
        """Give the rollout's folder below the run folder."""
        return rollout_folder(self.renderer.name, self.policy.name, self.scene, self.seed)

    @property
    def names(self) -> dict[str, str | int]:
        """Give the columns that identify the rollout in tables."""
        return {
            "renderer": self.renderer.name,
            "policy": self.policy.name,
            "scene": self.scene,
            "seed": self.seed,
        }


@dataclass(frozen=True)
class RunPlan:
    """A resolved run.

    Attributes:
        scenario_names: The scenarios as the command named them: files, folders, suites; in no key.
        shard: Which part of their scenes this is, ``I/N``; None: all of them; in no key.
        question: Digest of a question that decides which of the rollouts are driven; empty where all
            are.
        whole: The plan that this is a part of, whose keys it bears; see `part_of`.
    """

    cells: tuple[Cell, ...]
    scenarios: dict[str, Scenario]
    renderers: tuple[RendererSpec, ...]
    policies: tuple[PartSpec, ...]
    seeds: tuple[int, ...]
    options: RunOptions
    scenario_names: tuple[str, ...] = ()
    shard: str | None = None
    question: str = ""
    whole: RunPlan | None = None

    @property
    def command_key(self) -> str:
        """Give a short digest of the command: names, paths and options, in any order, not the
        content of the parts.
        """
        if self.whole is not None:
            return self.whole.command_key
        named = sorted(
            digest([*cell.names.values(), cell.ref.path, cell.ref.seed, cell.ref.overrides])
            for cell in self.cells
        )
        question = [self.question] if self.question else []
        return digest([named, asdict(self.options), *question])[:12]

    @property
    def content(self) -> str:
        """Give a short digest of everything that determines the results; it changes with any
        part.
        """
        if self.whole is not None:
            return self.whole.content
        return digest([[cell.score_key for cell in self.cells], asdict(self.options)])[:12]

    @property
    def parts(self) -> tuple[PartSpec, ...]:
        """Give every part that the run builds, each once."""
        parts = [
            part
            for cell in self.cells
            for part in (cell.renderer.base, cell.renderer.fixer, cell.policy, cell.controller)
        ]
        parts += [part for cell in self.cells[:1] for part in cell.evaluators]
        return tuple({(part.kind, part.name): part for part in parts if part is not None}.values())

    @property
    def undigested(self) -> tuple[str, ...]:
        """Give the parts without a digest."""
        return tuple(dict.fromkeys(part for cell in self.cells for part in cell.undigested))


def make_plan(
    refs: Sequence[ScenarioRef],
    renderers: Sequence[str],
    policies: Sequence[str],
    seeds: Sequence[int],
    options: RunOptions,
    report: Callable[[int, int], None] | None = None,
) -> RunPlan:
    """Load every scenario, resolve every part, and list the rollouts, scene by scene so that workers
    reuse a loaded scene.

    Args:
        refs: The scenarios.
        renderers, policies, seeds: Their names, and the seeds.
        options: Of the run.
        report: Called with scenarios read, and all of them.

    Raises:
        InputError: A scenario or a part is invalid, two scenarios share an id, or a name is given
            twice.
        InfrastructureError: The device is not here.
    """
    options = replace(options, device=require_device(options.device))
    _check_names({"renderer": renderers, "policy": policies, "seed": seeds})
    rendering = _resolve_renderers(renderers, options.fixer)
    driving = tuple(resolve("policy", name) for name in policies)
    moving = {
        spec.name: resolve("controller", options.controller or spec.controller) for spec in driving
    }
    evaluators = resolve_evaluators(options.evaluators)
    loop = package_digest()
    scoring = scoring_content(options.preset, evaluators)
    scenarios = {}
    sources: dict[str | None, str | None] = {}  # source of a recorded log -> digest of its code
    cells = []
    for ref, scenario in _load(refs, report):
        scenarios[scenario.scene_id] = scenario
        if scenario.source_part not in sources:
            sources[scenario.source_part] = code_digest_of(scenario)
        for renderer, policy, seed in product(rendering, driving, seeds):
            controller = moving[policy.name]
            if controller.name == "perfect":
                make_controller(controller.name, scenario.vehicle)  # refuses friction
            parts = _part_digests(renderer, policy, controller)
            parts[f"source of {scenario.scene_id}"] = sources[scenario.source_part]
            made_of = parts | {SIMRUN: loop} | _facts_of(scenario, seed, options)
            rollout_key = digest(made_of)
            driven = as_driven(scenario, options.preset)
            clock = Clock(driven.start_us, driven.end_us, driven.rates)
            cells.append(
                Cell(
                    renderer,
                    policy,
                    controller,
                    scenario.scene_id,
                    seed,
                    ref,
                    evaluators,
                    made_of,
                    scenario.content_hash,
                    rollout_key,
                    digest([rollout_key, *scoring]),
                    driven.stop_at_path_end,
                    clock.n_steps,
                    tuple(part for part, content in parts.items() if content is None),
                )
            )
    return RunPlan(tuple(cells), scenarios, rendering, driving, tuple(seeds), options)


def as_driven(scenario: Scenario, preset_name: str) -> Scenario:
    """Return a scenario with the end that a preset gives its rollouts: whether they stop at the end
    of the path, and up to when they last.

    Raises:
        InputError: Unknown preset.
    """
    chosen = preset(preset_name)
    ends_by_expert = chosen.until_recorded and scenario.path_end == "goal"
    return replace(
        scenario,
        stop_at_path_end=scenario.stop_at_path_end and chosen.stop_at_path_end,
        end_us=scenario.recorded_until_us if ends_by_expert else scenario.end_us,
    )


def _facts_of(scenario: Scenario, seed: int, options: RunOptions) -> dict[str, str | None]:
    """Return what determines a log beside the parts and the program."""
    return {
        f"scene {scenario.scene_id}": scenario.content_hash,
        "seed": str(seed),
        "--images": options.images,
        "--device": options.device,
    }


def _check_names(names_by_kind: Mapping[str, Sequence[object]]) -> None:
    """Refuse a kind of which nothing is named, or one thing twice.

    Raises:
        InputError: Naming the kind.
    """
    for kind, names in names_by_kind.items():
        if not names:
            raise InputError(f"no {kind} is named", f"Name at least one {kind}.")
        for name, count in Counter(names).items():
            if count > 1:
                raise InputError(
                    f"{kind} {name} is named {count} times", f"Name every {kind} once."
                )


def _resolve_renderers(
    names: Sequence[str], fixer_settings: Sequence[str]
) -> tuple[RendererSpec, ...]:
    """Resolve the renderers of a run.

    Raises:
        InputError: A name is invalid, two resolve to the same renderer, or a fixer's setting is of
            no renderer.
    """
    specs = tuple(resolve_renderer(name, fixer_settings) for name in names)
    labels = [str(spec) for spec in specs]
    if len(set(labels)) != len(labels):
        raise InputError(
            f"renderers {list(names)}: they resolve to {labels}",
            "name every renderer once",
        )
    _check_fixer_settings(fixer_settings, names, specs)
    return specs


def _part_digests(
    renderer: RendererSpec, policy: PartSpec, controller: PartSpec
) -> dict[str, str | None]:
    """Return the digests of a rollout's parts, by kind and name."""
    return {
        f"renderer {renderer.name}": renderer.digest,
        f"policy {policy.name}": policy.digest,
        f"controller {controller.name}": controller.digest,
    }


def _check_fixer_settings(
    settings: Sequence[str], names: Sequence[str], renderers: Sequence[RendererSpec]
) -> None:
    """Refuse settings of fixers that no renderer has."""
    fixed = {spec.name for spec in renderers if spec.fixer is not None}
    labels = {label for label, _ in map(split_label, settings) if label}
    if unknown := sorted(labels - fixed):
        raise InputError(
            f"--set {unknown[0]}:fixer...: no fixer of that name among the renderers {list(names)}",
            "write the name as --renderer has it",
        )
    if settings and not fixed:
        raise InputError(
            f"--set fixer.{settings[0]}: no fixer among the renderers {list(names)}",
            "leave it out, or name a fixer",
        )


def _load(
    refs: Sequence[ScenarioRef], report: Callable[[int, int], None] | None
) -> list[tuple[ScenarioRef, Scenario]]:
    """Load scenarios with the files that they show, and a note where the background is not as stated."""
    loaded: dict[str, tuple[ScenarioRef, Scenario]] = {}
    distinct = list(dict.fromkeys(refs))  # what two suites list is driven once
    for number, ref in enumerate(distinct):
        if report is not None:
            report(number, len(distinct))
        scenario = load_scenario(ref.path, ref.seed, ref.overrides, ref.source)
        if scenario.scene_id in loaded:
            raise InputError(
                f"{ref.path} and {loaded[scenario.scene_id][0].path}: both have the scene id {scenario.scene_id!r}",
                "give one of them another id, or name it once",
            )
        shown_by_files = [actor for actor in scenario.actors if actor.appearance is not None]
        if shown_by_files:
            from alpasim_plugin.streets.build_actors import build_actor  # loads kernels

            for actor in shown_by_files:
                build_actor(actor, scenario)
        note = background_note(scenario)
        loaded[scenario.scene_id] = (
            ref,
            replace(scenario, notes=(*scenario.notes, note)) if note else scenario,
        )
    return list(loaded.values())


def part_of(plan: RunPlan, cells: Sequence[Cell]) -> RunPlan:
    """Return the part of a plan that consists of some of its rollouts, with the keys of the whole."""
    scenes = {cell.scene for cell in cells}
    seeds = {cell.seed for cell in cells}
    scenarios = {name: scenario for name, scenario in plan.scenarios.items() if name in scenes}
    kept = tuple(seed for seed in plan.seeds if seed in seeds)
    return replace(
        plan, cells=tuple(cells), scenarios=scenarios, seeds=kept, whole=plan.whole or plan
    )


def score_key(rollout_key: str, preset_name: str, evaluators: Sequence[PartSpec]) -> str:
    """Return the content key of a rollout's scores; it changes with the preset and the code of the
    evaluators and of the reduction.
    """
    return digest([rollout_key, *scoring_content(preset_name, evaluators)])


def scoring_content(preset_name: str, evaluators: Sequence[PartSpec]) -> tuple[Any, ...]:
    """Return what a `score_key` covers besides the rollout: the preset, the code of the scoring,
    the digest of every evaluator.
    """
    return (
        preset(preset_name).as_dict(),
        package_digest(),
        [(spec.name, spec.digest) for spec in evaluators],
    )
