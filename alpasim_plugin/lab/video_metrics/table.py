"""The quality table as markdown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from alpasim_plugin.lab.video_metrics.facts import (
    DRIFT,
    FACTS,
    GRID,
    MS,
    PSNR,
    SSIM,
    WARP,
    WARP_LATE,
)

TITLES = {
    PSNR: "PSNR, dB",
    SSIM: "SSIM",
    WARP: "Warp L1 x 1e4",
    WARP_LATE: "late Warp L1 x 1e4",
    DRIFT: "drift, dB",
    MS: "ms per frame",
    GRID[4]: "grid of 4",
    GRID[16]: "grid of 16",
}
SCALE = {WARP: 1e4, WARP_LATE: 1e4}
DIGITS = {PSNR: 2, SSIM: 4, WARP: 1, WARP_LATE: 1, DRIFT: 2, MS: 1, GRID[4]: 3, GRID[16]: 3}
ARROWS = {"higher": "\u2191", "lower": "\u2193", "none": ""}


def markdown(summary: Mapping[str, Any]) -> str:
    """Return two tables of a summary (`alpasim_plugin.lab.video_metrics.summary.summarise`): means,
    and differences from the baseline.

    Cells are mean and half-width of the 95 % t interval over clips. A difference in bold is one
    that the paired test shows.
    """
    variants, paired = summary["arms"], summary["paired"]
    shown = [m for m in FACTS if any(m in values for values in variants.values())]
    head = [
        "variant",
        *(f"{TITLES.get(m, m)} {ARROWS[FACTS[m].direction]}" for m in shown),
        "clips x frames",
    ]
    rows = []
    for name, values in variants.items():
        lengths = summary["frames"][name]
        frames = str(lengths[0]) if len(lengths) == 1 else f"{lengths[0]} to {lengths[-1]}"
        rows.append(
            [
                name,
                *(_mean(m, values.get(m)) for m in shown),
                f"{summary['clips'][name]} x {frames}",
            ]
        )
    out = [_table(head, rows)]
    if paired:
        compared = [m for m in shown if any(m in values for values in paired.values())]
        head = [
            f"minus {summary['baseline']}",
            *(f"{TITLES.get(m, m)} {ARROWS[FACTS[m].direction]}" for m in compared),
        ]
        out.append(
            _table(
                head,
                [
                    [name, *(_difference(m, values.get(m)) for m in compared)]
                    for name, values in paired.items()
                ],
            )
        )
    return "\n".join(out)


def _mean(metric: str, entry: Mapping[str, Any] | None) -> str:
    return "" if entry is None else _number(metric, entry["mean"], entry["ci95"])


def _difference(metric: str, entry: Mapping[str, Any] | None) -> str:
    if entry is None or entry["diff"] is None:
        return ""
    text = _number(metric, entry["diff"], entry["ci95"], sign="+")
    return f"**{text}**" if entry["difference"] != "none shown" else text


def _number(metric: str, value: float, bounds: list[float] | None, sign: str = "") -> str:
    digits, scale = DIGITS.get(metric, 4), SCALE.get(metric, 1.0)
    text = f"{value * scale:{sign}.{digits}f}"
    return (
        text
        if bounds is None
        else f"{text} \u00b1 {(bounds[1] - bounds[0]) / 2 * scale:.{digits}f}"
    )


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---", *(["---:"] * (len(head) - 1))], *rows]
    return "".join(f"| {' | '.join(cell.strip() for cell in line)} |\n" for line in lines)
