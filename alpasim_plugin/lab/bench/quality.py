"""Open-loop quality: a fixer over recorded clips, block by block as in the closed loop, compared
with the ground truth. Rows of finished clips are kept and measured again only if their key changes.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache, lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal

import cv2
import numpy as np
import torch

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.atomic import write_bytes, write_json
from alpasim_plugin.core.interfaces import Fixer
from alpasim_plugin.core.parts import PartSpec, build
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F64, I64, U8, Frame
from alpasim_plugin.fixers.refine import StreamStats, refine_frames
from alpasim_plugin.fixers.settings import FixerSettings
from alpasim_plugin.lab.jobs import map_jobs
from alpasim_plugin.lab.training.lane_lines import has_lanes, read_lanes
from alpasim_plugin.lab.training.lost_resolution import draw_lost_resolution
from alpasim_plugin.lab.training.pair_store import CONTENT, PairSequence
from alpasim_plugin.lab.training.reference_store import SequenceReferences, open_references
from alpasim_plugin.lab.video_metrics.clip import clip_quality
from alpasim_plugin.lab.video_metrics.detectors import available_detectors, intrinsics_of
from alpasim_plugin.lab.video_metrics.image_distance import (
    ImageDistance,
    available,
    digests,
    load_distance,
)
from alpasim_plugin.lab.video_metrics.objects import (
    Objects,
    clean_metrics,
    detect_objects,
    object_metrics,
)
from alpasim_plugin.lab.video_metrics.road import road_mask
from alpasim_plugin.lab.video_metrics.sheet import sheet
from alpasim_plugin.lab.video_metrics.summary import TRUTH, summarise
from alpasim_plugin.lab.video_metrics.table import markdown
from alpasim_plugin.lab.video_metrics.video_features import available_i3d, video_features
from alpasim_plugin.log.run_folder.reader import read_json
from alpasim_plugin.log.run_folder.records import json_of
from alpasim_plugin.runs.provenance import hardware, part_facts, versions

RAW = "3dgs"  # the variant of the unfixed render
VERSION = 9  # of what a row holds and how it is measured; part of its key
CAMERA = "camera"
DIGITS = 7  # significant, of stored values
PICTURE_SHARES = (0.1, 0.5, 0.97)  # frames on the sheets, as shares of a clip
InputKind = Literal["render", "truth", "lost-resolution"]  # what the fixers receive
Report = Callable[[int, int, "Work", Mapping[str, Any]], None]


@dataclass(frozen=True)
class QualityClip:
    """A degraded render with the other inputs of a fixer, and the ground truth; ``T`` frames of one
    camera.
    """

    name: str
    identity: Mapping[str, Any]  # distinguishes this clip from others of the same name
    render: U8  # (T, H, W, 3)
    truth: U8  # (T, H, W, 3)
    opacity: U8  # (T, H, W), 255 is opaque
    sdmap: U8  # (T, H, W, 3)
    t_us: I64  # (T,)
    recorded: SequenceReferences | None = None
    lanes: Sequence[F64] | None = None  # of every frame (L, 29), metres

    @property
    def scene(self) -> str:
        """Name of the drawn scene or recorded street; clips of one scene are not independent."""
        return str(self.identity.get("scene_id", self.name))

    def first(self, frames: int) -> QualityClip:
        """Return the clip's first frames, all of them where it has fewer."""
        names = ("render", "truth", "opacity", "sdmap", "t_us")
        lanes = None if self.lanes is None else self.lanes[:frames]
        cut = {name: getattr(self, name)[:frames] for name in names}
        return replace(self, **cut, lanes=lanes)

    def references(self, count: int, past: bool = False) -> Iterator[tuple[U8, ...]]:
        """Yield the references of every frame, at most ``count`` each."""
        if self.recorded is None or not count:
            yield from ((),) * len(self.t_us)
        else:
            yield from self.recorded.warped(len(self.t_us), count, past)


def quality_clip(sequence: PairSequence, input_kind: InputKind = "render") -> QualityClip:
    """Return a sequence of pairs as a clip to measure on, its render replaced as ``--input`` says.

    Recorded frames are warped by the depth of the degraded render, since pairs hold no other.
    """
    clip = sequence.clip
    identity = {**sequence.info, CONTENT: sequence.content}
    render = clip.rgb_input
    opacity = clip.opacity
    if input_kind != "render":
        identity["input"] = input_kind
        render = clip.rgb_gt
        opacity = np.full_like(clip.opacity, 255)
    if input_kind == "lost-resolution":
        render, opacity = lose_resolution(clip.rgb_gt, sequence.name)
    recorded = open_references(sequence)
    lanes = read_lanes(sequence.folder) if has_lanes(sequence.folder) else None
    return QualityClip(
        sequence.name,
        identity,
        render,
        clip.rgb_gt,
        opacity,
        clip.sdmap,
        clip.t_us,
        recorded,
        lanes,
    )


def lose_resolution(video: U8, name: str) -> tuple[U8, U8]:
    """Return a video ``(T, H, W, 3)`` with a lower resolution, and its opacity ``(T, H, W)``; the
    damage is keyed by the clip's name.
    """
    lost = draw_lost_resolution(stream(name, 0, "lost-resolution"), *video.shape[1:3])
    frames = lost.apply(np.moveaxis(video, -1, 1).astype(np.float32) / np.float32(127.5) - 1)
    damaged = np.clip(np.rint((frames + 1) * np.float32(127.5)), 0, 255).astype(np.uint8)
    opacity = np.rint(lost.opacity * 255).astype(np.uint8)
    return np.moveaxis(damaged, 1, -1), np.broadcast_to(opacity, video.shape[:3])


@dataclass(frozen=True)
class Variant:
    """One row of the table: the render as it is (``3dgs``), the truth, or a fixer under a label."""

    label: str
    spec: PartSpec | None = None  # None for 3dgs and the truth

    def __post_init__(self) -> None:
        if self.spec is None and self.label not in (RAW, TRUTH):
            raise InputError(
                f"variant {self.label!r}: no fixer", f"name a fixer, or one of {RAW}, {TRUTH}"
            )


@dataclass(frozen=True)
class VariantResult:
    """Output of a variant on a clip.

    Attributes:
        video: ``(T, H, W, 3)``.
        ms_per_frame: Of every block, the first included; empty where no fixer ran.
        events: Frames that the guard replaced by the raw ones, by event.
    """

    video: U8
    ms_per_frame: tuple[float, ...]
    events: Mapping[str, int]


def run_variant(clip: QualityClip, variant: Variant, fixer: Fixer | None) -> VariantResult:
    """Run a variant over a clip; ``fixer`` is a session at the start of a rollout, for fixers.

    Raises:
        InputError: The fixer is missing, or given where none runs.
    """
    if (fixer is None) != (variant.spec is None):
        raise InputError(
            f"variant {variant.label!r}: a missing or superfluous fixer",
            "give a session exactly for a fixer's variant",
        )
    if fixer is None or variant.spec is None:
        video = clip.truth if variant.label == TRUTH else clip.render
        return VariantResult(np.array(video), (), {})
    assert isinstance(variant.spec.settings, FixerSettings)
    tally = StreamStats()
    frames = []
    for block in refine_frames(fixer_input(clip, variant.spec.settings), fixer):
        tally.add(block)
        frames += [frame.rgb for frame in block.fixed]
    return VariantResult(np.stack(frames), tuple(tally.ms_per_frame), dict(tally.events))


def fixer_input(clip: QualityClip, settings: FixerSettings) -> Iterator[tuple[Frame, U8 | None]]:
    """Yield every frame of a clip as a fixer receives it, with its map if the settings use one."""
    recorded = clip.references(settings.references, settings.recording == "past")
    for i, (t_us, references) in enumerate(zip(clip.t_us, recorded, strict=True)):
        alpha = clip.opacity[i].astype(np.float32) / np.float32(255)
        frame = Frame(int(t_us), CAMERA, np.array(clip.render[i]), alpha, references=references)
        yield frame, np.array(clip.sdmap[i]) if settings.uses_map else None


def measure(
    clip: QualityClip,
    variant: Variant,
    result: VariantResult,
    seed: int,
    networks: Mapping[str, ImageDistance],
    weights: Path | None = None,
    objects: Mapping[str, float] = MappingProxyType({}),
) -> dict[str, Any]:
    """Return the row of one clip under one variant (`alpasim_plugin.lab.video_metrics.summary`);
    ``weights`` is the folder of I3D, ``objects`` are the values by detectors.
    """
    truth = None if variant.label == TRUTH else clip.truth
    quality = clip_quality(result.video, truth, networks, road_mask(clip.sdmap))
    values = {**quality.means, **objects}
    later_blocks = result.ms_per_frame[1:] or result.ms_per_frame  # the first one is shorter
    return {
        "arm": variant.label,
        "clip": clip.name,
        "scene": clip.scene,
        "seed": seed,
        "frames": len(clip.t_us),
        "size": list(clip.truth.shape[1:3]),
        "values": values,
        "identical": quality.identical,
        "events": dict(result.events),
        "ms_per_frame": [round(ms, 4) for ms in later_blocks],
        "series": {name: _rounded(values) for name, values in quality.series.items()},
        "features": {
            name: [_rounded(vector) for vector in vectors]
            for name, vectors in video_features(result.video, weights).items()
        },
    }


def _rounded(values: F64) -> list[float]:
    return [float(f"{value:.{DIGITS}g}") for value in values]


@dataclass(frozen=True)
class Work:
    """One clip under one variant, as sent to a worker process.

    Attributes:
        folder: Of the sequence.
        input_kind: What the fixer receives.
        variant: Which.
        frames: First frames of the clip that are measured.
        seed: Of the fixer's noise.
        device, threads: Where the fixer computes, and with how many threads.
        weights: Folder of the metrics' weights.
        out: Folder of rows and images.
        pictured: Whether some frames are kept for a sheet.
        truth_rows: Folder of the rows of the truth; None: that of the others.
        detectors: Folder of detectors; None: there are none.
    """

    folder: Path
    input_kind: InputKind
    variant: Variant
    frames: int
    seed: int
    device: str
    threads: int
    weights: Path | None
    out: Path
    pictured: bool
    truth_rows: Path | None = None
    detectors: Path | None = None

    @property
    def row_file(self) -> Path:
        """Where the row is kept."""
        if self.truth_rows is not None and self.variant.label == TRUTH:
            return self.truth_rows / f"{self.folder.name}.json"
        return self.out / "clips" / self.variant.label / f"{self.folder.name}.json"

    def picture_file(self, frame: int) -> Path:
        """Where a frame of the sheet is kept."""
        return self.out / "frames" / self.variant.label / f"{self.folder.name}_{frame:04d}.png"


def row_key(clip: QualityClip, work: Work) -> str:
    """Return the digest of everything that determines a row, except the speed of the machine.

    Args:
        clip: Already cut to length.
        work: With the digests of the fixer's weights and of the metrics'.
    """
    facts = [
        VERSION,
        clip.name,
        len(clip.t_us),
        dict(clip.identity),
        work.variant.label,
        work.variant.spec and work.variant.spec.digest,
        work.seed,
        work.device,
        metric_digests(work.weights, work.detectors),
        clip.lanes is not None,
    ]
    return hashlib.sha256(json.dumps(facts, sort_keys=True, default=str).encode()).hexdigest()


def metric_digests(folder: Path | None, detectors: Path | None) -> dict[str, str]:
    """Return the metrics that there are weights or a detector for, each with the digest of what
    calibrates it.
    """
    return digests(folder) | available_i3d(folder) | available_detectors(detectors)


def finish(work: Work) -> dict[str, Any]:
    """Return the row of one clip under one variant, from disk if it is up to date."""
    sequence = PairSequence(work.folder)
    clip = quality_clip(sequence, work.input_kind).first(work.frames)
    key = row_key(clip, work)
    frame_numbers = shown_frames(len(clip.t_us)) if work.pictured else ()
    if work.row_file.is_file() and all(work.picture_file(i).is_file() for i in frame_numbers):
        stored = read_json(work.row_file)
        if stored["key"] == key:
            return dict(stored["row"])
    torch.set_num_threads(work.threads)
    cv2.setNumThreads(work.threads)
    fixer = None
    if work.variant.spec is not None:
        fixer = build(
            work.variant.spec,
            scene_id=str(sequence.info.get("scene_id", sequence.name)),
            seed=work.seed,
            device=work.device,
            threads=work.threads,
        )
    result = run_variant(clip, work.variant, fixer)
    for i in frame_numbers:
        _write_png(work.picture_file(i), result.video[i])
    distances = {name: _network(name, work.weights) for name in available(work.weights)}
    objects = object_values(clip, work, result.video)
    row = measure(clip, work.variant, result, work.seed, distances, work.weights, objects)
    write_json(work.row_file, {"key": key, "row": row})
    return row


def object_values(clip: QualityClip, work: Work, video: U8) -> dict[str, float]:
    """Return what detectors say of a variant's video of a clip, by the name of the metric: of the truth
    their precision and recall, of others these and how far they agree with the truth.
    """
    if work.detectors is None or not available_detectors(work.detectors):
        return {}
    K = intrinsics_of(clip.identity.get("camera"), clip.name)
    true = _true_objects(work.folder, str(clip.identity[CONTENT]), len(clip.t_us), work.detectors)
    values = clean_metrics(true, clip.sdmap, clip.lanes)
    if work.variant.label != TRUTH:
        values |= object_metrics(detect_objects(video, K, work.detectors), true)
    return values


@lru_cache(256)
def _true_objects(folder: Path, content: str, frames: int, detectors: Path) -> Objects:
    """Return what detectors find in the clean frames of a sequence, which every variant needs."""
    sequence = PairSequence(folder)
    assert sequence.content == content
    K = intrinsics_of(sequence.info.get("camera"), sequence.name)
    return detect_objects(sequence.clip.rgb_gt[:frames], K, detectors)


def measure_quality(
    works: Sequence[Work], baseline: str, jobs: int, out: Path, report: Report
) -> dict[str, Any]:
    """Measure what is not measured yet, write OUT/quality.json, quality.md and the sheets, and
    return the summary.

    Args:
        works: Every clip under every variant.
        baseline: Variant that the others are compared with.
        jobs: Clips at a time.
        out: Folder of results.
        report: Called after each clip with its number, the number of all, the work and its row.
    """
    finished = {}
    for i, (work, row) in enumerate(map_jobs(finish, works, jobs), start=1):
        report(i, len(works), work, row)
        finished[work.row_file] = row
    rows = [finished[work.row_file] for work in works]  # with several jobs they end in any order
    variants = {
        work.variant.label: work.variant.spec for work in works if work.variant.label != TRUTH
    }
    first = works[0]
    summary = summarise(rows, baseline)
    summary["run"] = {
        "input": first.input_kind,
        "frames": first.frames,
        "seed": first.seed,
        "device": first.device,
        "jobs": jobs,
        "threads": first.threads,
        "fixers": {
            label: None if spec is None else json_of(part_facts(spec))
            for label, spec in variants.items()
        },
        "units": {label: unit_of(spec) for label, spec in variants.items()},
        "networks": metric_digests(first.weights, first.detectors),
        "load": os.getloadavg()[0],
        "hardware": hardware(),
        "versions": versions(),
    }
    write_json(out / "quality.json", summary)
    write_bytes(out / "quality.md", markdown(summary).encode())
    write_sheets(works, rows, out)
    return summary


def unit_of(spec: PartSpec | None) -> dict[str, Any] | None:
    """Return what a fixer makes at a time and what that costs; None where it does not say."""
    unit = getattr(spec and spec.settings, "unit", None)
    return unit and {**asdict(unit), "calls_per_frame": unit.network_calls / unit.frames}


def write_sheets(works: Sequence[Work], rows: Sequence[Mapping[str, Any]], out: Path) -> None:
    """Write a sheet of every pictured clip: some frames, all variants side by side."""
    by_clip: dict[str, dict[str, list[U8]]] = {}
    titles: dict[str, list[str]] = {}
    for work, row in zip(works, rows, strict=True):
        if work.pictured:
            frame_numbers = shown_frames(int(row["frames"]))
            name = work.folder.name
            titles[name] = [f"frame {i}" for i in frame_numbers]
            images = [_read_png(work.picture_file(i)) for i in frame_numbers]
            by_clip.setdefault(name, {})[work.variant.label] = images
    for name, columns in by_clip.items():
        _write_png(out / "sheets" / f"{name}.png", sheet(columns, titles[name]))


def shown_frames(frames: int) -> tuple[int, ...]:
    """Return the indices of the frames on a sheet."""
    return tuple(dict.fromkeys(int(share * (frames - 1)) for share in PICTURE_SHARES))


def evenly(sequences: Sequence[PairSequence], count: int | None) -> list[PairSequence]:
    """Return at most ``count`` sequences, evenly chosen."""
    if count is None or count >= len(sequences):
        return list(sequences)
    return [sequences[i] for i in np.linspace(0, len(sequences) - 1, count).round().astype(int)]


def _write_png(path: Path, rgb: U8) -> None:
    encoded = cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))[1]
    write_bytes(path, encoded.tobytes())


def _read_png(path: Path) -> U8:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise InputError(f"{path}: no readable image", "remove it and start the command again")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


@cache
def _network(name: str, folder: Path | None) -> ImageDistance:
    return load_distance(name, folder)
