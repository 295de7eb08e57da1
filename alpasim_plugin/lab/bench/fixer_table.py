"""The fixer's bench as a Markdown table and as a plot of speed against error."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

from alpasim_plugin.block_fixers.pipeline import TIMED
from alpasim_plugin.lab.bench.fixer_rows import Row

HEAD = (
    "setting",
    "weights",
    *(f"{stage} ms" for stage in TIMED),
    "all-in ms",
    "CPU ms",
    "first block ms",
    "peak MB",
    "rounding: mean, max, PSNR",
    "model: mean, max, PSNR",
    "hits",
)
NEAR = 0.15  # decades between points that share a label
FEW = 3  # up to so many names are written to the right of their points, more to the left
FLOOR = 1e-4  # grey levels; where the plot puts errors that are zero
MARKERS = {
    "precision": "o",
    "window": "s",
    "history": "^",
    "decoder": "D",
    "mode": "P",
    "guard": "v",
    "source": "<",
    "cameras": ">",
}
MARK = "<!-- bench: {} -->"


def markdown(rows: Sequence[Row]) -> str:
    """Return one table per size; times are median / 95th percentile per frame, errors grey levels
    and dB.
    """
    parts = []
    for size in dict.fromkeys(row.size for row in rows):
        mine = [row for row in rows if row.size == size]
        frames = max(row.frames for row in mine)
        parts.append(f"**{size[0]}x{size[1]}**, {frames} frames\n")
        parts.append("| " + " | ".join(HEAD) + " |")
        parts.append("|---|---|" + "---:|" * (len(HEAD) - 2))
        parts += ["| " + " | ".join(cells(row)) + " |" for row in mine]
        parts.append("")
    return "\n".join(parts)


def cells(row: Row) -> list[str]:
    """Return a row's texts under `HEAD`."""
    name = f"{row.group}: {row.name}"
    if row.problem:
        return [name, row.weights, f"not measured: {row.problem}", *([""] * (len(HEAD) - 3))]
    return [
        name,
        row.weights,
        *(_times(row, stage) for stage in (*TIMED, "all-in", "cpu")),
        _number(row.first_ms, ".0f"),
        _number(row.peak_mb, ".0f"),
        _error(row.rounding)
        + (f" (guard: {row.guarded} of {row.frames} frames unfixed)" if row.guarded else ""),
        _error(row.model),
        "" if row.hit_rate is None else f"{row.hit_rate:.0%}",
    ]


def _times(row: Row, stage: str) -> str:
    if stage not in row.ms:
        return ""
    p50, p95 = row.ms[stage]
    digits = 2 if p95 < 1 else 1
    return f"{p50:.{digits}f} / {p95:.{digits}f}"


def _number(value: float | None, form: str) -> str:
    return "" if value is None else format(value, form)


def _error(error: tuple[float, int, float | None] | None) -> str:
    if error is None:
        return ""
    mean, largest, psnr = error
    return "equal" if psnr is None else f"{mean:.2g}, {largest}, {psnr:.1f}"


def plot(rows: Sequence[Row], path: str | Path) -> None:
    """Draw all-in time per frame against both errors, one point a setting, and write a PNG."""
    sizes = list(dict.fromkeys(row.size for row in rows))
    figure = Figure(figsize=(14, 6.2 * len(sizes)), layout="constrained")
    axes = figure.subplots(len(sizes), 2, squeeze=False)
    titles = {
        "rounding": "rounding: the same setting",
        "model": "model: the base with a window over the whole clip",
    }
    for line, size in zip(axes, sizes, strict=True):
        mine = [row for row in rows if row.size == size and not row.problem]
        for ax, (kind, title) in zip(line, titles.items(), strict=True):
            _panel(
                ax, [(row, error[0]) for row in mine if (error := getattr(row, kind)) is not None]
            )
            ax.set_title(
                f"{size[0]}x{size[1]}, against the float32 whole clip of {title.partition(': ')[2]} ({kind})",
                fontsize=9,
            )
    figure.savefig(path, dpi=100)


def _panel(ax: Any, errors: Sequence[tuple[Row, float]]) -> None:
    points = [(row, row.ms["all-in"][0], max(error, FLOOR)) for row, error in errors]
    for row, x, y in points:
        ax.plot(x, y, MARKERS[row.group], color=f"C{list(MARKERS).index(row.group)}", markersize=7)
    for (left, right), y, names in _clusters(points):
        side = "bottom" if y <= FLOOR else "top"
        at, shift, align = (left, -7, "right") if len(names) > FEW else (right, 7, "left")
        ax.annotate(
            "\n".join(names),
            (at, y),
            xytext=(shift, 4),
            textcoords="offset points",
            fontsize=7,
            va=side,
            ha=align,
        )
    for group, marker in MARKERS.items():
        ax.plot([], [], marker, color=f"C{list(MARKERS).index(group)}", label=group)
    ax.legend(fontsize=8, loc="center right")
    ax.set_xscale("log")
    ax.set_yscale("log")
    ax.margins(x=0.38, y=0.12)
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.xaxis.set_major_formatter(ScalarFormatter())
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.set_xlabel("all-in, ms per frame (median)")
    ax.set_ylabel(f"mean error, grey levels ({FLOOR:g}: that or less)")
    ax.grid(visible=True, which="both", alpha=0.25)


def _clusters(
    points: Sequence[tuple[Row, float, float]],
) -> list[tuple[tuple[float, float], float, list[str]]]:
    """Join the names of points whose labels would lie on each other: leftmost and rightmost of
    them, their height, names.
    """
    out: list[tuple[tuple[float, float], float, list[str]]] = []
    for row, x, y in sorted(points, key=lambda point: (point[2], point[1])):
        for i, ((left, right), height, names) in enumerate(out):
            if abs(math.log10(x / right)) < NEAR and abs(math.log10(y / height)) < NEAR:
                out[i] = ((min(x, left), max(x, right)), height, [*names, row.name])
                break
        else:
            out.append(((x, x), y, [row.name]))
    return out


def put_between_marks(page: str, name: str, text: str) -> str:
    """Replace the text of a page between ``<!-- bench: NAME -->`` and ``<!-- bench: end of NAME
    -->``.

    Raises:
        ValueError: When the page has no such marks.
    """
    begin, end = MARK.format(name), MARK.format(f"end of {name}")
    pattern = re.compile(f"{re.escape(begin)}.*?{re.escape(end)}", re.S)
    if not pattern.search(page):
        raise ValueError(f"no marks {begin} ... {end}")
    return pattern.sub(lambda _: f"{begin}\n{text.strip()}\n{end}", page)
