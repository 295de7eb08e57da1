"""Choose between trainings of one arm at several learning rates: the lowest `perceptual-syn` on the
cycle renders of split ``val``.

PSNR stands beside it, for the distance is also a loss of most arms. The candidates are measured as
`simrun bench quality` measures.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from alpasim_plugin.core.atomic import disk_error, temporary_path, write_bytes, write_json
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.parts import resolve
from alpasim_plugin.core.reading import read_json_object
from alpasim_plugin.fixers.bundle import bundle_fixer
from alpasim_plugin.lab.bench.quality import Variant
from alpasim_plugin.lab.bench.quality_run import QualityRun, evenly, row_of
from alpasim_plugin.lab.training.fixer_run import BUNDLE_FILE
from alpasim_plugin.lab.training.pair_store import PairDataset, PairSequence
from alpasim_plugin.lab.training.snapshots import SNAPSHOTS
from alpasim_plugin.lab.training.trainer import LOG_FILE, STATE_FILE
from alpasim_plugin.lab.video_metrics.perceptual_net import NAME as PERCEPTUAL

DOING = "choosing a learning rate"
SPLIT = "val"
PSNR = "psnr_db"


@dataclass(frozen=True)
class Score:
    """Means over clips."""

    perceptual: float
    psnr_db: float

    def __str__(self) -> str:
        return f"{PERCEPTUAL} {self.perceptual:.4f}, {self.psnr_db:.2f} dB"


@dataclass(frozen=True)
class Choice:
    """The learning rate of an arm.

    Args:
        rate: The best.
        scores: Of all candidates, by rate.
        clips: That they were measured on.
    """

    rate: float
    scores: Mapping[float, Score]
    clips: tuple[str, ...]

    def facts(self) -> dict[str, object]:
        """Return it for a card."""
        scores = {
            f"{rate:g}": {PERCEPTUAL: score.perceptual, PSNR: score.psnr_db}
            for rate, score in self.scores.items()
        }
        how = f"lowest {PERCEPTUAL} on cycle renders of split {SPLIT}"
        return {"rate": self.rate, "by": how, "scores": scores, "clips": list(self.clips)}


def choose(
    candidates: Mapping[float, Path], pairs: Path, out: Path, clips: int | None, seed: int
) -> Choice:
    """Measure an arm's candidates and return the best.

    Args:
        candidates: Folders of the trained arm by learning rate.
        pairs: Folder of pairs with a split ``val``.
        out: Folder of the rows; those that are up to date are not measured again.
        clips: At most so many, evenly chosen; None: all.
        seed: Of the fixers' noise.

    Raises:
        InputError: No cycle render in the split.
    """
    sequences = cycle_renders(pairs, clips)
    labels = {rate: f"{rate:g}" for rate in candidates}
    variants = []
    for rate, folder in candidates.items():
        name, settings = bundle_fixer(folder / BUNDLE_FILE)
        variants.append(Variant(labels[rate], resolve("fixer", name, settings)))
    run = QualityRun(sequences, variants, out, seed=seed)
    rows = [
        row_of(work)
        for work, _ in run.finished([work for work in run.works() if work.variant.spec is not None])
    ]

    def mean(label: str, metric: str) -> float:
        return float(np.mean([row["values"][metric] for row in rows if row["arm"] == label]))

    scores = {
        rate: Score(mean(label, PERCEPTUAL), mean(label, PSNR)) for rate, label in labels.items()
    }
    return Choice(
        min(scores, key=lambda rate: scores[rate].perceptual),
        scores,
        tuple(sequence.name for sequence in sequences),
    )


def cycle_renders(pairs: Path, clips: int | None) -> list[PairSequence]:
    """Return cycle renders of split ``val``.

    Raises:
        InputError: There is none.
    """
    found = [
        s for s in PairDataset(pairs, SPLIT).sequences if s.info["degradation"]["kind"] == "cycle"
    ]
    if not found:
        raise InputError(
            f"{pairs}, split {SPLIT}: no cycle render",
            "make such pairs: 'simrun train pairs SCENES --split val'",
        )
    return evenly(found, clips)


def take(candidate: Path, arm: Path, choice: Choice) -> None:
    """Make the best candidate the arm: its bundle and snapshots by hard links, its log, and its
    card with the choice.

    Raises:
        InputError: The arm's folder was trained in itself.
    """
    if (arm / STATE_FILE).exists():
        raise InputError(
            f"{arm}: an arm that was trained without a sweep",
            "choose another folder, or remove that of the arm",
        )
    for path in [candidate / BUNDLE_FILE, *sorted((candidate / SNAPSHOTS).glob("*.safetensors"))]:
        _link(path, arm / path.relative_to(candidate))
    write_bytes(arm / LOG_FILE, (candidate / LOG_FILE).read_bytes())
    write_card(candidate, arm, choice)


def write_card(candidate: Path, arm: Path, choice: Choice) -> None:
    """Write the card of a candidate as that of the arm, with the choice."""
    name = Path(BUNDLE_FILE).with_suffix(".card.json")
    write_json(arm / name, {**read_json_object(candidate / name), "sweep": choice.facts()})


def _link(path: Path, to: Path) -> None:
    if to.exists() and to.samefile(path):
        return
    partial = temporary_path(to)
    try:
        to.parent.mkdir(parents=True, exist_ok=True)
        try:
            os.link(path, partial)
        except OSError:  # a file system without hard links, or a full one, which the copy reports
            shutil.copyfile(path, partial)
        partial.replace(to)
    except OSError as error:
        raise disk_error(to, error) from error
    finally:
        partial.unlink(missing_ok=True)
