"""The charts of a report: drift over time, the forest of paired differences, and speed against error, drawn in one style."""

from __future__ import annotations

import io
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, NullFormatter

from alpasim_plugin.core.types import F64
from alpasim_plugin.run_folder.rows import Rollout, Series
from alpasim_plugin.run_folder.shapes import pair_tables
from evaluators.metrics import MetricInfo
from evaluators.opening import Run
from evaluators.report.numbers import LEAST_SPAN, finite, interval
from evaluators.report.rollouts import events_of

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
    x: F64
    y: F64
    low: F64 | None = None
    high: F64 | None = None


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
        if rollout.ok and "lateral_bias_m" in series.get(rollout.cell, {}):
            by_variant.setdefault((rollout.renderer, rollout.policy), []).append(rollout)
    by_variant = {variant: by_variant[variant] for variant in variant_of if variant in by_variant}
    if not by_variant:
        return []
    several = len({policy for _, policy in by_variant}) > 1

    def curves(make: Callable[[list[Rollout]], tuple[F64, ...]]) -> list[Curve]:
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


def _offset_band(members: list[Rollout], series: Series) -> tuple[F64, ...]:
    own = [series[r.cell]["lateral_bias_m"] for r in members]
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


def _survival(members: list[Rollout], series: Series) -> tuple[F64, ...]:
    ends = [series[r.cell]["lateral_bias_m"][0] for r in members]
    end_s = max(float(t[-1] - t[0]) for t in ends) * 1e-6
    firsts = [min((e.t_s for e in events_of(r, series) if e.t_s is not None), default=np.inf) for r in members]
    times = np.array(sorted(t for t in firsts if np.isfinite(t)))
    x = np.concatenate([[0.0], np.repeat(times, 2), [end_s]])
    alive = 100.0 * (1.0 - np.arange(len(times) + 1) / len(members))
    y = np.repeat(alive, 2)
    return x, y


LETTER_PT, LINE_PT = 6.0, 12.0  # width and height of a letter of a name, points
CHARACTER_IN = 0.075  # width of a tick label's character, inches: the page's font at 10 points
MARKERS = ("o", "s", "D", "^", "v", "P", "X", "p")
ERRORS = ("collision_at_fault", "offroad", "lateral_distance_m")


@dataclass(frozen=True)
class _Line:
    """One difference turned so that positive is worse, in printed units."""

    metric: MetricInfo
    variant: int
    centre: float
    low: float
    high: float
    margin: float


def forest(run: Run, variants: Mapping[str, int]) -> list[Chart]:
    """Draw the paired differences with their intervals, one chart a unit; metrics without a better side are left out.

    Args:
        run: The run.
        variants: Key of ``summary.json`` -> colour.
    """
    lines: dict[tuple[str, str], list[_Line]] = {}
    for variant, pairs in pair_tables(run.summary):
        for metric in run.table.ordered(pairs):
            facts = run.table.shown(metric)
            found = _line(facts, variants.get(variant, 0), pairs[metric] or {})
            if found is not None and facts.is_headline:
                lines.setdefault((str(pairs[metric].get("baseline") or "the baseline"), found[0]), []).append(found[1])
    several = len({baseline for baseline, _ in lines}) > 1
    return [_forest_chart(unit, baseline, several, some) for (baseline, unit), some in lines.items()]


def _line(metric: MetricInfo, variant: int, entry: Mapping[str, Any]) -> tuple[str, _Line] | None:
    centre, direction = finite(entry.get("diff")), entry.get("direction")
    bounds = interval(entry.get("ci95"), centre)
    if centre is None or bounds is None or direction not in ("lower", "higher"):
        return None
    unit = str(entry.get("unit") or "")
    scale = 100.0 if metric.in_percent else 1.0
    turned = [v * scale if direction == "lower" else -v * scale for v in (centre, *bounds)]
    margin = (finite(entry.get("margin")) or 0.0) * scale
    return ("points" if scale == 100.0 else unit), _Line(metric, variant, turned[0], min(turned[1:]), max(turned[1:]), margin)


def _forest_chart(unit: str, baseline: str, several: bool, lines: Sequence[_Line]) -> Chart:
    metrics = list(dict.fromkeys(line.metric.name for line in lines))
    names = list(dict.fromkeys(line.metric.words for line in lines))
    variants = sorted({line.variant for line in lines})
    gap = 1.0 / (len(variants) + 1)
    with mpl.rc_context(RC | {"axes.grid.axis": "x"}):
        left_in = 0.15 + CHARACTER_IN * max(len(name) for name in names)
        figure, axes = new_axes(0.75 + 0.42 * len(metrics) * max(1.0, 0.6 * len(variants)), min(left_in, 0.55 * SIZE_IN[0]))
        axes.axvline(0.0, color=INK, linewidth=1.0)
        for line in lines:
            y = metrics.index(line.metric.name) + (variants.index(line.variant) + 1) * gap - 0.5
            colour = VARIANT[line.variant % N_COLOURS]
            axes.plot([line.low, line.high], [y, y], color=colour, linewidth=1.8, solid_capstyle="butt")
            axes.plot([line.centre], [y], MARKERS[line.variant % len(MARKERS)], color=colour, markersize=5.5)
        for row, metric in enumerate(metrics):
            margin = max(line.margin for line in lines if line.metric.name == metric)
            if margin > 0.0:
                axes.plot([margin, margin], [row - 0.42, row + 0.42], color=MUTED, linewidth=1.0, linestyle=(0, (2.0, 2.0)))
        _no_magnifying(axes.get_xlim, axes.set_xlim, unit)
        axes.set_yticks(range(len(metrics)), names)
        axes.set_ylim(len(metrics) - 0.5, -0.5)
        axes.tick_params(length=0)
        axes.spines["left"].set_visible(False)
        worse_in = "percentage points" if unit == "points" else unit or "no unit"
        axes.set_xlabel(f"{worse_in} worse than {baseline} \u2192", x=1.0, ha="right")
        svg = themed_svg(figure)
    title = "Rates and shares" if unit == "points" else "Distances" if unit == "m" else f"In {unit or 'numbers without unit'}"
    title += f", against {baseline}" if several else ""
    return Chart(title, "Right of the line is worse. Bars: 95 % over scenes. Dashed: the margin that is still accepted.", svg)


@dataclass(frozen=True)
class _Point:
    """A renderer in the chart of speed against error."""

    variant: str
    mean_ms: float
    p95_ms: float
    line: _Line


def speed_against_error(run: Run, variants: Mapping[str, int]) -> list[Chart]:
    """Draw milliseconds per frame against what the renderer does to the driving, for each of a few metrics.

    The time is the mean: a fixer of blocks spends nothing on most frames, so its median says nothing of what a rollout costs.
    """
    speed = run.summary.get("speed") or {}
    paired = run.summary.get("paired") or {}
    charts = []
    for name in ERRORS:
        metric = run.table.shown(name)
        points = []
        for variant, times in speed.items():
            mean_ms, p95_ms = finite(times.get("ms_per_frame_mean")), finite(times.get("ms_per_frame_p95"))
            if mean_ms is None or mean_ms <= 0:
                continue
            entry = (paired.get(variant) or {}).get(name)
            line = _Line(metric, variants.get(variant, 0), 0.0, 0.0, 0.0, 0.0) if entry is None and variant not in paired else None
            if entry is not None and (found := _line(metric, variants.get(variant, 0), entry)) is not None:
                line = found[1]
            if line is not None:
                points.append(_Point(variant, mean_ms, mean_ms if p95_ms is None else p95_ms, line))
        if len(points) >= 2 and any(p.line.low < p.line.high or p.line.centre for p in points):
            charts.append(_speed_chart(metric, "points" if metric.in_percent else "m", points))
    return charts


def _speed_chart(metric: MetricInfo, unit: str, points: Sequence[_Point]) -> Chart:
    with mpl.rc_context(RC):
        figure, axes = new_axes()
        axes.axhline(0.0, color=INK, linewidth=0.9, alpha=0.7)
        for point in points:
            line, colour = point.line, VARIANT[point.line.variant % N_COLOURS]
            axes.plot([point.mean_ms, point.mean_ms], [line.low, line.high], color=colour, linewidth=1.8)
            axes.plot([point.mean_ms, max(point.p95_ms, point.mean_ms)], [line.centre, line.centre], color=colour, linewidth=0.9, alpha=0.7)
            axes.plot([point.mean_ms], [line.centre], MARKERS[line.variant % len(MARKERS)], color=colour, markersize=7, label=point.variant)
        _no_magnifying(axes.get_ylim, axes.set_ylim, unit)
        _time_axis(axes, [ms for p in points for ms in (p.mean_ms, p.p95_ms)])
        _name(axes, points)
        axes.set_xlabel("ms per camera frame: mean, line to the 95th percentile")
        axes.set_ylabel("points worse" if unit == "points" else f"{unit} worse")
        axes.tick_params(length=0)
        return Chart(metric.words, "Paired with the baseline, which lies on the line; 95 % over scenes.", themed_svg(figure))


def _name(axes: Axes, points: Sequence[_Point]) -> None:
    """Write each renderer's name beside its point: right and above, or at the nearest height where it covers no other name."""
    point_px = axes.figure.dpi / 72
    taken: list[tuple[float, float, float, float]] = []  # left, right, bottom, top in points from the figure's corner
    for point in sorted(points, key=lambda p: p.mean_ms):
        x, y = axes.transData.transform((point.mean_ms, point.line.centre)) / point_px
        width, right_end = LETTER_PT * len(point.variant), axes.bbox.x1 / point_px
        dx = 7.0 if x + 7.0 + width <= right_end else -7.0 - width
        steps = sorted((5.0 + LINE_PT * k for k in range(-12, 13)), key=lambda dy: abs(dy - 5.0))
        boxes = ((x + dx, x + dx + width, y + dy, y + dy + LINE_PT) for dy in steps)
        bottom, top = axes.bbox.y0 / point_px, axes.bbox.y1 / point_px
        box = None
        for b in boxes:
            covers = any(b[0] < t[1] and t[0] < b[1] and b[2] < t[3] and t[2] < b[3] for t in taken)
            if b[2] >= bottom and b[3] <= top and not covers:
                box = b
                break
        box = box or (x + dx, x + dx + width, y + 5.0, y + 5.0 + LINE_PT)
        taken.append(box)
        colour = VARIANT[point.line.variant % N_COLOURS]
        place = (point.mean_ms, point.line.centre)
        axes.annotate(point.variant, place, (box[0] - x, box[2] - y), textcoords="offset points", color=colour)


def _no_magnifying(get: Callable[[], tuple[float, float]], put: Callable[[float, float], Any], unit: str) -> None:
    """Widen an axis around zero to `LEAST_SPAN`: a micrometre drawn across the page would pass for a finding."""
    low, high = get()
    lacking = LEAST_SPAN.get(unit, 0.0) - (high - low)
    if lacking > 0.0:
        put(low - lacking / 2, high + lacking / 2)


def _time_axis(axes: Axes, ms: Sequence[float]) -> None:
    """Take a logarithmic axis where renderers differ by much, with room for their names on both sides."""
    low, high = min(ms), max(ms)
    if high < 4.0 * low:
        room = max(high - low, 0.1 * high)
        axes.set_xlim(max(low - 0.6 * room, 0.0), high + 0.6 * room)
        return
    axes.set_xscale("log")
    low, high = low / 2.0, high * 2.0
    axes.set_xlim(low, high)
    axes.set_xticks([t for t in (base * 10**k for k in range(-1, 6) for base in (1, 2, 5)) if low <= t <= high])
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
