"""The paper's appearance experiment on our clips: one fixer asked for night, fog and snow, beside
the formulas on other systems' output.

Arms by style: ``appearance``, the fixer with the style's prompt; ``V9 + formula`` and ``3dgs +
formula``, the controls; and the styled target itself. Controls and target are made with the
simulator's depth of the clean frames and its lamps, which no fixer sees. Style and lanes are judged
by the frozen judges, lanes against those found on the *clear* clean frames, pictures against the
styled target.

    OUT/clips/CLIP.json         the values of a clip under all arms and styles
    OUT/sheets/CLIP-STYLE.png   what they look like, for a few clips
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from alpasim_plugin.block_fixers.settings import STYLES
from alpasim_plugin.core.atomic import write_bytes, write_json
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.parts import build, resolve
from alpasim_plugin.core.types import U8, CameraSpec
from alpasim_plugin.fixers.bundle import bundle_fixer
from alpasim_plugin.lab.bench.judged import Judging, camera_of
from alpasim_plugin.lab.bench.quality import RAW, QualityClip, Variant, row_key, run_variant
from alpasim_plugin.lab.bench.quality_run import encoded, identity, quality_clip, shown_frames
from alpasim_plugin.lab.learned_metrics.clip import lane_values
from alpasim_plugin.lab.learned_metrics.facts import LANE_F1, LANE_XERR, STYLE_ACC, of_seed
from alpasim_plugin.lab.learned_metrics.nets.detect import find_lanes
from alpasim_plugin.lab.learned_metrics.nets.files import check_digests, file_name, load_judge
from alpasim_plugin.lab.learned_metrics.nets.style_net import StyleNet, style_probabilities
from alpasim_plugin.lab.paper.appearance import OURS, PROTOCOL, TARGET, control, protocol_of
from alpasim_plugin.lab.paper.measured import Measured
from alpasim_plugin.lab.training.appearance import VERSION
from alpasim_plugin.lab.training.pair_store import PairSequence
from alpasim_plugin.lab.training.seen_scene import restyle_video, scene_of, seen_frames
from alpasim_plugin.lab.video_metrics import clip_quality
from alpasim_plugin.lab.video_metrics.image_distance import (
    ImageDistance,
    available,
    load_distance,
    weights_folder,
)
from alpasim_plugin.lab.video_metrics.sheet import sheet
from alpasim_plugin.log.run_folder.reader import read_json
from alpasim_plugin.runs.executors.local import map_jobs

FRAMES = 198  # of a clip at most, as in the paper
JUDGE_SEEDS = (0, 1)
PICTURES = ("psnr_db", "perceptual-syn")
LANES = (LANE_F1, LANE_XERR)
Told = Callable[[int, int, str], None]  # clip number, their count, name
Row = dict[str, dict[str, dict[str, float]]]  # STYLE -> ARM -> METRIC -> value


@dataclass(frozen=True)
class AppearanceRun:
    """What is measured on what.

    Args:
        sequences: Clips.
        bundle: Weights of the recipe ``appearance``.
        plain: Fixers whose output the formulas restyle.
        scenes: Folder of the scenes behind the pairs.
        out: Folder of the results; rows that are up to date there are kept.
        judging: Which judges are asked.
        frames: First frames of a clip.
        seed: Of the fixers' noise.
        jobs: Clips at a time.
        shown: Clips with pictures.
    """

    sequences: Sequence[PairSequence]
    bundle: Path
    plain: tuple[Variant, ...]
    scenes: Path | None
    out: Path
    judging: Judging
    frames: int = FRAMES
    seed: int = 0
    jobs: int = 1
    shown: frozenset[str] = frozenset()


@dataclass(frozen=True)
class _Work:
    run: AppearanceRun
    sequence: Path

    @property
    def row_file(self) -> Path:
        return self.run.out / "clips" / f"{self.sequence.name}.json"

    def sheet_file(self, style: str) -> Path:
        return self.run.out / "sheets" / f"{self.sequence.name}-{style}.png"


def prompted(bundle: Path, style: str) -> Variant:
    """Return the fixer of a bundle, asked for a style.

    Raises:
        InputError: Not a bundle.
    """
    name, settings = bundle_fixer(bundle)
    return Variant(OURS, resolve("fixer", name, (*settings, f"prompt={style}")))


def judges_of(judging: Judging) -> dict[str, str]:
    """Return the frozen digests of the judges that are asked.

    Raises:
        InputError: A judge is not frozen, or has changed since.
    """
    digests = check_digests(judging.folder)
    names = [file_name(name, seed) for name in ("style", "lane") for seed in judging.seeds]
    if missing := [name for name in names if name not in digests]:
        raise InputError(
            f"{', '.join(missing)}: not among the frozen judges",
            "choose other seeds with --judges, or name the folder of your frozen judges with --judge-folder (docs/lab/judges.md)",
        )
    return {name: digests[name] for name in names}


def measure_appearance(run: AppearanceRun, told: Told) -> dict[str, Measured]:
    """Measure every clip and return the values by protocol: one for each style, and ``appearance``,
    their mean clip by clip.

    Raises:
        InputError: A missing scene, judge or prompt.
    """
    judges_of(run.judging)
    works = [_Work(run, sequence.folder) for sequence in run.sequences]
    rows: dict[str, Row] = {}
    for i, (work, row) in enumerate(map_jobs(_finish, works, run.jobs), start=1):
        rows[work.sequence.name] = row
        told(i, len(works), work.sequence.name)
    styles = STYLES[1:]
    arms = list(next(iter(rows.values()))[styles[0]])
    out = {
        protocol_of(s): Measured(
            {a: {clip: row[s][a] for clip, row in rows.items()} for a in arms}, reference=TARGET
        )
        for s in styles
    }
    means = {
        a: {clip: _mean([row[s][a] for s in styles]) for clip, row in rows.items()} for a in arms
    }
    return {PROTOCOL: Measured(means, reference=TARGET), **out}


def _mean(values: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Average the metrics that are defined in every style."""
    return {
        metric: float(np.mean([v[metric] for v in values]))
        for metric in values[0]
        if all(metric in v for v in values)
    }


def _finish(work: _Work) -> Row:
    run, sequence = work.run, PairSequence(work.sequence)
    clip = quality_clip(sequence).first(run.frames)
    pictured = (
        [work.sheet_file(style) for style in STYLES[1:]] if sequence.name in run.shown else []
    )
    key = _key(run, clip)
    if work.row_file.is_file() and all(path.is_file() for path in pictured):
        stored = read_json(work.row_file)
        if stored["key"] == key:
            return dict(stored["row"])
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    scene_id = str(sequence.info.get("scene_id", sequence.name))
    seen = seen_frames(sequence, scene_of(sequence, run.scenes), 0, len(clip.t_us))
    judged = _Judged(run.judging, camera_of(sequence, run.scenes), np.array(clip.truth))
    plain = {
        variant.label: _output(clip, variant, scene_id, run.seed)
        for variant in (Variant(RAW), *run.plain)
    }
    row: Row = {}
    for style in STYLES[1:]:
        target = restyle_video(clip.truth, seen, style, scene_id)
        made = {OURS: _output(clip, prompted(run.bundle, style), scene_id, run.seed)}
        made |= {
            control(label): restyle_video(video, seen, style, scene_id)
            for label, video in plain.items()
        }
        row[style] = {arm: judged.values(video, target, style) for arm, video in made.items()}
        row[style][TARGET] = judged.values(target, None, style)
        if pictured:
            _write_sheet(work.sheet_file(style), {"render": clip.render, **made, TARGET: target})
    write_json(work.row_file, {"key": key, "row": row})
    return row


def _key(run: AppearanceRun, clip: QualityClip) -> str:
    """Return the digest of everything that determines a row."""
    networks: dict[str, str] = {
        name: identity(name, None) for name in available(None) if name in PICTURES
    }
    variants = [prompted(run.bundle, style) for style in STYLES[1:]] + list(run.plain)
    keys = [row_key(clip, variant, run.seed, "cpu", networks) for variant in variants]
    facts = [VERSION, keys, judges_of(run.judging), sorted(run.judging.seeds)]
    return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()


def _output(clip: QualityClip, variant: Variant, scene_id: str, seed: int) -> U8:
    fixer = (
        None
        if variant.spec is None
        else build(variant.spec, scene_id=scene_id, seed=seed, device="cpu", threads=1)
    )
    return run_variant(clip, variant, fixer).video


class _Judged:
    """The frozen judges with what they found on the clear clean frames of a clip."""

    def __init__(self, judging: Judging, camera: CameraSpec, clear: U8) -> None:
        self.judging, self.camera = judging, camera
        self.lanes = {
            seed: find_lanes(load_judge("lane", seed, judging.folder), clear, camera)
            for seed in judging.seeds
        }

    def values(self, video: U8, target: U8 | None, style: str) -> dict[str, float]:
        """Return the values of a clip; against the target only where one is given."""
        found: dict[str, float | None] = {}
        for seed in self.judging.seeds:
            net = load_judge("style", seed, self.judging.folder)
            assert isinstance(net, StyleNet)
            said = style_probabilities(net, video).argmax(axis=1)
            found[of_seed(STYLE_ACC, seed)] = float((said == STYLES.index(style)).mean())
            lanes = lane_values(
                find_lanes(load_judge("lane", seed, self.judging.folder), video, self.camera),
                self.lanes[seed],
            )
            found |= {of_seed(metric, seed): lanes[metric] for metric in LANES}
        if target is not None:
            folder = weights_folder(None)
            networks: dict[str, ImageDistance] = {
                name: load_distance(name, folder) for name in available(None) if name in PICTURES
            }
            means = clip_quality(video, target, networks).means
            found |= {metric: means[metric] for metric in PICTURES}
        return {metric: value for metric, value in found.items() if value is not None}


def _write_sheet(path: Path, columns: Mapping[str, U8]) -> None:
    at = shown_frames(len(next(iter(columns.values()))))
    picture = sheet(
        {name: [video[i] for i in at] for name, video in columns.items()},
        [f"frame {i}" for i in at],
    )
    write_bytes(path, encoded(".png", picture).tobytes())
