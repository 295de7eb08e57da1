"""``simrun bench quality``: fixers over recorded clips, open loop, against ground-truth frames."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import cv2
import numpy as np
import torch
import typer
from rich.console import Console

from alpasim_plugin.atomic import atomic_file, write_bytes, write_json
from alpasim_plugin.bench.judged import Judging, camera_of, judge_clip, judge_sets, paper_row
from alpasim_plugin.bench.quality import RAW, QualityClip, Variant, measure, row_key, run_variant
from alpasim_plugin.cli.jobs import parallel_map
from alpasim_plugin.cli.refine import fixer_overrides
from alpasim_plugin.cli.training_options import whole_numbers
from alpasim_plugin.errors import InputError
from alpasim_plugin.fixers.bundle import bundle_fixer
from alpasim_plugin.nets.checkpoints import file_sha256
from alpasim_plugin.nets.dists import HEADS_SHA256 as DISTS_HEADS
from alpasim_plugin.nets.image_distance import DISTS, FOLDER_VARIABLE, ImageDistance, available, load_distance, weights_folder
from alpasim_plugin.nets.lpips import TRUNKS
from alpasim_plugin.nets.perceptual import NAME, shipped_weights
from alpasim_plugin.parts import build, resolve
from alpasim_plugin.reading import parsing
from alpasim_plugin.runtime.provenance import hardware, versions
from alpasim_plugin.runtime.store import read_json
from alpasim_plugin.seeding import stream
from alpasim_plugin.training.lost_resolution import draw_lost_resolution
from alpasim_plugin.training.pair_store import CONTENT, PairDataset, PairSequence
from alpasim_plugin.types import U8
from evaluators.judges.table import judged_markdown
from evaluators.video.charts import plot_by_frame, plot_speed
from evaluators.video.sheet import sheet
from evaluators.video.summary import TRUTH, summarise
from evaluators.video.table import markdown

DOING = "measuring quality"
Given = Literal["render", "truth", "lost-resolution"]  # what the fixers get
PICTURE_SHARES = (0.1, 0.5, 0.97)  # frames that are shown, as shares of a clip
EPILOG = """
Examples:

- `simrun bench quality data/pairs --split test --fixer 3dgs,onefixer --out runs/quality`

- `simrun bench quality data/video --split held-out --input truth --fixer onefixer --baseline onefixer --out runs/unharmed`

- `simrun bench quality data/pairs --fixer 3dgs,v9=runs/v9/fixer.safetensors,two=onefixer@2 --set two:fixer.window=4 --jobs 2 --out runs/q`
"""


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
    networks: tuple[tuple[str, str], ...]  # perceptual distances, each with what identifies its weights
    weights: Path | None
    out: Path
    pictured: bool
    judging: Judging | None = None

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


def quality(
    data: Annotated[Path, typer.Argument(help="Folder of pairs (docs/pairs.md).")],
    out: Annotated[Path, typer.Option("--out", help="Folder for results; the same command continues there.")],
    fixers: Annotated[str, typer.Option("--fixer", help="Comma-separated: 3dgs, NAME[@STEPS], LABEL=NAME, LABEL=FILE.")] = "3dgs",
    split: Annotated[str, typer.Option("--split", help="Split to measure on.")] = "test-known",
    given: Annotated[
        Given,
        typer.Option(
            "--input",
            help="What fixers get: the degraded render; the ground truth, opaque, which they should leave alone; or the truth "
            "that has lost resolution (blur, cells of 2 to 4 pixels, up to 3 holes that stay in place).",
        ),
    ] = "render",
    baseline: Annotated[str, typer.Option("--baseline", help="Variant that the others are compared with.")] = RAW,
    frames: Annotated[int, typer.Option("--frames", min=2, help="First frames of every clip; shorter clips are taken whole.")] = 198,
    clips: Annotated[int | None, typer.Option("--clips", min=1, help="At most so many clips, evenly chosen.")] = None,
    overrides: Annotated[list[str] | None, typer.Option("--set", help="[LABEL:]fixer.key=value, of one variant or of all fixers.")] = None,
    weights: Annotated[Path | None, typer.Option("--metric-weights", help=f"Folder of LPIPS weights; also {FOLDER_VARIABLE}.")] = None,
    judges: Annotated[
        str | None, typer.Option("--judges", help="Also ask the judges of these training seeds, as 0,1 (docs/judges.md).")
    ] = None,
    scenes: Annotated[
        Path | None, typer.Option("--scenes", help="Folder of the pairs' scenes: judges of lanes need the camera's mounting.")
    ] = None,
    judge_folder: Annotated[Path | None, typer.Option("--judge-folder", help="Folder of judges that you froze.")] = None,
    detections: Annotated[Path | None, typer.Option("--detections", help="Folder of a detector's results, VARIANT/CLIP.json.")] = None,
    pictures: Annotated[int, typer.Option("--pictures", min=0, help="Clips that are shown side by side.")] = 4,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the fixers' noise.")] = 0,
    device: Annotated[Literal["cpu", "cuda"], typer.Option("--device", help="Where fixers compute.")] = "cpu",
    jobs: Annotated[int, typer.Option("--jobs", min=1, help="Clips at a time, one thread each; times are then of a busy machine.")] = 1,
    threads: Annotated[int, typer.Option("--threads", min=1, help="Torch threads with one job.")] = 1,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as one JSON document on stdout.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Measure fixers on recorded clips: PSNR, SSIM, perceptual distances, Warp L1, drift and time, with 95 % intervals over clips.

    Writes quality.json, quality.md, by-frame.png, speed.png and pictures side by side; rows of finished clips are kept.
    """
    del debug
    variants = parse_variants(fixers, overrides or [])
    if baseline not in {variant.label for variant in variants}:
        raise InputError(DOING, f"--baseline {baseline}", f"variants {', '.join(a.label for a in variants)}", "name one of the variants")
    judging = None if judges is None else _judging(judges, scenes, detections, weights, judge_folder)
    networks = tuple((name, identity(name, weights)) for name in available(weights))
    sequences = evenly(PairDataset(data, split).sequences, clips)
    shown = {s.name for s in evenly(sequences, pictures)} if pictures else set()
    used = threads if jobs == 1 else 1
    todo = [
        Work(s.folder, given, variant, frames, seed, device, used, networks, weights, out, s.name in shown, judging)
        for s in sequences
        for variant in (*variants, Variant(TRUTH))
    ]
    console = Console(stderr=True)
    for i, (work, row) in enumerate(parallel_map(finish, todo, jobs), start=1):
        if not as_json:
            psnr = row["values"].get("psnr_db")
            console.print(f"{i}/{len(todo)} {work.variant.label} {work.folder.name}" + ("" if psnr is None else f" {psnr:.2f} dB"))
    summary = summarise([read_json(work.row_file)["row"] for work in todo], baseline)
    if judging is not None:
        summary |= judged(summary, todo, judging, baseline)
    summary["run"] = {
        "data": str(data), "split": split, "input": given, "frames": frames, "seed": seed, "device": device, "jobs": jobs, "threads": used,
        "fixers": {variant.label: variant.spec and variant.spec.as_dict() for variant in variants}, "networks": dict(networks),
        "units": {variant.label: unit_of(variant) for variant in variants},
        "load": os.getloadavg()[0], "hardware": hardware(), "versions": versions(),
    }  # fmt: skip
    write_results(summary, todo, out)
    print(json.dumps(summary) if as_json else markdown(summary) + judged_markdown(summary) + f"\nwrote {out / 'quality.json'}")


def _judging(seeds: str, scenes: Path | None, detections: Path | None, weights: Path | None, folder: Path | None) -> Judging:
    return Judging(tuple(whole_numbers("--judges", seeds, 0)), scenes, detections, weights_folder(weights), folder)


def judged(summary: dict[str, Any], todo: Sequence[Work], judging: Judging, baseline: str) -> dict[str, Any]:
    """Return ``judges`` (the frozen digests), ``sets`` (metrics of whole sets) and ``paper`` (its names: null without the user's means)."""
    features: dict[str, list[dict[str, Any]]] = {}
    for work in todo:
        do = "remove the clip's row and start the command again"
        with parsing(DOING, work.features_file, do, "not whole features"), np.load(work.features_file) as stored:
            features.setdefault(work.variant.label, []).append({key: stored[key] for key in stored.files})
    sets = judge_sets(features, baseline)
    cells = {name: paper_row(means, sets, name) for name, means in summary["arms"].items() if name != TRUTH}
    return {"judges": judging.identity["judges"], "sets": sets, "paper": cells}


def parse_variants(text: str, overrides: Sequence[str]) -> tuple[Variant, ...]:
    """Return the variants that ``--fixer`` and ``--set`` name.

    Raises:
        InputError: A label twice, a fixer or key that is not known, or a setting for a variant that is not there.
    """
    common: list[str] = []
    own: dict[str, list[str]] = {}
    for given in overrides:
        label, colon, rest = given.partition(":")
        if colon and not label.startswith("fixer."):
            own.setdefault(label, []).append(rest)
        else:
            common.append(given)
    variants: dict[str, Variant] = {}
    for part in (p.strip() for p in text.split(",") if p.strip()):
        label, equals, named = part.partition("=")
        fixer = named if equals else label
        if label in variants or label == TRUTH or "/" in label:
            found = f"label {label!r} is taken, or no name of a folder"
            raise InputError(DOING, f"--fixer {text}", found, "write LABEL=NAME with labels of your own")
        if fixer == RAW:
            variants[label] = Variant(label)
            continue
        name, settings = bundle_fixer(fixer) if fixer.endswith(".safetensors") else (fixer, ())
        variants[label] = Variant(label, resolve("fixer", name, (*settings, *fixer_overrides([*common, *own.pop(label, [])]))))
    if own or not variants:
        raise InputError(
            DOING, f"--set {next(iter(own), '')}", "no fixer of this label", f"the variants are {', '.join(variants) or 'none'}"
        )
    return tuple(variants.values())


def unit_of(variant: Variant) -> dict[str, Any] | None:
    """Return what a fixer makes at a time and what that costs; None for the render, and where a fixer does not say."""
    unit = getattr(variant.spec and variant.spec.settings, "unit", None)
    return unit and {**asdict(unit), "calls_per_frame": unit.calls_per_frame}


def evenly(sequences: Sequence[PairSequence], count: int | None) -> list[PairSequence]:
    """Return at most ``count`` sequences, evenly chosen."""
    if count is None or count >= len(sequences):
        return list(sequences)
    return [sequences[i] for i in np.linspace(0, len(sequences) - 1, count).round().astype(int)]


def identity(name: str, folder: Path | None) -> str:
    """Return what identifies the weights of a perceptual distance: the file's digest, or LPIPS's published ones, checked on loading."""
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
    complete = work.judging is None or work.features_file.is_file()
    if work.row_file.is_file() and complete and all(work.picture_file(i).is_file() for i in at):
        stored = read_json(work.row_file)
        if stored["key"] == key:
            return dict(stored["row"])
    torch.set_num_threads(work.threads)
    cv2.setNumThreads(work.threads)
    spec = work.variant.spec
    fixer = None
    if spec is not None:
        scene = str(sequence.info.get("scene_id", sequence.name))
        fixer = build(spec, scene_id=scene, seed=work.seed, device=work.device, threads=work.threads)
    result = run_variant(clip, work.variant, fixer)
    for i in at:
        _write_png(work.picture_file(i), result.video[i])
    row = measure(clip, work.variant, result, work.seed, {name: _network(name, work.weights) for name, _ in work.networks})
    if work.judging is not None:
        truth = None if work.variant.label == TRUTH else np.array(clip.truth)
        camera = camera_of(sequence, work.judging.scenes)
        values, features = judge_clip(sequence.name, work.variant.label, result.video, truth, camera, work.judging)
        row["values"] |= values
        with atomic_file(work.features_file) as partial, partial.open("wb") as file:
            np.savez(file, **cast("dict[str, Any]", features))
    write_json(work.row_file, {"key": key, "row": row})
    return row


def quality_clip(sequence: PairSequence, given: Given = "render") -> QualityClip:
    """Return a sequence of pairs as a clip to measure on, its render replaced as ``--input`` says."""
    clip = sequence.clip
    facts = {**sequence.info, CONTENT: sequence.content}  # a sequence written again has another digest
    if given == "render":
        return QualityClip(sequence.name, facts, clip.rgb_input, clip.rgb_gt, clip.opacity, clip.sdmap, clip.t_us)
    render, opacity = clip.rgb_gt, np.full_like(clip.opacity, 255)
    if given == "lost-resolution":
        render, opacity = lose_resolution(clip.rgb_gt, sequence.name)
    return QualityClip(sequence.name, {**facts, "input": given}, render, clip.rgb_gt, opacity, clip.sdmap, clip.t_us)


def lose_resolution(video: U8, name: str) -> tuple[U8, U8]:
    """Return a video ``(T, H, W, 3)`` that has lost resolution, and its opacity ``(T, H, W)``; the damage is keyed by the clip's name."""
    lost = draw_lost_resolution(stream(name, 0, "lost-resolution"), *video.shape[1:3])
    frames = lost.apply(np.moveaxis(video, -1, 1).astype(np.float32) / np.float32(127.5) - 1)
    damaged = np.clip(np.rint((frames + 1) * np.float32(127.5)), 0, 255).astype(np.uint8)
    return np.moveaxis(damaged, 1, -1), np.broadcast_to(np.rint(lost.opacity * 255).astype(np.uint8), video.shape[:3])


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
        columns = {work.variant.label: [_picture(work.picture_file(i)) for i in at] for work in works}
        _write_png(out / "sheets" / f"{folder.name}.png", sheet(columns, [f"frame {i}" for i in at]))


def _write_png(path: Path, rgb: U8) -> None:
    done, png = cv2.imencode(".png", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
    assert done
    write_bytes(path, png.tobytes())


def _picture(path: Path) -> Any:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        raise InputError(DOING, str(path), "no readable image", "remove the clip's row and start the command again")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


@cache
def _network(name: str, folder: Path | None) -> ImageDistance:
    return load_distance(name, weights_folder(folder))
