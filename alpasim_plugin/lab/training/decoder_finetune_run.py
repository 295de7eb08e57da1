"""Fine-tune the decoder of a trained bundle on its generator, in one run folder: bundle in, bundle
out.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from torch import Tensor

from alpasim_plugin.block_fixers.networks import streaming_dit
from alpasim_plugin.block_fixers.settings import OneFixerSettings
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.core.devices import require_device
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import file_sha256
from alpasim_plugin.core.files.arrays import read_metadata
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.fixers.bundle import parts_of, save_bundle
from alpasim_plugin.fixers.network.checkpoints import load_weights
from alpasim_plugin.lab.training.bundle_fixer import bundle_fixer
from alpasim_plugin.lab.training.decoder_finetune import DecoderRecipe, DecoderTask, Rollouts
from alpasim_plugin.lab.training.fixer_run import BUNDLE_FILE, half
from alpasim_plugin.lab.training.latent_clips import ClipForm, LatentClips
from alpasim_plugin.lab.training.model_card import ModelCard, curves
from alpasim_plugin.lab.training.pair_store import PairDataset
from alpasim_plugin.lab.training.perceptual_term import Distance
from alpasim_plugin.lab.training.trainer import LOG_FILE, Schedule, Trainer


def finetune_decoder(
    bundle: Path,
    data: Path,
    out: Path,
    form: ClipForm,
    recipe: DecoderRecipe,
    schedule: Schedule,
    distance: tuple[str, Distance] | None = None,
    prepared: Callable[[str, int, int], None] | None = None,
    report: Callable[[int, Mapping[str, float]], None] | None = None,
    size: tuple[int, int] | None = None,
    device: str = "cpu",
) -> Path:
    """Train the decoder of a bundle on its generator's rollouts, and write OUT/fixer.safetensors
    and its card.

    Args:
        bundle: A trained fixer whose decoder belongs to its autoencoder and is conditioned on the
            render.
        data: Folder of pairs; its ``train`` split is used.
        out: Folder of the run; latents and rollouts of the clips are cached in its parent folder.
        form, recipe, schedule: Clips, batches, optimisation.
        distance: Name and function of the perceptual term.
        prepared: Called with the current item (latents, rollouts), the number done and the total.
        report: Called after every update with its number and the logged values.
        size: Width and height of the sequences to train on, pixels; None: all are of one size.
        device: Of the training; latents and rollouts are made on the CPU.

    Raises:
        InputError: Another kind of bundle, no data, or a crop larger than the clips.
        InfrastructureError: The loss is not finite.
    """
    settings = bundle_settings(bundle)
    parts = _float32_parts(bundle)
    vae = TinyVAE.from_state_dict(parts["vae"], source=str(bundle))
    generator = streaming_dit(parts["dit"], settings, str(bundle)).requires_grad_(False)

    sequences = PairDataset(data, "train", size).sequences
    clips = LatentClips(sequences, vae, form, out.parent / "latents", _named(prepared, "latents"))
    rollouts = Rollouts(
        clips,
        vae,
        generator,
        settings.block_latents,
        settings.window,
        "drawn" if settings.uses_map else settings.no_map,
        out.parent / "rollouts",
        _named(prepared, "rollouts"),
    )
    task = DecoderTask(vae, rollouts, recipe, distance)
    facts = {**task.facts, "init": file_sha256(bundle)}
    vae.to(require_device(device))
    trainer = Trainer(vae, out, schedule, task.batch, task.loss, facts)
    trainer.run(report)

    path = out / BUNDLE_FILE
    note = f"{read_metadata(bundle).get('note', '')}, decoder {schedule.steps} updates"
    weights = {"dit": _halves(parts["dit"]), "vae": _halves(trainer.averaged())}
    save_bundle(path, weights, settings, trained=True, note=note)
    _write_card(path, note, len(clips), form, schedule, facts)
    return path


def _float32_parts(bundle: Path) -> dict[str, dict[str, Tensor]]:
    """Return the tensors of each network of a bundle."""
    return parts_of({name: tensor.float() for name, tensor in load_weights(bundle).items()})


def _halves(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return tensors in the precision of a bundle."""
    return {name: half(tensor) for name, tensor in tensors.items()}


def _write_card(
    path: Path,
    note: str,
    n_clips: int,
    form: ClipForm,
    schedule: Schedule,
    facts: Mapping[str, Any],
) -> None:
    """Write the model card beside a bundle.

    Args:
        path: The bundle, in the folder of its run.
        note: What it is, as in its metadata.
        n_clips, form: What it was trained on.
        schedule: How long.
        facts: What else identifies the run.
    """
    about = {"pairs": "rendered scenes, split train", "clips": n_clips, "form": asdict(form)}
    training = {
        "what": "decoder only, on the generator's rollouts",
        "schedule": asdict(schedule),
        **facts,
    }
    rows, hours = curves(path.parent / LOG_FILE)
    ModelCard(f"OneFixer weights: {note}", about, training, rows, hours).write(path)


def _named(
    prepared: Callable[[str, int, int], None] | None, subject: str
) -> Callable[[int, int], None] | None:
    """Return a report of what is prepared that says what it is."""
    return None if prepared is None else partial(prepared, subject)


def bundle_settings(bundle: Path) -> OneFixerSettings:
    """Return the settings that a bundle was trained for.

    Raises:
        InputError: A bundle without a generator of blocks, or without a decoder that is
            conditioned on the render.
    """
    name, overrides = bundle_fixer(bundle)
    settings = fixer_settings(name, overrides)
    if not isinstance(settings, OneFixerSettings):
        raise InputError(
            f"{bundle}: it is for {name}, which has no networks",
            "give a bundle of 'simrun train fixer'",
        )
    problems = [
        text
        for text, wrong in (
            ("its decoder does not see the render", settings.decoder.kind != "render"),
            (f"its autoencoder is {settings.vae.kind}", settings.vae.kind != "tiny"),
            # Rollouts take one step from the source of Eq. 1, with a finalised history.
            (f"its history is {settings.history}", settings.history == "last-forward"),
            (f"it takes {len(settings.steps)} steps", len(settings.steps) != 1),
            (f"it keeps a sink of {settings.sink}", settings.sink != 0),
            ("its source is not that of Eq. 1", settings.holes != "noise"),
            ("it takes the opacity as an input", settings.opacity_input),
        )
        if wrong
    ]
    if problems:
        raise InputError(
            f"{bundle}: {'; '.join(problems)}",
            "give a bundle that 'simrun train fixer' made with a history",
        )
    return settings
