"""Train one stage of the comparison in its folder, with the options that all arms share; time one;
what became of them.

OUT/TRAINING/       `plan` names them
OUT/latents/        of the clips, encoded once for all
OUT/probe.json      processor seconds of an update, where the budget is in minutes
OUT/arms.json       the trainings of every arm, in order
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from alpasim_plugin.block_fixers.networks import load_tiny_vae
from alpasim_plugin.core.atomic import write_json
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.reading import read_json_object
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.lab.training.arms.plan import INITIAL, Plan, Training, initial_name
from alpasim_plugin.lab.training.clip_batches import BatchForm
from alpasim_plugin.lab.training.fixer_run import (
    BUNDLE_FILE,
    FixerRun,
    Report,
    TrainableSettings,
    train_stage,
)
from alpasim_plugin.lab.training.latent_clips import ClipForm, LatentClips
from alpasim_plugin.lab.training.pair_store import PairDataset
from alpasim_plugin.lab.training.recipes.recipe import Recipe
from alpasim_plugin.lab.training.snapshots import core_seconds
from alpasim_plugin.lab.training.trainer import Schedule
from alpasim_plugin.lab.video_metrics.image_distance import distance_for_training

READING, DO = "reading which trainings an arm has", "train the arms with 'simrun train arms'"
PLAN_FILE, PROBE_FILE = "arms.json", "probe.json"
WARM_UP = 2  # updates before those that are timed
DOING = "training the arms"


@dataclass(frozen=True)
class ArmsRun:
    """Options that all arms share.

    Args:
        data: Folder of pairs; its ``train`` split is used.
        vae: Trained autoencoder, or a bundle that holds it.
        out: Folder of the arms.
        form: Clips.
        batches: Clips of a batch.
        schedule: Of a stage of share 1; its updates are the unit U.
        initial: Schedule of the initial networks.
        given: Bundles in the place of initial networks, by their recipes.
        equal_channels: Whether flow matching weights all latent channels alike.
        precision: Of the forward passes: None is float32.
        snapshots: Kept of every stage.
        metric_weights: Folder of LPIPS weights for the perceptual term.
        scenes: Folder of the pairs' scenes, for arms whose targets need depth.
        size: Width and height of the sequences to train on, pixels; None: all are of one size.
    """

    data: Path
    vae: Path
    out: Path
    form: ClipForm
    batches: BatchForm
    schedule: Schedule
    initial: Schedule
    given: Mapping[str, Path] = field(default_factory=dict)
    equal_channels: bool = False
    precision: torch.dtype | None = None
    snapshots: int = 0
    metric_weights: Path | None = None
    scenes: Path | None = None
    size: tuple[int, int] | None = None

    def bundle_of(self, training: str) -> Path:
        """Return the weights of a training, given or made."""
        given = {initial_name(recipe): path for recipe, path in self.given.items()}
        return given.get(training, self.out / training / BUNDLE_FILE)

    def clips(self, encoded: Callable[[int, int], None] | None = None) -> LatentClips:
        """Return the clips' latents, encoded where they are not yet.

        Raises:
            InputError: No pairs, none of the size, or pairs of several sizes and none chosen.
        """
        sequences = PairDataset(self.data, "train", self.size).sequences
        return LatentClips(
            sequences, load_tiny_vae(self.vae), self.form, self.out / "latents", encoded
        )

    def fixer_run(
        self, recipe: Recipe, weights: Mapping[str, Path], schedule: Schedule | None = None
    ) -> FixerRun:
        """Return the run of a recipe with these options."""
        settings = fixer_settings(recipe.fixer)
        assert isinstance(settings, TrainableSettings)
        chosen = self.initial if recipe.name in INITIAL.values() else self.schedule
        return FixerRun(
            settings,
            recipe,
            self.data,
            self.vae,
            weights,
            self.form,
            self.batches,
            schedule or chosen,
            self.equal_channels,
            self.precision,
            self.snapshots,
            self.scenes,
            self.size,
        )


def train(
    run: ArmsRun,
    training: Training,
    folder: str | None = None,
    peak_lr: float | None = None,
    steps: int | None = None,
    report: Report | None = None,
) -> Path:
    """Train one stage, or continue it; a finished one is left as it is.

    Args:
        run: Shared options.
        training: Its starts are finished.
        folder: Below ``run.out``, instead of the training's own.
        peak_lr: Instead of the run's.
        steps: U, instead of the run's.
        report: Called after every update.

    Raises:
        InputError: A folder that was begun with other options.
        InfrastructureError: The loss is not finite.
    """
    files = {source: run.bundle_of(name) for source, name in training.starts.items()}
    of = run.fixer_run(training.recipe, files)
    schedule = of.schedule if steps is None else of.schedule.of_length(steps)
    of = replace(of, schedule=schedule if peak_lr is None else replace(schedule, peak_lr=peak_lr))
    distance = _distance(run) if training.stage.objective.perceptual else None
    return train_stage(
        of,
        training.stage,
        run.out / (folder or training.name),
        run.clips(),
        files,
        distance,
        report,
    )


def seconds_of_update(run: ArmsRun, training: Training, updates: int) -> float:
    """Return the processor seconds of an update: the mean over a stage of so many, its borders
    between objectives included.

    The stage begins at initial networks, for those before it are not trained yet; the time does not
    depend on the weights' values.
    """
    distance = _distance(run) if training.stage.objective.perceptual else None
    files = {
        source: path
        for source, recipe in INITIAL.items()
        if (path := run.bundle_of(initial_name(recipe))).exists()
    }
    files = {source: path for source, path in files.items() if source in training.stage.sources}
    with tempfile.TemporaryDirectory(prefix="simrun-probe-") as scratch:
        for name, count in (("warm-up", WARM_UP), ("timed", updates)):
            stage = replace(training.stage, share=1.0)
            recipe = replace(
                training.recipe,
                stages=tuple(
                    stage if one is training.stage else one for one in training.recipe.stages
                ),
            )
            of = replace(run.fixer_run(recipe, files, run.schedule.of_length(count)), snapshots=0)
            train_stage(of, stage, Path(scratch) / name, run.clips(), files, distance)
        return core_seconds(Path(scratch) / "timed")[-1] / updates


def probe(
    run: ArmsRun, trainings: Sequence[Training], updates: int, told: Callable[[str, float], None]
) -> dict[str, float]:
    """Return the processor seconds of an update of every training, measured once and kept in the
    run's folder.

    Raises:
        InputError: The folder has times that were measured with other options.
    """
    path = run.out / PROBE_FILE
    options = {
        "updates": updates,
        "form": asdict(run.form),
        "batches": asdict(run.batches),
        "accumulate": run.schedule.accumulate,
        "precision": str(run.precision),
        "threads": torch.get_num_threads(),
    }
    known: dict[str, Any] = {"options": options, "seconds_of_update": {}}
    if path.exists():
        known = read_json_object(path)
        if (begun := known.get("options")) != options:
            raise InputError(
                f"{path}: times measured with {begun}, this is {options}",
                "choose another folder",
            )
    seconds = dict(known["seconds_of_update"])
    for training in trainings:
        if training.name not in seconds:
            seconds[training.name] = float(f"{seconds_of_update(run, training, updates):.4g}")
            write_json(path, {**known, "seconds_of_update": seconds})
            told(training.name, seconds[training.name])
    return {training.name: float(seconds[training.name]) for training in trainings}


def write_plan(run: ArmsRun, plan: Plan, facts: Mapping[str, Any]) -> None:
    """Record the trainings of every arm in the folder, beside arms that are recorded there
    already.
    """
    arms = {**arms_of(run.out)} if (run.out / PLAN_FILE).exists() else {}
    write_json(
        run.out / PLAN_FILE,
        {
            **facts,
            "arms": {**arms, **{name: list(trainings) for name, trainings in plan.arms.items()}},
        },
    )


def arms_of(folder: Path) -> dict[str, list[str]]:
    """Return the trainings of every arm in a folder of arms, in order.

    Raises:
        InputError: It was not made by `simrun train arms`.
    """
    path = folder / PLAN_FILE
    found = read_json_object(path, do_this=DO).get("arms")
    if not isinstance(found, dict):
        raise InputError(f"{path}: no arms", DO)
    return {str(name): [str(one) for one in trainings] for name, trainings in found.items()}


def minutes_of(folder: Path) -> float | None:
    """Return the core-minutes that every arm in a folder of arms was given; None: it has the
    paper's updates.

    Raises:
        InputError: It was not made by `simrun train arms`.
    """
    minutes = read_json_object(folder / PLAN_FILE, do_this=DO).get("minutes")
    return None if minutes is None else float(minutes)


def _distance(run: ArmsRun) -> tuple[str, Any]:
    name, measure = distance_for_training(run.metric_weights)
    return name, measure.distance
