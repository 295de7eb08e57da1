"""Train the per-frame generator in one run folder: streams of frames in, bundles of averaged
weights and a model card out.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from alpasim_plugin.core.devices import require_device
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import file_sha256
from alpasim_plugin.core.files.arrays import read_metadata
from alpasim_plugin.core.seeding import derive_seed
from alpasim_plugin.fixers.bundle import parts_of, save_bundle
from alpasim_plugin.fixers.network.checkpoints import load_weights
from alpasim_plugin.fixers.network.pixel_generator import PixelGenerator, PixelSizes
from alpasim_plugin.fixers.pixel_settings import PixelFixerSettings
from alpasim_plugin.lab.training.episode_references import USUAL_REFERENCES
from alpasim_plugin.lab.training.fixer_run import BUNDLE_FILE, half
from alpasim_plugin.lab.training.model_card import ModelCard, curves
from alpasim_plugin.lab.training.pixel_rollout import Distance
from alpasim_plugin.lab.training.pixel_task import FrameStreams, PixelTask
from alpasim_plugin.lab.training.pixel_variants import DEPLOYED, PixelVariant
from alpasim_plugin.lab.training.processes import join_ranks
from alpasim_plugin.lab.training.trainer import LOG_FILE, Schedule, Trainer

BLOCK = re.compile(r"(encode|decode|middle)\w*\.\d+\.")  # a residual block of a stage


@dataclass(frozen=True)
class PixelRun:
    """Definition of a run; equal runs give equal weights.

    Args:
        settings: Fixer to train: its sizes.
        streams: Data.
        variant: Objectives.
        schedule: Optimisation.
        init: A checkpoint of another run (weights, averages and moments go on) or a bundle
            (weights); None begins anew.
        seed: Of the initial weights and the noise.
        precision: Of the forward passes: None is float32.
        keep_every: Updates between bundles that are kept for a learning curve; 0 keeps the last
            alone.
        device: Where to train; a run may go on on another.
    """

    settings: PixelFixerSettings
    streams: FrameStreams
    variant: PixelVariant
    schedule: Schedule
    init: Path | None = None
    seed: int = 0
    precision: torch.dtype | None = None
    keep_every: int = 0
    device: str = "cpu"


def train_per_frame(
    run: PixelRun,
    out: Path,
    distance: tuple[str, Distance] | None,
    stop_at: int | None = None,
    report: Callable[[int, Mapping[str, float]], None] | None = None,
) -> Path:
    """Train to the schedule's end or to ``stop_at``, from the last checkpoint if any; write
    OUT/fixer.safetensors and its card. Processes of torchrun share the streams.

    Args:
        run: Definition of the run.
        out: Folder of the run.
        distance: Name and function of the perceptual term, or None.
        stop_at: Update after which to stop and write the weights; a later call continues.
        report: Called after every update with its number and the logged values.

    Raises:
        InputError: Weights of other sizes, or a folder of another run.
        InfrastructureError: The loss is not finite, or there is no such device.
    """
    device = torch.device(require_device(run.device))
    net = initial_generator(run).to(device)
    whole = net, run.streams, run.variant, run.schedule.steps, distance, run.seed
    task = PixelTask(*whole, *join_ranks(device))
    facts = {
        **task.facts,
        "init": file_sha256(run.init) if run.init else None,
        "precision": str(run.precision),
    }
    trainer = Trainer(net, out, run.schedule, task.batch, task.loss, facts, run.precision, task)
    if run.init is not None and _is_checkpoint(run.init):
        trainer.begin_from(run.init)

    def reported(step: int, numbers: Mapping[str, float]) -> None:
        if run.keep_every and step % run.keep_every == 0:
            write_bundle(run, out / f"fixer-{step:06d}.safetensors", trainer.averaged(), step)
        if report is not None:
            report(step, numbers)

    trainer.run(reported, stop_at)
    if trainer.rank:
        return out / BUNDLE_FILE
    path = write_bundle(run, out / BUNDLE_FILE, trainer.averaged(), trainer.step)
    rows, hours = curves(out / LOG_FILE)
    training = {"schedule": asdict(run.schedule), "updates": trainer.step, **facts}
    model = f"per-frame generator, {trainer.step} updates"
    ModelCard(model, dict(run.streams.facts()), training, rows, hours).write(path)
    return path


def initial_generator(run: PixelRun) -> PixelGenerator:
    """Return the network that a run begins with: a bundle may lack the heads for references or have
    fewer residual blocks than the settings.

    What it lacks is untrained; a block that it lacks leaves its input as it is.

    Raises:
        InputError: A bundle of another kind, or of other widths than the settings.
    """
    net = PixelGenerator.random(
        sizes_of(run.settings), derive_seed("training", run.seed, "pixel.weights")
    )
    if run.init is None or _is_checkpoint(run.init):
        return net
    tensors = parts_of({key: value.float() for key, value in load_weights(run.init).items()}).get(
        "generator"
    )
    if tensors is None:
        raise InputError(
            f"{run.init}: no part generator.*",
            "give a checkpoint or a bundle of 'simrun train per-frame'",
        )
    fresh = net.state_dict()
    lacking = {
        key
        for key in fresh.keys() - tensors.keys()
        if key.startswith(("blend.", "finer.")) or BLOCK.match(key)
    }
    wrong = sorted(
        key
        for key in (tensors.keys() | fresh.keys()) - lacking
        if not _fits(tensors.get(key), fresh.get(key))
    )
    if wrong:
        raise InputError(
            f"{run.init}: {len(wrong)} tensors of other sizes than {net.facts}, such as {wrong[0]}",
            "choose the fixer of the same widths",
        )
    identity = {
        key: torch.zeros_like(fresh[key]) for key in lacking if key.endswith("second.weight")
    }
    net.load_state_dict({**fresh, **tensors, **identity})
    return net


def _fits(tensor: Tensor | None, parameter: Tensor | None) -> bool:
    return tensor is not None and parameter is not None and tensor.shape == parameter.shape


def sizes_of(settings: PixelFixerSettings) -> PixelSizes:
    """Return the sizes that the settings name."""
    return PixelSizes(**settings.generator.model_dump())


def write_bundle(run: PixelRun, path: Path, weights: Mapping[str, Tensor], updates: int) -> Path:
    """Write averaged weights as a float16 bundle."""
    trained_at = {"uses_map": run.variant.use_map, "steps": (1000.0,), "holes": run.variant.holes}
    if run.settings.generator.blend:
        trained_at |= {"references": USUAL_REFERENCES}
    settings = run.settings.model_copy(update=trained_at)
    tensors: dict[str, Any] = {key: half(value) for key, value in weights.items()}
    named = "" if run.variant.name == DEPLOYED else f"{run.variant.name}, "
    save_bundle(
        path,
        {"generator": tensors},
        settings,
        trained=True,
        note=f"{named}{updates} updates",
        updates=updates if run.init is None else None,
    )
    return path


def _is_checkpoint(path: Path) -> bool:
    return "facts" in read_metadata(path)
