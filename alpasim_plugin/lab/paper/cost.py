"""Quality against training time (the paper's figure of GPU-hours): the curve of each arm, as a
table and as a figure.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from alpasim_plugin.lab.learned_metrics.facts import FD_16, FVMD_LK
from alpasim_plugin.lab.paper.claims import CLAIMS, OURS, within
from alpasim_plugin.lab.paper.measured import Measured
from alpasim_plugin.lab.paper.tables import ARROWS, SET_DIGITS, difference_text, markdown_table
from alpasim_plugin.lab.paper.verdict import contest_results
from alpasim_plugin.lab.video_metrics.charts import DPI, finish, legend, panels_of
from alpasim_plugin.lab.video_metrics.facts import KNOWN
from alpasim_plugin.lab.video_metrics.table import DIGITS

METRICS = (FD_16, FVMD_LK, "psnr_db", "perceptual-syn")
COLOURS = {OURS: "C3", "self-forcing": "C0", "one-forcing": "C2"}
HOW = """Core-minutes are processor time of the updates alone, all stages of an arm in turn, a shared one counted for each; the initial
networks and the evaluation do not count. A distilled arm's teacher is no causal network: its time counts, and the arm's curve begins with
the student's first snapshot; curves of arms with that stage in common coincide there."""
BY_SEED = """What the claims compare, in every seed of the trainings; the verdict is of the first. All seeds start from the same initial
networks."""


@dataclass(frozen=True)
class Point:
    """A snapshot.

    Args:
        stage: Training that it is of.
        updates: Of that stage.
        core_minutes: Of all stages up to here.
        label: Its name in the measurements.
    """

    stage: str
    updates: int
    core_minutes: float
    label: str


@dataclass(frozen=True)
class Curve:
    """An arm's snapshots in order.

    Args:
        arm: Which.
        points: Measured snapshots; the last one is the arm.
        ends: Core-minutes at the end of each stage, by training.
        seed: Of the training.
    """

    arm: str
    points: tuple[Point, ...]
    ends: Mapping[str, float]
    seed: int = 0

    @property
    def core_minutes(self) -> float:
        """Return the time of the whole arm."""
        return self.points[-1].core_minutes

    def at(self, core_minutes: float) -> Point | None:
        """Return the last snapshot within a time; None where the first one takes longer."""
        return next(
            (point for point in reversed(self.points) if point.core_minutes <= core_minutes), None
        )


@dataclass(frozen=True)
class Cost:
    """What was measured of training times.

    Args:
        curves: Of the arms, those of the first seed before others.
        measured: By labels of their points.
        about: What the clips are.
    """

    curves: tuple[Curve, ...]
    measured: Measured
    about: str

    @property
    def seeds(self) -> list[int]:
        """Seeds of the trainings, the one by which claims are judged first."""
        return list(dict.fromkeys(curve.seed for curve in self.curves))

    def name(self, curve: Curve) -> str:
        """Return the arm of a curve, with its seed where there are several."""
        return curve.arm if len(self.seeds) == 1 else f"{curve.arm}, seed {curve.seed}"

    @property
    def metrics(self) -> list[str]:
        """Metrics that any point has."""
        labels = [point.label for curve in self.curves for point in curve.points]
        return [
            metric
            for metric in METRICS
            if any(self.measured.has(label, metric) for label in labels)
        ]


def contested(cost: Cost, seed: int | None = None) -> Measured:
    """Return the measurements by names that claims use: every arm at its end, and ours in half of
    each other arm's time.

    Args:
        cost: What was measured.
        seed: Of the trainings; None: the first.
    """
    chosen = cost.seeds[0] if seed is None else seed
    curves, measured = [curve for curve in cost.curves if curve.seed == chosen], cost.measured
    labels = {curve.arm: curve.points[-1].label for curve in curves}
    ours = next((curve for curve in curves if curve.arm == OURS), None)
    for curve in curves:
        if (
            ours is not None
            and curve is not ours
            and (point := ours.at(curve.core_minutes / 2)) is not None
        ):
            labels[within(curve.arm)] = point.label
    values = {arm: measured.values[label] for arm, label in labels.items()}
    features = {
        arm: measured.features[label] for arm, label in labels.items() if label in measured.features
    }
    reference = {
        name: kinds for name, kinds in measured.features.items() if name == measured.reference
    }
    return Measured(values, {**features, **reference}, measured.reference, measured.seed)


def cost_section(cost: Cost, figure: str) -> str:
    """Return the section: how, the figure, a row for every snapshot, and what half of the others'
    time gives.

    Args:
        cost: What was measured.
        figure: Path of the figure, from the document's folder.
    """
    curves = cost.curves
    measured = cost.measured
    shown = cost.metrics
    rows = []
    for curve in curves:
        for point in curve.points:
            values = [_value(measured, point.label, metric) for metric in shown]
            rows.append(
                [
                    curve.arm,
                    str(curve.seed),
                    point.stage,
                    str(point.updates),
                    _minutes(point.core_minutes),
                    *values,
                ]
            )
    head = [
        "arm",
        "seed",
        "stage",
        "updates",
        "core-minutes",
        *(f"{m} {ARROWS[KNOWN.info(m).direction]}" for m in shown),
    ]
    ends = "".join(
        f"- {cost.name(curve)}: {', '.join(f'{name} to {_minutes(end)}' for name, end in curve.ends.items())}\n"
        for curve in curves
    )
    return (
        f"{HOW}\n\n{cost.about}\n\n![Quality against core-minutes, borders of stages dashed]({figure})\n\n"
        f"Ends of stages, core-minutes:\n\n{ends}\n{markdown_table(head, rows)}\n{_halves(cost)}{_by_seed(cost)}"
    )


def _halves(cost: Cost) -> str:
    lines = []
    for curve in cost.curves:
        ours = next(
            (other for other in cost.curves if (other.arm, other.seed) == (OURS, curve.seed)), None
        )
        if ours is None or curve is ours:
            continue
        point, half = ours.at(curve.core_minutes / 2), curve.core_minutes / 2
        found = (
            "no snapshot"
            if point is None
            else f"the snapshot of {point.updates} updates, {_minutes(point.core_minutes)}"
        )
        lines.append(
            f"- Within half of the core-minutes of {cost.name(curve)} ({_minutes(half)}), {OURS} has {found}.\n"
        )
    return "".join(lines)


def _by_seed(cost: Cost) -> str:
    """Return the claims' comparisons of training time in every seed; empty where there is one
    seed.
    """
    if len(cost.seeds) == 1:
        return ""
    comparisons = [
        comparison
        for claim in CLAIMS
        for comparison in claim.comparisons
        if comparison.protocol == "cost"
    ]
    found = [contest_results(comparisons, {"cost": contested(cost, seed)}) for seed in cost.seeds]
    rows = []
    for i, comparison in enumerate(comparisons):
        results = [each[i] for each in found]
        cells = [
            r.missing if r.difference is None else f"{difference_text(r.difference)}: {r.outcome}"
            for r in results
        ]
        rows.append(
            [f"`{comparison.metric}`: {comparison.first} minus {comparison.second}", *cells]
        )
    return f"\n{BY_SEED}\n\n" + markdown_table(
        ["comparison", *(f"seed {seed}" for seed in cost.seeds)], rows
    )


def _minutes(value: float) -> str:
    return f"{value:.3g}" if value < 100 else f"{value:.0f}"


def _value(measured: Measured, label: str, metric: str) -> str:
    if not measured.has(label, metric):
        return "null"
    return f"{measured.mean(label, metric).centre:.{(DIGITS | SET_DIGITS).get(metric, 3)}f}"


def plot_cost(cost: Cost, path: Path) -> None:
    """Draw every metric against core-minutes and write a PNG; dashed lines are the ends of stages
    before the last.
    """
    curves = cost.curves
    measured = cost.measured
    shown = cost.metrics
    figure, panels = panels_of(len(shown))
    for ax, metric in zip(panels, shown, strict=False):
        for i, curve in enumerate(curves):
            colour = COLOURS.get(curve.arm, f"C{i + 4}")
            x = [point.core_minutes for point in curve.points if measured.has(point.label, metric)]
            y = [
                measured.mean(point.label, metric).centre
                for point in curve.points
                if measured.has(point.label, metric)
            ]
            first = curve.seed == cost.seeds[0]
            how: Any = (
                {"marker": "o", "linewidth": 1.6}
                if first
                else {"marker": "s", "linewidth": 1.0, "alpha": 0.55}
            )
            ax.plot(x, y, markersize=3.5, color=colour, label=cost.name(curve), **how)
            for end in list(curve.ends.values())[:-1] if first else ():
                ax.axvline(end, color=colour, linestyle="--", linewidth=0.9, alpha=0.5)
        ax.set_xlim(left=0)
        ax.set_xlabel("core-minutes")
        finish(ax, metric, "; dashed: a stage ends")
    legend(figure, panels[:1], len(curves))
    figure.savefig(path, dpi=DPI)
