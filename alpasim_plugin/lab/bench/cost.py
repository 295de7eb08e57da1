"""Quality against core-minutes of training: snapshots of our method and of the distilled arms, with
the stages that they need.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from alpasim_plugin.block_fixers.settings import OneFixerSettings
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.parts import resolve
from alpasim_plugin.core.reading import parsing, read_json_object
from alpasim_plugin.fixers.bundle import bundle_fixer
from alpasim_plugin.lab.bench.quality import Variant
from alpasim_plugin.lab.bench.quality_run import evenly
from alpasim_plugin.lab.paper.claims import DISTILLED, OURS
from alpasim_plugin.lab.paper.cost import Curve, Point
from alpasim_plugin.lab.training.arms.run import arms_of
from alpasim_plugin.lab.training.fixer_run import BUNDLE_FILE
from alpasim_plugin.lab.training.pair_store import PairDataset, PairSequence
from alpasim_plugin.lab.training.snapshots import core_seconds, snapshots_of

DOING = "measuring quality against training time"
SPLIT = "val"
CLIPS = 12  # by an exact test of 8 no metric of whole sets could refute a claim of nine comparisons
FRAMES = 93  # the paper's clips are the length of its training clips
ARMS = (OURS, *DISTILLED)


def cost_curves(folders: Sequence[Path]) -> tuple[list[Curve], list[Variant]]:
    """Return the curve of each arm that was trained, and the snapshots to measure, each once.

    The snapshots of a stage that is no causal generator of short blocks, such as a teacher, are
    left out; its time counts.

    Args:
        folders: Of trained arms, each with a seed of its own; claims are judged by the first.

    Raises:
        InputError: A folder without any of the arms, an arm twice with one seed, or one without
            snapshots or processor times.
    """
    curves, variants = list[Curve](), dict[str, Variant]()
    for arms in folders:
        trained = arms_of(arms)
        chosen = [arm for arm in ARMS if arm in trained]
        if not chosen:
            raise InputError(
                f"{arms}: none of {', '.join(ARMS)}",
                "train them: 'simrun train arms --only V9,self-forcing,one-forcing'",
            )
        for arm in chosen:
            seed = _seed(arms / arm)
            if any((curve.arm, curve.seed) == (arm, seed) for curve in curves):
                raise InputError(
                    f"{arms}: {arm} of seed {seed}, which another folder has too",
                    "train it with another --seed, or name one of the folders",
                )
            curve, snapshots = _curve(
                arms, arm, trained[arm], seed, "" if arms == folders[0] else f", seed {seed}"
            )
            curves.append(curve)
            variants |= snapshots
    return curves, list(variants.values())


def _seed(training: Path) -> int:
    path, do = (
        (training / BUNDLE_FILE).with_suffix(".card.json"),
        "train the arm again with 'simrun train arms'",
    )
    card = read_json_object(path, do_this=do)
    with parsing(path, do, "no card of a training"):
        return int(card["training"]["batches"]["seed"])


def _curve(
    arms: Path, arm: str, stages: Sequence[str], seed: int, suffix: str
) -> tuple[Curve, dict[str, Variant]]:
    points = list[Point]()
    variants = dict[str, Variant]()
    ends = dict[str, float]()
    before_s = 0.0
    for stage in stages:
        for label, variant, step, core_s in _snapshots(arms, stage, suffix):
            points.append(Point(stage, step, (before_s + core_s) / 60, label))
            variants[label] = variant
        before_s += core_seconds(arms / stage)[-1]
        ends[stage] = before_s / 60
    return Curve(arm, tuple(points), ends, seed), variants


def _snapshots(arms: Path, stage: str, suffix: str) -> Iterator[tuple[str, Variant, int, float]]:
    for snapshot in snapshots_of(arms / stage):
        name, overrides = bundle_fixer(snapshot.path)
        spec = resolve("fixer", name, overrides)
        if isinstance(spec.settings, OneFixerSettings) and spec.settings.history != "finalise":
            return  # a bidirectional network: the clip is one block
        label = f"{stage.replace('/', ' ')} after {snapshot.step}{suffix}"
        yield label, Variant(label, spec), snapshot.step, snapshot.core_s


def cost_clips(
    pairs: Path, clips: int | None, frames: int | None
) -> tuple[list[PairSequence], int, str]:
    """Return the clips of split ``val``, their common number of frames, and what they are in words.

    Raises:
        InputError: Fewer than two cycle renders.
    """
    sequences = [
        s for s in PairDataset(pairs, SPLIT).sequences if s.info["degradation"]["kind"] == "cycle"
    ]
    chosen = evenly(sequences, clips or CLIPS)
    if len(chosen) < 2:
        raise InputError(
            f"{pairs}, split {SPLIT}: {len(chosen)} cycle renders, two are needed",
            "make such pairs: 'simrun train pairs SCENES --split val'",
        )
    shortest = min(len(sequence.clip) for sequence in chosen)
    used = min(frames or FRAMES, shortest)
    why = (
        ""
        if used == (frames or FRAMES)
        else f" (the shortest clip has no more; the paper's have {FRAMES})"
    )
    return chosen, used, f"{len(chosen)} cycle renders of split {SPLIT}, {used} frames each{why}."
