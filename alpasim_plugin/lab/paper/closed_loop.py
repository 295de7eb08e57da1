"""Table 2b: one policy behind several renderers, with the paper's interval and one over scenes,
paired differences, and flips.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from alpasim_plugin.lab.paper.claims import behind
from alpasim_plugin.lab.paper.measured import Difference, Measured
from alpasim_plugin.lab.paper.published import Published
from alpasim_plugin.lab.paper.tables import markdown_table, paper_against_ours
from alpasim_plugin.lab.video_metrics.charts import DPI, finish
from alpasim_plugin.lab.video_metrics.facts import KNOWN
from alpasim_plugin.log.run_folder.sides import Row, by_renderer
from evaluators.report.ci import cell_text, metric_label
from evaluators.report.numbers import plural
from evaluators.report.tables import PairRow, metric_rows, p_text, pair_rows
from evaluators.statistics.bounded import mean_bounds
from evaluators.statistics.intervals import Interval, cluster_means
from evaluators.statistics.paired import Pairs, compare, paired_sides
from evaluators.statistics.summary import aggregate_sides

TABLE = "closed-loop"  # of the paper
BASELINE = "3dgs"
EVENTS = ("collision_at_fault", "offroad", "offroad_or_collision_at_fault")
METRICS = (*EVENTS, "route_distance_m", "progress")
CAPTION = "Mean by renderer; thin: 95 % with scenes as clusters; thick: the paper's interval"
RATES = """Means over rollouts. ± is the paper's 1.96 σ/√N, as if rollouts were independent; a to b is the 95 % interval with scenes as
clusters.
"""
PAIRS = """Paired differences on the same scenes and seeds: 95 % interval and p-value, with scenes as the unit. Bold: shown.
"""
FLIPS = f"""Flips: scenes and seeds with the event behind one of the two renderers alone. The test on scenes compares how many have more
events than behind `{BASELINE}` with how many have fewer; the test on rollouts (McNemar) takes them as independent.
"""
PANELS = {
    "offroad_or_collision_at_fault": 100.0,
    "route_distance_m": 1.0,
    "progress": 100.0,
}  # of the figure, and their scales
FLIP_HEAD = (
    "renderer",
    "event",
    "only behind it",
    f"only behind {BASELINE}",
    "p, rollouts",
    "scenes with more",
    "scenes with fewer",
    "p, scenes",
)


class Driven(Measured):
    """Rollouts of one policy behind several renderers, as arms and scenes.

    Means and differences are those of every run: a rare event gets bounds that are never without
    width, where a t interval over scenes has none.

    Args:
        policy: Who drove.
        rows: A rollout each, as `evaluators.statistics.summary.aggregate` takes them; ``renderer``
            is the arm's name.
    """

    def __init__(self, policy: str, rows: Sequence[Row]) -> None:
        self.policy, self.rows, self.sides = policy, tuple(rows), by_renderer(rows)
        values: dict[str, dict[str, dict[str, float]]] = {arm: {} for arm in self.sides}
        for arm, side in self.sides.items():
            for metric in METRICS:
                for cell, value in zip(side.cells, side.values(metric).tolist(), strict=True):
                    if value == value:  # a cell without a value is NaN
                        values[arm].setdefault(f"{cell[1]} seed {cell[2]}", {})[metric] = value
        super().__init__(values)

    @property
    def protocol(self) -> str:
        """Return the name of these measurements among the protocols."""
        return behind(self.policy)

    def only(self, arms: Sequence[str]) -> Driven:
        """Return the rollouts behind some of the renderers, in this order."""
        return Driven(
            self.policy, [row for arm in arms for row in self.rows if row["renderer"] == arm]
        )

    def mean(self, arm: str, metric: str) -> Interval:
        """Return the mean over rollouts with the paper's interval."""
        entry = aggregate_sides({arm: self.sides[arm]}, [metric])[arm][metric]
        if entry["ci95"] is None:
            return Interval(entry["mean"], reason=entry.get("ci95_reason", ""))
        return Interval(
            entry["mean"],
            entry["mean"] - entry["ci95"],
            entry["mean"] + entry["ci95"],
            method="1.96 sigma / sqrt(N)",
        )

    def difference(self, metric: str, first: str, second: str, share: float = 0.0) -> Difference:
        """Return the paired difference of two renderers with scenes as the unit; see
        `evaluators.statistics.paired.compare`.

        Of what is left of the second's rate without a share of it the bounds are those of
        `evaluators.statistics.bounded`, which hold for scenes that were not drawn as well.

        Raises:
            EvaluatorError: They share fewer than two rollouts.
        """
        self._shared(metric, first, second)
        if share:
            pairs = Pairs(self.sides[first], self.sides[second], metric)
            means, _ = cluster_means(pairs.mine - (1 - share) * pairs.base, pairs.scenes)
            bounds = mean_bounds(means, share - 1.0, 1.0)
            return Difference(
                metric,
                first,
                f"{1 - share:.3g} of {second}",
                float(means.mean()),
                *bounds,
                None,
                len(means),
                0,
            )
        found = compare(self.sides[first], self.sides[second], KNOWN.info(metric), second)
        low, high = found["ci95"] or (None, None)
        favours = {"better": 1, "worse": -1}.get(found["difference"], 0)
        return Difference(
            metric,
            first,
            second,
            found["diff"],
            low,
            high,
            found["p_value"],
            found["n_scenes"],
            favours,
        )


def closed_loop_section(published: Published, drives: Sequence[Driven], figure: str) -> str:
    """Return the figure and the tables of every policy; empty where none drove.

    Args:
        published: The paper's numbers.
        drives: A policy each.
        figure: Path of the figure, from the document's folder.
    """
    if not drives:
        return ""
    return "\n".join(
        [f"![{CAPTION}]({figure})\n", *(_of_policy(published, driven) for driven in drives)]
    )


def plot_closed_loop(drives: Sequence[Driven], path: Path) -> None:
    """Draw event rate, route distance and progress by renderer, a row of panels for each policy,
    and write a PNG.
    """
    most = max(len(driven.arms) for driven in drives)
    figure = Figure(figsize=(10.4, (0.28 * most + 0.9) * len(drives) + 0.3), layout="constrained")
    for driven, row in zip(
        drives, figure.subplots(len(drives), len(PANELS), squeeze=False), strict=True
    ):
        for ax, (metric, scale) in zip(row, PANELS.items(), strict=True):
            _panel(ax, driven, metric, scale)
        row[0].set_yticks(range(len(driven.arms)), driven.arms)
        row[0].set_title(f"behind {driven.policy}", fontsize=10, loc="left")
    figure.savefig(path, dpi=DPI)


def _panel(ax: Axes, driven: Driven, metric: str, scale: float) -> None:
    found = aggregate_sides(driven.sides, [metric])
    for i, arm in enumerate(driven.arms):
        entry, colour = found[arm][metric], "C1" if arm == BASELINE else "C0"
        if entry["mean"] is None:
            continue
        centre = scale * entry["mean"]
        if entry["ci95_clustered"] is not None:
            ax.plot(
                [scale * bound for bound in entry["ci95_clustered"]],
                [i, i],
                color=colour,
                linewidth=1.2,
            )
        if entry["ci95"] is not None:
            half = scale * entry["ci95"]
            ax.plot([centre - half, centre + half], [i, i], color=colour, linewidth=4.5, alpha=0.35)
        ax.plot([centre], [i], "o", color=colour, markersize=4.5)
    ax.set_yticks(range(len(driven.arms)), [""] * len(driven.arms))
    ax.set_ylim(len(driven.arms) - 0.5, -0.5)
    ax.set_xlabel(f"{metric}, %" if scale == 100.0 else metric)
    finish(ax, metric, axis="x")


def _of_policy(published: Published, driven: Driven) -> str:
    summary = {
        "metrics": aggregate_sides(driven.sides, METRICS),
        "paired": paired_sides(driven.sides, METRICS, BASELINE),
    }
    seeds, scenes = ({row[key] for row in driven.rows} for key in ("seed", "scene"))
    rows = sorted(metric_rows(summary), key=lambda row: METRICS.index(row.name))
    head = [metric_label(f"`{row.name}`", row.unit, row.arrow) for row in rows]
    means = [[arm, *(cell_text(row.cells[i]) for row in rows)] for i, arm in enumerate(driven.arms)]
    pairs = {(row.variant, row.metric): row for row in pair_rows(summary)}
    others = [arm for arm in driven.arms if arm != BASELINE]
    differences = [[arm, *(_pair(pairs[arm, row.name]) for row in rows)] for arm in others]
    flips = [
        _flips(arm, metric, summary["paired"][arm][metric]) for arm in others for metric in EVENTS
    ]
    return "\n".join(
        (
            f"### Behind `{driven.policy}`\n\n{plural(len(scenes), 'scene')} x {plural(len(seeds), 'seed')}.\n",
            paper_against_ours(published, TABLE, driven),
            RATES + "\n" + markdown_table(["renderer", *head], means),
            PAIRS + "\n" + markdown_table([f"minus {BASELINE}", *head], differences),
            FLIPS + "\n" + markdown_table(FLIP_HEAD, flips),
        )
    )


def _pair(row: PairRow) -> str:
    if row.diff.missing or row.interval.missing:
        return row.diff.text
    text = f"{row.diff.text} ({row.interval.text}), p {row.p_value.text}"
    return f"**{text}**" if row.tone in ("better", "worse") else text


def _flips(arm: str, event: str, found: Mapping[str, Any]) -> list[str]:
    if "cells" not in found:  # no rollout on both sides
        return [arm, f"`{event}`", *["-"] * 6]
    cells, scenes = found["cells"], found["scenes"]
    counts = [str(cells["only_here"]), str(cells["only_baseline"]), p_text(cells["p_value"])]
    return [
        arm,
        f"`{event}`",
        *counts,
        str(scenes["up"]),
        str(scenes["down"]),
        p_text(scenes["p_value"]),
    ]
