"""Metrics of one clip: values per frame, and their means."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from alpasim_plugin.core.types import F64, U8, Bool
from alpasim_plugin.lab.video_metrics.facts import (
    DRIFT,
    GRID,
    PSNR,
    SSIM,
    WARP,
    WARP_LATE,
    WARP_LATE_ROAD,
)
from alpasim_plugin.lab.video_metrics.frames import psnr_db, ssim
from alpasim_plugin.lab.video_metrics.image_distance import ImageDistance, image_distances
from alpasim_plugin.lab.video_metrics.warp import late_window, warp_errors

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


def clip_quality(
    made: U8,
    truth: U8 | None,
    networks: Mapping[str, ImageDistance],
    road: Bool | None = None,
) -> ClipQuality:
    """Measure one clip.

    Args:
        made: ``(T, H, W, 3)``, at least two frames.
        truth: The ground-truth frames; None computes only the metrics without a reference.
        networks: Perceptual distances by name.
        road: ``(T, H, W)``, the pixels that show the road; None where nothing says so.

    Raises:
        EvaluatorError: Videos that do not belong together.
    """
    warp = warp_errors(made, road)
    whole = late_road_error(warp.road)
    if truth is None:
        return ClipQuality({WARP: warp.whole}, 0, whole)
    series = {PSNR: psnr_db(made, truth), SSIM: ssim(made, truth)}
    series |= {name: image_distances(net, made, truth) for name, net in networks.items()}
    series[WARP] = warp.whole
    for side, name in GRID.items():
        ratio = grid_ratio(made[::GRID_EVERY], truth[::GRID_EVERY], side)
        if ratio is not None:
            whole[name] = ratio
    identical = int(np.sum(np.all(made == truth, axis=(1, 2, 3))))
    return ClipQuality(series, identical, whole)


def late_road_error(road_errors: F64 | None) -> dict[str, float]:
    """Return the mean warp error of the road over the late pairs that show it, by its name; nothing
    where none does.
    """
    if road_errors is None:
        return {}
    late = road_errors[late_window(len(road_errors))]
    on_road = late[~np.isnan(late)]
    return {WARP_LATE_ROAD: float(on_road.mean())} if len(on_road) else {}


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


def grid_ratio(images: U8, truths: U8, side: int = 4, flat_levels: float = 3.0) -> float | None:
    """Return how much stronger an image's steps are across the borders of a grid than elsewhere,
    on surfaces that are flat in the truth.

    A network that makes cells of pixels at a time may leave their grid in the image; 1 is none.
    Both axes count alike.

    Args:
        images: ``(..., H, W, 3)`` what a network made, 8 bits.
        truths: Like ``images``; they say which surfaces are flat.
        side: Pixels of a cell.
        flat_levels: A step between neighbouring pixels of the truth up to which it counts as flat.

    Returns:
        Mean step at borders over mean step elsewhere; None where nothing is flat, or the image does
        not change there.

    Example:
        >>> column = np.arange(64)
        >>> cells = np.tile((column % 2 + 2 * (column // 4 % 2)).astype(np.uint8)[None, :, None], (64, 1, 3))
        >>> round(grid_ratio(cells, np.zeros_like(cells)), 2), round(grid_ratio(cells, np.zeros_like(cells), side=3), 2)
        (1.93, 0.96)
    """
    border, elsewhere = np.zeros(2), np.zeros(2)  # sum of steps, their number
    for axis in (-3, -2):
        step, flat = (
            np.abs(np.diff(x.astype(np.int16), axis=axis)).mean(axis=-1) for x in (images, truths)
        )
        # The step from pixel k to k + 1 crosses a border where side divides k + 1
        on_border = np.arange(1, step.shape[axis + 1] + 1) % side == 0
        on_border = on_border[:, None] if axis == -3 else on_border
        for total, chosen in ((border, on_border), (elsewhere, ~on_border)):
            counted = step[(flat <= flat_levels) & chosen]
            total += (counted.sum(), counted.size)
    if not border[1] or not elsewhere[0]:
        return None
    return float(border[0] / border[1] / (elsewhere[0] / elsewhere[1]))
