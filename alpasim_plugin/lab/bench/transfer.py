"""The transfer beyond driving: arms as they are and fine-tuned, on held-out scenes that nobody
drives through and on photographs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.lab.bench.judged import Judging, set_metrics, vectors
from alpasim_plugin.lab.bench.quality import RAW, Variant
from alpasim_plugin.lab.bench.quality_run import QualityRun, Work, evenly, features_of, row_of
from alpasim_plugin.lab.paper.measured import Measured, from_rows
from alpasim_plugin.lab.paper.transfer import (
    COMPARED,
    PHOTOGRAPHS,
    TRANSFER,
    ZERO_SHOT,
    clip_values,
)
from alpasim_plugin.lab.training.pair_store import PairDataset
from alpasim_plugin.lab.video_metrics.summary import TRUTH

SPLIT = "test"
MOST_FRAMES = 100_000  # clips are measured whole
SHIPPED = (RAW, "onefixer", "onefixer-dit-tiny")
Told = Callable[[str, int, int, Work, Mapping[str, Any]], None]


@dataclass(frozen=True)
class TransferData:
    """What the transfer is measured on.

    Args:
        pairs: Folder that `simrun train transfer` wrote; its split ``test`` is measured.
        arms: Folder with ``NAME/fixer.safetensors`` of the arms that were fine-tuned on its split
            ``train``; None: none was.
        photographs: Folder that `simrun train photographs` wrote; None: no photographs are
            measured.
        clips: At most so many clips of each, evenly chosen.
        frames: First frames of a clip; None: all.
    """

    pairs: Path
    arms: Path | None = None
    photographs: Path | None = None
    clips: int | None = None
    frames: int | None = None


def measure_transfer(
    data: TransferData,
    untuned: Sequence[Variant],
    tuned: Sequence[Variant],
    out: Path,
    seed: int,
    jobs: int,
    told: Told,
) -> dict[str, Measured]:
    """Measure the arms of the paper's table and ours, each as it is and fine-tuned.

    Args:
        data: Clips.
        untuned: Render, shipped fixers and arms trained on driving; those that the table lacks are
            left out.
        tuned: The same arms after fine-tuning; they keep their plain names, as in the paper.
        out: Folder of the results, as of every protocol.
        seed: Of noise and swaps.
        jobs: Clips at a time.
        told: See `compare_arms`.

    Returns:
        PROTOCOL -> what was measured: ``transfer``, and ``transfer-photographs`` if there are any.

    Raises:
        InputError: No clip to measure.
    """
    arms = [
        *(arm for arm in untuned if arm.label in SHIPPED),
        *(replace(arm, label=arm.label + ZERO_SHOT) for arm in untuned if arm.label in COMPARED),
        *(arm for arm in tuned if arm.label in COMPARED),
    ]
    # Judges without seeds: nobody is asked for lanes or vehicles, features of motion alone are
    # kept.
    sources = {TRANSFER: data.pairs} | (
        {} if data.photographs is None else {PHOTOGRAPHS: data.photographs}
    )
    found = {}
    for name, folder in sources.items():
        sequences = evenly(PairDataset(folder, SPLIT).sequences, data.clips)
        run = QualityRun(
            sequences,
            tuple(arms),
            out / name,
            frames=data.frames or MOST_FRAMES,
            seed=seed,
            jobs=jobs,
            judging=Judging(()),
        )
        found[name] = _measured(name, run, told)
    return found


def _measured(name: str, run: QualityRun, told: Told) -> Measured:
    works = run.works()
    for i, (work, row) in enumerate(run.finished(works), start=1):
        told(name, i, len(works), work, row)
    counted = {s.name: s.info.get("held_out") for s in run.sequences}
    values = from_rows([row_of(work) for work in works])
    features: dict[str, dict[str, dict[str, Any]]] = {}
    for work in works:
        row = row_of(work)
        arm = work.variant.label
        clip = work.folder.name
        series = {metric: np.asarray(found) for metric, found in row["series"].items()}
        values[arm][clip] |= clip_values(series, int(row["frames"]), counted[clip])
        kinds = features_of(work)
        found = {metric: vectors(kinds, key, whole) for metric, key, whole in set_metrics([kinds])}
        features.setdefault(arm, {})[clip] = {metric: x for metric, x in found.items() if len(x)}
    return Measured(values, features, TRUTH, run.seed)
