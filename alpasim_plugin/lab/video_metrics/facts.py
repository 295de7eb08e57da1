"""Metrics of the quality tables."""

from __future__ import annotations

from alpasim_plugin.lab.learned_metrics.facts import CLIP_FACTS, EXTERNAL_FACTS, SET_FACTS
from evaluators.metrics import METRICS, MetricInfo

PSNR = "psnr_db"
SSIM = "ssim"
WARP = "warp_l1"
WARP_LATE = "warp_l1_late"
MS = "ms_per_frame"
WARP_ROAD = "warp_l1_late_road"
DRIFT = "drift_psnr_db"
JOD = "cvvdp_jod"
GRID = {4: "grid_4", 16: "grid_16"}  # by the side of a cell, pixels

FACTS: dict[str, MetricInfo] = {
    PSNR: MetricInfo(
        "dB",
        "higher",
        "mean",
        "peak signal-to-noise ratio of frames, identical ones count as 100 dB",
    ),
    SSIM: MetricInfo(
        "",
        "higher",
        "mean",
        "structural similarity of frames, 11x11 Gaussian, zero padded, per channel",
    ),
    "perceptual-syn-mid": MetricInfo(
        "", "lower", "mean", "perceptual-syn of the middle tenth of a clip's frames"
    ),
    "perceptual-syn-last": MetricInfo(
        "", "lower", "mean", "perceptual-syn of the last tenth of a clip's frames"
    ),
    "perceptual-syn": MetricInfo(
        "",
        "lower",
        "mean",
        "perceptual distance by the feature network that comes with the package; not LPIPS",
    ),
    "lpips_alex": MetricInfo("", "lower", "mean", "LPIPS v0.1 with AlexNet"),
    "lpips_vgg": MetricInfo("", "lower", "mean", "LPIPS v0.1 with VGG-16"),
    JOD: MetricInfo(
        "",
        "higher",
        "mean",
        "ColorVideoVDP of every 20th frame, just-objectionable differences; 10 is none to be seen",
    ),
    "dists": MetricInfo("", "lower", "mean", "DISTS with VGG-16, full resolution"),
    WARP: MetricInfo(
        "", "lower", "mean", "change from frame to frame beyond the video's own motion"
    ),
    WARP_LATE: MetricInfo("", "lower", "mean", "the same over the last third of the clip"),
    WARP_ROAD: MetricInfo("", "lower", "mean", "that of the road alone, as the paper has it"),
    DRIFT: MetricInfo(
        "dB", "higher", "mean", "PSNR of the last 50 frames minus that of frames 50 to 100"
    ),
    **{
        name: MetricInfo(
            "",
            "lower",
            "mean",
            f"step across the borders of {side}-pixel cells over other steps, on flat surfaces; 1: no grid",
        )
        for side, name in GRID.items()
    },
    **CLIP_FACTS,
    **EXTERNAL_FACTS,
    MS: MetricInfo("ms", "lower", "median", "time of the fixer per frame"),
}
SOMETIMES = frozenset(
    {*CLIP_FACTS, *EXTERNAL_FACTS}
)  # undefined on some clips, such as those without a vehicle; these are left out and counted
KNOWN = METRICS.adding({**FACTS, **SET_FACTS})
