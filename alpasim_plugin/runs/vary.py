"""Sequential search along one or two parameters of a scene: drive the points of a grid that enclose
where each variant starts to fail.

Everything but the parameters stays as it is: the scene is the same, and so is the noise, since every
point bears the scene's name with its values behind it (`core.seeding.POINT`). What is driven next
follows from the outcomes alone, so the same command continues after any interruption.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.core.lazy import require_library
from alpasim_plugin.core.parts import digest
from alpasim_plugin.core.seeding import POINT
from alpasim_plugin.log.run_folder.records import Manifest, RunInfo
from alpasim_plugin.runs.plan import Cell, RunPlan
from alpasim_plugin.runs.run import Progress
from evaluators.metrics.outcomes import OUTCOMES, POLICY_FAULT
from evaluators.pages.boundary import sentence_of
from evaluators.statistics.boundary import (
    MOST_POINTS,
    STEPS,
    Bracket,
    Interval,
    boundary_of,
    bracket_of,
    difference_of,
    next_points,
)
from evaluators.statistics.boundary_area import AREA_STEPS, MOST_AREA_POINTS, Area, area_of
from evaluators.statistics.variants import Variant, usual_base, variants_of
from scenarios.suite import ScenarioRef

UNITS = {"mps": "m/s", "mps2": "m/s\u00b2", "m": "m", "s": "s", "us": "\u00b5s", "rad": "rad"}
RANGE = re.compile(r"([A-Za-z_][\w.\-]*)=([^=]+?)\.\.([^=]+)")
EXAMPLE = "Write for example --vary actors.cutter.s_m=4..14."
MakePlan = Callable[[Sequence[ScenarioRef]], RunPlan]
Point = tuple[int, ...]  # of the grid, a step of each parameter


@dataclass(frozen=True)
class Sweep:
    """One parameter of a scene and its range.

    Attributes:
        key: Dotted key of the scenario file.
        low, high: Ends of the range.
        steps: Of the grid between them.
    """

    key: str
    low: float
    high: float
    steps: int = STEPS

    @classmethod
    def parse(cls, text: str, steps: int = STEPS) -> Sweep:
        """Read ``KEY=LOW..HIGH``.

        Raises:
            InputError: Another form, no numbers, or ``LOW`` is not below ``HIGH``.
        """
        match = RANGE.fullmatch(text.strip())
        if match is None:
            raise InputError(f"--vary {text}: not KEY=LOW..HIGH", EXAMPLE)
        try:
            low = float(match[2])
            high = float(match[3])
        except ValueError:
            raise InputError(f"--vary {text}: an end is not a number", EXAMPLE) from None
        if not -1e12 < low < high < 1e12:
            raise InputError(f"--vary {text}: LOW is not below HIGH", EXAMPLE)
        if match[1] == "seed":
            raise InputError(
                f"--vary {text}: every seed is another scene", "Use --seeds, or name a parameter."
            )
        sweep = cls(match[1], low, high, steps)
        if len(set(sweep.values)) <= steps:
            raise InputError(
                f"--vary {text}: its {steps + 1} points round to fewer values",
                "Give a wider range.",
            )
        return sweep

    @property
    def values(self) -> list[float]:
        """Give the values of the grid; times in microseconds are whole numbers."""
        digits = 0 if self.key.endswith("_us") else 9
        span = self.high - self.low
        return [
            float(round(self.low + span * point / self.steps, digits))
            for point in range(self.steps + 1)
        ]

    @property
    def unit(self) -> str:
        """Give the unit that the key ends with; empty where it names none."""
        return UNITS.get(self.key.rpartition("_")[2], "")


def parse_sweeps(texts: Sequence[str]) -> tuple[Sweep, ...]:
    """Read every ``--vary``; their order does not matter.

    Raises:
        InputError: More than two, a key named twice, or no optuna for two.
    """
    if len(texts) == 2:
        require_library(
            "optuna", "--vary of two parameters", 'Run pip install "alpasim-onefixer[vary]".'
        )
    elif len(texts) > 2:
        raise InputError(
            f"--vary: {len(texts)} parameters", "Name at most two, and fix others by --set."
        )
    sweeps = [Sweep.parse(text, AREA_STEPS if len(texts) == 2 else STEPS) for text in texts]
    if len({sweep.key for sweep in sweeps}) < len(sweeps):
        raise InputError(f"--vary: {sweeps[0].key} is named twice", "Name two parameters.")
    return tuple(sorted(sweeps, key=lambda sweep: sweep.key))


@dataclass
class BoundarySearch:
    """The points driven so far, what follows from them, and which come next; a
    `alpasim_plugin.runs.run.Search`.

    Attributes:
        plan: The scene as written, with the keys of the whole run.
        sweeps: One or two parameters and their ranges.
        reached: The parts of the ranges in which the scene can be built.
        cells: The rollouts driven so far.
        scenes: Values of the parameters -> plan of the scene with them.
        unreachable: Values of the parameters -> why the scene cannot be built with them.
    """

    kind: ClassVar[str] = "vary"
    plan: RunPlan
    sweeps: tuple[Sweep, ...]
    make: MakePlan
    driven: dict[str, Manifest] = field(default_factory=dict)
    cells: list[Cell] = field(default_factory=list)
    scenes: dict[tuple[float, ...], RunPlan] = field(default_factory=dict)
    unreachable: dict[tuple[float, ...], InputError] = field(default_factory=dict)
    failed: dict[tuple[Variant, int], dict[Point, bool]] = field(default_factory=dict)
    stopped: str = ""

    def __post_init__(self) -> None:
        ref = self.plan.cells[0].ref
        varied = digest([[one.key, one.low, one.high, one.steps] for one in self.sweeps])
        self.plan = replace(self.plan, question=varied)
        self.is_area = len(self.sweeps) == 2
        most = MOST_AREA_POINTS if self.is_area else MOST_POINTS
        self.ceiling = replace(self.plan, cells=self.plan.cells * most, whole=self.plan)
        self.own_id = self.plan.cells[0].scene.removesuffix(f"-seed{ref.seed}")
        self.ref = ref
        names = [(cell.renderer.name, cell.policy.name) for cell in self.plan.cells]
        self.variants = variants_of(names)
        self.failed = {(one, seed): {} for one in self.variants for seed in self.plan.seeds}
        self.at_once = len(self.failed) * 4
        self.points: dict[str, Point] = {}  # by scene
        self.skipped: set[Point] = set()
        self.reached = tuple(self._reachable_part(axis) for axis in range(len(self.sweeps)))

    def _reachable_part(self, axis: int) -> Sweep:
        """Return the part of a range in which the scene can be built, with the other parameter in
        the middle of its own.
        """
        sweep = self.sweeps[axis]
        middle = [one.values[one.steps // 2] for one in self.sweeps]

        def values(point: int) -> tuple[float, ...]:
            return (*middle[:axis], sweep.values[point], *middle[axis + 1 :])

        ends = [end for end in (0, sweep.steps) if self._is_reachable(values(end))]
        good = ends[0] if ends else 0
        bad = sweep.steps - good
        inside = 1 if good == 0 else sweep.steps - 1  # of a whole number the ends alone are whole
        for point in (good, inside):
            if not self._is_reachable(values(point)):
                raise self.unreachable[values(point)]
        if len(ends) == 2:
            return sweep
        reached = inside
        while abs(reached - bad) > 1:
            tried = (reached + bad) // 2
            if self._is_reachable(values(tried)):
                reached = tried
            else:
                bad = tried
        low, high = sorted((sweep.values[good], sweep.values[reached]))
        part = replace(sweep, low=low, high=high)
        if len(set(part.values)) <= part.steps:
            raise self.unreachable[values(bad)]
        return part

    def _values(self, point: Point) -> tuple[float, ...]:
        """Return the values of the parameters at a point."""
        return tuple(one.values[step] for one, step in zip(self.reached, point, strict=True))

    def _is_reachable(self, values: tuple[float, ...]) -> bool:
        """Plan the rollouts of the scene with some values, unless it cannot be built."""
        if values not in self.scenes and values not in self.unreachable:
            texts = [f"{int(one)}" if one.is_integer() else f"{one!r}" for one in values]
            name = self.own_id + "".join(POINT + text for text in texts)
            keys = [sweep.key for sweep in self.sweeps]
            more = [f"{key}={text}" for key, text in zip(keys, texts, strict=True)]
            overrides = (*self.ref.overrides, *more, f"scene_id={name}")
            try:
                self.scenes[values] = self.make([replace(self.ref, overrides=overrides)])
            except InputError as error:
                message = f"--vary {', '.join(more)}: {error.message}"
                self.unreachable[values] = InputError(message, error.hint)
        return values in self.scenes

    def _candidates(self, failed: Mapping[Point, bool]) -> list[Point]:
        """Return the points that a variant and seed drives next."""
        if self.is_area:
            from alpasim_plugin.runs.vary_study import next_points as next_area_points

            return next_area_points(failed, self.skipped)
        skipped = {step for (step,) in self.skipped}
        return [(step,) for step in next_points(_steps(failed), skipped)]

    def next_plan(self) -> RunPlan | None:
        """Return the rollouts of the next round; None where the search has ended."""
        if self.stopped:
            return None
        cells: list[Cell] = []
        for (variant, seed), failed in self.failed.items():
            points: list[Point] = []
            while not points and (candidates := self._candidates(failed)):
                points = [point for point in candidates if self._is_reachable(self._values(point))]
                self.skipped |= set(candidates) - set(points)
            for point in points:
                plan = self.scenes[self._values(point)]
                self.points[plan.cells[0].scene] = point
                cells += [
                    cell
                    for cell in plan.cells
                    if (cell.renderer.name, cell.policy.name, cell.seed)
                    == (variant.renderer, variant.policy, seed)
                ]
        return self.plan_of(cells) if cells else None

    def plan_of(self, cells: Sequence[Cell]) -> RunPlan:
        """Return a plan of some rollouts with the keys of the whole run."""
        scenario_by_name = {
            name: scenario
            for plan in self.scenes.values()
            for name, scenario in plan.scenarios.items()
        }
        wanted = dict.fromkeys(cell.scene for cell in cells)
        scenarios = {name: scenario_by_name[name] for name in wanted}
        return replace(self.plan, cells=tuple(cells), scenarios=scenarios, whole=self.plan)

    def driven_plan(self) -> RunPlan:
        """Return the plan of the points driven so far."""
        return self.plan_of(self.cells)

    def announce(self, root: Path, progress: Progress) -> None:
        """Do nothing: `stated_in` puts the record into the summary."""

    def stated_in(self, info: RunInfo) -> RunInfo:
        """Return ``run.json`` with the record."""
        return replace(info, boundary=self.record())

    def add(self, plan: RunPlan, manifests: Sequence[Manifest]) -> None:
        """Take in the outcomes of a round."""
        for cell, manifest in zip(plan.cells, manifests, strict=True):
            self.cells.append(cell)
            self.driven[cell.folder.as_posix()] = manifest
            if not manifest.ok:
                failed = True if manifest.failure_class == POLICY_FAULT else None
            else:
                metrics = manifest.metrics
                measured = [metrics[name] for name in OUTCOMES if name in metrics]
                failed = any(one.value is not None and one.value >= 0.5 for one in measured)
                needed = ("collision_any", "offroad")
                is_known = all(name in metrics and metrics[name].valid for name in needed)
                if not failed and not is_known:
                    failed = None  # it is not known
            if failed is None:
                self.stopped = f"{cell.folder.as_posix()} has no outcome"
                continue
            variant = Variant(cell.renderer.name, cell.policy.name)
            self.failed[variant, cell.seed][self.points[cell.scene]] = failed

    def record(self) -> JsonObject:
        """Return what ``summary.json`` holds of the search, as its member ``boundary``."""
        facts_by_variant = {one: self._of_variant(one) for one in self.variants}
        base = usual_base(self.variants, self.plan.options.baseline)
        differences = {}
        for variant, other in base.pairs(self.variants):
            brackets = facts_by_variant[variant][1]
            others = facts_by_variant[other][1]
            if brackets and others:
                estimate = difference_of(brackets, others)
                differences[variant.name] = {"baseline": other.name} | vars(estimate)
        grid_points = math.prod(one.steps + 1 for one in self.sweeps)
        record: JsonObject = {
            "parameter": self._per_parameter([one.key for one in self.sweeps]),
            "unit": self._per_parameter([one.unit for one in self.sweeps]),
            "range": self._per_parameter([[one.low, one.high] for one in self.sweeps]),
            "reachable": self._per_parameter([[one.low, one.high] for one in self.reached]),
            "unreachable": {
                ", ".join(f"{one:g}" for one in values): error.message
                for values, error in self.unreachable.items()
            },
            "stopped": self.stopped,
            "rollouts": len(self.driven),
            "grid_rollouts": grid_points * len(self.failed),
            "variants": {one.name: facts for one, (facts, _) in facts_by_variant.items()},
            "differences": differences,
        }
        return record | {"sentence": sentence_of(record)}

    def _per_parameter(self, items: Sequence[Any]) -> Any:
        """Return the facts of two parameters as a list, or the fact of a single parameter."""
        return list(items) if self.is_area else items[0]

    def _of_variant(self, variant: Variant) -> tuple[JsonObject, Sequence[Interval]]:
        """Return the facts of a variant, and the brackets or areas of its seeds if all have one."""
        seeds = {seed: self.failed[variant, seed] for seed in self.plan.seeds}
        values = self.reached[-1].values
        ended = {
            seed: area_of(failed, values)
            if self.is_area
            else bracket_of(_steps(failed), dict(enumerate(values)))
            for seed, failed in seeds.items()
        }
        facts: JsonObject = {
            "outcomes": {
                str(seed): [[*self._values(point), failed[point]] for point in sorted(failed)]
                for seed, failed in seeds.items()
            }
        }
        areas = {seed: end for seed, end in ended.items() if isinstance(end, Area)}
        brackets = [end for end in ended.values() if isinstance(end, Bracket)]
        reasons = [end for end in ended.values() if isinstance(end, str)]
        if self.stopped:
            reasons.append("not finished")
        elif len({bracket.fails_below for bracket in brackets}) > 1:
            reasons.append("fails on either side, by seed")
        if reasons:
            counted = [f"{why} in {reasons.count(why)} of {len(ended)} seeds" for why in reasons]
            return facts | {"reason": "; ".join(dict.fromkeys(counted))}, []
        if self.is_area:
            return facts | _area_facts(areas), list(areas.values())
        return facts | _bracket_facts(brackets), brackets


def _area_facts(areas: Mapping[int, Area]) -> JsonObject:
    """Return the facts of a boundary in two parameters, of which each seed has an area."""
    return {
        "contradictions": sum(area.contradictions for area in areas.values()),
        "areas": {str(seed): vars(area) for seed, area in areas.items()},
        **vars(boundary_of(list(areas.values()))),
    }


def _bracket_facts(brackets: Sequence[Bracket]) -> JsonObject:
    """Return the facts of a boundary along one parameter, of which each seed has a bracket; all fail
    on the same side.
    """
    return {
        "fails": "below" if brackets[0].fails_below else "above",
        "changes": max(bracket.changes for bracket in brackets),
        **vars(boundary_of(brackets)),
    }


def _steps(failed: Mapping[Point, bool]) -> dict[int, bool]:
    """Return outcomes along one parameter by step."""
    return {step: has_failed for (step,), has_failed in failed.items()}
