"""Adapt a fixer to one recorded street: some updates on its own photographs, kept only where
photographs that nobody trained on gain.

Training shows the model where photographs were taken that it was fitted to, with the other
photographs as references; they are measured by the photographs that were held out of the fit. New weights
are accepted where the mean gain in PSNR over them is above 0 with 95 % confidence (Student's t over
photographs), for the alternative is to keep what ships.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import read_bytes
from alpasim_plugin.core.files.atomic import write_bytes
from alpasim_plugin.core.image_metrics import psnr_db
from alpasim_plugin.core.parts import build, resolve
from alpasim_plugin.core.types import F64, Scenario
from alpasim_plugin.fixers.pixel_settings import PixelFixerSettings
from alpasim_plugin.lab.bench.quality import Variant, quality_clip, run_variant
from alpasim_plugin.lab.training.bundle_fixer import bundle_fixer
from alpasim_plugin.lab.training.drive_pairs import DRIVE, Shot, write_drive_sequence
from alpasim_plugin.lab.training.pair_store import PairSequence
from alpasim_plugin.lab.training.pixel_rollout import Distance
from alpasim_plugin.lab.training.pixel_run import PixelRun, train_per_frame
from alpasim_plugin.lab.training.pixel_variants import pixel_variant
from alpasim_plugin.lab.training.streams import StreamShares, TrainingStreams
from alpasim_plugin.lab.training.trainer import Schedule

FEWEST = 12  # fitted photographs to train on
ENOUGH = 4  # held-out ones to measure by
SHARE = 0.75  # of the held-out photographs that have to gain
WIDTH_PX = 512  # of the photographs, at most
LR = 2e-4
WARMUP = 5
CROP = (96, 128)
VARIANT = "V9-still"
Report = Callable[[int, Mapping[str, float]], None]


@dataclass(frozen=True)
class Adapted:
    """What an adaptation gave.

    Attributes:
        before, after: PSNR of each held-out photograph, dB.
        gain_db: Mean of the differences.
        n_better: Photographs that gain.
        accepted: Whether the weights were written: the mean gains, and so do `SHARE` of the
            photographs. Neighbours in a drive are alike, so that no interval of other photographs
            follows from them.
    """

    before: tuple[float, ...]
    after: tuple[float, ...]
    gain_db: float
    n_better: int
    accepted: bool


def adapt(
    scenario: Scenario,
    weights: Path,
    out: Path,
    *,
    updates: int,
    distance: tuple[str, Distance] | None,
    seed: int = 0,
    report: Report | None = None,
) -> Adapted:
    """Train on a drive's own photographs and write the weights where held-out photographs gain.

    Args:
        scenario: An imported drive.
        weights: Bundle to begin with.
        out: File for the new bundle; written only where they are accepted.
        updates: Of the training.
        distance: Name and function of the perceptual term.
        seed: Of everything drawn.
        report: Called after every update with its number and the logged values.

    Raises:
        InputError: No imported drive, too few photographs, or weights of another kind.
    """
    with tempfile.TemporaryDirectory(prefix="simrun-adapt-") as scratch:
        root = Path(scratch)
        held_out = _pairs(scenario, root, seed)
        before = _psnr(held_out, weights, seed)
        trained = _trained(root, weights, updates, distance, seed, report)
        after = _psnr(held_out, trained, seed)
        adaptation = compared(before, after)
        if adaptation.accepted:
            write_bytes(out, read_bytes(trained))
    return adaptation


def compared(before: F64, after: F64) -> Adapted:
    """Compare the PSNR of photographs ``(N,)`` before and after."""
    gain = after - before
    mean = float(gain.mean())
    n_better = int(np.sum(gain > 0.0))
    return Adapted(
        tuple(before.tolist()),
        tuple(after.tolist()),
        mean,
        n_better,
        mean > 0.0 and n_better >= SHARE * len(gain),
    )


def _pairs(scenario: Scenario, root: Path, seed: int) -> PairSequence:
    """Write the split ``train`` and return the held-out sequence."""
    camera = next((photograph.name for photograph in scenario.cameras), "")
    taken = sorted(
        (photograph for photograph in scenario.recording if photograph.camera == camera),
        key=lambda photograph: photograph.t_us,
    )
    count = {
        use: sum(photograph.use == use for photograph in taken) for use in ("fitted", "held-out")
    }
    if scenario.model is None or count["fitted"] < FEWEST or count["held-out"] < ENOUGH:
        raise InputError(
            f"{scenario.scene_id}: {count['fitted']} fitted and {count['held-out']} held-out photographs of camera {camera!r}",
            f"give an imported drive (simrun import drive) with at least {FEWEST} and {ENOUGH} of them",
        )
    shots = [Shot.read(photograph, WIDTH_PX) for photograph in taken]
    fitted = [shot for shot in shots if shot.photograph.use == "fitted"]
    held = [shot for shot in shots if shot.photograph.use == "held-out"]
    for split, split_shots in (("train", fitted), ("held_out", held)):
        info: dict[str, Any] = {
            "scene_id": scenario.scene_id,
            "seed": seed,
            "split": split,
            "family": DRIVE,
        }
        write_drive_sequence(
            scenario, split_shots, fitted, root / "pairs" / split / "drive_0", info
        )
    return PairSequence(root / "pairs" / "held_out" / "drive_0")


def _psnr(held_out: PairSequence, weights: Path, seed: int) -> F64:
    """Return the PSNR of each held-out photograph behind the fixer, in order of time, so that it
    has its history.
    """
    name, overrides = bundle_fixer(weights)
    spec = resolve("fixer", name, overrides)
    clip = quality_clip(held_out)
    made = run_variant(
        clip,
        Variant("adapted", spec),
        build(spec, scene_id=clip.name, seed=seed, device="cpu", threads=1),
    )
    return np.array([psnr_db(a, b) for a, b in zip(made.video, clip.truth, strict=True)])


def _trained(
    root: Path,
    weights: Path,
    updates: int,
    distance: tuple[str, Distance] | None,
    seed: int,
    report: Report | None,
) -> Path:
    name, overrides = bundle_fixer(weights)
    settings = resolve("fixer", name, overrides).settings
    if not isinstance(settings, PixelFixerSettings):
        raise InputError(f"{weights}: weights of {name}", "give those of onefixer")
    width, height = PairSequence(root / "pairs" / "train" / "drive_0").size
    crop = min(CROP[0], height), min(CROP[1], width)
    shares = StreamShares(pairs=0.93, identity=0.07, video=0.0, damaged_video=0.0)
    streams = TrainingStreams(
        root / "pairs", seed=seed, batch=4, frames=4, crop=crop, episode=6, shares=shares
    )
    schedule = Schedule(updates, peak_lr=LR, warmup=min(WARMUP, updates), clip=0.5, ema=0.9)
    return train_per_frame(
        PixelRun(settings, streams, pixel_variant(VARIANT), schedule, weights, seed),
        root / "run",
        distance,
        report=report,
    )
