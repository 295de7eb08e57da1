"""Charts of a report as SVG in the page's colours."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from markupsafe import Markup, escape

from alpasim_plugin.core.types import F64

N_COLOURS = 8
WIDTH_PT, HEIGHT_PT = 331.2, 194.4  # about 440 x 260 CSS pixels: legible on a phone
FONT_PT = 10.0  # the page's font
MOST_TICKS = 7
VARIANT = [f"var(--variant-{i})" for i in range(N_COLOURS)]
INK, MUTED, GRID = "var(--ink)", "var(--muted)", "var(--line)"
Values = Sequence[float] | F64


@dataclass(frozen=True)
class Chart:
    """One chart: title and note are text of the page."""

    title: str
    note: str
    picture: Markup


class Axes:
    """Axes with fixed margins. Lines and markers are added in the units of the data, and `chart`
    draws them within the limits that then hold.

    Attributes:
        limits: Of x and of y; None: what was added, with a twentieth of room on either side.
        labels: Of x and of y.
    """

    def __init__(self) -> None:
        self.box = 56.0, 7.2, WIDTH_PT - 5.8, HEIGHT_PT - 36.0  # left, top, right, bottom
        self.limits: list[tuple[float, float] | None] = [None, None]
        self.labels = ["", ""]
        self._values: tuple[list[float], list[float]] = ([], [])
        self._lines: list[Callable[[], str]] = []
        self._markers: list[Callable[[], str]] = []

    def line(self, x: Values, y: Values, colour: str, width: float = 1.8, dash: str = "") -> None:
        """Add a line, interrupted where it is not finite."""
        self._note(x, y)
        style = (
            f"fill:none;stroke:{colour};stroke-width:{width:g};stroke-dasharray:{dash or 'none'}"
        )
        self._lines.append(partial(self._path, x, y, style))

    def band(
        self, x: Values, low: Values, high: Values, colour: str, opacity: float = 0.16
    ) -> None:
        """Add the area between two lines, without places where one is not finite."""
        known = np.isfinite(low) & np.isfinite(high)
        style = f"fill:{colour};fill-opacity:{opacity:g};stroke:none"
        for part in np.split(np.arange(len(known)), np.flatnonzero(np.diff(known)) + 1):
            if known[part].all():
                xs = np.asarray(x)[part]
                lower, upper = np.asarray(low)[part], np.asarray(high)[part]
                around = np.concatenate([xs, xs[::-1]])
                edge = np.concatenate([lower, upper[::-1]])
                self._note(around, edge)
                self._lines.append(partial(self._path, around, edge, style))

    def points(self, x: Values, y: Values, colour: str, size: float = 6.0) -> None:
        """Add round markers; those outside the axes are not drawn."""
        self._note(x, y)

        def draw() -> str:
            left, top, right, bottom = self.box
            places = zip(self._place(0, x), self._place(1, y), strict=True)
            return "".join(
                f'<circle cx="{cx:.2f}" cy="{cy:.2f}" r="{size / 2:g}" style="fill:{colour}"/>'
                for cx, cy in places
                if left - 0.5 < cx < right + 0.5 and top - 0.5 < cy < bottom + 0.5
            )

        self._markers.append(draw)

    def across(self, y: float, colour: str, width: float = 1.0, dash: str = "") -> None:
        """Add a level line over the whole width."""
        self._note([], [y])
        style = (
            f"fill:none;stroke:{colour};stroke-width:{width:g};stroke-dasharray:{dash or 'none'}"
        )
        self._lines.append(lambda: self._path(self.range(0), [y, y], style))

    def range(self, axis: int) -> tuple[float, float]:
        """Return the limits of an axis."""
        limits = self.limits[axis]
        if limits is not None:
            return limits
        low = min(self._values[axis], default=0.0)
        high = max(self._values[axis], default=0.0)
        room = 0.05 * ((high - low) or abs(high) or 1.0)
        return low - room, high + room

    def chart(self, title: str, note: str) -> Chart:
        """Draw everything."""
        left, top, right, bottom = self.box
        text = f"fill:{MUTED};font-size:{FONT_PT:g}px;text-anchor"
        x_ticks = round_ticks(*self.range(0))
        y_ticks = round_ticks(*self.range(1))
        xs = self._place(0, [value for value, _ in x_ticks])
        ys = self._place(1, [value for value, _ in y_ticks])
        grid = [f"M{x:.2f} {top:g}V{bottom:g}" for x in xs]
        grid += [f"M{left:g} {y:.2f}H{right:g}" for y in ys]
        parts = [f'<path d="{"".join(grid)}" style="fill:none;stroke:{GRID};stroke-width:0.8"/>']
        for x, (_, label) in zip(xs, x_ticks, strict=True):
            parts.append(
                f'<text x="{x:.2f}" y="{bottom + 12:g}" style="{text}:middle">{label}</text>'
            )
        for y, (_, label) in zip(ys, y_ticks, strict=True):
            place = f'x="{left - 3.5:g}" y="{y + 3.5:.2f}"'
            parts.append(f'<text {place} style="{text}:end">{escape(label)}</text>')
        place = f'x="{right:g}" y="{HEIGHT_PT - 6:g}"'
        parts.append(f'<text {place} style="{text}:end">{escape(self.labels[0])}</text>')
        place = f'transform="translate(10 {(top + bottom) / 2:g}) rotate(-90)"'
        parts.append(f'<text {place} style="{text}:middle">{escape(self.labels[1])}</text>')
        width, height = right - left, bottom - top
        inner = f'x="{left:g}" y="{top:g}" width="{width:g}" height="{height:g}"'
        box = f'viewBox="{left:g} {top:g} {width:g} {height:g}" preserveAspectRatio="none"'
        parts += [f"<svg {inner} {box}>", *(draw() for draw in self._lines), "</svg>"]
        parts += [draw() for draw in self._markers]
        label = escape(f"{title}. {note}")
        view = f'viewBox="0 0 {WIDTH_PT:g} {HEIGHT_PT:g}"'
        svg = f'<svg {view} role="img" aria-label="{label}" class="chart">{"".join(parts)}</svg>'
        return Chart(title, note, Markup(svg))

    def _note(self, x: Values, y: Values) -> None:
        for known, values in zip(self._values, (x, y), strict=True):
            known += [float(value) for value in values if math.isfinite(value)]

    def _place(self, axis: int, values: Values) -> F64:
        """Return where values of an axis are in the picture, in points."""
        left, top, right, bottom = self.box
        low, high = self.range(axis)
        start, end = ((left, right), (bottom, top))[axis]
        return start + (end - start) * (np.asarray(values, np.float64) - low) / (high - low)

    def _path(self, x: Values, y: Values, style: str) -> str:
        steps = []
        command = "M"
        for px, py in np.clip(np.column_stack([self._place(0, x), self._place(1, y)]), -1e4, 1e4):
            if math.isfinite(px) and math.isfinite(py):
                steps.append(f"{command}{px:.2f} {py:.2f}")
                command = "L"
            else:
                command = "M"
        return f'<path d="{"".join(steps)}" style="{style}"/>'


def round_ticks(low: float, high: float) -> list[tuple[float, str]]:
    """Return at most `MOST_TICKS` + 1 round values between two limits, and their texts."""
    power = 10.0 ** math.floor(math.log10((high - low) / MOST_TICKS))
    step = next(
        k * power for k in (1, 2, 5, 10) if k * power * MOST_TICKS >= 0.999999 * (high - low)
    )
    places = max(0, -math.floor(math.log10(step) + 1e-9))
    numbers = range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    return [(k * step, f"{k * step:.{places}f}".replace("-", "\u2212")) for k in numbers]
