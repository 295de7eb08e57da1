"""The paper's comparison on our clips: which arms there are, what each protocol measures, and what
becomes of it.

A protocol is a folder below the output with the rows of its clips. What is up to date there is not
measured again, so the same command resumes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.block_fixers.settings import OneFixerSettings
from alpasim_plugin.core.atomic import write_json
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.parts import resolve
from alpasim_plugin.core.reading import read_json_object
from alpasim_plugin.fixers.bundle import bundle_fixer
from alpasim_plugin.lab.bench.appearance import JUDGE_SEEDS, AppearanceRun, measure_appearance
from alpasim_plugin.lab.bench.cost import cost_clips, cost_curves
from alpasim_plugin.lab.bench.drives import read_drives
from alpasim_plugin.lab.bench.judged import Judging, set_metrics, vectors
from alpasim_plugin.lab.bench.map_error import CONFIGURATIONS, MapShift
from alpasim_plugin.lab.bench.quality import RAW, Variant
from alpasim_plugin.lab.bench.quality_run import (
    QualityRun,
    Work,
    evenly,
    features_of,
    film_of,
    row_of,
    unit_of,
)
from alpasim_plugin.lab.bench.regime import measure_regime
from alpasim_plugin.lab.bench.trained_arms import STEPS, TRANSFER_STEPS, trained_arms, within_budget
from alpasim_plugin.lab.bench.training_memory import (
    MemoryCell,
    measure_memory,
    memory_table,
    monotone,
)
from alpasim_plugin.lab.bench.transfer import TransferData, measure_transfer
from alpasim_plugin.lab.paper.appearance import OURS as APPEARANCE
from alpasim_plugin.lab.paper.claims import WINDOWS
from alpasim_plugin.lab.paper.cost import Cost, contested
from alpasim_plugin.lab.paper.document import EqualTime, Findings
from alpasim_plugin.lab.paper.measured import Measured, from_rows
from alpasim_plugin.lab.paper.page import ShownClip
from alpasim_plugin.lab.paper.position import windows
from alpasim_plugin.lab.paper.regime import TRAINED_ON_CLEAN, TRAINED_ON_OWN, as_measured
from alpasim_plugin.lab.paper.wrong_map import Shift
from alpasim_plugin.lab.training.fixer_run import BUNDLE_FILE
from alpasim_plugin.lab.training.pair_store import PairDataset, PairSequence
from alpasim_plugin.lab.video_metrics.summary import TRUTH
from alpasim_plugin.runs.provenance import hardware, versions

DOING = "making the paper's comparison"
OURS = "V9"  # the paper's own method on the backbone that the arms share
SHIPPED = ("onefixer", "onefixer-dit-tiny")  # rows of their own in every table
ABLATION = ("V1", "V2", "V3", "V3b", "V4", "V5", "V6", "V7", "V8", "V9")
UNCONDITIONED = ("V5", "artifixer")  # trained with a black map; without a map's input
PAPER_LENGTH = {"cycle": 198, "under-trained": 900, "map-error": 198, "appearance": 198}
SHIFTS = {shift.label: shift for shift in CONFIGURATIONS}
MEMORY = """Peak memory of forward and backward of one training sample above that of the network and its inputs, and the time of the second
of two runs: 256x144, one clip, the rollout on own history with the perceptual term on its last k latents, without decoding.
"""
MEMORY_LATENTS, MEMORY_HORIZONS = (
    (8, 12, 16, 24),
    (1, 4, 8, 12, 16),
)  # the paper's figure has 16 and 24 latents
TWICE = ("cycle", "under-trained")  # protocols that are measured for both budgets of training
CURVES = ("psnr_db", "perceptual-syn", "warp_l1")
Told = Callable[[str, int, int, Work, Mapping[str, Any]], None]


@dataclass(frozen=True)
class PaperRun:
    """What is compared, on what, how.

    Args:
        pairs: Folder of pairs; the sequences of ``split`` with a cycle render are the protocol
            ``cycle``, the others ``under-trained``.
        scenes: Folder of their scenes.
        arms: Folder with ``NAME/fixer.safetensors`` for every trained arm.
        out: Folder of the results.
        split: Of the pairs.
        long: Folder of pairs for ``under-trained`` instead, of longer sequences; its cycle renders
            are left out.
        drives: Finished run folders of the closed loop; without any that table is not made.
        clips: At most so many clips of a protocol, evenly chosen.
        frames: First frames of a clip; None: as many as in the paper.
        judging: Which judges are asked.
        jobs: Clips at a time.
        seed: Of noise and swaps.
        filmed: Clips on the page.
        map_clips: Clips of the protocol ``map-error``.
        transfer: What the protocol ``transfer`` is measured on; None: it is not.
        equal_time: Folder like ``arms`` of the arms trained with equal core-minutes; None: that
            budget is not measured.
        other_seeds: Folders like ``arms`` of the same arms trained with other seeds, for the
            protocols ``cost`` and ``regime``.
    """

    pairs: Path
    scenes: Path | None
    arms: Path
    out: Path
    split: str = "test-known"
    long: Path | None = None
    drives: tuple[Path, ...] = ()
    clips: int | None = None
    frames: int | None = None
    judging: Judging | None = None
    jobs: int = 1
    seed: int = 0
    filmed: int = 2
    map_clips: int = 8
    protocols: tuple[str, ...] = (
        "cycle",
        "under-trained",
        "map-error",
        "closed-loop",
        "memory",
        "transfer",
        "appearance",
    )
    transfer: TransferData | None = None
    equal_time: Path | None = None
    other_seeds: tuple[Path, ...] = ()


def arms_in(
    folder: Path, option: str = "--arms", steps_of: Mapping[str, tuple[int | None, ...]] = STEPS
) -> tuple[Variant, ...]:
    """Return the arms that were trained: a variant for each number of steps that the paper reports,
    in alphabetical order.

    Args:
        folder: With ``NAME/fixer.safetensors``.
        option: That named it, for errors.
        steps_of: ARM -> its numbers of steps; None: the bundle's own, under the arm's plain name.

    Raises:
        InputError: No folder, or a file that is no bundle.
    """
    if not folder.is_dir():
        raise InputError(
            f"{option} {folder}: no such folder",
            "train arms into it: 'simrun train arms PAIRS --vae VAE --out ARMS'",
        )
    found: list[Variant] = []
    for path in sorted(folder.glob(f"*/{BUNDLE_FILE}")):
        name, settings = bundle_fixer(path)
        arm = path.parent.name
        for steps in steps_of.get(arm, (None,)):
            if steps is None:
                found.append(Variant(arm, resolve("fixer", name, settings)))
            else:  # the bundle's own steps would come after those of the name
                others = tuple(
                    setting for setting in settings if setting.partition("=")[0] != "steps"
                )
                found.append(Variant(f"{arm}@{steps}", resolve("fixer", f"{name}@{steps}", others)))
    return tuple(found)


def compare_arms(run: PaperRun, told: Told, told_clip: Callable[[int, int, str], None]) -> Findings:
    """Measure every arm under every protocol that is asked for.

    Args:
        run: What is compared, on what, how.
        told: Called after every clip of an arm.
        told_clip: Called after every clip of the appearance experiment and of the regime map: its
            number, their count, its name.

    Raises:
        InputError: No clip for a protocol.
    """
    out = Findings()
    arms = (
        Variant(RAW),
        *(Variant(name, resolve("fixer", name, ())) for name in SHIPPED),
        *arms_in(run.arms),
    )
    plain = tuple(arm for arm in arms if arm.label == OURS)
    arms = tuple(arm for arm in arms if arm.label != APPEARANCE)  # it has a protocol of its own
    out.units = {arm.label: unit_of(arm) for arm in arms}
    out.training = trained_arms(run.arms)
    again = (
        () if run.equal_time is None else arms_in(run.equal_time, "--equal-time")
    )  # before hours of measuring
    driven = read_drives(run.drives, run.arms) if "closed-loop" in run.protocols else {}
    for name in TWICE:
        if name in run.protocols:
            sequences = _sequences(run, name)
            works = _open_loop(
                run,
                name,
                sequences,
                arms,
                frozenset(s.name for s in evenly(sequences, run.filmed)),
                told,
                out,
            )
            out.shown = shown_clips(works) if name == "cycle" else out.shown
    if (found := out.measured.get("under-trained")) is not None:
        frames = min(int(row["frames"]) for row in out.rows["under-trained"])
        out.measured |= dict(zip(WINDOWS, windows(found, frames), strict=False))
    if "map-error" in run.protocols:
        shown = _wrong_maps(arms, run.arms)
        _open_loop(
            run,
            "map-error",
            evenly(_sequences(run, "cycle"), run.map_clips),
            shown,
            frozenset(),
            told,
            out,
        )
        out.shifted = shifted(out.measured["map-error"])
        out.measured["map-error"] = grouped(out.shifted[0])
    out.measured |= driven
    if "memory" in run.protocols:
        cells = training_memory(run.out / "memory.json")
        rises = (
            "It rises with both, as in the paper"
            if monotone(cells)
            else "It does not rise with both everywhere; in the paper it does"
        )
        out.memory = f"{MEMORY}\n{memory_table(cells)}\n\n{rises} (within 10 %, the allocator's).\n"
    if "cost" in run.protocols:
        curves, snapshots = cost_curves((run.arms, *run.other_seeds))
        clips, frames, about = cost_clips(run.pairs, run.clips, run.frames)
        _open_loop(replace(run, frames=frames), "cost", clips, snapshots, frozenset(), told, out)
        out.cost = Cost(tuple(curves), out.measured["cost"], about)
        out.measured["cost"] = contested(out.cost)
    if "regime" in run.protocols:
        sequences = evenly(PairDataset(run.pairs, run.split).sequences, run.clips)
        out.regime = measure_regime(sequences, _by_history(run), told_clip)
        out.measured["regime"] = as_measured(out.regime)
    if "transfer" in run.protocols and run.transfer is not None:
        tuned = (
            ()
            if run.transfer.arms is None
            else arms_in(run.transfer.arms, "--transfer-arms", TRANSFER_STEPS)
        )
        out.measured |= measure_transfer(
            run.transfer, arms, tuned, run.out, run.seed, run.jobs, told
        )
    if run.equal_time is not None:
        out.equal_time = _equal_time(run, run.equal_time, again, told, out)
    bundle = run.arms / APPEARANCE / BUNDLE_FILE
    if "appearance" in run.protocols and bundle.is_file():
        out.measured |= measure_appearance(_appearance(run, bundle, plain), told_clip)
    return out


def _by_history(run: PaperRun) -> tuple[Variant, ...]:
    """Return the shipped generator, and those that were trained on their own history and on clean
    frames, where both are there.
    """
    found = [Variant(SHIPPED[0], resolve("fixer", SHIPPED[0], ()))]
    for i, folder in enumerate((run.arms, *run.other_seeds)):
        arms = [arm for arm in arms_in(folder) if arm.label in (TRAINED_ON_OWN, TRAINED_ON_CLEAN)]
        if len(arms) == 1:
            raise InputError(
                f"{folder}, protocol regime: {arms[0].label} alone",
                f"train {TRAINED_ON_OWN} and {TRAINED_ON_CLEAN} ('simrun train per-frame --variant')",
            )
        found += [replace(arm, label=f"{arm.label}, seed {i}") if i else arm for arm in arms]
    return tuple(found)


def _equal_time(
    run: PaperRun, folder: Path, found: Sequence[Variant], told: Told, out: Findings
) -> EqualTime:
    """Measure the arms of equal core-minutes on the clips of the others; the others' values are
    those measured there.
    """
    arms, second = tuple(arm for arm in found if arm.label != APPEARANCE), Findings()
    taken = within_budget([one for one in out.training if one.arm != APPEARANCE], folder)
    same = {RAW, *SHIPPED, *(one.arm for one in taken)}
    merged: dict[str, Measured] = {}
    for name in (name for name in TWICE if name in run.protocols):
        _open_loop(
            replace(run, out=run.out / "equal-time"),
            name,
            _sequences(run, name),
            arms,
            frozenset(),
            told,
            second,
        )
        mine, others = second.measured[name], out.measured[name]
        shared = [arm for arm in others.values if arm.partition("@")[0] in same]
        merged[name] = Measured(
            {**{arm: others.values[arm] for arm in shared}, **mine.values},
            {
                **{arm: others.features[arm] for arm in shared if arm in others.features},
                **mine.features,
            },
            mine.reference,
            mine.seed,
        )
    return EqualTime(merged, (*trained_arms(folder), *taken), tuple(one.arm for one in taken))


def shifted(measured: Measured) -> tuple[Measured, dict[str, Shift]]:
    """Return measurements with an arm for each configuration of a wrong map, and how far each is
    off.
    """
    return measured, {arm: shift for arm in measured.arms if (shift := _shift_of(arm)) is not None}


def _shift_of(arm: str) -> Shift | None:
    """Return how far the map of an arm of ``map-error`` is off; None for arms beside the
    configurations.
    """
    shift = SHIFTS.get(arm.rpartition(" ")[2])
    return None if shift is None else Shift(abs(shift.lanes_left_m), shift.boxes_m)


def training_memory(path: Path) -> list[MemoryCell]:
    """Measure the peak memory of a training sample on our backbone over clip length and horizon;
    ``path`` keeps it while its facts hold.
    """
    settings = resolve("fixer", "onefixer-dit-tiny", ()).settings
    assert isinstance(settings, OneFixerSettings)
    facts = {
        "dit": settings.dit.model_dump(),
        "window": settings.window,
        "latents": list(MEMORY_LATENTS),
        "horizons": list(MEMORY_HORIZONS),
        "hardware": hardware(),
        "versions": versions(),
    }
    if path.is_file():
        kept = read_json_object(path, do_this="remove it, and the memory is measured again")
        if kept.get("facts") == facts:
            return [MemoryCell(**cell) for cell in kept["cells"]]
    cells = measure_memory(settings, MEMORY_LATENTS, MEMORY_HORIZONS, clips=1, rows=18, columns=32)
    write_json(path, {"facts": facts, "cells": [cell._asdict() for cell in cells]})
    return cells


def _appearance(run: PaperRun, bundle: Path, plain: tuple[Variant, ...]) -> AppearanceRun:
    """Return how the appearance experiment is measured: on cycle renders, with the judges of both
    seeds where none are named.
    """
    sequences = _sequences(run, "cycle")
    judging = run.judging or Judging(JUDGE_SEEDS, run.scenes)
    shown = frozenset(s.name for s in evenly(sequences, run.filmed))
    frames = run.frames or PAPER_LENGTH["appearance"]
    return AppearanceRun(
        sequences,
        bundle,
        plain,
        run.scenes,
        run.out / "appearance",
        judging,
        frames,
        run.seed,
        run.jobs,
        shown,
    )


def _sequences(run: PaperRun, protocol: str) -> list[PairSequence]:
    cycle = protocol == "cycle"
    folder = run.long if protocol == "under-trained" and run.long is not None else run.pairs
    everything = PairDataset(folder, run.split).sequences
    chosen = [s for s in everything if (s.info["degradation"]["kind"] == "cycle") == cycle]
    if not chosen:
        raise InputError(
            f"{folder}, split {run.split}: no clip of the protocol {protocol}",
            "make such pairs, or leave it out with --only",
        )
    return evenly(chosen, run.clips)


def _open_loop(
    run: PaperRun,
    name: str,
    sequences: Sequence[PairSequence],
    arms: Sequence[Variant],
    filmed: frozenset[str],
    told: Told,
    out: Findings,
) -> list[Work]:
    """Measure arms under a protocol and add it to what was found; return the works."""
    measuring = QualityRun(
        sequences,
        arms,
        run.out / name,
        frames=run.frames or PAPER_LENGTH[name],
        seed=run.seed,
        jobs=run.jobs,
        filmed=filmed,
        judging=run.judging,
        scenes=run.scenes,
    )
    works = measuring.works()
    for i, (work, row) in enumerate(measuring.finished(works), start=1):
        told(name, i, len(works), work, row)
    out.rows[name] = [row_of(work) for work in works]
    out.measured[name] = Measured(
        from_rows(out.rows[name]), _features(works) if run.judging else None, TRUTH, run.seed
    )
    return works


def _features(works: Iterable[Work]) -> dict[str, dict[str, dict[str, Any]]]:
    stored = {(work.variant.label, work.folder.name): features_of(work) for work in works}
    metrics = set_metrics(list(stored.values()))
    out: dict[str, dict[str, dict[str, Any]]] = {}
    for (arm, clip), kinds in stored.items():
        out.setdefault(arm, {})[clip] = {
            metric: vectors(kinds, key, whole) for metric, key, whole in metrics
        }
    return out


def _wrong_maps(arms: Sequence[Variant], folder: Path) -> tuple[Variant, ...]:
    """Return our method under all wrong maps, and the lines to stay above: itself and V5 with a
    black map, and an arm without a map.
    """
    by_name = {arm.label: arm for arm in arms}
    ours = by_name.get(OURS) or by_name[SHIPPED[0]]
    wrong = (
        replace(ours, label=f"{ours.label} {shift.label}", map_shift=shift)
        for shift in CONFIGURATIONS
    )
    lines = (by_name[name] for name in UNCONDITIONED if name in by_name)
    return (
        Variant(RAW),
        *wrong,
        *([black_map(folder / OURS / BUNDLE_FILE)] if OURS in by_name else []),
        *lines,
    )


def black_map(bundle: Path) -> Variant:
    """Return an arm that is shown a black semantic map, which is what the paper calls
    unconditioned.
    """
    name, settings = bundle_fixer(bundle)
    others = tuple(
        setting for setting in settings if setting.partition("=")[0] not in ("uses_map", "no_map")
    )
    return Variant(
        f"{bundle.parent.name}, black map",
        resolve("fixer", name, (*others, "uses_map=false", "no_map=black")),
    )


def grouped(measured: Measured) -> Measured:
    """Average the configurations of a wrong map by how far lanes are aside, and by how far boxes
    are, clip by clip.

    Returns:
        Arms ``NAME, lanes 0.25 m aside`` and ``NAME, boxes 0.35 m aside`` beside those without a
        shift.
    """
    values: dict[str, dict[str, dict[str, list[float]]]] = {}
    plain: dict[str, Mapping[str, Mapping[str, float]]] = {}
    for arm, clips in measured.values.items():
        name, _, label = arm.rpartition(" ")
        if label not in SHIFTS:
            plain[arm] = clips
            continue
        for group in _groups(name, SHIFTS[label]):
            for clip, found in clips.items():
                for metric, value in found.items():
                    values.setdefault(group, {}).setdefault(clip, {}).setdefault(metric, []).append(
                        value
                    )
    means = {
        group: {
            clip: {metric: float(np.mean(many)) for metric, many in found.items()}
            for clip, found in clips.items()
        }
        for group, clips in values.items()
    }
    return Measured(
        {**plain, **dict(sorted(means.items()))}, None, measured.reference, measured.seed
    )


def _groups(name: str, shift: MapShift) -> tuple[str, str]:
    return (
        f"{name}, lanes {abs(shift.lanes_left_m):.2f} m aside",
        f"{name}, boxes {shift.boxes_m:.2f} m aside",
    )


def shown_clips(works: Sequence[Work]) -> list[ShownClip]:
    """Return the filmed clips with the curves of all arms, the clean frames last."""
    clips: dict[str, list[Work]] = {}
    for work in works:
        if work.filmed:
            clips.setdefault(work.folder.name, []).append(work)
    shown = []
    for name, mine in clips.items():
        rows = {work.variant.label: row_of(work) for work in mine}
        curves = {
            m: {arm: row["series"][m] for arm, row in rows.items() if m in row["series"]}
            for m in CURVES
        }
        shown.append(ShownClip(name, {work.variant.label: film_of(work) for work in mine}, curves))
    return shown
