"""Results by how far the ego was from the logged path, and by how much of the picture the renderer
covered.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from alpasim_plugin.core.types import F64, I64
from alpasim_plugin.log.run_folder.rows import Own, Rollout, series_by_cell
from evaluators.metrics import METRICS
from evaluators.opening import Run
from evaluators.report.charts import GRID, MARKERS, N_COLOURS, VARIANT, Axes, Chart
from evaluators.report.numbers import Cell, fixed, missing, plural, short
from evaluators.report.rollouts import COLLISION
from evaluators.statistics.intervals import clustered

DISTANCE, OPACITY = "lateral_bias_m", "opacity_mean"
DISTANCE_EDGES_M = (0.25, 0.5, 1.0, 2.0)
OPACITY_SHARES = (
    25,
    50,
    75,
)  # percentiles of the run's own frames: what is much covered depends on how much sky there is
EVENTS = (("collision_at_fault", "at-fault collisions"), ("offroad", "off-road"))
VALUES = ("plan_deviation", "min_ade@1.0s(gt)")
SERIES = (DISTANCE, OPACITY, *VALUES, *COLLISION, "offroad", "eval_relevant")
NOT_BESIDE = "not beside the path"
LEAST_STEPS = 10  # fewer steps in a stratum give no mean
LEAST_SCENES = 3  # fewer scenes give no interval


@dataclass(frozen=True)
class Bin:
    """One renderer within one stratum.

    Attributes:
        seconds: Time driven there, of the scored part of all rollouts.
        events: Rollouts whose first event of the kind began there, by metric.
        means: By metric: mean over scenes of the scene's mean over steps, and its interval (None,
            None where there is none); absent where unknown.
    """

    variant: int
    renderer: str
    seconds: float
    rollouts: int
    events: dict[str, int]
    means: dict[str, tuple[float, float | None, float | None]]


@dataclass(frozen=True)
class Stratum:
    """A range of the variable with the renderers in it."""

    label: str
    bins: tuple[Bin, ...]


@dataclass(frozen=True)
class Strata:
    """All ranges of one variable."""

    title: str
    note: str
    axis: str
    unit: str
    strata: tuple[Stratum, ...]


@dataclass(frozen=True)
class StratumRow:
    """One line of the table."""

    label: str
    order: int
    renderer: str
    variant: int
    cells: tuple[Cell, ...]  # time, events, values


def strata(run: Run, scenes: Sequence[str] | None = None) -> list[Strata]:
    """Split the scored steps of a run by distance and by opacity; a variable that the run does not
    hold is left out.

    Args:
        run: The run.
        scenes: Whose steps count; None: all.
    """
    series = series_by_cell(run.steps(SERIES, scenes))
    steps = [
        _Steps(r, series[r.cell])
        for r in run.rollouts
        if r.ok and DISTANCE in series.get(r.cell, {})
    ]
    steps = [one for one in steps if len(one.t_us)]
    found = []
    if steps:
        labels = [*_labels(DISTANCE_EDGES_M, "m"), NOT_BESIDE]
        note = "Time, events and plans by how far the ego's box centre was from the logged path at that moment."
        groups = [one.distance_bin() for one in steps]
        found.append(
            _split(
                "By distance from the logged path",
                note,
                "distance from the path",
                "m",
                labels,
                steps,
                groups,
                run,
            )
        )
    covered = [one for one in steps if one.opacity is not None]
    if covered:
        seen = [np.asarray(one.opacity) for one in covered]
        every = np.concatenate([values[np.isfinite(values)] for values in seen])
        quartiles = (
            np.floor(np.percentile(every, OPACITY_SHARES) * 1000) / 1000 if every.size else ()
        )  # down: 0.9996 is not 1
        edges = tuple(dict.fromkeys(float(v) for v in quartiles))
        note = "Opacity: mean over the picture of what the Gaussians cover; little means sky, or holes. Limits are quartiles of this run."
        groups = [np.where(np.isfinite(values), np.digitize(values, edges), -1) for values in seen]
        found.append(
            _split(
                "By rendered opacity",
                note,
                "rendered opacity",
                "",
                _labels(edges, ""),
                covered,
                groups,
                run,
            )
        )
    return found


def stratum_rows(one: Strata) -> list[StratumRow]:
    """Lay out a table: ranges x renderers."""
    rows = []
    for order, stratum in enumerate(one.strata):
        for b in stratum.bins:
            counts = []
            for name, _ in EVENTS:
                n = b.events[name]
                rate = f"{short(100 * n / b.seconds)} per 100 s driven" if b.seconds > 0 else ""
                counts.append(Cell(str(n), rate, sort=n))
            values = [_mean(b, name) for name in VALUES]
            time = Cell(
                f"{fixed(b.seconds, 1)}\u00a0s", plural(b.rollouts, "rollout"), sort=b.seconds
            )
            rows.append(
                StratumRow(stratum.label, order, b.renderer, b.variant, (time, *counts, *values))
            )
    return rows


def heads() -> list[tuple[str, str]]:
    """Give the heads of the columns with their meaning."""
    events = [
        (word, f"rollouts whose first {word.removesuffix('s')} event began there")
        for _, word in EVENTS
    ]
    return [
        ("time driven", "scored steps of all rollouts"),
        *events,
        *((f"{name} (m)", METRICS[name].help) for name in VALUES),
    ]


class _Steps:
    """The scored steps of one rollout: after the warm-up, up to its first counted event."""

    def __init__(self, rollout: Rollout, own: Own) -> None:
        self.rollout, self.own = rollout, own
        t_us = own["eval_relevant"][0] if "eval_relevant" in own else own[DISTANCE][0]
        counted = (
            own["eval_relevant"][1] >= 0.5
            if "eval_relevant" in own
            else np.ones(len(t_us), dtype=bool)
        )
        self.first: dict[str, int] = {}
        for name, _ in EVENTS:
            if name in own and rollout.flag(name):
                times, values = own[name]
                hit = times[(values >= 0.5) & np.isin(times, t_us[counted])]
                if len(hit):
                    self.first[name] = int(hit[0])
        end = min(self.first.values(), default=None)
        self.t_us: I64 = t_us[counted & (t_us <= end)] if end is not None else t_us[counted]
        self.step_s = float(np.median(np.diff(t_us))) * 1e-6 if len(t_us) > 1 else 0.0
        self.opacity = self._at(OPACITY)

    def _at(self, name: str) -> F64 | None:
        """Return a series at the scored steps: the newest value, NaN before the first; several
        cameras are averaged.
        """
        if name not in self.own:
            return None
        times, where = np.unique(self.own[name][0], return_inverse=True)
        values = np.bincount(where, self.own[name][1]) / np.bincount(where)
        at = np.searchsorted(times, self.t_us, side="right") - 1
        return np.where(at >= 0, values[np.maximum(at, 0)], np.nan)

    def distance_bin(self) -> I64:
        times, values = self.own[DISTANCE]
        at = np.searchsorted(times, self.t_us)
        beside = (at < len(times)) & (times[np.minimum(at, len(times) - 1)] == self.t_us)
        found = np.digitize(np.abs(values[np.minimum(at, len(times) - 1)]), DISTANCE_EDGES_M)
        return np.where(beside, found, len(DISTANCE_EDGES_M) + 1)

    def values(self, name: str, group: I64, k: int) -> F64:
        """Return the values of a metric at the steps of one group; times without a value have
        none.
        """
        if name not in self.own:
            return np.zeros(0)
        times, values = self.own[name]
        return np.asarray(values[np.isin(times, self.t_us[group == k])])


def _split(
    title: str,
    note: str,
    axis: str,
    unit: str,
    labels: Sequence[str],
    steps: list[_Steps],
    groups: list[I64],
    run: Run,
) -> Strata:
    strata_found = []
    for k, label in enumerate(labels):
        bins = []
        for variant, renderer in enumerate(run.renderers):
            mine = [
                (s, g)
                for s, g in zip(steps, groups, strict=True)
                if s.rollout.renderer == renderer and bool((g == k).any())
            ]
            if mine:
                bins.append(_bin(variant, renderer, mine, k))
        if bins:
            strata_found.append(Stratum(label, tuple(bins)))
    return Strata(title, note, axis, unit, tuple(strata_found))


def _bin(variant: int, renderer: str, mine: list[tuple[_Steps, I64]], k: int) -> Bin:
    seconds = sum(float(np.count_nonzero(g == k)) * s.step_s for s, g in mine)
    events = {}
    for name, _ in EVENTS:
        began = [(s.first[name], s, g) for s, g in mine if name in s.first]
        events[name] = sum(bool((g[s.t_us == t_us] == k).any()) for t_us, s, g in began)
    means = {}
    for name in VALUES:
        parts = [(s.values(name, g, k), s.rollout.scene) for s, g in mine]
        values = np.concatenate([v for v, _ in parts])
        scenes = [scene for v, scene in parts for _ in v]
        if len(values) >= LEAST_STEPS:
            interval = clustered(values, scenes)
            enough = len(set(scenes)) >= LEAST_SCENES and interval.low is not None
            # Neither metric can be negative; a t interval over few scenes does not know that.
            means[name] = (
                interval.centre,
                max(interval.low or 0.0, 0.0) if enough else None,
                interval.high if enough else None,
            )
    return Bin(variant, renderer, seconds, len(mine), events, means)


def _mean(b: Bin, name: str) -> Cell:
    if name not in b.means:
        return missing(f"fewer than {LEAST_STEPS} steps here have it")
    mean, low, high = b.means[name]
    detail = "" if low is None or high is None else f"{short(low)} to {short(high)}"
    return Cell(
        short(mean),
        "" if detail else f"no interval: it needs {LEAST_SCENES} scenes",
        detail,
        sort=mean,
    )


def _labels(edges: Sequence[float], unit: str) -> list[str]:
    tail = f"\u00a0{unit}" if unit else ""
    if not edges:
        return ["all"]
    inner = [f"{a:g} to {b:g}{tail}" for a, b in pairwise(edges)]
    top = (
        "1" if not unit and edges[-1] >= 1.0 else f"{edges[-1]:g}{tail} and more"
    )  # no more than all of a picture can be covered
    return [f"below {edges[0]:g}{tail}", *inner, top]


def strata_chart(one: Strata) -> Chart | None:
    """Draw the steadiness of plans by stratum; None where it is known in fewer than two."""
    name = VALUES[0]
    known = [
        s for s in one.strata if s.label != NOT_BESIDE and any(name in b.means for b in s.bins)
    ]
    if len(known) < 2:
        return None
    variants = sorted({b.variant for s in known for b in s.bins})
    axes = Axes(grid="y")
    for k, stratum in enumerate(known):
        for b in stratum.bins:
            if name not in b.means:
                continue
            x = k + (variants.index(b.variant) + 1) / (len(variants) + 1) - 0.5
            mean, low, high = b.means[name]
            colour = VARIANT[b.variant % N_COLOURS]
            if low is not None and high is not None:
                axes.line([x, x], [max(low, 0.0), high], colour)
            axes.points([x], [mean], colour, MARKERS[b.variant % len(MARKERS)])
    for k in range(1, len(known)):
        axes.upright(k - 0.5, GRID, 0.8)
    ticks = [s.label.replace(f"\u00a0{one.unit}", "") if one.unit else s.label for s in known]
    ticks = [
        tick.replace(" and more", "+").replace("below ", "< ").replace(" to ", "\u2013")
        for tick in ticks
    ]
    axes.ticks[0], axes.limits[0] = list(enumerate(ticks)), (-0.5, len(known) - 0.5)
    axes.limits[1] = 0.0, 1.08 * axes.range(1)[1]  # the highest marker is whole
    axes.labels = [f"{one.axis}, {one.unit}" if one.unit else one.axis, "m between plans in a row"]
    return Chart(
        f"Steadiness of plans by {one.axis}",
        "Mean of plan_deviation; bars: 95 % over scenes, from three scenes on.",
        axes.svg(),
    )
