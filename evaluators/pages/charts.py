"""Charts of a report as SVG in the page's colours."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING

from markupsafe import Markup, escape

if TYPE_CHECKING:  # slow to load, and most reports have no chart
    from matplotlib.axes import Axes

SIZE_IN = (4.6, 2.7)  # about 440 x 260 CSS pixels: legible on a phone
STYLE = {"font.size": 10, "svg.fonttype": "none", "svg.hashsalt": "simrun"}
# matplotlib knows no variables of CSS: what it draws in these colours becomes the page's
INK, MUTED, GRID = "#000001", "#000002", "#000003"
VARIANT = [f"#00001{i}" for i in range(8)]
VARIABLES = {INK: "--ink", MUTED: "--muted", GRID: "--line"} | {
    colour: f"--variant-{i}" for i, colour in enumerate(VARIANT)
}


@dataclass(frozen=True)
class Chart:
    """One chart: title and note are text of the page."""

    title: str
    note: str
    image: Markup


def new_axes(x_label: str, y_label: str) -> Axes:
    """Return empty axes with a grid."""
    from matplotlib.figure import Figure

    figure = Figure(SIZE_IN, layout="constrained")
    axes = figure.add_subplot()
    axes.grid(color=GRID, linewidth=0.8)
    axes.tick_params(length=0, labelcolor=MUTED)
    axes.spines[:].set_visible(False)
    axes.set_xlabel(x_label, color=MUTED, parse_math=False, loc="right")
    axes.set_ylabel(y_label, color=MUTED, parse_math=False)
    return axes


def chart_of(axes: Axes, title: str, note: str) -> Chart:
    """Return axes and what is drawn on them as a chart."""
    from matplotlib import rc_context

    text = io.StringIO()
    with rc_context(STYLE):
        axes.figure.canvas.figure.savefig(
            text, format="svg", transparent=True, metadata={"Date": None}
        )
    label = escape(f"{title}. {note}")
    svg = text.getvalue()
    svg = svg[svg.index("<svg ") :].replace(
        "<svg ", f'<svg role="img" aria-label="{label}" class="chart" ', 1
    )
    for colour, variable in VARIABLES.items():
        svg = svg.replace(colour, f"var({variable})")
    return Chart(title, note, Markup(svg))
