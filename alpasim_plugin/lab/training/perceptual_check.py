"""Validate a perceptual image distance on held-out frames: monotonicity in severity and rank
correlation with the targets.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import stats

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F32, F64
from alpasim_plugin.lab.training.distortions import KINDS, SHIFT_PX, draw_distortion
from alpasim_plugin.lab.training.pair_store import PairSequence
from alpasim_plugin.lab.training.perceptual_targets import target_distance

ArrayDistance = Callable[
    [F32, F32], F64
]  # images (N, H, W, 3) in 0 to 1, twice -> (N,), smaller is closer
STRENGTHS = (0.05, 0.15, 0.3, 0.5, 0.75, 1.0)
STRUCTURAL = ("blur", "coarse", "erase", "ghost", "splat")
MODERATE = (
    0.5  # strength at which a structural distortion must be farther than a shift of one pixel
)


@dataclass(frozen=True)
class SeveritySweep:
    """Distances under one kind of distortion at increasing strengths: ``made`` and target
    ``wanted``, ``(frames, strengths)``.
    """

    made: F64
    wanted: F64

    @property
    def in_order(self) -> float:
        """Share of consecutive strengths with increasing distance; steps with a negligible target
        difference are excluded.
        """
        counted = np.diff(self.wanted, axis=1) > 1e-3
        return (
            float((np.diff(self.made, axis=1) > 0)[counted].mean())
            if counted.any()
            else float("nan")
        )


def check_frames(sequences: Sequence[PairSequence], count: int, channel: str = "rgb_gt") -> F32:
    """Return ``count`` frames ``(count, H, W, 3)`` of a channel in 0 to 1, evenly from all
    sequences.
    """
    which = np.linspace(0, 1, count, endpoint=False)
    picked = []
    for i, share in enumerate(which):
        clip = sequences[i % len(sequences)].clip
        picked.append(getattr(clip, channel)[int(share * len(clip))])
    return np.stack(picked).astype(np.float32) / np.float32(255)


def severity_sweeps(
    distance: ArrayDistance, frames: F32, seed: int = 0
) -> dict[str, SeveritySweep]:
    """Distort every frame with every kind at increasing strengths."""
    out = {}
    for kind in KINDS:
        draws = [
            draw_distortion(stream("training", seed, f"perceptual.check.{kind}", i), f.shape, kind)
            for i, f in enumerate(frames)
        ]
        made, wanted = [], []
        for s in STRENGTHS:
            damaged = np.stack([draw(f, s) for draw, f in zip(draws, frames, strict=True)])
            made.append(distance(damaged, frames))
            moved = draws[0].displacement_px(s)
            wanted.append(
                [target_distance(f, d, kind, moved) for f, d in zip(frames, damaged, strict=True)]
            )
        out[kind] = SeveritySweep(np.array(made).T, np.array(wanted).T)
    return out


def shift_one_px(frames: F32) -> list[F32]:
    """Return the frames moved by one pixel to the right and down, ``(N, H, W, 3)`` each; the border
    is repeated.
    """
    right = np.concatenate([frames[:, :, :1], frames[:, :, :-1]], axis=2)
    down = np.concatenate([frames[:, :1], frames[:, :-1]], axis=1)
    return [right, down]


def check(
    distance: ArrayDistance, frames: F32, renders: F32 | None = None, seed: int = 0
) -> dict[str, Any]:
    """Return the validation results of a distance (docs/lab/video-metrics.md).

    Args:
        distance: Of images.
        frames: ``(N, H, W, 3)`` clean, in 0 to 1.
        renders: Their degraded renders, or None.
        seed: Of the distortions.

    Returns:
        ``in_order`` by kind; ``rank_correlation`` with the targets over all kinds and strengths;
        ``shift_1px`` (median distance), and ``moderate`` (median distance by structural kind at
        strength 0.5, and ``above_shift``: share of frames where it exceeds the frame's shift of one
        pixel); ``render`` (median distance of degraded renders).
    """
    steps = severity_sweeps(distance, frames, seed)
    shift = np.mean([distance(moved, frames) for moved in shift_one_px(frames)], axis=0)
    at = STRENGTHS.index(MODERATE)
    moderate = {
        kind: {
            "median": float(np.median(steps[kind].made[:, at])),
            "above_shift": float((steps[kind].made[:, at] > shift).mean()),
        }
        for kind in STRUCTURAL
    }
    return {
        "frames": len(frames),
        "in_order": {kind: round(sweep.in_order, 4) for kind, sweep in steps.items()},
        "rank_correlation": float(stats.spearmanr(*_flat(steps)).statistic),
        "shift_1px": float(np.median(shift)),
        "moderate": moderate,
        "by_strength": {
            kind: [round(float(v), 5) for v in np.median(sweep.made, axis=0)]
            for kind, sweep in steps.items()
        },
        "shift_px_at_1": SHIFT_PX,
        "render": None if renders is None else float(np.median(distance(renders, frames))),
    }


def _flat(steps: Mapping[str, SeveritySweep]) -> tuple[F64, F64]:
    return tuple(
        np.concatenate([getattr(sweep, name).ravel() for sweep in steps.values()])
        for name in ("made", "wanted")
    )  # type: ignore[return-value]
