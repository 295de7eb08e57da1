"""Charts with axes, as inline SVG: drawn by matplotlib, coloured by the page.

Every colour that matplotlib writes is a stand-in that is replaced by a CSS variable, so one drawing serves light and dark. Text stays
text (``svg.fonttype: none``) and takes the page's font.
"""

from __future__ import annotations

import io
import re
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure

from alpasim_plugin.run_folder.rows import Rollout, Series
from evaluators.report.events import events_of
from evaluators.report.numbers import LEAST_SPAN

N_COLOURS = 8
SIZE_IN = (4.6, 2.7)  # about 440 x 260 CSS pixels: legible at its own size on a phone
DASHES: tuple[str | tuple[int, tuple[float, ...]], ...] = ("solid", (0, (5.0, 2.0)), (0, (1.5, 1.5)), (0, (6.0, 2.0, 1.5, 2.0)))
VARIANT = [f"#01{i:02x}a1" for i in range(N_COLOURS)]  # stand-ins, found again in the SVG
INK, MUTED, GRID = "#0201a1", "#0202a1", "#0203a1"
VARIABLES = {colour: f"var(--variant-{i})" for i, colour in enumerate(VARIANT)}
VARIABLES |= {INK: "var(--ink)", MUTED: "var(--muted)", GRID: "var(--line)"}
N_BINS = 60

RC = {
    "svg.fonttype": "none",
    "svg.hashsalt": "simrun",
    "font.size": 10,
    "text.color": INK,
    "axes.labelcolor": MUTED,
    "axes.edgecolor": GRID,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "grid.color": GRID,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
    "lines.linewidth": 1.8,
}


@dataclass(frozen=True)
class Chart:
    """One chart: title and note are text of the page, the rest is SVG."""

    title: str
    note: str
    svg: str

    @property
    def picture(self) -> Markup:
        """Give the SVG element with a name for screen readers."""
        return Markup(self.svg.replace(' role="img"', Markup(' role="img" aria-label="{}. {}"').format(self.title, self.note), 1))


@dataclass(frozen=True)
class Curve:
    """One variant's line with an optional band; all ``(N,)``."""

    label: str
    colour: int
    dash: int
    x: npt.NDArray[np.float64]
    y: npt.NDArray[np.float64]
    low: npt.NDArray[np.float64] | None = None
    high: npt.NDArray[np.float64] | None = None


def new_axes(
    height_in: float = SIZE_IN[1], left_in: float = 0.78, bottom_in: float = 0.5, width_in: float = SIZE_IN[0]
) -> tuple[Figure, Axes]:
    """Return a figure with one set of axes and fixed margins.

    Margins are given, not measured: measuring text takes two thirds of the time of a chart, and the page has a font of its own.

    Args:
        height_in: Height of the figure, inches.
        left_in: Room for the tick labels and the label of the y axis, inches.
        bottom_in: Room for those of the x axis, inches.
        width_in: Width of the figure, inches.
    """
    figure = Figure(figsize=(width_in, height_in))
    box = (left_in / width_in, bottom_in / height_in, 1.0 - (left_in + 0.08) / width_in, 1.0 - (bottom_in + 0.1) / height_in)
    return figure, figure.add_axes(box)


def line_chart(curves: Sequence[Curve], x_label: str, y_label: str, y_top: float | None = None) -> str:
    """Draw curves with bands and return themed SVG."""
    with mpl.rc_context(RC):
        figure, axes = new_axes()
        for curve in curves:
            colour = VARIANT[curve.colour % N_COLOURS]
            if curve.low is not None and curve.high is not None:
                axes.fill_between(curve.x, curve.low, curve.high, color=colour, alpha=0.16, linewidth=0)
            axes.plot(curve.x, curve.y, color=colour, linestyle=DASHES[curve.dash % len(DASHES)], label=curve.label)
        axes.set_xlabel(x_label)
        axes.set_ylabel(y_label)
        axes.set_ylim(bottom=0.0, top=max(axes.get_ylim()[1], LEAST_SPAN["m"]) if y_top is None else y_top)
        axes.margins(x=0.01)
        axes.tick_params(length=0)
        return themed_svg(figure)


def themed_svg(figure: Figure) -> str:
    """Print a figure as an SVG element whose colours are CSS variables and whose ids cannot meet those of another figure."""
    buffer = io.StringIO()
    FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None, "Creator": None, "Format": None, "Type": None})
    svg = buffer.getvalue()
    svg = svg[svg.index("<svg") :]
    for colour, variable in VARIABLES.items():
        svg = svg.replace(colour, variable)
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    # Hundredths of a point are plenty; numbers between tags are text and stay.
    svg = re.sub(r"<[^>]*>", lambda tag: re.sub(r"(\d+\.\d{2})\d+", r"\1", tag[0]), svg)
    svg = re.sub(r'font: ([\d.]+)px [^;"]*', r"font-size: \1px", svg)
    prefix = f"c{zlib.crc32(svg.encode()):08x}"
    svg = re.sub(r'\bid="([^"]+)"', rf'id="{prefix}-\1"', svg)
    svg = re.sub(r'(url\(#|href="#)', rf"\1{prefix}-", svg)
    return re.sub(r'<svg [^>]*?(viewBox="[^"]+")[^>]*>', r'<svg \1 role="img" class="chart">', svg, count=1)


def drift_charts(rollouts: Sequence[Rollout], series: Series, variant_of: dict[tuple[str, str], tuple[int, int]]) -> list[Chart]:
    """Draw how far from the logged path the ego is over time, and how many rollouts are still without an event."""
    charts = []
    by_variant: dict[tuple[str, str], list[Rollout]] = {}
    for rollout in rollouts:
        if rollout.ok and "lateral_offset_m" in series.get(rollout.cell, {}):
            by_variant.setdefault((rollout.renderer, rollout.policy), []).append(rollout)
    by_variant = {variant: by_variant[variant] for variant in variant_of if variant in by_variant}
    if not by_variant:
        return []
    several = len({policy for _, policy in by_variant}) > 1

    def curves(make: Callable[[list[Rollout]], tuple[npt.NDArray[np.float64], ...]]) -> list[Curve]:
        names = {key: " \u00b7 ".join(key) if several else key[0] for key in by_variant}
        return [Curve(names[key], *variant_of[key], *make(members)) for key, members in by_variant.items()]

    charts.append(
        Chart(
            "Distance from the logged path over time",
            "Line: median over rollouts. Band: 10th to 90th percentile. Drawn while at least half of the rollouts still run.",
            line_chart(curves(lambda members: _offset_band(members, series)), "s since start", "m beside the path"),
        )
    )
    charts.append(
        Chart(
            "Rollouts without a collision or off-road event so far",
            "Share of completed rollouts, by time of the first counted event.",
            line_chart(curves(lambda members: _survival(members, series)), "s since start", "% of rollouts", y_top=104.0),
        )
    )
    return charts


def _offset_band(members: list[Rollout], series: Series) -> tuple[npt.NDArray[np.float64], ...]:
    own = [series[r.cell]["lateral_offset_m"] for r in members]
    end_s = max(float(t[-1] - t[0]) for t, _ in own) * 1e-6
    grid = np.linspace(0.0, end_s, N_BINS)
    values = np.full((len(own), N_BINS), np.nan)  # (rollouts, times); NaN after a rollout's end
    for row, (t_us, offset) in zip(values, own, strict=True):
        seconds = (t_us - t_us[0]) * 1e-6
        inside = grid <= seconds[-1] + 1e-9
        row[inside] = np.abs(np.interp(grid[inside], seconds, offset))
    enough = np.count_nonzero(np.isfinite(values), axis=0) * 2 >= len(own)  # later, the few long scenes would pass for a trend
    low, middle, high = np.nanpercentile(values[:, enough], [10, 50, 90], axis=0)
    return grid[enough], middle, low, high


def _survival(members: list[Rollout], series: Series) -> tuple[npt.NDArray[np.float64], ...]:
    ends = [series[r.cell]["lateral_offset_m"][0] for r in members]
    end_s = max(float(t[-1] - t[0]) for t in ends) * 1e-6
    firsts = [min((e.t_s for e in events_of(r, series) if e.t_s is not None), default=np.inf) for r in members]
    times = np.array(sorted(t for t in firsts if np.isfinite(t)))
    x = np.concatenate([[0.0], np.repeat(times, 2), [end_s]])
    alive = 100.0 * (1.0 - np.arange(len(times) + 1) / len(members))
    y = np.repeat(alive, 2)
    return x, y
