"""Metrics of the quality tables: unit, direction, title, digits."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

PSNR = "psnr_db"
SSIM = "ssim"
WARP = "warp_l1"
WARP_LATE = "warp_l1_late"
WARP_LATE_ROAD = "warp_l1_late_road"
MS = "ms_per_frame"
DRIFT = "drift_psnr_db"
GRID = {4: "grid_4", 16: "grid_16"}  # by the side of a cell, pixels


@dataclass(frozen=True)
class Fact:
    """How a metric is read; values of a table are multiplied by ``scale``. Clips in which an
    optional one is not defined are left out.
    """

    unit: str
    direction: Literal["higher", "lower"]
    title: str
    digits: int = 4
    scale: float = 1.0
    optional: bool = False


FACTS = {
    PSNR: Fact("dB", "higher", "PSNR, dB", 2),
    SSIM: Fact("", "higher", "SSIM"),
    "perceptual-syn": Fact("", "lower", "perceptual-syn"),
    "lpips_alex": Fact("", "lower", "LPIPS (AlexNet)"),
    "lpips_vgg": Fact("", "lower", "LPIPS (VGG)"),
    "dists": Fact("", "lower", "DISTS"),
    WARP: Fact("", "lower", "Warp L1 x 1e4", 1, 1e4),
    WARP_LATE: Fact("", "lower", "late Warp L1 x 1e4", 1, 1e4),
    WARP_LATE_ROAD: Fact("", "lower", "late Warp L1 of the road x 1e4", 1, 1e4, optional=True),
    "cuboid_f1": Fact("", "higher", "Cuboid F1", optional=True),
    "cuboid_clean_precision": Fact("", "higher", "cuboid precision on clean frames", optional=True),
    "cuboid_clean_recall": Fact("", "higher", "cuboid recall on clean frames", optional=True),
    "lane_f1": Fact("", "higher", "Lane F1", optional=True),
    "lane_clean_precision": Fact("", "higher", "lane precision on clean frames", optional=True),
    "lane_clean_recall": Fact("", "higher", "lane recall on clean frames", optional=True),
    "lane_error_m": Fact("m", "lower", "lane error, m", 3, optional=True),
    DRIFT: Fact("dB", "higher", "drift, dB", 2),
    GRID[4]: Fact("", "lower", "grid of 4", 3),
    GRID[16]: Fact("", "lower", "grid of 16", 3),
    MS: Fact("ms", "lower", "ms per frame", 1),
}

# Distances between sets of clips; less is closer to the truth
SET_TITLES = {
    "fvd": "FVD",
    "fvd_state_dict": "FVD (state dict)",
    "fvmd_lk": "FVMD by Lucas-Kanade",
}
