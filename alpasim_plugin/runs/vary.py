"""Sequential search along one parameter of a scene: drive the points of a grid that enclose where
each variant starts to fail.

Everything but the parameter stays as it is: the scene is the same, and so is the noise, since every
point bears the scene's name with its value behind it (`core.seeding.POINT`). What is driven next
follows from the outcomes alone, so the same command continues after any interruption.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.json_types import JsonObject, JsonView
from alpasim_plugin.core.parts import digest
from alpasim_plugin.core.seeding import POINT
from alpasim_plugin.runs.plan import Cell, RunPlan
from alpasim_plugin.runs.run import Progress
from evaluators.metrics.outcomes import OUTCOMES, POLICY_FAULT
from evaluators.report.boundary import sentence_of
from evaluators.statistics.boundary import (
    MOST_POINTS,
    STEPS,
    Bracket,
    boundary_of,
    bracket_of,
    difference_of,
    next_points,
)
from evaluators.statistics.variants import Variant, usual_base, variants_of
from scenarios.suite import ScenarioRef

UNITS = {"mps": "m/s", "mps2": "m/s\u00b2", "m": "m", "s": "s", "us": "\u00b5s", "rad": "rad"}
RANGE = re.compile(r"([A-Za-z_][\w.\-]*)=([^=]+?)\.\.([^=]+)")
MakePlan = Callable[[Sequence[ScenarioRef]], RunPlan]


@dataclass(frozen=True)
class Sweep:
    """One parameter of a scene and its range.

    Attributes:
        key: Dotted key of the scenario file.
        low, high: Ends of the range.
    """

    key: str
    low: float
    high: float

    @classmethod
    def parse(cls, text: str) -> Sweep:
        """Read ``KEY=LOW..HIGH``.

        Raises:
            InputError: Another form, no numbers, or ``LOW`` is not below ``HIGH``.
        """
        example = "Write for example --vary actors.cutter.s_m=4..14."
        match = RANGE.fullmatch(text.strip())
        if match is None:
            raise InputError(f"--vary {text}: not KEY=LOW..HIGH", example)
        try:
            low, high = float(match[2]), float(match[3])
        except ValueError:
            raise InputError(f"--vary {text}: an end is not a number", example) from None
        if not -1e12 < low < high < 1e12:
            raise InputError(f"--vary {text}: LOW is not below HIGH", example)
        sweep = cls(match[1], low, high)
        if len({sweep.value(point) for point in range(STEPS + 1)}) <= STEPS:
            raise InputError(
                f"--vary {text}: its {STEPS + 1} points round to fewer values",
                "Give a wider range.",
            )
        return sweep

    def value(self, point: int) -> float:
        """Return the value at a point of the grid; times in microseconds are whole numbers."""
        value = self.low + (self.high - self.low) * point / STEPS
        return float(round(value, 0 if self.key.endswith("_us") else 9))

    @property
    def unit(self) -> str:
        """Give the unit that the key ends with; empty where it names none."""
        return UNITS.get(self.key.rpartition("_")[2], "")


@dataclass
class BoundarySearch:
    """The points driven so far, what follows from them, and which come next; a
    `alpasim_plugin.runs.run.Search`.

    Attributes:
        plan: The scene as written, with the keys of the whole run.
        cells: The cells driven so far.
        scenes: Point -> plan of the scene with the parameter at that value.
        unreachable: Point -> why the scene cannot be built there.
    """

    kind: ClassVar[str] = "vary"
    plan: RunPlan
    sweep: Sweep
    make: MakePlan
    driven: dict[str, JsonObject] = field(default_factory=dict)
    cells: list[Cell] = field(default_factory=list)
    scenes: dict[int, RunPlan] = field(default_factory=dict)
    unreachable: dict[int, InputError] = field(default_factory=dict)
    failed: dict[tuple[Variant, int], dict[int, bool]] = field(default_factory=dict)
    stopped: str = ""

    def __post_init__(self) -> None:
        ref, sweep = self.plan.cells[0].ref, self.sweep
        varied = digest([sweep.key, sweep.low, sweep.high, STEPS])
        self.plan = replace(self.plan, question=varied)
        self.ceiling = replace(self.plan, cells=self.plan.cells * MOST_POINTS, whole=self.plan)
        self.own_id = self.plan.cells[0].scene.removesuffix(f"-seed{ref.seed}")
        self.ref = ref
        names = [(cell.renderer.name, cell.policy.name) for cell in self.plan.cells]
        self.variants = variants_of(names)
        self.failed = {(one, seed): {} for one in self.variants for seed in self.plan.seeds}
        self.at_once = len(self.failed) * 4  # points beside a change
        self.ends = self._reachable_ends()

    def _reachable_ends(self) -> tuple[int, int]:
        """Return the first and the last point at which the scene can be built."""
        if self._is_reachable(0) and self._is_reachable(STEPS):
            return 0, STEPS
        bad, good = (0, STEPS) if 0 in self.unreachable else (STEPS, 0)
        if not self._is_reachable(good):
            raise self.unreachable[bad]
        reached = good
        while abs(reached - bad) > 1:
            middle = (reached + bad) // 2
            if self._is_reachable(middle):
                reached = middle
            else:
                bad = middle
        if reached == good:
            raise self.unreachable[bad]
        return min(reached, good), max(reached, good)

    def _is_reachable(self, point: int) -> bool:
        try:
            self._load(point)
        except InputError as error:
            self.unreachable[point] = error
        return point not in self.unreachable

    def _load(self, point: int) -> RunPlan:
        """Plan the rollouts of a point."""
        if point not in self.scenes:
            value = self.sweep.value(point)
            written = f"{int(value)}" if value.is_integer() else f"{value!r}"
            name = f"{self.own_id}{POINT}{written}"
            more = (f"{self.sweep.key}={written}", f"scene_id={name}")
            ref = replace(self.ref, overrides=(*self.ref.overrides, *more))
            self.scenes[point] = self.make([ref])
        return self.scenes[point]

    def next_plan(self) -> RunPlan | None:
        """Return the rollouts of the next round; None where the search has ended."""
        if self.stopped:
            return None
        cells: list[Cell] = []
        for (variant, seed), failed in self.failed.items():
            points: list[int] = []
            while not points:
                asked = next_points(failed, self.ends, set(self.unreachable))
                points = [point for point in asked if self._is_reachable(point)]
                if not asked:
                    break
            for point in points:
                cells += [
                    cell
                    for cell in self.scenes[point].cells
                    if (cell.renderer.name, cell.policy.name, cell.seed)
                    == (variant.renderer, variant.policy, seed)
                ]
        return self.plan_of(cells) if cells else None

    def plan_of(self, cells: Sequence[Cell]) -> RunPlan:
        """Return a plan of some cells with the keys of the whole run."""
        known = {name: one for plan in self.scenes.values() for name, one in plan.scenarios.items()}
        wanted = dict.fromkeys(cell.scene for cell in cells)
        scenarios = {name: known[name] for name in wanted}
        return replace(self.plan, cells=tuple(cells), scenarios=scenarios, whole=self.plan)

    def driven_plan(self) -> RunPlan:
        """Return the plan of the points driven so far."""
        return self.plan_of(self.cells)

    def announce(self, root: Path, progress: Progress) -> None:
        """Say nothing: the record is part of the summary."""

    def facts(self) -> JsonObject:
        """Return the record."""
        return {"boundary": self.record()}

    def add(self, plan: RunPlan, manifests: Sequence[JsonObject]) -> None:
        """Take in the outcomes of a round."""
        points = {one.cells[0].scene: point for point, one in self.scenes.items()}
        for cell, manifest in zip(plan.cells, manifests, strict=True):
            self.cells.append(cell)
            self.driven[cell.folder.as_posix()] = manifest
            failed = _has_failed(manifest)
            if failed is None:
                self.stopped = f"{cell.folder.as_posix()} has no outcome"
                continue
            variant = Variant(cell.renderer.name, cell.policy.name)
            self.failed[variant, cell.seed][points[cell.scene]] = failed

    def record(self) -> JsonObject:
        """Return what ``summary.json`` holds of the search, as its member ``boundary``."""
        values = {point: self.sweep.value(point) for point in range(STEPS + 1)}
        found = {one: self._of_variant(one, values) for one in self.variants}
        base = usual_base(self.variants, self.plan.options.baseline)
        differences = {}
        for variant, other in base.pairs(self.variants):
            brackets, others = found[variant][1], found[other][1]
            if brackets and others:
                estimate = difference_of(brackets, others)
                differences[variant.name] = {"baseline": other.name} | vars(estimate)
        least, most = (values[point] for point in self.ends)
        record: JsonObject = {
            "parameter": self.sweep.key,
            "unit": self.sweep.unit,
            "range": [self.sweep.low, self.sweep.high],
            "reachable": [least, most],
            "unreachable": {
                f"{values[k]:g}": error.message for k, error in self.unreachable.items()
            },
            "stopped": self.stopped,
            "rollouts": len(self.driven),
            "grid_rollouts": (STEPS + 1) * len(self.failed),
            "variants": {one.name: facts for one, (facts, _) in found.items()},
            "differences": differences,
        }
        return record | {"sentence": sentence_of(record)}

    def _of_variant(
        self, variant: Variant, values: Mapping[int, float]
    ) -> tuple[JsonObject, list[Bracket]]:
        """Return the facts of a variant, and the brackets of its seeds if all have one."""
        seeds = {seed: self.failed[variant, seed] for seed in self.plan.seeds}
        ended = {seed: bracket_of(failed, values) for seed, failed in seeds.items()}
        outcomes = {
            seed: [[values[point], failed[point]] for point in sorted(failed)]
            for seed, failed in seeds.items()
        }
        facts: JsonObject = {"outcomes": {str(seed): one for seed, one in outcomes.items()}}
        brackets = [one for one in ended.values() if isinstance(one, Bracket)]
        reasons = [one for one in ended.values() if isinstance(one, str)]
        sides = {one.fails_below for one in brackets}
        if self.stopped:
            reasons.append("not finished")
        elif len(sides) > 1:
            reasons.append("fails on either side, by seed")
        if reasons:
            counted = [f"{why} in {reasons.count(why)} of {len(ended)} seeds" for why in reasons]
            return facts | {"reason": "; ".join(dict.fromkeys(counted))}, []
        side = "below" if sides.pop() else "above"
        changes = max(one.changes for one in brackets)
        return facts | {"fails": side, "changes": changes} | vars(boundary_of(brackets)), brackets


def _has_failed(manifest: JsonView) -> bool | None:
    """Tell whether a rollout had an outcome that counts as a failure; None where that is not
    known.
    """
    if manifest["status"] != "ok":
        return True if manifest["error"]["failure_class"] == POLICY_FAULT else None
    metrics = manifest["metrics"]
    measured = [metrics[name] for name in OUTCOMES if name in metrics]
    if any(one["valid"] and one["value"] >= 0.5 for one in measured):
        return True
    known = {name: metrics.get(name, {}).get("valid") for name in ("collision_any", "offroad")}
    return False if all(known.values()) else None
