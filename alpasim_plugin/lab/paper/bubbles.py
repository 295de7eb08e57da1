"""The paper's first figure: every arm by quality and consistency, the area of its bubble by its
time a frame.
"""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

from alpasim_plugin.lab.paper.claims import ALL, MOTION, MS, OURS, PERCEPTUAL, RAW
from alpasim_plugin.lab.paper.verdict import Evidence
from alpasim_plugin.lab.video_metrics.charts import DPI

SHOWN = (
    RAW,
    *ALL,
    "omnidreams@1",
    "artifixer-pre@4",
    "artifixer-pre@1",
    OURS,
    "onefixer-dit-tiny",
    "onefixer",
)
PATHS = (
    ("omnidreams@4", "omnidreams@1"),
    ("artifixer-pre@4", "artifixer-pre@1"),
    ("artifixer-pre@1", "artifixer"),
)
AREA, RENDER_AREA = 12.0, 30.0  # points squared a millisecond; of what takes none


def plot_bubbles(measured: Evidence, path: Path) -> None:
    """Draw the arms that were measured and write a PNG; dashed: the same arm with fewer steps, or
    distilled.
    """
    figure = Figure(figsize=(9.6, 6.6), layout="constrained")
    ax = figure.subplots()
    at = {}
    for arm in dict.fromkeys(SHOWN):
        if not (measured.has(arm, PERCEPTUAL) and measured.has(arm, MOTION)):
            continue
        at[arm] = x, y = measured.mean(arm, PERCEPTUAL).centre, measured.mean(arm, MOTION).centre
        area = AREA * measured.mean(arm, MS).centre if measured.has(arm, MS) else RENDER_AREA
        colour = {RAW: "0.4", OURS: "C1", "onefixer": "C3"}.get(arm, "C0")
        ax.scatter([x], [y], s=area, color=colour, alpha=0.45, edgecolor=colour)
        ax.annotate(
            arm, (x, y), xytext=(4, 4 - 13 * (len(at) % 2)), textcoords="offset points", fontsize=8
        )
    for first, second in PATHS:
        if first in at and second in at:
            ax.plot(
                *zip(at[first], at[second], strict=True), linestyle="--", color="0.5", linewidth=0.9
            )
    ax.margins(x=0.14)
    ax.set_yscale("log")
    ax.set_xlabel(f"{PERCEPTUAL}, lower is better")
    ax.set_ylabel(f"{MOTION}, lower is better")
    ax.set_title("area: ms a frame; the render takes none", fontsize=9, loc="right", color="0.4")
    ax.grid(visible=True, alpha=0.25)
    figure.savefig(path, dpi=DPI)
