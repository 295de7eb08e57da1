"""The charts of a report: axes that draw themselves as SVG in the page's colours, and drift, paired
differences and speed on them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from markupsafe import Markup, escape

from alpasim_plugin.core.types import F64
from alpasim_plugin.log.run_folder.shapes import pair_tables
from evaluators.metrics import MetricInfo
from evaluators.opening import Run
from evaluators.report.numbers import LEAST_SPAN, finite, interval

N_COLOURS = 8
SIZE_PT = (331.2, 194.4)  # about 440 x 260 CSS pixels: legible at its own size on a phone
FONT_PT, LETTER_PT, LINE_PT = (
    10.0,
    6.0,
    12.0,
)  # the page's font: its size, the width and height of a letter
DASHES = ("", "9 3.6", "2.7 2.7", "10.8 2.7 2.7 3.6")
VARIANT = [f"var(--variant-{i})" for i in range(N_COLOURS)]
INK = "var(--ink)"
MUTED = "var(--muted)"
GRID = "var(--line)"
STEPS = (1.0, 2.0, 2.5, 5.0, 10.0)  # between ticks, times a power of ten
MARKERS = ("o", "s", "D", "^", "v", "P", "X", "p")
SHAPES = {  # corners of markers of size 1 around their middle, y down
    "s": "-.5 -.5 .5 -.5 .5 .5 -.5 .5",
    "D": "0 -.7 .7 0 0 .7 -.7 0",
    "^": "0 -.5 .5 .5 -.5 .5",
    "v": "0 .5 .5 -.5 -.5 -.5",
    "P": "-.17 -.5 .17 -.5 .17 -.17 .5 -.17 .5 .17 .17 .17 .17 .5 -.17 .5 -.17 .17 -.5 .17 -.5 -.17 -.17 -.17",
    "X": "-.5 -.25 -.25 -.5 0 -.25 .25 -.5 .5 -.25 .25 0 .5 .25 .25 .5 0 .25 -.25 .5 -.5 .25 -.25 0",
    "p": "0 -.5 .48 -.15 .29 .4 -.29 .4 -.48 -.15",
}
Values = Sequence[float] | F64
Tick = tuple[float, str]


@dataclass(frozen=True)
class Chart:
    """One chart: title and note are text of the page, the rest is SVG."""

    title: str
    note: str
    svg: str

    @property
    def picture(self) -> Markup:
        """Give the SVG element with a name for screen readers."""
        return Markup(
            self.svg.replace(
                ' role="img"',
                Markup(' role="img" aria-label="{}. {}"').format(self.title, self.note),
                1,
            )
        )


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


class Axes:
    """One set of axes with fixed margins. Things are added in data's units, and `svg` draws all of
    them where the limits then are.

    Margins are given, not measured: the page has a font of its own.

    Args:
        height_pt: Height of the picture, points.
        left_pt: Room for the tick labels and the label of the y axis.
        bottom_pt: Room for those of the x axis.
        width_pt: Width of the picture.
        grid: Axes whose ticks have lines across.

    Attributes:
        limits: Of x and of y; None: what was added, with a twentieth of room on either side.
        ticks: Of x and of y; None: round numbers.
        labels: Of x and of y.
        log: The x axis is logarithmic.
        tilted: The tick labels of x are written aslant.
        spine: The line of the y axis is drawn.
        room: Share of what was added that is left free on either side, x and y.
    """

    def __init__(
        self,
        height_pt: float = SIZE_PT[1],
        left_pt: float = 56.0,
        bottom_pt: float = 36.0,
        width_pt: float = SIZE_PT[0],
        grid: str = "xy",
    ) -> None:
        self.size = width_pt, height_pt
        self.box = left_pt, 7.2, width_pt - 5.8, height_pt - bottom_pt  # left, top, right, bottom
        self.limits: list[tuple[float, float] | None] = [None, None]
        self.ticks: list[Sequence[Tick] | None] = [None, None]
        self.labels, self.room = ["", ""], [0.05, 0.05]
        self.log, self.tilted, self.spine = False, False, True
        self.named: list[
            tuple[float, float, float, float]
        ] = []  # what names cover: left, right, top, bottom, points
        self._grid = grid
        self._seen: tuple[list[float], list[float]] = ([], [])
        self._drawn: list[tuple[str, Any]] = []

    def line(
        self,
        x: Values,
        y: Values,
        colour: str,
        width: float = 1.8,
        dash: str = "",
        opacity: float = 1.0,
    ) -> None:
        """Add a line, interrupted where it is not finite."""
        style = f"fill:none;stroke:{colour};stroke-width:{width:g};stroke-linejoin:round"
        style += (f";stroke-dasharray:{dash}" if dash else "") + (
            f";stroke-opacity:{opacity:g}" if opacity < 1 else ""
        )
        self._add("line", x, y, style)

    def band(
        self, x: Values, low: Values, high: Values, colour: str, opacity: float = 0.16
    ) -> None:
        """Add the area between two lines, without places where one is not finite."""
        known = np.isfinite(low) & np.isfinite(high)
        runs = np.split(np.arange(len(known)), np.flatnonzero(np.diff(known)) + 1)
        for at in (run for run in runs if len(run) and known[run[0]]):
            xs, ys = (
                np.asarray(x)[at],
                np.concatenate([np.asarray(low)[at], np.asarray(high)[at][::-1]]),
            )
            self._add(
                "line",
                np.concatenate([xs, xs[::-1]]),
                ys,
                f"fill:{colour};fill-opacity:{opacity:g};stroke:none",
            )

    def points(
        self,
        x: Values,
        y: Values,
        colour: str,
        marker: str = "o",
        size: float = 6.0,
        ring: float = 0.0,
    ) -> None:
        """Add markers; ``ring`` is the width of a hollow one's line."""
        style = f"fill:none;stroke:{colour};stroke-width:{ring:g}" if ring else f"fill:{colour}"
        self._add("points", x, y, (marker, size, style))

    def across(
        self, y: float, colour: str, width: float = 1.0, dash: str = "", opacity: float = 1.0
    ) -> None:
        """Add a level line over the whole width."""
        self.line([math.nan], [y], colour, width, dash, opacity)

    def upright(self, x: float, colour: str, width: float = 1.0) -> None:
        """Add a vertical line over the whole height."""
        self.line([x], [math.nan], colour, width)

    def name(self, x: float, y: float, text: str, colour: str) -> None:
        """Write a name beside a point, once the limits are known: right and above, or at the
        nearest height where it covers no other.
        """
        (px, py), width = (float(v[0]) for v in self._at([x], [y])), LETTER_PT * len(text)
        dx = 7.0 if px + 7.0 + width <= self.box[2] else -7.0 - width
        heights = sorted((5.0 + LINE_PT * k for k in range(-12, 13)), key=lambda dy: abs(dy - 5.0))
        boxes = [(px + dx, px + dx + width, py - dy - LINE_PT, py - dy) for dy in heights]
        inside = [b for b in boxes if b[2] >= self.box[1] and b[3] <= self.box[3]]
        free = [
            b
            for b in inside
            if not any(
                b[0] < t[1] and t[0] < b[1] and b[2] < t[3] and t[2] < b[3] for t in self.named
            )
        ]
        self.named.append(free[0] if free else boxes[0])
        self._drawn.append(("text", (*self.named[-1], text, colour)))

    def range(self, axis: Literal[0, 1]) -> tuple[float, float]:
        """Return the limits of an axis."""
        if self.limits[axis] is not None:
            return self.limits[axis]  # type: ignore[return-value]
        seen = self._seen[axis] or [0.0]
        low, high = min(seen), max(seen)
        if high == low:
            return low - 0.05 * (abs(low) or 1.0), high + 0.05 * (abs(high) or 1.0)
        return low - self.room[axis] * (high - low), high + self.room[axis] * (high - low)

    def svg(self) -> str:
        """Draw everything."""
        (width, height), (left, top, right, bottom) = self.size, self.box
        x_ticks, y_ticks = (self._ticks(axis) for axis in (0, 1))
        at_x, at_y = (
            self._at([v for v, _ in x_ticks], [])[0],
            self._at([], [v for v, _ in y_ticks])[1],
        )
        text = f"fill:{MUTED};font-size:{FONT_PT:g}px"
        lines = [f"M{x:.2f} {top:g}V{bottom:g}" for x in at_x if "x" in self._grid]
        lines += [f"M{left:g} {y:.2f}H{right:g}" for y in at_y if "y" in self._grid]
        lines += [f"M{left:g} {bottom:g}H{right:g}"] + (
            [f"M{left:g} {top:g}V{bottom:g}"] if self.spine else []
        )
        out = [f'<path d="{"".join(lines)}" style="fill:none;stroke:{GRID};stroke-width:0.8"/>']
        for x, (_, label) in zip(at_x, x_ticks, strict=True):
            turn = f' transform="rotate(-30 {x:.2f} {bottom + 12:g})"' if self.tilted else ""
            out.append(
                _text(float(x), bottom + 12, label, text, "end" if self.tilted else "middle", turn)
            )
        out += [
            _text(left - 3.5, float(y) + 3.5, label, text, "end")
            for y, (_, label) in zip(at_y, y_ticks, strict=True)
        ]
        out.append(_text(right, height - 6.0, self.labels[0], text, "end"))
        turn = f' transform="rotate(-90 10 {(top + bottom) / 2:g})"'
        out.append(_text(10.0, (top + bottom) / 2, self.labels[1], text, "middle", turn))
        # lines end at the axes
        inner = f'x="{left:g}" y="{top:g}" width="{right - left:g}" height="{bottom - top:g}"'
        box = f'viewBox="{left:g} {top:g} {right - left:g} {bottom - top:g}" preserveAspectRatio="none"'
        out += [
            f"<svg {inner} {box}>",
            *(self._path(*what) for kind, what in self._drawn if kind == "line"),
            "</svg>",
        ]
        out += [self._markers(*what) for kind, what in self._drawn if kind == "points"]
        for begin, _, _, base, name, colour in (
            what for kind, what in self._drawn if kind == "text"
        ):
            out.append(
                _text(begin, base - 2.5, name, f"fill:{colour};font-size:{FONT_PT:g}px", "start")
            )
        return (
            f'<svg viewBox="0 0 {width:g} {height:g}" role="img" class="chart">{"".join(out)}</svg>'
        )

    def _add(self, kind: str, x: Values, y: Values, what: Any) -> None:
        for seen, values in zip(self._seen, (x, y), strict=True):
            seen += [float(v) for v in values if math.isfinite(v)]
        self._drawn.append((kind, (np.asarray(x, np.float64), np.asarray(y, np.float64), what)))

    def _at(self, x: Values, y: Values) -> tuple[F64, F64]:
        """Return where data are in the picture, points from its upper left corner."""
        left, top, right, bottom = self.box
        (x0, x1), (y0, y1), xs = self.range(0), self.range(1), np.asarray(x, np.float64)
        if self.log:
            x0 = math.log(x0)
            x1 = math.log(x1)
            xs = np.log(xs)
        return left + (right - left) * (xs - x0) / (x1 - x0), bottom - (bottom - top) * (
            np.asarray(y, np.float64) - y0
        ) / (y1 - y0)

    def _path(self, xs: F64, ys: F64, style: str) -> str:
        left, top, right, bottom = self.box
        x, y = (np.clip(v, -1e4, 1e4) for v in self._at(xs, ys))  # NaN stays
        if len(x) == 1 and math.isnan(y[0]):
            x, y = x[[0, 0]], np.array([top, bottom])
        elif len(x) == 1 and math.isnan(x[0]):
            x, y = np.array([left, right]), y[[0, 0]]
        known = np.isfinite(x) & np.isfinite(y)
        after = np.concatenate(
            [[False], known[:-1]]
        )  # a point begins a new line where none is known before it
        steps = (
            f"{'L' if on else 'M'}{a:.2f} {b:.2f}"
            for a, b, ok, on in zip(x, y, known, after, strict=True)
            if ok
        )
        return f'<path d="{"".join(steps)}" style="{style}"/>'

    def _markers(self, xs: F64, ys: F64, how: tuple[str, float, str]) -> str:
        """Draw the markers whose middles are inside the axes."""
        left, top, right, bottom = self.box
        x, y = self._at(xs, ys)
        inside = (x > left - 0.5) & (x < right + 0.5) & (y > top - 0.5) & (y < bottom + 0.5)
        return "".join(
            _marker(float(a), float(b), *how) for a, b in zip(x[inside], y[inside], strict=True)
        )

    def _ticks(self, axis: Literal[0, 1]) -> Sequence[Tick]:
        given = self.ticks[axis]
        low, high = sorted(self.range(axis))
        if given is not None:
            return [tick for tick in given if low <= tick[0] <= high]
        length = self.box[2] - self.box[0] if axis == 0 else self.box[3] - self.box[1]
        most = min(max(math.floor(length / FONT_PT / (3 if axis == 0 else 2)), 1), 9)
        power = 10.0 ** math.floor(math.log10((high - low) / most))
        step = next(one * power for one in STEPS if one * power * most >= 0.999999 * (high - low))
        decimals = next(
            d for d in range(16) if abs(step * 10**d - round(step * 10**d)) < 1e-6 * step * 10**d
        )
        first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
        return [
            (k * step, f"{k * step:.{decimals}f}".replace("-", "\u2212"))
            for k in range(first, last + 1)
        ]


def _text(x: float, y: float, text: str, style: str, anchor: str, more: str = "") -> str:
    return (
        f'<text x="{x:.2f}" y="{y:.2f}" style="{style};text-anchor:{anchor}"{more}>{escape(text)}</text>'
        if text
        else ""
    )


def _marker(x: float, y: float, marker: str, size: float, style: str) -> str:
    if marker == "o":
        return f'<circle cx="{x:.2f}" cy="{y:.2f}" r="{size / 2:g}" style="{style}"/>'
    return f'<polygon points="{SHAPES[marker]}" transform="translate({x:.2f} {y:.2f}) scale({size:g})" style="{style}"/>'


def line_chart(
    curves: Sequence[Curve], x_label: str, y_label: str, y_top: float | None = None
) -> str:
    """Draw curves with bands and return themed SVG."""
    axes = Axes()
    for curve in curves:
        colour = VARIANT[curve.colour % N_COLOURS]
        if curve.low is not None and curve.high is not None:
            axes.band(curve.x, curve.low, curve.high, colour)
        axes.line(curve.x, curve.y, colour, dash=DASHES[curve.dash % len(DASHES)])
    axes.labels = [x_label, y_label]
    axes.limits[1] = 0.0, max(axes.range(1)[1], LEAST_SPAN["m"]) if y_top is None else y_top
    axes.room[0] = 0.01
    return axes.svg()


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
    """Draw the paired differences with their intervals, one chart a unit; metrics without a better
    side are left out.

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
                lines.setdefault(
                    (str(pairs[metric].get("baseline") or "the baseline"), found[0]), []
                ).append(found[1])
    several = len({baseline for baseline, _ in lines}) > 1
    return [
        _forest_chart(unit, baseline, several, some) for (baseline, unit), some in lines.items()
    ]


def _line(metric: MetricInfo, variant: int, entry: Mapping[str, Any]) -> tuple[str, _Line] | None:
    centre, direction = finite(entry.get("diff")), entry.get("direction")
    bounds = interval(entry.get("ci95"), centre)
    if centre is None or bounds is None or direction not in ("lower", "higher"):
        return None
    unit = str(entry.get("unit") or "")
    scale = 100.0 if metric.in_percent else 1.0
    turned = [v * scale if direction == "lower" else -v * scale for v in (centre, *bounds)]
    margin = (finite(entry.get("margin")) or 0.0) * scale
    return ("points" if scale == 100.0 else unit), _Line(
        metric, variant, turned[0], min(turned[1:]), max(turned[1:]), margin
    )


def _forest_chart(unit: str, baseline: str, several: bool, lines: Sequence[_Line]) -> Chart:
    metrics = list(dict.fromkeys(line.metric.name for line in lines))
    names = list(dict.fromkeys(line.metric.words for line in lines))
    variants = sorted({line.variant for line in lines})
    gap = 1.0 / (len(variants) + 1)
    left_pt = min(11.0 + 0.9 * LETTER_PT * max(len(name) for name in names), 0.55 * SIZE_PT[0])
    axes = Axes(54.0 + 30.0 * len(metrics) * max(1.0, 0.6 * len(variants)), left_pt, grid="x")
    axes.upright(0.0, INK)
    for line in lines:
        y = metrics.index(line.metric.name) + (variants.index(line.variant) + 1) * gap - 0.5
        colour = VARIANT[line.variant % N_COLOURS]
        axes.line([line.low, line.high], [y, y], colour)
        axes.points([line.centre], [y], colour, MARKERS[line.variant % len(MARKERS)], 5.5)
    for row, metric in enumerate(metrics):
        margin = max(line.margin for line in lines if line.metric.name == metric)
        if margin > 0.0:
            axes.line([margin, margin], [row - 0.42, row + 0.42], MUTED, 1.0, "2 2")
    _no_magnifying(axes, 0, unit)
    axes.ticks[1], axes.limits[1] = list(enumerate(names)), (len(metrics) - 0.5, -0.5)
    axes.spine = False
    worse_in = "percentage points" if unit == "points" else unit or "no unit"
    axes.labels[0] = f"{worse_in} worse than {baseline} \u2192"
    title = (
        "Rates and shares"
        if unit == "points"
        else "Distances"
        if unit == "m"
        else f"In {unit or 'numbers without unit'}"
    )
    title += f", against {baseline}" if several else ""
    return Chart(
        title,
        "Right of the line is worse. Bars: 95 % over scenes. Dashed: the margin that is still accepted.",
        axes.svg(),
    )


@dataclass(frozen=True)
class _Point:
    """A renderer in the chart of speed against error."""

    variant: str
    mean_ms: float
    p95_ms: float
    line: _Line


def speed_against_error(run: Run, variants: Mapping[str, int]) -> list[Chart]:
    """Draw milliseconds per frame against what the renderer does to the driving, for each of a few
    metrics.

    The time is the mean: a fixer of blocks spends nothing on most frames, so its median says
    nothing of what a rollout costs.
    """
    speed = run.summary.get("speed") or {}
    paired = run.summary.get("paired") or {}
    charts = []
    for name in ERRORS:
        metric = run.table.shown(name)
        points = []
        for variant, times in speed.items():
            mean_ms, p95_ms = (
                finite(times.get("ms_per_frame_mean")),
                finite(times.get("ms_per_frame_p95")),
            )
            if mean_ms is None or mean_ms <= 0:
                continue
            entry = (paired.get(variant) or {}).get(name)
            line = (
                _Line(metric, variants.get(variant, 0), 0.0, 0.0, 0.0, 0.0)
                if entry is None and variant not in paired
                else None
            )
            if (
                entry is not None
                and (found := _line(metric, variants.get(variant, 0), entry)) is not None
            ):
                line = found[1]
            if line is not None:
                points.append(_Point(variant, mean_ms, mean_ms if p95_ms is None else p95_ms, line))
        if len(points) >= 2 and any(p.line.low < p.line.high or p.line.centre for p in points):
            charts.append(_speed_chart(metric, "points" if metric.in_percent else "m", points))
    return charts


def _speed_chart(metric: MetricInfo, unit: str, points: Sequence[_Point]) -> Chart:
    axes = Axes()
    axes.across(0.0, INK, 0.9, opacity=0.7)
    for point in points:
        line, colour = point.line, VARIANT[point.line.variant % N_COLOURS]
        axes.line([point.mean_ms, point.mean_ms], [line.low, line.high], colour)
        axes.line(
            [point.mean_ms, max(point.p95_ms, point.mean_ms)],
            [line.centre, line.centre],
            colour,
            0.9,
            opacity=0.7,
        )
        axes.points(
            [point.mean_ms], [line.centre], colour, MARKERS[line.variant % len(MARKERS)], 7.0
        )
    _no_magnifying(axes, 1, unit)
    _time_axis(axes, [ms for p in points for ms in (p.mean_ms, p.p95_ms)])
    for point in sorted(points, key=lambda p: p.mean_ms):
        axes.name(
            point.mean_ms, point.line.centre, point.variant, VARIANT[point.line.variant % N_COLOURS]
        )
    axes.labels = [
        "ms per camera frame: mean, line to the 95th percentile",
        "points worse" if unit == "points" else f"{unit} worse",
    ]
    return Chart(
        metric.words,
        "Paired with the baseline, which lies on the line; 95 % over scenes.",
        axes.svg(),
    )


def _no_magnifying(axes: Axes, axis: Literal[0, 1], unit: str) -> None:
    """Widen an axis around zero to `LEAST_SPAN`: a micrometre drawn across the page would pass for
    a finding.
    """
    low, high = axes.range(axis)
    lacking = max(LEAST_SPAN.get(unit, 0.0) - (high - low), 0.0)
    axes.limits[axis] = low - lacking / 2, high + lacking / 2


def _time_axis(axes: Axes, ms: Sequence[float]) -> None:
    """Take a logarithmic axis where renderers differ by much, with room for their names on both
    sides.
    """
    low, high = min(ms), max(ms)
    if high < 4.0 * low:
        room = max(high - low, 0.1 * high)
        axes.limits[0] = max(low - 0.6 * room, 0.0), high + 0.6 * room
        return
    axes.log, axes.limits[0] = True, (low / 2.0, high * 2.0)
    axes.ticks[0] = [
        (t, f"{t:g}") for t in (base * 10.0**k for k in range(-1, 6) for base in (1, 2, 5))
    ]
