"""How blunt a judge is: its detections against simulator truth on clean frames, and whether its
metric worsens with every damage.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from torch import nn

from alpasim_plugin.block_fixers.settings import STYLES
from alpasim_plugin.core.types import F64, U8, CameraSpec
from alpasim_plugin.lab.learned_metrics.clip import cuboid_values, lane_values
from alpasim_plugin.lab.learned_metrics.cuboids import cuboid_f1
from alpasim_plugin.lab.learned_metrics.damage import STRENGTHS, Kind, damaged, in_order
from alpasim_plugin.lab.learned_metrics.facts import (
    CUBOID_F1,
    FD_16,
    FVMD_LK,
    LANE_F1,
    LANE_F1_30,
    LANE_XERR,
    LANE_XERR_30,
)
from alpasim_plugin.lab.learned_metrics.frechet import frechet_distance, halves
from alpasim_plugin.lab.learned_metrics.fvmd import fvmd_lk, motion_features
from alpasim_plugin.lab.learned_metrics.lanes import LaneScore, score_clip, up_to
from alpasim_plugin.lab.learned_metrics.nets.detect import find_cuboids, find_lanes
from alpasim_plugin.lab.learned_metrics.nets.files import JudgeName
from alpasim_plugin.lab.learned_metrics.nets.style_net import StyleNet, style_probabilities
from alpasim_plugin.lab.learned_metrics.nets.video_net import VideoNet, window_features
from alpasim_plugin.lab.learned_metrics.types import Cuboid, Lane3D
from alpasim_plugin.lab.training.learned_metrics.labels import Labels

NEAR_M = 30.0
# What must worsen with which damage. Jitter is left out for blur: a blurred line may stand still.
LOWER: Mapping[str, bool] = {
    LANE_F1: False,
    LANE_F1_30: False,
    LANE_XERR: True,
    LANE_XERR_30: True,
    CUBOID_F1: False,
    FD_16: True,
    FVMD_LK: True,
}
DAMAGES: Mapping[str, tuple[Kind, ...]] = {
    "lane": ("blur", "noise"),
    "cuboid": ("blur", "noise", "repeat"),
    "video": ("blur", "noise", "repeat", "drop"),
    "fvmd_lk": ("noise", "repeat", "drop"),
}
STRIDE = 4  # frames between the windows of the features: clips are short here


@dataclass(frozen=True)
class CheckClip:
    """A clean clip with the truth of some of its frames.

    Args:
        name: Of the sequence.
        frames: ``(T, H, W, 3)``.
        camera: Lens and mounting.
        labels: Truth.
    """

    name: str
    frames: U8
    camera: CameraSpec
    labels: Labels


def lane_card(net: nn.Module, clips: Sequence[CheckClip]) -> dict[str, Any]:
    """Return F1 and x-error of the lane judge against the map's painted lines, and how far its
    lines are supported.
    """
    far = near = LaneScore()
    rows: list[list[Lane3D]] = []
    for clip in clips:
        made = find_lanes(net, clip.frames[clip.labels.frames], clip.camera)
        truth = [clip.labels.lanes_of(i) for i in range(len(made))]
        far, rows = far + score_clip(made, truth), rows + made
        near = near + score_clip(
            [up_to(m, NEAR_M) for m in made], [up_to(t, NEAR_M) for t in truth]
        )
    reach = {f"frames_with_a_line_at_{at}_m": _reach(rows, at) for at in (20, 40)}
    return {
        "frames": len(rows),
        "to_59_m": _lane_numbers(far),
        "to_30_m": _lane_numbers(near),
        **reach,
    }


def _lane_numbers(score: LaneScore) -> dict[str, float | int | None]:
    precision, recall = (score.matched / n if n else None for n in (score.made, score.reference))
    return {
        "f1": score.f1,
        "precision": precision,
        "recall": recall,
        "xerr_m": score.xerr_m,
        "xerr_near_m": score.xerr_near_m,
        "xerr_far_m": score.xerr_far_m,
        "lanes_made": score.made,
        "lanes_true": score.reference,
    }


def _reach(rows: Sequence[Sequence[Lane3D]], at_m: float) -> float:
    row = int((at_m - 3) // 2)
    return float(
        np.mean(
            [
                any(np.isfinite(lane.lateral_m[row : row + 2]).all() for lane in lanes)
                for lanes in rows
            ]
        )
    )


def cuboid_card(net: nn.Module, clips: Sequence[CheckClip]) -> dict[str, Any]:
    """Return what the cuboid judge finds of the vehicles in view: Dice of outlines, middles within
    15 % of depth, and their errors.
    """
    scores = []
    found = 0
    wanted = 0
    surplus = 0
    depth: list[float] = []
    aside: list[float] = []
    turned: list[float] = []
    for clip in clips:
        made = find_cuboids(net, clip.frames[clip.labels.frames], clip.camera.K)
        truth = [clip.labels.cuboids_of(i) for i in range(len(made))]
        scores.append(cuboid_f1(made, truth, clip.camera.K, clip.frames.shape[1:3]))
        for m, t in zip(made, truth, strict=True):
            sure = [c for c in m if c.score >= 0.3]
            links = _nearest(sure, t)
            found = found + len(links)
            wanted = wanted + len(t)
            surplus = surplus + len(sure) - len(links)
            for a, b in links:
                depth.append(abs(a.z_m - b.z_m) / b.z_m)
                aside.append(abs(a.x_m - b.x_m))
                turned.append(abs(np.angle(np.exp(2j * (a.yaw_rad - b.yaw_rad)))) / 2)
    defined = [s for s in scores if s is not None]
    return {
        "clips": len(clips),
        "clips_without_vehicles": len(scores) - len(defined),
        "outline_f1": _mean(defined),
        "vehicles": wanted,
        "recall": _share(found, wanted),
        "precision": _share(found, found + surplus),
        "depth_error_median": _median(depth),
        "aside_error_median_m": _median(aside),
        "yaw_error_median_rad": _median(turned),
    }


def _nearest(made: Sequence[Cuboid], truth: Sequence[Cuboid]) -> list[tuple[Cuboid, Cuboid]]:
    """Pair boxes greedily by distance: at most 15 % of the depth or 1.5 m apart."""
    order = sorted(
        (float(np.hypot(a.x_m - b.x_m, a.z_m - b.z_m)), i, j)
        for i, a in enumerate(made)
        for j, b in enumerate(truth)
    )
    used_a: set[int] = set()
    used_b: set[int] = set()
    out = []
    for distance, i, j in order:
        if i not in used_a and j not in used_b and distance <= max(1.5, 0.15 * truth[j].z_m):
            used_a.add(i)
            used_b.add(j)
            out.append((made[i], truth[j]))
    return out


def _mean(values: Sequence[float]) -> float | None:
    return float(np.mean(values)) if values else None


def _share(part: int, whole: int) -> float | None:
    return part / whole if whole else None


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def style_card(net: StyleNet, frames: U8) -> dict[str, Any]:
    """Return the style judge's confusion on frames in all styles ``(S, N, H, W, 3)``, and its
    probability as a style fades in.
    """
    confusion = {}
    for i, style in enumerate(STYLES):
        said = style_probabilities(net, frames[i]).argmax(axis=1)
        confusion[style] = {other: float((said == j).mean()) for j, other in enumerate(STYLES)}
    fading = {}
    for i, style in enumerate(STYLES[1:], start=1):
        values = [_faded(net, frames[0], frames[i], share, i) for share in (0.0, 0.33, 0.67, 1.0)]
        fading[style] = {"values": values, "in_order": in_order(values, lower_is_better=True)}
    return {
        "frames": int(frames.shape[1]),
        "right": float(np.mean([confusion[s][s] for s in STYLES])),
        "confusion": confusion,
        "fading": fading,
    }


def _faded(net: StyleNet, clear: U8, target: U8, share: float, style: int) -> float:
    mixed = np.rint(clear + share * (target.astype(np.float32) - clear)).astype(np.uint8)
    return float(style_probabilities(net, mixed)[:, style].mean())


def sweep(
    name: JudgeName | str, net: nn.Module | None, clips: Sequence[CheckClip]
) -> dict[str, Any]:
    """Return a judge's metrics under rising damage: the mean over clips (a set metric: one value),
    and whether each step is worse.

    Args:
        name: ``lane``, ``cuboid``, ``video``, or ``fvmd_lk``, which has no network.
        net: The judge.
        clips: Clean ones.
    """
    measure: dict[str, Callable[..., Mapping[str, float | None]]] = {
        "lane": _lanes,
        "cuboid": _cuboids,
        "video": _video,
        "fvmd_lk": _motion,
    }
    references: list[Any] = [_detect(name, net, clip, clip.frames) for clip in clips]
    out: dict[str, Any] = {}
    for kind in DAMAGES[name]:
        rows = [measure[name](references, references, clips)]
        for strength in STRENGTHS[kind]:
            made = [
                _detect(name, net, clip, damaged(clip.frames, kind, strength)) for clip in clips
            ]
            rows.append(measure[name](made, references, clips))
        for metric in rows[0]:
            values = [row[metric] for row in rows]
            known = [v for v in values if v is not None]
            ordered = (
                in_order(known, LOWER[metric])
                if metric in LOWER and len(known) == len(values)
                else None
            )
            out.setdefault(metric, {})[kind] = {
                "strengths": [0.0, *STRENGTHS[kind]],
                "values": values,
                "in_order": ordered,
            }
    return out


def _detect(name: str, net: nn.Module | None, clip: CheckClip, frames: U8) -> Any:
    if name == "lane":
        return find_lanes(_net(net), frames, clip.camera)
    if name == "cuboid":
        return find_cuboids(_net(net), frames, clip.camera.K)
    if name == "video":
        features = _net(net)
        assert isinstance(features, VideoNet)
        return window_features(features, frames, STRIDE)
    return motion_features(frames)


def _net(net: nn.Module | None) -> nn.Module:
    assert net is not None
    return net


def _lanes(
    made: Sequence[Any], references: Sequence[Any], clips: Sequence[CheckClip]
) -> Mapping[str, float | None]:
    del clips
    return _means([lane_values(m, r) for m, r in zip(made, references, strict=True)])


def _cuboids(
    made: Sequence[Any], references: Sequence[Any], clips: Sequence[CheckClip]
) -> Mapping[str, float | None]:
    rows = zip(made, references, clips, strict=True)
    return _means(
        [cuboid_values(m, r, c.camera.K, (c.camera.height, c.camera.width)) for m, r, c in rows]
    )


def _video(
    made: Sequence[F64], references: Sequence[F64], clips: Sequence[CheckClip]
) -> Mapping[str, float | None]:
    del clips
    return {FD_16: frechet_distance(np.concatenate(made), np.concatenate(references))}


def _motion(
    made: Sequence[F64], references: Sequence[F64], clips: Sequence[CheckClip]
) -> Mapping[str, float | None]:
    del clips
    return {FVMD_LK: fvmd_lk(made, references)}


def oracle(name: str, net: nn.Module | None, clips: Sequence[CheckClip]) -> float | None:
    """Return the distance of one half of the clean clips from the other: below this a set metric
    says nothing about unpaired sets.
    """
    return halves([_detect(name, net, clip, clip.frames) for clip in clips])


def _means(rows: Sequence[Mapping[str, float | None]]) -> dict[str, float | None]:
    """Return the mean of every metric over the clips where it is defined."""
    out: dict[str, float | None] = {}
    for metric in rows[0]:
        known = [row[metric] for row in rows]
        values = [v for v in known if v is not None]
        out[metric] = float(np.mean(values)) if values else None
    return out
