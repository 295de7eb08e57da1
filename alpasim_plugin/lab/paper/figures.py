"""Figures of the record: quality against steadiness and time, differences from OneFixer, and the curve
over a clip. Matplotlib loads when a figure is drawn.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from alpasim_plugin.core.files.atomic import write_bytes
from alpasim_plugin.lab.paper.claims import TIME, measured_as
from alpasim_plugin.lab.paper.config import RAW
from alpasim_plugin.lab.paper.printed import printed
from alpasim_plugin.lab.paper.records import Quality
from evaluators.statistics.intervals import median_interval

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ONEFIXER = "V9"
STEADINESS = "warp_l1"
DISTANCE = "lpips"
POINTS_A_MS = 4.0  # area of a bubble
FOLDER = "figures"


def write_figures(rows: Sequence[str], quality: Quality, out: Path) -> dict[str, str | None]:
    """Write the figures that the record has numbers for.

    Args:
        rows: Of the tables of clips.
        quality: The record.
        out: Folder of the experiment; files lie in ``figures`` there.

    Returns:
        File name -> None, or why it is not drawn.
    """
    figures = {
        "tradeoff.png": _tradeoff,
        "differences.png": _differences,
        "over-a-clip.png": _over_a_clip,
    }
    reasons: dict[str, str | None] = {}
    for name, draw in figures.items():
        figure = _figure()
        reasons[name] = draw(figure.subplots(), rows, quality)
        if reasons[name] is None:
            buffer = io.BytesIO()
            figure.savefig(buffer, format="png", metadata={"Software": None})
            write_bytes(out / FOLDER / name, buffer.getvalue())
    return reasons


def _figure() -> Figure:
    from matplotlib.figure import Figure

    return Figure(figsize=(7.0, 4.5), dpi=120, layout="constrained")


def _medians(row: str, metric: str, quality: Quality) -> float | None:
    """Return the median over scenes of a metric of the paper, in its unit; None where it is not
    measured.
    """
    facts = printed().metrics[metric]
    ours = measured_as(facts, quality)
    if ours is None or ours not in quality.by_scene[row]:
        return None
    return facts.scale * float(np.median([*quality.by_scene[row][ours].values()]))


def _label(metric: str, quality: Quality) -> str:
    facts = printed().metrics[metric]
    return f"{facts.heading} ({measured_as(facts, quality)}), {facts.better} is better"


def _tradeoff(axes: Axes, rows: Sequence[str], quality: Quality) -> str | None:
    """Draw the distance from the truth against steadiness; areas are times, crosses have none."""
    points = 0
    for row in rows:
        distance = _medians(row, DISTANCE, quality)
        steadiness = _medians(row, STEADINESS, quality)
        if distance is None or steadiness is None:
            continue
        time_ms = None if row == RAW else _medians(row, TIME, quality)
        if time_ms is None:
            axes.plot(distance, steadiness, "x", color="C0")
        else:
            axes.scatter(distance, steadiness, s=POINTS_A_MS * time_ms, color="C0", alpha=0.5)
        axes.annotate(row, (distance, steadiness), fontsize=7)
        points += 1
    axes.set_xlabel(_label(DISTANCE, quality))
    axes.set_ylabel(_label(STEADINESS, quality))
    axes.set_title("Medians over scenes; areas are times of a frame, a cross has none", fontsize=9)
    return None if points else f"no row has both {DISTANCE} and {STEADINESS}"


def _differences(axes: Axes, rows: Sequence[str], quality: Quality) -> str | None:
    """Draw the paired difference of every row from OneFixer with its interval."""
    facts = printed().metrics[DISTANCE]
    ours = measured_as(facts, quality)
    if ours is None or ONEFIXER not in quality.by_scene:
        return f"{DISTANCE} of {ONEFIXER} is not measured"
    names: list[str] = []
    for row in rows:
        differences = quality.differences(row, ONEFIXER, ours) if row != ONEFIXER else np.array([])
        if not len(differences):
            continue
        interval = median_interval(differences, "scenes")
        place = len(names)
        names.append(row)
        axes.plot(interval.centre, place, "o", color="C0")
        if interval.low is not None and interval.high is not None:
            axes.plot([interval.low, interval.high], [place, place], color="C0")
    axes.axvline(0.0, color="grey", linewidth=0.8)
    axes.set_yticks(range(len(names)), names, fontsize=7)
    axes.set_xlabel(f"{ours} minus that of {ONEFIXER}; right of zero {ONEFIXER} is better")
    axes.set_title("Median over scenes and its 95 % interval", fontsize=9)
    return None if names else f"no other row than {ONEFIXER} is measured"


def _over_a_clip(axes: Axes, rows: Sequence[str], quality: Quality) -> str | None:
    """Draw FVD by the first frame of a window, where clips have two windows and enough vectors."""
    name = printed().metrics["fvd"].ours[0]
    curves = 0
    for row in rows:
        windows = quality.sets.get(row, {}).get(name, {}).get("windows", [])
        points = [
            (window["first_frame"], window["value"])
            for window in windows
            if window["value"] is not None
        ]
        if points:
            axes.plot(*np.transpose(points), label=row)
            curves += 1
    if not curves:
        return "no FVD by window: it needs its weights and more than 400 clips"
    axes.set_xlabel("first frame of a window of 93")
    axes.set_ylabel("FVD")
    axes.legend(fontsize=7)
    return None
