"""Train a variant of the fixer in one run folder: pairs and a trained autoencoder in, bundle and model card out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from alpasim_plugin.errors import InputError
from alpasim_plugin.fixers.bundle import load_tiny_vae, parts_of, save_bundle
from alpasim_plugin.fixers.settings import OneFixerSettings
from alpasim_plugin.nets import CosmosCausalDiT, DiTSizes, TinyVAE
from alpasim_plugin.nets.checkpoints import file_sha256, load_weights
from alpasim_plugin.nets.init import initial_weights
from alpasim_plugin.seeding import derive_seed
from alpasim_plugin.training.generator import GeneratorRecipe, GeneratorTask, widen_map
from alpasim_plugin.training.latent_clips import ClipForm, LatentClips
from alpasim_plugin.training.model_card import ModelCard, curves
from alpasim_plugin.training.pair_store import PairDataset
from alpasim_plugin.training.perceptual_term import Distance
from alpasim_plugin.training.trainer import LOG_FILE, Schedule, Trainer
from alpasim_plugin.training.variants import Variant

BUNDLE_FILE = "fixer.safetensors"


@dataclass(frozen=True)
class FixerRun:
    """Definition of a training run; equal runs give equal weights.

    Args:
        settings: Fixer to train: sizes, block, window.
        variant: Objectives.
        data: Folder of pairs; its ``train`` split is used.
        vae: Trained autoencoder's weights, or a bundle that holds them.
        init: Weights of a transformer or bundle to start from; None initialises a network that returns its source unchanged.
        form: Clips.
        recipe: Batches.
        schedule: Optimisation.
        precision: Of the forward passes: None is float32.
    """

    settings: OneFixerSettings
    variant: Variant
    data: Path
    vae: Path
    init: Path | None
    form: ClipForm
    recipe: GeneratorRecipe
    schedule: Schedule
    precision: torch.dtype | None = None


def train_fixer(
    run: FixerRun,
    out: Path,
    distance: tuple[str, Distance] | None = None,
    encoded: Callable[[int, int], None] | None = None,
    report: Callable[[int, Mapping[str, float]], None] | None = None,
    stop_at: int | None = None,
) -> Path:
    """Train to the schedule's end or to ``stop_at``, from the last checkpoint if any; write OUT/fixer.safetensors and its card.

    Args:
        run: Definition of the run.
        out: Folder of the run; the latents of the clips are cached in its parent folder, in ``latents``.
        distance: Name and function of the perceptual term.
        encoded: Called with the number of encoded sequences and the total.
        report: Called after every update with its number and the logged values.
        stop_at: Update after which to stop and write the weights; a later call continues.

    Raises:
        InputError: Invalid data, weights or recipe.
        InfrastructureError: The loss is not finite.
    """
    if run.recipe.steps != run.schedule.steps or run.recipe.accumulate != run.schedule.accumulate:
        found = f"recipe {run.recipe.steps} x {run.recipe.accumulate}, schedule {run.schedule.steps} x {run.schedule.accumulate}"
        raise InputError("training a fixer", str(out), found, "give both the same updates and batches an update")
    vae = load_tiny_vae(run.vae)
    dataset = PairDataset(run.data, "train")
    clips = LatentClips(dataset.sequences, vae, run.form, out.parent / "latents", encoded)
    net = CosmosCausalDiT.from_state_dict(start_weights(run), run.settings.rope_ratios, source=str(run.init or "initial weights"))
    task = GeneratorTask(net, vae, clips, run.variant, run.recipe, distance)
    facts = {**task.facts, "init": file_sha256(run.init) if run.init else None, "precision": str(run.precision)}
    trainer = Trainer(net, out, run.schedule, task.batch, task.loss, facts, run.precision)
    trainer.run(report, stop_at)
    return write_bundle(run, out, trainer.averaged(), vae, facts, trainer.step)


def start_weights(run: FixerRun) -> dict[str, Tensor]:
    """Return the transformer's initial weights; a variant conditioned on the render gets zero weights for that input."""
    settings = run.settings
    if run.init is None:
        sizes = DiTSizes(**settings.dit.model_dump())
        weights = initial_weights(sizes, derive_seed("training", run.recipe.seed, "generator"), zero_velocity=True)
    else:
        tensors = load_weights(run.init, dtype=torch.float32)
        weights = parts_of(tensors).get("dit", tensors)
    return weights if run.variant.mixed else widen_map(weights, 32)


def write_bundle(run: FixerRun, out: Path, dit: Mapping[str, Tensor], vae: TinyVAE, facts: Mapping[str, Any], updates: int) -> Path:
    """Write the weights after ``updates`` updates as one float16 bundle, with its card."""
    path = out / BUNDLE_FILE
    parts = {"dit": {k: half(v) for k, v in dit.items()}, "vae": {k: half(v) for k, v in vae.state_dict().items()}}
    history = run.settings.history if run.variant.history else "none"
    block = run.settings.block_latents if run.variant.history else 1
    settings = run.settings.model_copy(
        update={"holes": "noise", "history": history, "block_latents": block, "uses_map": run.variant.use_map}
    )  # fmt: skip
    planned = "" if updates == run.schedule.steps else f" of {run.schedule.steps}"
    note = f"{run.variant.name}, {updates}{planned} updates"
    save_bundle(path, parts, settings, trained=True, note=note)
    rows, hours = curves(out / LOG_FILE)
    training = {"variant": run.variant.name, "about": run.variant.about, "schedule": asdict(run.schedule), **facts}
    data = {"pairs": "rendered scenes, split train", "sequences": len(PairDataset(run.data, "train").sequences), "form": asdict(run.form)}
    ModelCard(f"OneFixer weights, variant {run.variant.name}: {run.variant.about}", data, training, rows, hours).write(path)
    return path


def half(tensor: Tensor) -> Tensor:
    """Convert a floating tensor to float16.

    Raises:
        InputError: A value overflows float16.
    """
    if not tensor.is_floating_point():
        return tensor
    rounded = tensor.detach().half()
    if not torch.isfinite(rounded).all():
        found = f"values up to {float(tensor.abs().max()):.3g}"
        raise InputError("rounding weights to float16", f"shape {list(tensor.shape)}", found, "train with a smaller learning rate")
    return rounded
