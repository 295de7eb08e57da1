"""Metrics of one clip: values per frame, and their means."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from alpasim_plugin.core.image_metrics import grid_ratio
from alpasim_plugin.core.types import F64, U8
from alpasim_plugin.lab.video_metrics.facts import DRIFT, GRID, PSNR, SSIM, WARP, WARP_LATE
from alpasim_plugin.lab.video_metrics.frames import psnr_db, ssim
from alpasim_plugin.lab.video_metrics.image_distance import ImageDistance, image_distances
from alpasim_plugin.lab.video_metrics.warp import late_window, warp_l1

SETTLED = slice(50, 100)  # frames with which the end of a long clip is compared
END = 50  # frames at the end
GRID_EVERY = 4  # frames: a grid does not move


@dataclass(frozen=True)
class ClipQuality:
    """One clip's values: ``(T,)`` by metric and frame, Warp L1 ``(T - 1,)`` from the second frame
    on.
    """

    series: Mapping[str, F64]
    identical: int  # frames that equal the truth
    whole: Mapping[str, float] = field(default_factory=dict)  # values of the whole clip

    @property
    def means(self) -> dict[str, float]:
        """One value a metric: the mean over the clip; the late window of Warp L1; the drift of
        clips that are long enough for it.
        """
        out = {name: float(values.mean()) for name, values in self.series.items()}
        out |= self.whole
        if WARP in self.series:
            pairs = self.series[WARP]
            out[WARP_LATE] = float(pairs[late_window(len(pairs))].mean())
        drift = drift_of(self.series.get(PSNR))
        return out if drift is None else {**out, DRIFT: drift}


def clip_quality(made: U8, truth: U8 | None, networks: Mapping[str, ImageDistance]) -> ClipQuality:
    """Measure one clip.

    Args:
        made: ``(T, H, W, 3)``, at least two frames.
        truth: The ground-truth frames; None computes only the metrics without a reference.
        networks: Perceptual distances by name.

    Raises:
        EvaluatorError: Videos that do not belong together.
    """
    if truth is None:
        return ClipQuality({WARP: warp_l1(made)}, 0)
    series = {PSNR: psnr_db(made, truth), SSIM: ssim(made, truth)}
    series |= {name: image_distances(net, made, truth) for name, net in networks.items()}
    series[WARP] = warp_l1(made)
    whole = {}
    for side, name in GRID.items():
        ratio = grid_ratio(made[::GRID_EVERY], truth[::GRID_EVERY], side)
        if ratio is not None:
            whole[name] = ratio
    identical = int(np.sum(np.all(made == truth, axis=(1, 2, 3))))
    return ClipQuality(series, identical, whole)


def drift_of(psnr: F64 | None) -> float | None:
    """Return the mean of the last 50 frames minus that of frames 50 to 100; None where the two
    would overlap.

    Example:
        >>> import numpy as np
        >>> drift_of(np.concatenate([np.full(150, 30.0), np.full(50, 29.0)]))
        -1.0
    """
    if psnr is None or len(psnr) < SETTLED.stop + END:
        return None
    return float(psnr[-END:].mean() - psnr[SETTLED].mean())
