"""Metrics of the judges, and the paper's own names, which need the user's weights."""

from __future__ import annotations

from collections.abc import Mapping

from evaluators.metrics import MetricInfo

LANE_F1 = "lane_f1_syn"
LANE_XERR = "lane_xerr_syn_m"
LANE_JITTER = "lane_jitter_syn_m"
CUBOID_F1 = "cuboid_f1_syn"
LANE_F1_30 = "lane_f1_syn_30"
LANE_XERR_30 = "lane_xerr_syn_30_m"
LANE_JITTER_20 = "lane_jitter_syn_20_m"
FD_16 = "fd_syn_16"
FD_CLIP = "fd_syn_clip"
FVMD_LK = "fvmd_lk"
STYLE_ACC = "style_acc_syn"

CLIP_FACTS: dict[str, MetricInfo] = {
    LANE_F1: MetricInfo(
        "",
        "higher",
        "mean",
        "lanes found as on the clean frames, by our lane judge, 3 to 59 m; not the paper's Lane F1",
    ),
    LANE_F1_30: MetricInfo("", "higher", "mean", "the same up to 30 m"),
    LANE_XERR: MetricInfo(
        "m", "lower", "mean", "lateral difference of matched lanes, by our lane judge, 3 to 59 m"
    ),
    LANE_XERR_30: MetricInfo("m", "lower", "mean", "the same up to 30 m"),
    LANE_JITTER: MetricInfo(
        "m", "lower", "mean", "jitter of lanes 40 m ahead from frame to frame, by our lane judge"
    ),
    LANE_JITTER_20: MetricInfo("m", "lower", "mean", "the same 20 m ahead"),
    STYLE_ACC: MetricInfo(
        "", "higher", "mean", "share of frames in the wanted style, by our style judge"
    ),
    CUBOID_F1: MetricInfo(
        "",
        "higher",
        "mean",
        "overlap of vehicles' outlines with those on the clean frames, by our cuboid judge",
    ),
}
SET_FACTS: dict[str, MetricInfo] = {
    FD_16: MetricInfo(
        "",
        "lower",
        "mean",
        "Frechet distance of our video judge's features, windows of 16 frames; not FVD",
    ),
    FD_CLIP: MetricInfo(
        "",
        "lower",
        "mean",
        "the same with one vector a clip; fewer clips than 128 dimensions: mostly bias",
    ),
    FVMD_LK: MetricInfo(
        "",
        "lower",
        "mean",
        "Frechet distance of motion histograms of Lucas-Kanade tracks; not FVMD",
    ),
}
# The paper's names, and what the user must supply for each. Without it the cell is null; no metric
# of ours stands in for it.
PAPER: Mapping[str, str] = {
    "fvd_clip": "i3d_torchscript.pt in --metric-weights",
    "fvd_16": "i3d_torchscript.pt in --metric-weights",
    "lpips_alex": "alexnet-owt-7be5be79.pth and lpips-v0.1-alex.pth in --metric-weights",
    "dists": "vgg16-397923af.pth and dists.pt in --metric-weights",
    "fvmd": "PIPs++ tracks (CLIP.tracks.npz) in --detections",
    "cuboid_f1": "a detector's boxes in --detections",
    "lane_f1": "a detector's lanes in --detections",
    "lane_xerr_m": "a detector's lanes in --detections",
    "lane_jitter_m": "a detector's lanes in --detections",
}
# Of detectors of the user's.
EXTERNAL_FACTS: dict[str, MetricInfo] = {
    "cuboid_f1": MetricInfo(
        "", "higher", "mean", "the paper's Cuboid F1, from a detector of the user's"
    ),
    "lane_f1": MetricInfo(
        "", "higher", "mean", "the paper's Lane F1, from a detector of the user's"
    ),
    "lane_xerr_m": MetricInfo(
        "m", "lower", "mean", "the paper's lane x-error, from a detector of the user's"
    ),
    "lane_jitter_m": MetricInfo(
        "m", "lower", "mean", "the paper's lane jitter at 40 m, from a detector of the user's"
    ),
}


def of_seed(metric: str, seed: int) -> str:
    """Return a metric's name by the judge of another training seed.

    Example:
        >>> of_seed("lane_f1_syn", 0), of_seed("lane_f1_syn", 1)
        ('lane_f1_syn', 'lane_f1_syn.seed1')
    """
    return metric if seed == 0 else f"{metric}.seed{seed}"


CLIP_FACTS |= {of_seed(name, 1): facts for name, facts in CLIP_FACTS.items()}
SET_FACTS |= {of_seed(name, 1): SET_FACTS[name] for name in (FD_16, FD_CLIP)}


def paper_cells(values: Mapping[str, float | None]) -> dict[str, dict[str, float | str | None]]:
    """Return a cell for each of the paper's names: its value, or None with the reason.

    Example:
        >>> paper_cells({"fvd_clip": 410.0})["fvd_16"]
        {'value': None, 'reason': 'weights_missing: i3d_torchscript.pt in --metric-weights'}
    """
    out: dict[str, dict[str, float | str | None]] = {}
    for name, needs in PAPER.items():
        value = values.get(name)
        kind = "no_detections" if "--detections" in needs else "weights_missing"
        out[name] = (
            {"value": value, "reason": None}
            if value is not None
            else {"value": None, "reason": f"{kind}: {needs}"}
        )
    return out
