"""The generator in pixels from its weights, or untrained; loaded once per process."""

from dataclasses import dataclass
from functools import lru_cache

import torch

from alpasim_plugin.core.devices import implementation, require_device
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import derive_seed
from alpasim_plugin.fixers.bundle import read_bundle, weights_to_give
from alpasim_plugin.fixers.gather import CPU
from alpasim_plugin.fixers.network.pixel_generator import (
    TORCH,
    PixelGenerator,
    PixelSizes,
)
from alpasim_plugin.fixers.network.reference_blend import Operations
from alpasim_plugin.fixers.pixel_settings import PixelFixerSettings
from alpasim_plugin.fixers.settings import WeightsStamp, weights_stamp

DTYPES = {"fp32": torch.float32, "bf16": torch.bfloat16}


@dataclass(frozen=True, eq=False)
class LoadedGenerator:
    """A generator ready to run; read-only and stateless, so rollouts share it."""

    net: PixelGenerator
    operations: Operations
    trained: bool
    note: str  # description of the weights, for labels
    device: torch.device
    captured: bool  # whether a frame is recorded as a graph


def load_generator(settings: PixelFixerSettings, device: str = "cpu") -> LoadedGenerator:
    """Build the generator that the settings name, or return it if this process has built it before.

    Raises:
        InputError: Weights that are missing or do not fit.
        InfrastructureError: The device is not here.
    """
    kept = settings.model_copy(update={"keep_render": True})
    return _load(kept, require_device(device), weights_stamp(settings.weights))


@lru_cache(maxsize=4)
def _load(settings: PixelFixerSettings, device: str, _: WeightsStamp) -> LoadedGenerator:
    if settings.weights.bundle is not None:
        bundle = read_bundle(settings.weights.bundle, settings)
        net = PixelGenerator.from_state_dict(bundle.parts["generator"], settings.weights.bundle)
        trained = bundle.trained
        note = bundle.note
    else:
        if settings.untrained == "refuse":
            raise InputError(
                f"{settings.name}, weights.bundle: no weights, and settings.untrained is 'refuse'",
                weights_to_give("bundle"),
            )
        sizes = PixelSizes(**settings.generator.model_dump())
        net = PixelGenerator.random(sizes, derive_seed("fixer", 0, settings.name))
        if settings.untrained == "identity":
            torch.nn.init.zeros_(net.write.weight)
        trained = False
        note = f"untrained ({settings.untrained})"
    net = net.requires_grad_(False).eval().to(device=device, dtype=DTYPES[settings.precision])
    operations = implementation(device, CPU, TORCH)
    captured = operations is TORCH
    return LoadedGenerator(net, operations, trained, note, torch.device(device), captured)
