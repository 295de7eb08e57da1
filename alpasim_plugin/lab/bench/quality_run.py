"""Run variants over sequences of pairs and keep the row of every clip: what `simrun bench quality`
and `simrun bench paper` share.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal, cast

import cv2
import numpy as np
import torch

from alpasim_plugin.core.atomic import atomic_file, write_bytes, write_json
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.parts import build
from alpasim_plugin.core.reading import parsing
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import U8
from alpasim_plugin.fixers.network.checkpoints import file_sha256
from alpasim_plugin.lab.bench.colour_video_vdp import DISPLAY, ColourVideoVDP, load_metric
from alpasim_plugin.lab.bench.judged import Judging, camera_of, judge_clip, judge_sets, paper_row
from alpasim_plugin.lab.bench.map_error import shifted_maps
from alpasim_plugin.lab.bench.quality import QualityClip, Variant, measure, row_key, run_variant
from alpasim_plugin.lab.learned_metrics.table import judged_markdown
from alpasim_plugin.lab.training.lost_resolution import draw_lost_resolution
from alpasim_plugin.lab.training.pair_store import CONTENT, PairSequence
from alpasim_plugin.lab.training.reference_store import open_references
from alpasim_plugin.lab.training.seen_scene import scene_of
from alpasim_plugin.lab.video_metrics.charts import plot_by_frame, plot_speed
from alpasim_plugin.lab.video_metrics.dists import HEADS_SHA256 as DISTS_HEADS
from alpasim_plugin.lab.video_metrics.facts import JOD
from alpasim_plugin.lab.video_metrics.image_distance import (
    DISTS,
    ImageDistance,
    available,
    load_distance,
    weights_folder,
)
from alpasim_plugin.lab.video_metrics.lpips import TRUNKS
from alpasim_plugin.lab.video_metrics.perceptual_net import NAME, shipped_weights
from alpasim_plugin.lab.video_metrics.sheet import sheet
from alpasim_plugin.lab.video_metrics.summary import TRUTH, summarise
from alpasim_plugin.lab.video_metrics.table import markdown
from alpasim_plugin.log.run_folder.reader import read_json
from alpasim_plugin.runs.executors.local import map_jobs
from alpasim_plugin.runs.provenance import hardware, versions

DOING = "measuring quality"
Given = Literal["render", "truth", "lost-resolution"]  # what the fixers get
PICTURE_SHARES = (0.1, 0.5, 0.97)  # frames that are shown, as shares of a clip
FILM_QUALITY = 80  # of JPEG
Told = Callable[[int, int, "Work", Mapping[str, Any]], None]


@dataclass(frozen=True)
class Work:
    """One clip under one variant, as sent to a worker process."""

    folder: Path  # of the sequence
    given: Given
    variant: Variant
    frames: int
    seed: int
    device: str
    threads: int
    networks: tuple[
        tuple[str, str], ...
    ]  # perceptual distances, each with what identifies its weights
    weights: Path | None
    out: Path
    pictured: bool
    filmed: bool = False
    judging: Judging | None = None
    scenes: Path | None = None

    @property
    def row_file(self) -> Path:
        """Where the row is kept."""
        return self.out / "clips" / self.variant.label / f"{self.folder.name}.json"

    @property
    def features_file(self) -> Path:
        """Where the judges' features are kept."""
        return self.row_file.with_suffix(".npz")

    def picture_file(self, at: int) -> Path:
        """Where a shown frame is kept."""
        return self.out / "frames" / self.variant.label / f"{self.folder.name}_{at:04d}.png"

    @property
    def film_file(self) -> Path:
        """Where all frames of a filmed clip are kept: JPEGs in an archive of arrays, ``0000`` and
        so on.
        """
        return self.out / "films" / self.variant.label / f"{self.folder.name}.npz"

    @property
    def complete(self) -> bool:
        """Whether everything but pictures is on disk."""
        wanted = [
            self.row_file,
            *([self.features_file] if self.judging else []),
            *([self.film_file] if self.filmed else []),
        ]
        return all(path.is_file() for path in wanted)


@dataclass(frozen=True)
class QualityRun:
    """Which clips, which variants, how.

    Args:
        sequences: Clips.
        variants: Arms; the clean frames are measured beside them.
        out: Folder of rows, features and pictures; what is up to date there is not measured again.
        given: What the fixers get.
        frames: First frames of every clip; shorter clips are taken whole.
        seed: Of the fixers' noise.
        device: Where fixers compute.
        jobs: Clips at a time, one thread each.
        threads: Torch threads with one job.
        weights: Folder of metric weights.
        shown: Names of the clips some of whose frames are kept as pictures.
        filmed: Names of the clips all of whose frames are kept, as JPEG.
        judging: Which judges are asked; None: none.
        scenes: Folder of the scenes behind the pairs; variants with a shifted map need it.
    """

    sequences: Sequence[PairSequence]
    variants: Sequence[Variant]
    out: Path
    given: Given = "render"
    frames: int = 198
    seed: int = 0
    device: str = "cpu"
    jobs: int = 1
    threads: int = 1
    weights: Path | None = None
    shown: frozenset[str] = frozenset()
    filmed: frozenset[str] = frozenset()
    judging: Judging | None = None
    scenes: Path | None = None

    @property
    def networks(self) -> tuple[tuple[str, str], ...]:
        """Perceptual distances that there are weights for, each with what identifies them."""
        by_weights = tuple((name, identity(name, self.weights)) for name in available(self.weights))
        return (
            by_weights
            if colour_video_vdp() is None
            else (*by_weights, (JOD, f"cvvdp {version('cvvdp')} {DISPLAY}"))
        )

    @property
    def used_threads(self) -> int:
        """Torch threads of a clip."""
        return self.threads if self.jobs == 1 else 1

    def works(self) -> list[Work]:
        """Return every clip under every variant and as the clean frames."""
        networks = self.networks
        return [
            Work(
                s.folder,
                self.given,
                variant,
                self.frames,
                self.seed,
                self.device,
                self.used_threads,
                networks,
                self.weights,
                self.out,
                s.name in self.shown,
                s.name in self.filmed,
                self.judging,
                self.scenes,
            )
            for s in self.sequences
            for variant in (*self.variants, Variant(TRUTH))
        ]

    def finished(self, works: Sequence[Work]) -> Iterator[tuple[Work, dict[str, Any]]]:
        """Yield every work with its row as it is finished; rows that are up to date come from
        disk.
        """
        yield from map_jobs(finish, works, self.jobs)

    def measure(self, baseline: str, told: Told) -> tuple[dict[str, Any], list[Work]]:
        """Measure what is not measured yet and return the summary over all, and the works that it
        is about.

        Args:
            baseline: Variant that the others are compared with.
            told: Called after each clip with its number, the number of all, the work and its row.
        """
        works = self.works()
        for i, (work, row) in enumerate(self.finished(works), start=1):
            told(i, len(works), work, row)
        summary = summarise([row_of(work) for work in works], baseline)
        if self.judging is not None:
            summary |= judged(summary, works, self.judging, baseline)
        return summary, works

    def facts(self) -> dict[str, Any]:
        """Return what a summary says of how it was made."""
        return {
            "input": self.given,
            "frames": self.frames,
            "seed": self.seed,
            "device": self.device,
            "jobs": self.jobs,
            "threads": self.used_threads,
            "fixers": {
                variant.label: variant.spec and variant.spec.as_dict() for variant in self.variants
            },
            "units": {variant.label: unit_of(variant) for variant in self.variants},
            "networks": dict(self.networks),
            "load": os.getloadavg()[0],
            "hardware": hardware(),
            "versions": versions(),
        }


def unit_of(variant: Variant) -> dict[str, Any] | None:
    """Return what a fixer makes at a time and what that costs; None for the render, and where a
    fixer does not say.
    """
    unit = getattr(variant.spec and variant.spec.settings, "unit", None)
    return unit and {**asdict(unit), "calls_per_frame": unit.calls_per_frame}


def row_of(work: Work) -> dict[str, Any]:
    """Return the row of a finished work."""
    return dict(read_json(work.row_file)["row"])


def features_of(work: Work) -> dict[str, Any]:
    """Return the judges' features of a finished work: kind -> vectors ``(n, d)``.

    Raises:
        InputError: They are not whole.
    """
    do = "remove the clip's row and start the command again"
    with (
        parsing(work.features_file, do, "not whole features"),
        np.load(work.features_file) as stored,
    ):
        return {key: stored[key] for key in stored.files}


def judged(
    summary: dict[str, Any], todo: Sequence[Work], judging: Judging, baseline: str
) -> dict[str, Any]:
    """Return ``judges`` (the frozen digests), ``sets`` (metrics of whole sets) and ``paper`` (its
    names: null without the user's means).
    """
    features: dict[str, list[dict[str, Any]]] = {}
    for work in todo:
        features.setdefault(work.variant.label, []).append(features_of(work))
    sets = judge_sets(features, baseline)
    cells = {
        name: paper_row(means, sets, name)
        for name, means in summary["arms"].items()
        if name != TRUTH
    }
    return {"judges": judging.identity["judges"], "sets": sets, "paper": cells}


def evenly(sequences: Sequence[PairSequence], count: int | None) -> list[PairSequence]:
    """Return at most ``count`` sequences, evenly chosen."""
    if count is None or count >= len(sequences):
        return list(sequences)
    return [sequences[i] for i in np.linspace(0, len(sequences) - 1, count).round().astype(int)]


def identity(name: str, folder: Path | None) -> str:
    """Return what identifies the weights of a perceptual distance: the file's digest, or LPIPS's
    published ones, checked on loading.
    """
    if name == NAME:
        return file_sha256(shipped_weights())
    plan = TRUNKS["alex" if name == "lpips_alex" else "vgg"]
    return f"{plan.file} {DISTS_HEADS if name == DISTS else plan.heads_sha256}"


def finish(work: Work) -> dict[str, Any]:
    """Return the row of one clip under one variant, from disk if it is up to date."""
    sequence = PairSequence(work.folder)
    clip = quality_clip(sequence, work.given).first(work.frames)
    asked = {} if work.judging is None else {"judging": json.dumps(work.judging.identity)}
    key = row_key(clip, work.variant, work.seed, work.device, {**dict(work.networks), **asked})
    at = shown_frames(len(clip.t_us)) if work.pictured else ()
    if work.complete and all(work.picture_file(i).is_file() for i in at):
        stored = read_json(work.row_file)
        if stored["key"] == key:
            return dict(stored["row"])
    torch.set_num_threads(work.threads)
    cv2.setNumThreads(work.threads)
    spec = work.variant.spec
    fixer = None
    if spec is not None:
        scene = str(sequence.info.get("scene_id", sequence.name))
        fixer = build(
            spec, scene_id=scene, seed=work.seed, device=work.device, threads=work.threads
        )
    if work.variant.map_shift is not None:
        clip = replace(clip, sdmap=_shifted(sequence, clip, work))
    result = run_variant(clip, work.variant, fixer)
    for i in at:
        _write_png(work.picture_file(i), result.video[i])
    distances = {name: _network(name, work.weights) for name, _ in work.networks if name != JOD}
    row = measure(
        clip,
        work.variant,
        result,
        work.seed,
        distances,
        colour_video_vdp() if len(distances) < len(work.networks) else None,
    )
    if work.judging is not None:
        truth = None if work.variant.label == TRUTH else np.array(clip.truth)
        camera = camera_of(sequence, work.judging.scenes)
        values, features = judge_clip(
            sequence.name, work.variant.label, result.video, truth, camera, work.judging
        )
        row["values"] |= values
        work.features_file.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(work.features_file) as partial, partial.open("wb") as file:
            np.savez(file, **cast("dict[str, Any]", features))
    if work.filmed:
        frames = {
            f"{i:04d}": encoded(".jpg", frame, (cv2.IMWRITE_JPEG_QUALITY, FILM_QUALITY))
            for i, frame in enumerate(result.video)
        }
        work.film_file.parent.mkdir(parents=True, exist_ok=True)
        with atomic_file(work.film_file) as partial, partial.open("wb") as file:
            np.savez(file, **cast("dict[str, Any]", frames))
    write_json(work.row_file, {"key": key, "row": row})
    return row


def film_of(work: Work) -> list[bytes]:
    """Return the frames of a filmed work as JPEG.

    Raises:
        InputError: They are not whole.
    """
    do = "remove the clip's film and start the command again"
    with parsing(work.film_file, do, "not whole frames"), np.load(work.film_file) as stored:
        return [stored[key].tobytes() for key in sorted(stored.files)]


def _shifted(sequence: PairSequence, clip: QualityClip, work: Work) -> U8:
    assert work.variant.map_shift is not None
    scenario = scene_of(sequence, work.scenes)
    poses = np.array(sequence.clip.T_world_camera[: len(clip.t_us)])
    return shifted_maps(
        scenario,
        camera_of(sequence, work.scenes),
        poses,
        clip.t_us,
        work.variant.map_shift,
        work.threads,
    )


def quality_clip(sequence: PairSequence, given: Given = "render") -> QualityClip:
    """Return a sequence of pairs as a clip to measure on, its render replaced as ``--input`` says.

    Whatever the picture is, recorded frames are carried into it by the depth of the degraded
    render, since pairs hold no other.
    """
    clip = sequence.clip
    facts = {
        **sequence.info,
        CONTENT: sequence.content,
    }  # a sequence written again has another digest
    recorded = open_references(sequence)
    if given == "render":
        return QualityClip(
            sequence.name,
            facts,
            clip.rgb_input,
            clip.rgb_gt,
            clip.opacity,
            clip.sdmap,
            clip.t_us,
            recorded,
        )
    render, opacity = clip.rgb_gt, np.full_like(clip.opacity, 255)
    if given == "lost-resolution":
        render, opacity = lose_resolution(clip.rgb_gt, sequence.name)
    return QualityClip(
        sequence.name,
        {**facts, "input": given},
        render,
        clip.rgb_gt,
        opacity,
        clip.sdmap,
        clip.t_us,
        recorded,
    )


def lose_resolution(video: U8, name: str) -> tuple[U8, U8]:
    """Return a video ``(T, H, W, 3)`` that has lost resolution, and its opacity ``(T, H, W)``; the
    damage is keyed by the clip's name.
    """
    lost = draw_lost_resolution(stream(name, 0, "lost-resolution"), *video.shape[1:3])
    frames = lost.apply(np.moveaxis(video, -1, 1).astype(np.float32) / np.float32(127.5) - 1)
    damaged = np.clip(np.rint((frames + 1) * np.float32(127.5)), 0, 255).astype(np.uint8)
    return np.moveaxis(damaged, 1, -1), np.broadcast_to(
        np.rint(lost.opacity * 255).astype(np.uint8), video.shape[:3]
    )


def shown_frames(frames: int) -> tuple[int, ...]:
    """Return the indices of the frames shown."""
    return tuple(dict.fromkeys(int(share * (frames - 1)) for share in PICTURE_SHARES))


def write_results(summary: dict[str, Any], done: Sequence[Work], out: Path) -> None:
    """Write the summary, the table, the charts and the pictures."""
    write_json(out / "quality.json", summary)
    write_bytes(out / "quality.md", (markdown(summary) + judged_markdown(summary)).encode())
    plot_by_frame(summary, out / "by-frame.png")
    plot_speed(summary, out / "speed.png")
    shown: dict[Path, list[Work]] = {}
    for work in done:
        if work.pictured:
            shown.setdefault(work.folder, []).append(work)
    for folder, works in shown.items():
        at = shown_frames(int(read_json(works[0].row_file)["row"]["frames"]))
        columns = {
            work.variant.label: [_picture(work.picture_file(i)) for i in at] for work in works
        }
        _write_png(
            out / "sheets" / f"{folder.name}.png", sheet(columns, [f"frame {i}" for i in at])
        )


def _write_png(path: Path, rgb: U8) -> None:
    write_bytes(path, encoded(".png", rgb).tobytes())


def encoded(kind: str, rgb: U8, options: Sequence[int] = ()) -> U8:
    """Return a picture ``(H, W, 3)`` as the bytes of a file of a kind, such as ``.png``."""
    done, encoded = cv2.imencode(kind, cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), list(options))
    assert done
    return np.asarray(encoded, dtype=np.uint8)


def _picture(path: Path) -> Any:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise InputError(
            f"{path}: no readable image",
            "remove the clip's row and start the command again",
        )
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


@cache
def colour_video_vdp() -> ColourVideoVDP | None:
    """Return the metric if it is installed."""
    return load_metric()[0]


@cache
def _network(name: str, folder: Path | None) -> ImageDistance:
    return load_distance(name, weights_folder(folder))
