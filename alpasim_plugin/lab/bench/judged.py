"""What the judges say of a clip under one variant, and of its clips as a set; the paper's own names
where the user has the means.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F64, U8, CameraSpec
from alpasim_plugin.lab.learned_metrics.clip import cuboid_values, lane_values
from alpasim_plugin.lab.learned_metrics.cuboids import cuboid_f1
from alpasim_plugin.lab.learned_metrics.external import read_detections, read_tracks
from alpasim_plugin.lab.learned_metrics.facts import FD_16, FD_CLIP, FVMD_LK, of_seed, paper_cells
from alpasim_plugin.lab.learned_metrics.frechet import frechet_distance, halves
from alpasim_plugin.lab.learned_metrics.fvmd import FVMD, RIDGE, histograms, motion_features
from alpasim_plugin.lab.learned_metrics.lane_jitter import lane_jitter_m
from alpasim_plugin.lab.learned_metrics.lanes import score_clip
from alpasim_plugin.lab.learned_metrics.nets.detect import find_cuboids, find_lanes
from alpasim_plugin.lab.learned_metrics.nets.files import (
    NAMES,
    check_digests,
    file_name,
    load_judge,
)
from alpasim_plugin.lab.learned_metrics.nets.video_net import FRAMES, VideoNet, window_features
from alpasim_plugin.lab.learned_metrics.swapping import swap_test
from alpasim_plugin.lab.training.pair_store import PairSequence
from alpasim_plugin.lab.training.seen_scene import scene_of
from alpasim_plugin.lab.video_metrics.i3d import FILE as I3D_FILE
from alpasim_plugin.lab.video_metrics.i3d import i3d_features, load_i3d

DOING = "judging clips"
REFERENCE = "truth"  # folder of detections on the clean frames
MOST_KEPT = 4
_KEPT: dict[
    tuple[bytes, str, int], tuple[Any, Any]
] = {}  # detections on the clean frames of the last clips
MOTION = "motion"
WINDOWS = "windows"
FVD_CLIP = "fvd_clip"
FVD_16 = "fvd_16"


@dataclass(frozen=True)
class Judging:
    """Which judges are asked, and what the user supplies.

    Args:
        seeds: Of the judges' training; the first one's values have plain names.
        scenes: Folder of the scenes of the pairs, for the camera's mounting, which lanes need.
        detections: DETECTIONS/VARIANT/CLIP.json, and ``truth`` as a variant; None: no detectors of
            the user's.
        weights: Folder of metric weights.
        folder: Of the frozen judges; None: those of the package.
    """

    seeds: tuple[int, ...]
    scenes: Path | None = None
    detections: Path | None = None
    weights: Path | None = None
    folder: Path | None = None

    @property
    def identity(self) -> dict[str, Any]:
        """What determines a value, for the key of a row: the frozen digests of the judges asked.

        Raises:
            InputError: A judge is not frozen, or has changed since.
        """
        digests = check_digests(self.folder)
        wanted = [file_name(name, seed) for name in NAMES if name != "style" for seed in self.seeds]
        if missing := [name for name in wanted if name not in digests]:
            raise InputError(
                f"{', '.join(missing)}: not among the frozen judges",
                "choose other seeds with --judges, or name the folder of your frozen judges with --judge-folder (docs/lab/judges.md)",
            )
        return {
            "judges": {name: digests[name] for name in wanted},
            "detections": str(self.detections),
            "weights": str(self.weights),
        }


def camera_of(sequence: PairSequence, scenes: Path | None) -> CameraSpec:
    """Return the camera of a sequence of pairs with its mounting: from the sequence itself, else
    from its scene.

    Raises:
        InputError: Neither has it.
    """
    info = sequence.info.get("camera", {})
    if "T_rig_camera" in info:
        return CameraSpec(
            "camera",
            int(info["width"]),
            int(info["height"]),
            np.array(info["K"]),
            np.array(info["T_rig_camera"]),
        )
    return scene_of(sequence, scenes).cameras[0]


def judge_clip(
    name: str, variant: str, video: U8, truth: U8 | None, camera: CameraSpec, how: Judging
) -> tuple[dict[str, float], dict[str, F64]]:
    """Return a clip's values by metric, those that are defined, and its features by kind.

    Args:
        name: Of the clip.
        variant: Under which label.
        video: ``(T, H, W, 3)``.
        truth: The clean frames; None where ``video`` is those.
        camera: That took both.
        how: Which judges.
    """
    values: dict[str, float | None] = {}
    features: dict[str, F64] = {MOTION: motion_features(video)}
    for seed in how.seeds:
        lanes, cuboids = _detect(video, camera, seed, how.folder)
        found = lane_values(lanes, None)
        if truth is not None:
            true_lanes, true_cuboids = _reference(truth, camera, seed, how.folder)
            found = lane_values(lanes, true_lanes)
            found |= cuboid_values(cuboids, true_cuboids, camera.K, video.shape[1:3])
        values |= {of_seed(metric, seed): value for metric, value in found.items()}
        net = load_judge("video", seed, how.folder)
        assert isinstance(net, VideoNet)
        features[f"{WINDOWS}-{seed}"] = np.asarray(
            window_features(net, video, FRAMES), dtype=np.float64
        )
    if how.weights is not None and (how.weights / I3D_FILE).is_file():
        i3d, _ = load_i3d(how.weights)
        features |= {FVD_CLIP: i3d_features(i3d, video), FVD_16: i3d_features(i3d, video, FRAMES)}
    if how.detections is not None and truth is not None:
        values |= _external(how.detections, variant, name, len(video))
    if (
        how.detections is not None
        and (tracks := how.detections / variant / f"{name}.tracks.npz").is_file()
    ):
        features[FVMD] = np.stack(
            [histograms(window) for window in read_tracks(tracks, len(video))]
        )
    return {metric: value for metric, value in values.items() if value is not None}, features


def _detect(video: U8, camera: CameraSpec, seed: int, folder: Path | None) -> tuple[Any, Any]:
    lane, cuboid = load_judge("lane", seed, folder), load_judge("cuboid", seed, folder)
    return find_lanes(lane, video, camera), find_cuboids(cuboid, video, camera.K)


def _reference(truth: U8, camera: CameraSpec, seed: int, folder: Path | None) -> tuple[Any, Any]:
    """Return the detections on the clean frames, kept for the next variants of the same clip."""
    content = hashlib.blake2b(digest_size=16)
    for array in (truth, camera.K, camera.T_rig_camera):
        content.update(np.ascontiguousarray(array).data)
    key = content.digest(), str(folder), seed
    if key not in _KEPT:
        if len(_KEPT) >= MOST_KEPT:
            _KEPT.clear()
        _KEPT[key] = _detect(truth, camera, seed, folder)
    return _KEPT[key]


def _external(folder: Path, variant: str, name: str, frames: int) -> dict[str, float | None]:
    """Return the paper's lane and cuboid values from the user's detections; nothing where there are
    none for this clip.
    """
    made_file, true_file = folder / variant / f"{name}.json", folder / REFERENCE / f"{name}.json"
    if not (made_file.is_file() and true_file.is_file()):
        return {}
    made, true = read_detections(made_file, frames), read_detections(true_file, frames)
    if (made.detector, made.weights) != (true.detector, true.weights):
        raise InputError(
            f"{made_file}: another detector than on the clean frames: {made.detector} {made.weights[:8]} and {true.detector} {true.weights[:8]}",
            "run one detector on both",
        )
    out: dict[str, float | None] = {}
    if any(true.lanes) or any(made.lanes):
        score = score_clip(made.lanes, true.lanes)
        out |= {
            "lane_f1": score.f1,
            "lane_xerr_m": score.xerr_m,
            "lane_jitter_m": lane_jitter_m(made.lanes),
        }
    if true.K is not None and true.size is not None and (any(true.cuboids) or any(made.cuboids)):
        out["cuboid_f1"] = cuboid_f1(made.cuboids, true.cuboids, true.K, true.size)
    return out


def judge_sets(
    features: Mapping[str, Sequence[Mapping[str, F64]]], baseline: str, seed: int = 0
) -> dict[str, Any]:
    """Return the set metrics of every variant, and the test of its difference from the baseline.

    Args:
        features: VARIANT -> the features of its clips, in one order; ``truth`` is the reference.
        baseline: Variant that the others are compared with.
        seed: Of the swaps.

    Returns:
        METRIC -> ``oracle`` (one half of the clean clips against the other), ``dimensions``, and by
        variant ``value``, ``n`` (vectors) and, beside the baseline, ``difference`` and ``p_value``.
        None with a reason where there are too few vectors.
    """
    truth = features[REFERENCE]
    out: dict[str, Any] = {}
    for metric, key, whole in set_metrics(truth):
        reference = [vectors(clip, key, whole) for clip in truth]
        cell: dict[str, Any] = {
            "oracle": _halves(reference),
            "dimensions": int(reference[0].shape[1]),
            "variants": {},
        }
        made = {name: clips for name, clips in features.items() if name != REFERENCE}
        sides = {
            name: [vectors(clip, key, whole) for clip in clips]
            for name, clips in made.items()
            if all(key in clip for clip in clips)
        }
        cell["variants"] = {
            name: {"value": None, "reason": "no_detections", "n": 0}
            for name in made
            if name not in sides
        }
        for name, side in sides.items():
            n = sum(len(x) for x in side)
            if min(n, sum(len(x) for x in reference)) < 2:
                cell["variants"][name] = {"value": None, "reason": "too_few_clips", "n": n}
                continue
            entry: dict[str, Any] = {
                "value": frechet_distance(
                    np.concatenate(side),
                    np.concatenate(reference),
                    RIDGE if key in (MOTION, FVMD) else 0.0,
                ),
                "n": n,
            }
            if name != baseline and baseline in sides and key not in (MOTION, FVMD):
                test = swap_test(side, sides[baseline], reference, swaps=200, seed=seed)
                entry |= {"difference": test.difference, "p_value": test.p_value}
            cell["variants"][name] = entry
        out[metric] = cell
    return out


def set_metrics(clips: Sequence[Mapping[str, F64]]) -> list[tuple[str, str, bool]]:
    """Return name, kind of feature, and whether a clip's vectors are averaged, of the set metrics
    that all clips have features for.
    """
    rows: list[tuple[str, str, bool]] = [(FVMD_LK, MOTION, False)]
    for key in clips[0]:
        if key.startswith(WINDOWS):
            seed = int(key.rsplit("-", 1)[1])
            rows += [(of_seed(FD_16, seed), key, False), (of_seed(FD_CLIP, seed), key, True)]
        if key in (FVD_CLIP, FVD_16, FVMD) and all(key in clip for clip in clips):
            rows.append((key, key, False))
    return rows


def vectors(clip: Mapping[str, F64], key: str, whole: bool) -> F64:
    """Return a clip's vectors of one kind ``(n, d)``, or their mean ``(1, d)``."""
    x = clip[key]
    return x.mean(axis=0, keepdims=True) if whole and len(x) else x


def _halves(reference: Sequence[F64]) -> float | None:
    sides = [sum(len(x) for x in reference[i::2]) for i in (0, 1)]
    return halves(reference) if min(sides) >= 2 else None


def paper_row(
    means: Mapping[str, Mapping[str, Any]], sets: Mapping[str, Any], variant: str
) -> dict[str, Any]:
    """Return the cells under the paper's names of one variant: from the user's weights and
    detections, else None with the reason.
    """
    known = {name: float(entry["mean"]) for name, entry in means.items()}
    known |= {
        name: float(sets[name]["variants"][variant]["value"])
        for name in (FVD_CLIP, FVD_16, FVMD)
        if name in sets and sets[name]["variants"].get(variant, {}).get("value") is not None
    }
    return paper_cells(known)
