"""The charts that compare renderers: the forest of paired differences, speed against error, and plans by stratum."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.ticker import FuncFormatter, NullFormatter

from alpasim_plugin.run_folder.reader import Run
from evaluators.report.charts import GRID, INK, MUTED, N_COLOURS, RC, SIZE_IN, VARIANT, Chart, new_axes, themed_svg
from evaluators.report.headline import WORDS
from evaluators.report.metric_info import HEADLINE, in_percent, ordered
from evaluators.report.numbers import LEAST_SPAN, finite, interval
from evaluators.report.pairs import pair_tables
from evaluators.report.strata import NOT_BESIDE, VALUES, Strata

LETTER_PT, LINE_PT = 6.0, 12.0  # width and height of a letter of a name, points
CHARACTER_IN = 0.075  # width of a tick label's character, inches: the page's font at 10 points
MARKERS = ("o", "s", "D", "^", "v", "P", "X", "p")
ERRORS = ("collision_at_fault", "offroad", "lateral_distance_m")


@dataclass(frozen=True)
class _Line:
    """One difference turned so that positive is worse, in printed units."""

    metric: str
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
        for metric in ordered(pairs):
            found = _line(metric, variants.get(variant, 0), pairs[metric] or {})
            if found is not None and metric in HEADLINE:
                lines.setdefault((str(pairs[metric].get("baseline") or "the baseline"), found[0]), []).append(found[1])
    several = len({baseline for baseline, _ in lines}) > 1
    return [_forest_chart(unit, baseline, several, some) for (baseline, unit), some in lines.items()]


def _line(metric: str, variant: int, entry: Mapping[str, Any]) -> tuple[str, _Line] | None:
    centre, direction = finite(entry.get("diff")), entry.get("direction")
    bounds = interval(entry.get("ci95"), centre)
    if centre is None or bounds is None or direction not in ("lower", "higher"):
        return None
    unit = str(entry.get("unit") or "")
    scale = 100.0 if in_percent(metric, unit) else 1.0
    turned = [v * scale if direction == "lower" else -v * scale for v in (centre, *bounds)]
    margin = (finite(entry.get("margin")) or 0.0) * scale
    return ("points" if scale == 100.0 else unit), _Line(metric, variant, turned[0], min(turned[1:]), max(turned[1:]), margin)


def _forest_chart(unit: str, baseline: str, several: bool, lines: Sequence[_Line]) -> Chart:
    metrics = list(dict.fromkeys(line.metric for line in lines))
    variants = sorted({line.variant for line in lines})
    gap = 1.0 / (len(variants) + 1)
    with mpl.rc_context(RC | {"axes.grid.axis": "x"}):
        names = [WORDS.get(metric, metric) for metric in metrics]
        left_in = 0.15 + CHARACTER_IN * max(len(name) for name in names)
        figure, axes = new_axes(0.75 + 0.42 * len(metrics) * max(1.0, 0.6 * len(variants)), min(left_in, 0.55 * SIZE_IN[0]))
        axes.axvline(0.0, color=INK, linewidth=1.0)
        for line in lines:
            y = metrics.index(line.metric) + (variants.index(line.variant) + 1) * gap - 0.5
            colour = VARIANT[line.variant % N_COLOURS]
            axes.plot([line.low, line.high], [y, y], color=colour, linewidth=1.8, solid_capstyle="butt")
            axes.plot([line.centre], [y], MARKERS[line.variant % len(MARKERS)], color=colour, markersize=5.5)
        for row, metric in enumerate(metrics):
            margin = max(line.margin for line in lines if line.metric == metric)
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
    for metric in ERRORS:
        points = []
        for variant, times in speed.items():
            mean_ms, p95_ms = finite(times.get("ms_per_frame_mean")), finite(times.get("ms_per_frame_p95"))
            if mean_ms is None or mean_ms <= 0:
                continue
            entry = (paired.get(variant) or {}).get(metric)
            line = _Line(metric, variants.get(variant, 0), 0.0, 0.0, 0.0, 0.0) if entry is None and variant not in paired else None
            if entry is not None and (found := _line(metric, variants.get(variant, 0), entry)) is not None:
                line = found[1]
            if line is not None:
                points.append(_Point(variant, mean_ms, mean_ms if p95_ms is None else p95_ms, line))
        if len(points) >= 2 and any(p.line.low < p.line.high or p.line.centre for p in points):
            charts.append(_speed_chart(metric, "points" if in_percent(metric, "") else "m", points))
    return charts


def _speed_chart(metric: str, unit: str, points: Sequence[_Point]) -> Chart:
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
        return Chart(WORDS.get(metric, metric), "Paired with the baseline, which lies on the line; 95 % over scenes.", themed_svg(figure))


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
        box = next((b for b in boxes if b[2] >= bottom and b[3] <= top and not any(_overlap(b, t) for t in taken)), None)
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


def _overlap(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> bool:
    return a[0] < b[1] and b[0] < a[1] and a[2] < b[3] and b[2] < a[3]


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


def strata_chart(one: Strata) -> Chart | None:
    """Draw the steadiness of plans by stratum; None where it is known in fewer than two."""
    name = VALUES[0]
    known = [s for s in one.strata if s.label != NOT_BESIDE and any(name in b.means for b in s.bins)]
    if len(known) < 2:
        return None
    variants = sorted({b.variant for s in known for b in s.bins})
    with mpl.rc_context(RC | {"axes.grid.axis": "y"}):
        figure, axes = new_axes()
        for k, stratum in enumerate(known):
            for b in stratum.bins:
                if name not in b.means:
                    continue
                x = k + (variants.index(b.variant) + 1) / (len(variants) + 1) - 0.5
                mean, low, high = b.means[name]
                colour = VARIANT[b.variant % N_COLOURS]
                if low is not None and high is not None:
                    axes.plot([x, x], [max(low, 0.0), high], color=colour, linewidth=1.8)
                axes.plot([x], [mean], MARKERS[b.variant % len(MARKERS)], color=colour, markersize=6)
        for k in range(1, len(known)):
            axes.axvline(k - 0.5, color=GRID, linewidth=0.8)
        axes.set_xticks(range(len(known)), [_tick(s.label, one.unit) for s in known], fontsize=8.5)
        axes.set_xlim(-0.5, len(known) - 0.5)
        axes.set_ylim(0.0, 1.08 * axes.get_ylim()[1])  # the highest marker is whole
        axes.set_ylabel("m between plans in a row")
        axes.set_xlabel(f"{one.axis}, {one.unit}" if one.unit else one.axis)
        axes.tick_params(length=0)
        svg = themed_svg(figure)
    return Chart(f"Steadiness of plans by {one.axis}", "Mean of plan_deviation; bars: 95 % over scenes, from three scenes on.", svg)


def _tick(label: str, unit: str) -> str:
    short_label = label.replace("\u00a0" + unit, "") if unit else label
    return short_label.replace(" and more", "+").replace("below ", "< ").replace(" to ", "\u2013")
