"""Quality by position in a clip: how it changes over hundreds of frames, and whether a model drifts
on its own outputs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from alpasim_plugin.lab.learned_metrics.facts import FD_16
from alpasim_plugin.lab.paper.measured import Measured
from alpasim_plugin.lab.paper.tables import markdown_table, with_half
from alpasim_plugin.lab.video_metrics.facts import DRIFT, PSNR
from evaluators.statistics.intervals import t_interval

WINDOW = 93  # frames: the length of the paper's training clips
FEATURE_FRAMES = 16  # of a vector of `fd_syn_16`, one after the other
DRAWN = (  # by position: more curves cannot be told apart
    "3dgs",
    "onefixer",
    "onefixer-dit-tiny",
    "V9",
    "V5",
    "difix",
    "harmonizer-temporal",
    "artifixer",
    "omnidreams@1",
    "self-forcing",
)
DRIFTING = ("3dgs", "harmonizer", "harmonizer-temporal", "harmonizer-temporal-teacher", "V9")
DRIFT_WINDOW = 33  # frames: a sixth of the paper's 198
HOW_DRIFT = """The temporal Harmonizer sees its own last four outputs. `harmonizer-temporal` was trained on its own outputs,
`harmonizer-temporal-teacher` on clean frames. Drift is the PSNR of the last 50 frames minus that of frames 50 to 100.
"""


def edges(frames: int, window: int = WINDOW) -> list[int]:
    """Return the borders of windows over a clip; a last one of less than half the length joins the
    one before.
    """
    return [*range(0, frames - window // 2, window), frames] if frames > window else [0, frames]


def by_position(
    rows: Sequence[Mapping[str, Any]],
    metrics: Sequence[str] = (PSNR, "perceptual-syn"),
    window: int = WINDOW,
    arms: Sequence[str] | None = None,
) -> str:
    """Return quality in windows of frames: mean over clips with its 95 % t interval.

    Args:
        rows: Of clips.
        metrics: One table each.
        window: Frames.
        arms: Those to show; None for all.
    """
    by_arm: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        if all(metric in row["series"] for metric in metrics) and (
            arms is None or row["arm"] in arms
        ):
            by_arm.setdefault(str(row["arm"]), []).append(row)
    borders = edges(min((int(row["frames"]) for row in rows), default=0), window)
    out = []
    for metric in metrics:
        lines = []
        for arm, mine in by_arm.items():
            windows = [
                t_interval(
                    [float(np.mean(row["series"][metric][low:high])) for row in mine], "clips"
                )
                for low, high in pairwise(borders)
            ]
            lines.append([arm, *(with_half(w, 2 if metric == PSNR else 4) for w in windows)])
        out.append(markdown_table(_head(metric, borders), lines))
    return "\n".join(out)


def distance_by_position(measured: Measured, frames: int) -> str:
    """Return ``fd_syn_16`` in windows of 93 frames, each against the clean frames of the same
    window; empty without such features.

    Args:
        measured: With vectors of 16 frames each, one after the other from a clip's first frame.
        frames: Of the shortest clip.
    """
    found = windows(measured, frames)
    lines = [
        [arm, *(f"{each.mean(arm, FD_16).centre:.1f}" for each in found)] for arm in measured.arms
    ]
    return (
        markdown_table(
            _head(FD_16, [FEATURE_FRAMES * (edge // FEATURE_FRAMES) for edge in edges(frames)]),
            lines,
        )
        if found
        else ""
    )


def windows(measured: Measured, frames: int) -> list[Measured]:
    """Return ``fd_syn_16`` in windows of 93 frames, in order; none without such features."""
    if FD_16 not in measured.set_metrics:
        return []
    return [
        Measured(
            {arm: {} for arm in measured.values},
            {
                arm: {
                    clip: {FD_16: kinds[FD_16][low:high]}
                    for clip, kinds in clips.items()
                    if FD_16 in kinds
                }
                for arm, clips in measured.features.items()
            },
            measured.reference,
            measured.seed,
        )
        for low, high in pairwise(edge // FEATURE_FRAMES for edge in edges(frames))
    ]


def drift(measured: Measured, rows: Sequence[Mapping[str, Any]]) -> str:
    """Return PSNR by position of the temporal Harmonizer under both of its trainings, and what it
    loses to the end.
    """
    arms = [arm for arm in DRIFTING if arm in measured.values]
    lines = [
        [arm, with_half(measured.mean(arm, DRIFT), 2)] for arm in arms if measured.has(arm, DRIFT)
    ]
    lost = (
        markdown_table(["arm", "drift, dB"], lines)
        if lines
        else "The clips are too short for a drift of 150 frames.\n"
    )
    return HOW_DRIFT + "\n" + by_position(rows, (PSNR,), DRIFT_WINDOW, arms) + "\n" + lost


def _head(metric: str, borders: Sequence[int]) -> list[str]:
    return [metric, *(f"{low} to {high - 1}" for low, high in pairwise(borders))]
