"""Sequential search along one or two parameters of a scene: drive evenly spaced points, and those of a
finer grid between neighbours of which a variant fails at one.

Everything but the parameters stays as it is: the scene is the same, and so is the noise, since every
point bears the scene's name with its values behind it (`core.seeding.POINT`). What is driven next
follows from the outcomes alone, so the same command continues after any interruption. A point that
one variant or seed asks for is driven with all of them, so that all are compared at equal points.
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
    PARTS,
    SPACINGS,
    difference_of,
    median_boundary,
    next_points,
    stretches_of,
    widest_gap,
)
from evaluators.statistics.boundary_area import AREA_PARTS, AREA_SPACINGS, Lines, claims_of
from evaluators.statistics.intervals import least_for_median
from evaluators.statistics.variants import Variant, usual_base, variants_of
from scenarios.suite import ScenarioRef

UNITS = {"mps": "m/s", "mps2": "m/s\u00b2", "m": "m", "s": "s", "us": "\u00b5s", "rad": "rad"}
RANGE = re.compile(r"([A-Za-z_][\w.\-]*)=([^=]+?)\.\.([^=/]+)(?:/([^=/]+))?")
EXAMPLE = "Write for example --vary actors.cutter.s_m=4..14, or 4..14/0.5 for points 0.5 apart."
MOST_SPACINGS = 200  # of a range
MakePlan = Callable[[Sequence[ScenarioRef]], RunPlan]
Point = tuple[int, ...]  # of the grid, a step of each parameter


@dataclass(frozen=True)
class Sweep:
    """One parameter of a scene and its range.

    Attributes:
        key: Dotted key of the scenario file.
        low, high: Ends of the range.
        spacings: Between its first points.
        parts: Into which the grid divides each.
    """

    key: str
    low: float
    high: float
    spacings: int = SPACINGS
    parts: int = PARTS

    @classmethod
    def parse(cls, text: str, spacings: int = SPACINGS, parts: int = PARTS) -> Sweep:
        """Read ``KEY=LOW..HIGH`` or ``KEY=LOW..HIGH/STEP``.

        Args:
            text: As the user wrote it. First points are at most ``STEP`` apart: closer where it does
                not divide the range.
            spacings: Between first points where there is no ``STEP``.
            parts: Into which the grid divides each.

        Raises:
            InputError: Another form, no numbers, ``LOW`` is not below ``HIGH``, or ``STEP`` does not
                fit between them.
        """
        match = RANGE.fullmatch(text.strip())
        if match is None:
            raise InputError(f"--vary {text}: not KEY=LOW..HIGH or KEY=LOW..HIGH/STEP", EXAMPLE)
        try:
            low = float(match[2])
            high = float(match[3])
            step = float(match[4]) if match[4] else None
        except ValueError:
            raise InputError(
                f"--vary {text}: an end or the step is not a number", EXAMPLE
            ) from None
        if not -1e12 < low < high < 1e12:
            raise InputError(f"--vary {text}: LOW is not below HIGH", EXAMPLE)
        if match[1] == "seed":
            raise InputError(
                f"--vary {text}: every seed is another scene", "Use --seeds, or name a parameter."
            )
        if step is not None:
            if not (high - low) / MOST_SPACINGS <= step <= high - low:
                raise InputError(
                    f"--vary {text}: a step of {step:g} in a range of {high - low:g}",
                    f"Give a step of {(high - low) / MOST_SPACINGS:.3g} to {high - low:g}.",
                )
            spacings = math.ceil((high - low) / step - 1e-9)
        sweep = cls(match[1], low, high, spacings, parts)
        if len(set(sweep.values)) <= sweep.steps:
            raise InputError(
                f"--vary {text}: its {sweep.steps + 1} points round to fewer values",
                "Give a wider range or a larger step.",
            )
        return sweep

    @property
    def steps(self) -> int:
        """Give the steps of the grid."""
        return self.spacings * self.parts

    @property
    def first(self) -> range:
        """Give the first points."""
        return range(0, self.steps + 1, self.parts)

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
    sizes = (AREA_SPACINGS, AREA_PARTS) if len(texts) == 2 else (SPACINGS, PARTS)
    sweeps = [Sweep.parse(text, *sizes) for text in texts]
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
        varied = digest(
            [
                [sweep.key, sweep.low, sweep.high, sweep.spacings, sweep.parts]
                for sweep in self.sweeps
            ]
        )
        self.plan = replace(self.plan, question=varied)
        self.is_area = len(self.sweeps) == 2
        most = math.prod(sweep.steps + 1 for sweep in self.sweeps)
        if self.is_area:  # points beside all lines of first points are never driven
            most -= math.prod(sweep.spacings for sweep in self.sweeps)
        self.ceiling = replace(self.plan, cells=self.plan.cells * most, whole=self.plan)
        self.own_id = self.plan.cells[0].scene.removesuffix(f"-seed{ref.seed}")
        self.ref = ref
        names = [(cell.renderer.name, cell.policy.name) for cell in self.plan.cells]
        self.variants = variants_of(names)
        self.failed = {(variant, seed): {} for variant in self.variants for seed in self.plan.seeds}
        self.at_once = len(self.failed) * 4
        self.points: dict[str, Point] = {}  # by scene
        self.skipped: set[Point] = set()
        self.reached = tuple(self._reachable_part(axis) for axis in range(len(self.sweeps)))

    def _reachable_part(self, axis: int) -> Sweep:
        """Return the part of a range in which the scene can be built, with the other parameter in
        the middle of its own.
        """
        sweep = self.sweeps[axis]
        middle = [sweep.values[sweep.steps // 2] for sweep in self.sweeps]

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
        return tuple(sweep.values[step] for sweep, step in zip(self.reached, point, strict=True))

    def _is_reachable(self, values: tuple[float, ...]) -> bool:
        """Plan the rollouts of the scene with some values, unless it cannot be built."""
        if values not in self.scenes and values not in self.unreachable:
            texts = [f"{int(value)}" if value.is_integer() else f"{value!r}" for value in values]
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

            return next_area_points(failed, self._lines, self.skipped)
        skipped = {step for (step,) in self.skipped}
        first = self.reached[0].first
        return [(step,) for step in next_points(_steps(failed), first, skipped)]

    @property
    def _lines(self) -> Lines:
        """Give the steps of the first points, of two parameters."""
        return self.reached[0].first, self.reached[1].first

    def next_plan(self) -> RunPlan | None:
        """Return the rollouts of the next round; None where the search has ended.

        A point that one variant or seed asks for is driven with all.
        """
        if self.stopped:
            return None
        wanted: set[Point] = set()
        for failed in self.failed.values():
            points: list[Point] = []
            while not points and (candidates := self._candidates(failed)):
                points = [point for point in candidates if self._is_reachable(self._values(point))]
                self.skipped |= set(candidates) - set(points)
            wanted |= set(points)
        cells: list[Cell] = []
        for (variant, seed), failed in self.failed.items():
            for point in sorted(wanted - set(failed)):
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
            failed = has_failed(manifest)
            if failed is None:
                self.stopped = f"{cell.folder.as_posix()} has no outcome"
                continue
            variant = Variant(cell.renderer.name, cell.policy.name)
            self.failed[variant, cell.seed][self.points[cell.scene]] = failed

    def record(self) -> JsonObject:
        """Return what ``summary.json`` holds of the search, as its member ``boundary``."""
        facts_by_variant = {variant: self._of_variant(variant) for variant in self.variants}
        base = usual_base(self.variants, self.plan.options.baseline)
        first = [[sweep.values[step] for step in sweep.first] for sweep in self.reached]
        differences = {}
        for variant, other in base.pairs(self.variants):
            now, was = (facts_by_variant[side]["outcomes"] for side in (variant, other))
            if not self.stopped and (difference := difference_of(now, was, first)):
                differences[variant.name] = {"baseline": other.name} | vars(difference)
        grid_points = math.prod(sweep.steps + 1 for sweep in self.sweeps)
        record: JsonObject = {
            "parameter": self._per_parameter([sweep.key for sweep in self.sweeps]),
            "unit": self._per_parameter([sweep.unit for sweep in self.sweeps]),
            "range": self._per_parameter([[sweep.low, sweep.high] for sweep in self.sweeps]),
            "reachable": self._per_parameter([[sweep.low, sweep.high] for sweep in self.reached]),
            "spacing": self._per_parameter(
                [(sweep.high - sweep.low) / sweep.spacings for sweep in self.reached]
            ),
            "first": self._per_parameter(first),
            "unreachable": {
                ", ".join(f"{value:g}" for value in values): error.message
                for values, error in self.unreachable.items()
            },
            "stopped": self.stopped,
            "rollouts": len(self.driven),
            "grid_rollouts": grid_points * len(self.failed),
            "variants": {variant.name: facts for variant, facts in facts_by_variant.items()},
            "differences": differences,
        }
        if not self.is_area:
            gaps = [widest_gap(facts["outcomes"]) for facts in facts_by_variant.values()]
            record["apart"] = max(gaps)
        return record | {"sentence": sentence_of(record)}

    def _per_parameter(self, items: Sequence[Any]) -> Any:
        """Return the facts of two parameters as a list, or the fact of a single parameter."""
        return list(items) if self.is_area else items[0]

    def _of_variant(self, variant: Variant) -> JsonObject:
        """Return the facts of a variant."""
        seeds = {seed: self.failed[variant, seed] for seed in self.plan.seeds}
        outcomes = {
            str(seed): [[*self._values(point), failed[point]] for point in sorted(failed)]
            for seed, failed in seeds.items()
        }
        facts: JsonObject = {"outcomes": outcomes}
        if self.stopped:
            return facts | {"reason": "not finished"}
        if self.is_area:
            areas = {
                str(seed): vars(claims_of(failed, self._lines)) for seed, failed in seeds.items()
            }
            return facts | {"areas": areas}
        median = median_boundary(outcomes)
        return facts | {
            "stretches": [vars(stretch) for stretch in stretches_of(outcomes)],
            "median": None if median is None else vars(median),
            "seeds_for_median": least_for_median(),
        }


def has_failed(manifest: Manifest) -> bool | None:
    """Tell whether a drive ended in an outcome that counts as a failure; None where that is not known.

    Args:
        manifest: Of its rollout; an outcome is one of `evaluators.metrics.outcomes.OUTCOMES`.
    """
    if not manifest.ok:
        return True if manifest.failure_class == POLICY_FAULT else None
    metrics = manifest.metrics
    measured = [metrics[name].value for name in OUTCOMES if name in metrics]
    if any(value is not None and value >= 0.5 for value in measured):
        return True
    needed = ("collision_any", "offroad")
    is_known = all(name in metrics and metrics[name].valid for name in needed)
    return False if is_known else None


def _steps(failed: Mapping[Point, bool]) -> dict[int, bool]:
    """Return outcomes along one parameter by step."""
    return {step: has_failed for (step,), has_failed in failed.items()}
