"""Train a recipe in one run folder: pairs and a trained autoencoder in, a bundle and a model card
for every stage out.

    OUT/STAGE/   a stage before the last: state.safetensors, log.jsonl, fixer.safetensors and its card
    OUT/         the last stage, whose fixer.safetensors is the result

Every stage resumes from its own checkpoint; a finished one makes no update. A later stage starts
from the float16 bundles of earlier ones.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from alpasim_plugin.block_fixers.settings import OneFixerSettings
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.core.devices import require_device
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import file_sha256
from alpasim_plugin.core.files.arrays import read_metadata
from alpasim_plugin.fixers.bundle import parts_of, save_bundle
from alpasim_plugin.fixers.network.checkpoints import load_weights
from alpasim_plugin.lab.image_fixers.settings import NoiseWindowSettings, RenderStepSettings
from alpasim_plugin.lab.training.clip_batches import BatchForm
from alpasim_plugin.lab.training.latent_clips import ClipForm, LatentClips
from alpasim_plugin.lab.training.model_card import ModelCard, curves
from alpasim_plugin.lab.training.pair_store import PairDataset, PairSequence
from alpasim_plugin.lab.training.perceptual_term import Distance
from alpasim_plugin.lab.training.recipes.recipe import (
    GIVEN,
    Recipe,
    Stage,
    StageInputs,
    Weights,
)
from alpasim_plugin.lab.training.trainer import LOG_FILE, Schedule, Trainer
from alpasim_plugin.lab.training.vae import load_tiny_vae

BUNDLE_FILE = "fixer.safetensors"
BUNDLED = ("dit", "vae", "prompt")
TrainableSettings = OneFixerSettings | RenderStepSettings | NoiseWindowSettings
Report = Callable[[int, Mapping[str, float]], None]


@dataclass(frozen=True)
class FixerRun:
    """Definition of a training run; equal runs give equal weights.

    Args:
        settings: Fixer to train: sizes, and what the recipe does not say.
        recipe: Stages.
        data: Folder of pairs; its ``train`` split is used.
        vae: Trained autoencoder's weights, or a bundle that holds them.
        weights: Files by name: ``init`` and ``init-bi``, the initial weights (without a file, a
            network that returns its source unchanged); or a stage's name, whose weights these are,
            so that it is not trained.
        form: Clips.
        batches: Clips of a batch.
        schedule: Optimisation of a stage of share 1; its updates are the unit U.
        equal_channels: Whether flow matching weights all latent channels alike.
        precision: Of the forward passes: None is float32. A stage that is always trained in float32
            ignores it.
        size: Width and height of the sequences to train on, pixels; None: all are of one size.
        device: Where to train; a run may go on on another. Latents are made on the CPU.
    """

    settings: TrainableSettings
    recipe: Recipe
    data: Path
    vae: Path
    weights: Mapping[str, Path]
    form: ClipForm
    batches: BatchForm
    schedule: Schedule
    equal_channels: bool = False
    precision: torch.dtype | None = None
    size: tuple[int, int] | None = None
    device: str = "cpu"

    def __post_init__(self) -> None:
        names = {*GIVEN, *(stage.name for stage in self.recipe.stages[:-1])}
        if unknown := sorted(set(self.weights) - names):
            raise InputError(
                f"--weights {', '.join(unknown)}: no weights of that name in recipe {self.recipe.name}",
                f"name one of {', '.join(sorted(names))}",
            )

    def stages(self) -> list[Stage]:
        """Return the stages to train: those that the last needs and whose weights are not given."""
        needed = {self.recipe.stages[-1].name}
        out = []
        for stage in reversed(self.recipe.stages):
            if stage.name in needed and stage.name not in self.weights:
                out.append(stage)
                needed |= set(stage.sources)
        return out[::-1]

    @property
    def sequences(self) -> tuple[PairSequence, ...]:
        """Pairs to train on.

        Raises:
            InputError: None are finished, or none have the size.
        """
        return PairDataset(self.data, "train", self.size).sequences

    @property
    def updates(self) -> int:
        """Updates of all stages to train."""
        return sum(stage.updates(self.schedule.steps) for stage in self.stages())

    @property
    def perceptual(self) -> bool:
        """Whether any stage to train has a perceptual term."""
        return any(stage.objective.perceptual for stage in self.stages())

    def precision_of(self, stage: Stage) -> torch.dtype | None:
        """Return the precision of a stage's forward passes."""
        return None if stage.always_float32 else self.precision

    def schedule_of(self, stage: Stage) -> Schedule:
        """Return a stage's schedule."""
        steps = stage.updates(self.schedule.steps)
        warmup = min(self.schedule.warmup, steps)
        return replace(
            self.schedule,
            steps=steps,
            warmup=warmup,
            decay=stage.decay,
            last_share=stage.last_share,
        )


def train_fixer(
    run: FixerRun,
    out: Path,
    distance: tuple[str, Distance] | None = None,
    encoded: Callable[[int, int], None] | None = None,
    report: Report | None = None,
    stop_at: int | None = None,
) -> Path:
    """Train to the end of the last stage or to ``stop_at``, from the last checkpoints if any; write
    OUT/fixer.safetensors and its card.

    Args:
        run: Definition of the run.
        out: Folder of the run; the latents of the clips are cached in its parent folder, in
            ``latents``.
        distance: Name and function of the perceptual term.
        encoded: Called with the number of encoded sequences and the total.
        report: Called after every update with its number, counted over all stages, and the logged
            values.
        stop_at: Update, counted over all stages, after which to stop and write the weights; a later
            call continues.

    Returns:
        The bundle of the stage that was trained last.

    Raises:
        InputError: Invalid data, weights or recipe.
        InfrastructureError: The loss is not finite.
    """
    vae = load_tiny_vae(run.vae)
    clips = LatentClips(run.sequences, vae, run.form, out.parent / "latents", encoded)
    files = dict(run.weights)
    before = 0
    path = out / BUNDLE_FILE
    for stage in run.stages():
        if stop_at is not None and stop_at <= before:
            break
        last = stage is run.recipe.stages[-1]
        until = None if stop_at is None else stop_at - before
        path = train_stage(
            run,
            stage,
            out if last else out / stage.name,
            clips,
            files,
            distance,
            _from(report, before),
            until,
        )
        files[stage.name] = path
        before += stage.updates(run.schedule.steps)
    return path


def train_stage(
    run: FixerRun,
    stage: Stage,
    folder: Path,
    clips: LatentClips,
    files: Mapping[str, Path],
    distance: tuple[str, Distance] | None = None,
    report: Report | None = None,
    until: int | None = None,
) -> Path:
    """Train one stage from its last checkpoint, if any, and write its bundle; a finished one is
    checked and left as it is.

    Args:
        run: The run that the stage belongs to.
        stage: One of its recipe.
        folder: Of this stage alone.
        clips: Training latents.
        files: Bundles by the names of the sources that the stage starts from.
        distance: Name and function of the perceptual term.
        report: Called after every update with its number and the logged values.
        until: Update after which to stop; None: the last.

    Raises:
        InputError: Invalid data or weights, or a folder of another run.
        InfrastructureError: The loss is not finite.
    """
    inputs = stage_inputs(run, stage, clips, files, distance)
    task = stage.objective.task(inputs)
    for name, parameter in task.parts.named_parameters():
        parameter.requires_grad_(any(f"{name}.".startswith(f"{part}.") for part in stage.trained))
    schedule = run.schedule_of(stage)
    facts = {**task.facts, **_stage_facts(run, stage, clips, inputs, distance)}
    task.parts.to(require_device(run.device))
    trainer = Trainer(
        task.parts,
        folder,
        schedule,
        task.batch,
        task.loss,
        facts,
        run.precision_of(stage),
        parts=stage.trained,
    )
    if trainer.step == schedule.steps and is_written(run, stage, folder, schedule):
        return folder / BUNDLE_FILE
    trainer.run(report, until)
    return write_bundle(run, stage, folder, trainer.averaged(), facts, trainer.step, schedule)


def _stage_facts(
    run: FixerRun,
    stage: Stage,
    clips: LatentClips,
    inputs: StageInputs,
    distance: tuple[str, Distance] | None,
) -> dict[str, Any]:
    """Return what identifies a stage beside its task: a folder of another one is refused."""
    return {
        "recipe": run.recipe.name,
        "stage": stage.name,
        "clips": len(clips),
        "latents": clips.digest,
        "batches": asdict(inputs.form),
        "equal_channels": run.equal_channels,
        "seen": asdict(stage.conditioning),
        "attention": asdict(inputs.attention),
        "distance": distance[0] if distance else "none",
        "start": {part: _digest(inputs.weights.get(part)) for part in stage.start},
        "vae": file_sha256(run.vae),
        "precision": str(run.precision_of(stage)),
    }


def clip_latents(run: FixerRun, stage: Stage) -> int:
    """Return the latents of a stage's clips."""
    return min(
        run.form.latents, run.batches.latents or run.form.latents, stage.latents or run.form.latents
    )


def stage_inputs(
    run: FixerRun,
    stage: Stage,
    clips: LatentClips,
    files: Mapping[str, Path],
    distance: tuple[str, Distance] | None,
) -> StageInputs:
    """Return what a stage's objective makes its task of."""
    weights = {
        part: tensors
        for part, source in stage.start.items()
        if (tensors := _weights(files, source)) is not None
    }
    vae = (
        load_tiny_vae(run.vae)
        if "vae" not in weights
        else TinyVAE.from_state_dict(weights["vae"], source=stage.start["vae"])
    )
    latents = clip_latents(run, stage)
    return StageInputs(
        run.settings.dit,
        run.settings.rope_ratios,
        stage.attention(latents),
        stage.conditioning,
        weights,
        vae,
        clips,
        replace(run.batches, latents=latents),
        stage.updates(run.schedule.steps),
        run.schedule.accumulate,
        run.equal_channels,
        distance,
        run.settings,
        require_device(run.device),
    )


def write_bundle(
    run: FixerRun,
    stage: Stage,
    folder: Path,
    averaged: Weights,
    facts: Mapping[str, Any],
    updates: int,
    schedule: Schedule,
) -> Path:
    """Write a stage's weights after ``updates`` updates as one float16 bundle, with its card."""
    recipe = run.recipe
    path = folder / BUNDLE_FILE
    _write_weights(run, stage, path, averaged, updates, schedule)
    rows, hours = curves(folder / LOG_FILE)
    trained = {part: asdict(settings) for part, settings in stage.trained.items()}
    training = {
        "about": recipe.about,
        "schedule": asdict(schedule),
        "trained": trained,
        "always_float32": stage.always_float32,
        **facts,
    }
    data = {
        "pairs": "rendered scenes, split train",
        "sequences": len(run.sequences),
        "form": asdict(run.form),
    }
    ModelCard(
        f"OneFixer weights, recipe {name_of(run, stage)}: {recipe.about}",
        data,
        training,
        rows,
        hours,
    ).write(path)
    return path


def is_written(run: FixerRun, stage: Stage, folder: Path, schedule: Schedule) -> bool:
    """Whether a stage's bundle of all updates and its card are there; an earlier stop may have left
    those of fewer.
    """
    path = folder / BUNDLE_FILE
    card = path.with_suffix(".card.json")
    return (
        path.exists()
        and card.exists()
        and read_metadata(path).get("note") == _note(run, stage, schedule.steps, schedule)
    )


def name_of(run: FixerRun, stage: Stage) -> str:
    """Return what a stage's weights are called: the recipe, and the stage where it is not the
    last.
    """
    return (
        run.recipe.name
        if stage is run.recipe.stages[-1]
        else f"{run.recipe.name}, stage {stage.name}"
    )


def _note(run: FixerRun, stage: Stage, updates: int, schedule: Schedule) -> str:
    planned = "" if updates == schedule.steps else f" of {schedule.steps}"
    return f"{name_of(run, stage)}, {updates}{planned} updates"


def _write_weights(
    run: FixerRun, stage: Stage, path: Path, averaged: Weights, updates: int, schedule: Schedule
) -> None:
    parts = {
        name: {k: half(v) for k, v in part.items()}
        for name, part in parts_of(averaged).items()
        if name in BUNDLED
    }
    save_bundle(
        path,
        parts,
        deployed_settings(run, stage),
        trained=True,
        note=_note(run, stage, updates, schedule),
        # A later stage, or one of given weights, goes on from others.
        updates=None if run.weights or {*stage.sources} - {*GIVEN} else updates,
    )


def deployed_settings(run: FixerRun, stage: Stage) -> TrainableSettings:
    """Return the settings that a stage's weights are deployed with.

    Raises:
        InputError: Settings that do not fit together.
    """
    changes = stage.deployed
    if isinstance(run.settings, OneFixerSettings):
        changes = run.recipe.settings(stage, clip_latents(run, stage))
    try:
        return type(run.settings).model_validate({**run.settings.model_dump(), **changes})
    except ValueError as error:
        raise InputError(
            f"{run.recipe.name}, stage {stage.name}: {error}",
            "correct the recipe",
        ) from error


def half(tensor: Tensor) -> Tensor:
    """Convert a floating tensor to float16.

    Raises:
        InputError: A value overflows float16.
    """
    if not tensor.is_floating_point():
        return tensor
    rounded = tensor.detach().half()
    if not torch.isfinite(rounded).all():
        raise InputError(
            f"shape {list(tensor.shape)}: values up to {float(tensor.abs().max()):.3g}",
            "train with a smaller learning rate",
        )
    return rounded


def _weights(files: Mapping[str, Path], source: str) -> Weights | None:
    """Return the tensors of ``SOURCE.PART``; None where a run is not given its source.

    Raises:
        InputError: A file without that part.
    """
    name, _, part = source.partition(".")
    if name not in files:
        return None
    tensors = {key: value.float() for key, value in load_weights(files[name]).items()}
    parts = parts_of(tensors)
    if part == "dit" and "dit" not in parts:
        return tensors  # a transformer alone
    if part not in parts:
        raise InputError(
            f"{files[name]}: no part {part!r}", f"give a bundle of 'simrun train fixer' as {name}"
        )
    return parts[part]


def _digest(weights: Weights | None) -> str | None:
    """Return a digest of tensors. A file's would not do: the order of its header is not fixed, and
    a stage's bundle is written again.
    """
    if weights is None:
        return None
    out = hashlib.blake2b(digest_size=16)
    for key, value in sorted(weights.items()):
        out.update(key.encode() + value.contiguous().numpy().tobytes())
    return out.hexdigest()


def _from(report: Report | None, before: int) -> Report | None:
    return None if report is None else lambda step, numbers: report(before + step, numbers)
