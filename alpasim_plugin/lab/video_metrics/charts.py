"""The quality charts as PNG: by frame index, and against time per frame."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

from alpasim_plugin.lab.video_metrics.facts import FACTS, KNOWN, MS, PSNR, SSIM, WARP
from alpasim_plugin.lab.video_metrics.summary import TRUTH

LABELS = {PSNR: "PSNR, dB", SSIM: "SSIM", WARP: "Warp L1"}
MARKERS = ("o", "s", "D", "^", "v", "P", "X", "p")
COLUMNS = 2
DPI = 110
LEAST_BANDED = 5  # clips; the intervals of fewer hide the curves
MOST_BANDED = 8  # variants, beside the clean frames; the bands of more do


def plot_by_frame(summary: Mapping[str, Any], path: str | Path) -> None:
    """Draw every metric's mean over clips in windows of frames and write a PNG; few variants have
    95 % bands.
    """
    by_frame = summary["by_frame"]
    metrics = [m for m in FACTS if any(m in windows for windows in by_frame.values())]
    figure, panels = panels_of(len(metrics))
    banded = len([variant for variant in by_frame if variant != TRUTH]) <= MOST_BANDED
    for ax, metric in zip(panels, metrics, strict=True):
        for variant, colour, dash in _styles(summary):
            windows = by_frame[variant].get(metric)
            if windows is None:
                continue
            x = [(a + b) / 2 for a, b in zip(windows["first"], windows["last"], strict=True)]
            ax.plot(x, windows["mean"], color=colour, linestyle=dash, label=variant, linewidth=1.6)
            if banded and summary["clips"][variant] >= LEAST_BANDED:
                ax.fill_between(
                    x, windows["low"], windows["high"], color=colour, alpha=0.13, linewidth=0
                )
        ax.set_xlabel("frame")
        finish(ax, metric)
    legend(figure, panels)
    figure.savefig(path, dpi=DPI)


def plot_speed(summary: Mapping[str, Any], path: str | Path) -> None:
    """Draw every metric's mean against the fixer's time per frame and write a PNG; variants without
    a fixer are lines.

    Bars are 95 % intervals: of the time, and of the difference from the baseline, clip by clip,
    which is what variants are compared by.
    """
    variants = summary["arms"]
    paired = summary["paired"]
    baseline = summary["baseline"]
    metrics = [
        m
        for m in (PSNR, SSIM, "perceptual-syn", "lpips_alex", WARP)
        if any(m in values for values in variants.values())
    ]
    figure, panels = panels_of(len(metrics))
    timed = [values[MS]["mean"] for values in variants.values() if MS in values]
    for ax, metric in zip(panels, metrics, strict=True):
        for i, (variant, colour, dash) in enumerate(_styles(summary)):
            entry = variants[variant].get(metric)
            if entry is None:
                continue
            if MS not in variants[variant]:
                ax.axhline(
                    entry["mean"],
                    color=colour,
                    linestyle=dash,
                    label=f"{variant} (no fixer)",
                    linewidth=1.4,
                )
                continue
            x, y = variants[variant][MS], entry
            marker = MARKERS[i % len(MARKERS)]
            pair = paired.get(variant, {}).get(metric)
            reach = None if pair is None else _reach(pair["diff"], pair["ci95"])
            times = _reach(x["mean"], x["ci95"])
            ax.errorbar(
                x["mean"],
                y["mean"],
                xerr=times,
                yerr=reach,
                fmt=marker,
                color=colour,
                label=variant,
                capsize=2,
            )
        ax.set_xlabel(
            f"fixer, ms per frame (bars: 95 % of the difference from {baseline})", fontsize=9
        )
        if timed and max(timed) > 4 * max(min(timed), 1e-3):
            ax.set_xscale("log")
            ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            ax.xaxis.set_major_formatter(ScalarFormatter())
            ax.xaxis.set_minor_formatter(NullFormatter())
        ax.margins(x=0.15, y=0.15)
        finish(ax, metric)
    legend(figure, panels)
    figure.savefig(path, dpi=DPI)


def _reach(centre: float, bounds: list[float] | None) -> list[list[float]] | None:
    """Return how far an interval reaches below and above its centre, as matplotlib takes it."""
    return None if bounds is None else [[centre - bounds[0]], [bounds[1] - centre]]


def _styles(summary: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Return variant, colour and dashes: grey for what no fixer made."""
    out, used = [], 0
    for variant, values in summary["arms"].items():
        if MS in values:
            out.append((variant, f"C{used % 10}", "-"))
            used += 1
        else:
            out.append(
                (variant, "0.65" if variant == TRUTH else "0.25", ":" if variant == TRUTH else "--")
            )
    return out


def panels_of(count: int) -> tuple[Figure, list[Axes]]:
    """Return a figure with so many panels in two columns."""
    lines = -(-count // COLUMNS)
    figure = Figure(figsize=(5.2 * COLUMNS, 3.1 * lines + 0.6), layout="constrained")
    panels = list(figure.subplots(lines, COLUMNS, squeeze=False).ravel())
    for ax in panels[count:]:
        ax.set_visible(False)
    return figure, panels[:count]


def finish(ax: Axes, metric: str, note: str = "", axis: Literal["both", "x", "y"] = "both") -> None:
    """Say in a panel which side is better, label the metric where it is the other axis, and leave
    out what says nothing.
    """
    if axis == "both":
        ax.set_ylabel(LABELS.get(metric, metric))
    ax.set_title(
        f"{KNOWN.info(metric).direction} is better{note}", fontsize=8, loc="right", color="0.4"
    )
    ax.grid(visible=True, axis=axis, alpha=0.25)
    ax.spines[["top", "right"]].set_visible(False)


def legend(figure: Figure, panels: list[Axes], columns: int = 5) -> None:
    """Name what the panels show below them, once each."""
    handles = {
        label: handle
        for ax in panels
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        handles.values(),
        handles.keys(),
        loc="outside lower center",
        ncols=min(len(handles), columns),
        fontsize=9,
        frameon=False,
    )
