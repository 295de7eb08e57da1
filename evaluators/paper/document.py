"""The comparison as one markdown document: tables beside the paper's, the wrong map, quality by frame, time, and the verdicts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from evaluators.aggregate.intervals import t_interval
from evaluators.paper.appearance import appearance_section
from evaluators.paper.claims import OURS
from evaluators.paper.measured import Measured
from evaluators.paper.published import Published
from evaluators.paper.tables import differences, markdown_table, paper_against_ours, verdicts
from evaluators.paper.verdict import judge_claims

PERIOD_MS = 100.0  # between frames of the pairs
TIMES = """Median over blocks of each clip, mean over clips, one thread; drawing of map and render is not included. The first frame of a
block waits for the frames that the block looks ahead to, 100 ms apart, and for the block's computation.
"""
WINDOW = 93  # frames: the length of the paper's training clips
PAIRED = ("psnr_db", "perceptual-syn", "fd_syn_clip", "fvmd_lk", "warp_l1", "lane_f1_syn", "cuboid_f1_syn")
HOW = """A claim is a paired difference over the same clips, 95 %: a t interval, or for metrics of whole sets (`fd_syn_clip`, `fvmd_lk`)
a test that swaps whole clips. Bold: shown. Absolute values do not compare with the paper's: other scenes, networks and resolution; our
metrics stand in the place of those that need networks of others. Every arm but `onefixer` has the same backbone here."""
SHIFTED = """Lanes and boxes of the semantic map moved by a constant, 45 configurations grouped by distance, clip by clip; render and truth
as they are.
"""


def document(
    published: Published,
    measured: Mapping[str, Measured],
    rows: Mapping[str, Sequence[Mapping[str, Any]]],
    units: Mapping[str, Mapping[str, Any] | None],
    reasons: Mapping[int, str],
    command: str,
) -> str:
    """Return the document.

    Args:
        published: The paper's numbers.
        measured: PROTOCOL -> what was measured; one that was not run is named as such.
        rows: PROTOCOL -> rows of clips, for quality by frame.
        units: ARM -> ``frames``, ``lookahead_frames`` and ``calls_per_frame`` of what it makes at a time.
        reasons: Claim -> why it comes out as it does here.
        command: That makes it.
    """
    parts = [f"```bash\n{command}\n```\n", HOW + "\n"]
    for name, table, heading in (
        ("cycle", "cycle", "Cycle renders"),
        ("under-trained", "under-trained", "Under-trained reconstructions"),
        ("cycle", "ablation", "Ablation"),
        ("closed-loop", "closed-loop", "In closed loop"),
    ):
        parts.append(f"## {heading}\n")
        if name not in measured:
            parts.append("Not run.\n")
            continue
        mine = measured[name]
        parts.append(paper_against_ours(published, table, _of_table(mine, published.tables[table].rows)))
        lead = OURS if OURS in mine.arms else "onefixer"
        if table != "ablation" and lead in mine.arms:
            metrics = [m for m in (PAIRED if name != "closed-loop" else published_ours(published, table)) if mine.has(lead, m)]
            parts.append("\n" + differences(mine, lead, [arm for arm in mine.arms if arm != lead], metrics))
        parts.append(f"\n{_counts(mine)}\n")
    parts.append("## A wrong map\n\n" + (_map_error(measured["map-error"]) if "map-error" in measured else "Not run.\n"))
    parts.append("## By position\n\n" + (by_position(rows["under-trained"]) if "under-trained" in rows else "Not run.\n"))
    parts.append("## Time\n\n" + (_times(measured["cycle"], units) if "cycle" in measured else "Not run.\n"))
    parts.append("## Night, fog and snow\n\n" + appearance_section(published, measured))
    parts.append("## The paper's claims\n\n" + verdicts(judge_claims(measured), reasons))
    return "\n".join(parts)


def published_ours(published: Published, table: str) -> list[str]:
    """Return our metrics in the place of a table's."""
    return [ours for metric in published.tables[table].metrics if (ours := published.ours(metric)) is not None]


def _of_table(measured: Measured, rows: Mapping[str, Any]) -> Measured:
    """Leave variants of the ablation out of Table 1 and other arms out of the ablation; the raw render and our arms stay in both."""
    ablation = "V1" in rows
    always = {measured.reference, "3dgs", "onefixer", "onefixer-dit-tiny"}
    is_variant = {arm: arm.startswith("V") for arm in measured.values}
    kept = [arm for arm in measured.values if arm in rows or arm in always or is_variant[arm] == ablation]
    return Measured(
        {arm: measured.values[arm] for arm in kept},
        {arm: measured.features[arm] for arm in kept if arm in measured.features},
        measured.reference,
        measured.seed,
    )


def _counts(measured: Measured) -> str:
    most = max((len(clips) for clips in measured.values.values()), default=0)
    return f"{most} clips or scenes, {len(measured.arms)} arms."


def _map_error(measured: Measured) -> str:
    metrics = [
        m
        for m in ("lane_f1_syn", "lane_xerr_syn_m", "cuboid_f1_syn", "psnr_db", "perceptual-syn")
        if any(measured.has(a, m) for a in measured.arms)
    ]
    rows = []
    for arm in measured.arms:
        cells = []
        for metric in metrics:
            if not measured.has(arm, metric):
                cells.append("null")
                continue
            found = measured.mean(arm, metric)
            half = "" if found.low is None or found.high is None else f" ± {(found.high - found.low) / 2:.3f}"
            cells.append(f"{found.centre:.3f}{half}")
        rows.append([arm, *cells])
    return SHIFTED + "\n" + markdown_table(["arm", *metrics], rows)


def by_position(rows: Sequence[Mapping[str, Any]], metrics: Sequence[str] = ("psnr_db", "perceptual-syn")) -> str:
    """Return quality in windows of 93 frames: mean over clips with its 95 % t interval."""
    by_arm: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        if all(metric in row["series"] for metric in metrics):
            by_arm.setdefault(str(row["arm"]), []).append(row)
    length = min((int(row["frames"]) for row in rows), default=0)
    edges = [*range(0, length - WINDOW // 2, WINDOW), length] if length > WINDOW else [0, length]
    out = []
    for metric in metrics:
        head = [metric, *(f"{low} to {high - 1}" for low, high in pairwise(edges))]
        lines = []
        for arm, mine in by_arm.items():
            windows = [
                t_interval([float(np.mean(row["series"][metric][low:high])) for row in mine], "clips") for low, high in pairwise(edges)
            ]
            lines.append([arm, *(_with_half(w.centre, w.low, w.high, 2 if metric == "psnr_db" else 4) for w in windows)])
        out.append(markdown_table(head, lines))
    return "\n".join(out)


def _with_half(centre: float, low: float | None, high: float | None, digits: int) -> str:
    half = "" if low is None or high is None else f" ± {(high - low) / 2:.{digits}f}"
    return f"{centre:.{digits}f}{half}"


def _times(measured: Measured, units: Mapping[str, Mapping[str, Any] | None]) -> str:
    """Return time and latency: a frame waits for the frames that its block looks ahead to, and for the whole block's computation."""
    rows = []
    for arm in measured.arms:
        unit = units.get(arm)
        if not measured.has(arm, "ms_per_frame") or unit is None:
            continue
        found = measured.mean(arm, "ms_per_frame")
        first = unit["lookahead_frames"] * PERIOD_MS + unit["frames"] * found.centre
        calls = f"{unit['calls_per_frame']:.3g}"
        rows.append([arm, _with_half(found.centre, found.low, found.high, 1), calls, str(unit["lookahead_frames"]), f"{first:.0f}"])
    head = ["arm", "ms a frame", "network calls a frame", "look-ahead, frames", "first frame of a block, ms"]
    return TIMES + "\n" + markdown_table(head, rows)
