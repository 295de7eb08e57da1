"""The paper's robustness figure: what a wrong semantic map does, by how far its lanes or boxes are
off.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from alpasim_plugin.lab.paper.measured import Measured
from alpasim_plugin.lab.paper.tables import markdown_table, means_table
from alpasim_plugin.lab.video_metrics.charts import DPI, finish, legend, panels_of

METRICS = (
    "lane_f1_syn",
    "lane_xerr_syn_m",
    "cuboid_f1_syn",
    "fd_syn_16",
    "psnr_db",
    "perceptual-syn",
)
PANELS = (
    ("lane_f1_syn", "lanes"),
    ("lane_xerr_syn_m", "lanes"),
    ("cuboid_f1_syn", "boxes"),
    ("fd_syn_16", "lanes"),
)
HOW = """Lanes and boxes of the semantic map moved by a constant, 45 configurations: lanes by -0.5 to 0.5 m to the left, boxes by
{-0.25, 0, 0.25}² m ahead and to the left. Render, opacity and truth stay as they are. Below a black map is shown to the same weights, to V5
that was trained with one, and `artifixer` takes none.
"""
RANGES = "Median of the configurations, with the smallest and the largest (the paper's boxes):\n"


@dataclass(frozen=True)
class Shift:
    """How far a configuration is off, metres."""

    lanes_m: float
    boxes_m: float

    def by(self, what: str) -> float:
        """Return the distance of ``lanes`` or ``boxes``."""
        return self.lanes_m if what == "lanes" else self.boxes_m


def means(measured: Measured) -> str:
    """Return means over clips with their 95 % t intervals; configurations are grouped already.

    Args:
        measured: Groups of configurations, and the arms beside them.
    """
    metrics = [m for m in METRICS if any(measured.has(arm, m) for arm in measured.arms)]
    return HOW + "\n" + means_table(measured, metrics, {}, 3)


def ranges(measured: Measured, shifts: Mapping[str, Shift]) -> str:
    """Return, for every distance of lanes and of boxes, the median over configurations with the
    smallest and the largest.

    Args:
        measured: An arm for each configuration.
        shifts: ARM -> how far it is off.
    """
    metrics = [m for m in METRICS if any(measured.has(arm, m) for arm in shifts)]
    rows = []
    for what in ("lanes", "boxes"):
        for distance in distances(shifts, what):
            cells = []
            for metric in metrics:
                found = _values(measured, shifts, metric, what, distance)
                cells.append(
                    f"{np.median(found):.3f} ({min(found):.3f} to {max(found):.3f})"
                    if found
                    else "null"
                )
            rows.append(
                [
                    f"{what} {distance:.2f} m",
                    str(sum(shift.by(what) == distance for shift in shifts.values())),
                    *cells,
                ]
            )
    return RANGES + "\n" + markdown_table(["off by", "maps", *metrics], rows)


def distances(shifts: Mapping[str, Shift], what: str) -> list[float]:
    """Return the distances of ``lanes`` or ``boxes`` in rising order."""
    return sorted({shift.by(what) for shift in shifts.values()})


def plot(measured: Measured, shifts: Mapping[str, Shift], path: Path) -> None:
    """Draw the paper's four panels: a box over configurations for every distance, a dot for the
    true map, and the unconditioned arms.

    Args:
        measured: An arm for each configuration, and arms beside them, which become lines.
        shifts: ARM -> how far it is off.
        path: Of the PNG.
    """
    shown = [
        (metric, what)
        for metric, what in PANELS
        if any(measured.has(arm, metric) for arm in shifts)
    ]
    figure, panels = panels_of(max(len(shown), 1))
    beside = [arm for arm in measured.arms if arm not in shifts]
    true = [arm for arm, shift in shifts.items() if shift == Shift(0.0, 0.0)]
    for ax, (metric, what) in zip(panels, shown, strict=False):
        groups = distances(shifts, what)
        ax.boxplot(
            [_values(measured, shifts, metric, what, distance) for distance in groups],
            positions=range(len(groups)),
            widths=0.5,
        )
        for i, arm in enumerate(arm for arm in beside if measured.has(arm, metric)):
            ax.axhline(
                measured.mean(arm, metric).centre,
                color=f"C{i}",
                linestyle="--",
                label=arm,
                linewidth=1.4,
            )
        for arm in true:
            ax.plot([0], [measured.mean(arm, metric).centre], "ko", markersize=4, label="true map")
        ax.set_xticks(range(len(groups)), [f"{distance:.2f}" for distance in groups])
        ax.set_xlabel(f"{what} off by, m")
        finish(ax, metric)
    legend(figure, panels)
    figure.savefig(path, dpi=DPI)


def _values(
    measured: Measured, shifts: Mapping[str, Shift], metric: str, what: str, distance: float
) -> Sequence[float]:
    mine = [
        arm
        for arm, shift in shifts.items()
        if shift.by(what) == distance and measured.has(arm, metric)
    ]
    return [measured.mean(arm, metric).centre for arm in mine]
