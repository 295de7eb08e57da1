"""One frame through the generator in pixels: source (Eq. 1), flow steps (Eq. 2), the harmlessness guard. Tensors in, tensors out.

The state is explicit: it goes in and comes out, and nothing else is remembered. Several cameras are a batch.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import torch
from torch import Tensor

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import derive_seed
from alpasim_plugin.fixers.bundle import read_bundle
from alpasim_plugin.fixers.devices import require_device
from alpasim_plugin.fixers.factory import weights_to_give
from alpasim_plugin.fixers.keep_render import render_share
from alpasim_plugin.fixers.pixel_settings import PixelFixerSettings
from alpasim_plugin.fixers.recorded_step import RecordedStep
from alpasim_plugin.nets.pixel_generator import PixelGenerator, PixelSizes, PixelState
from alpasim_plugin.nets.precision import Choice, choose_precision
from alpasim_plugin.nets.sampling import interpolant
from alpasim_plugin.nets.schedule import from_names

DOING = "loading the network of a fixer"
DTYPES: Mapping[Literal["fp32", "bf16"], torch.dtype] = {"fp32": torch.float32, "bf16": torch.bfloat16}


@dataclass(frozen=True, eq=False)
class LoadedGenerator:
    """A generator ready to run; read-only and stateless, so rollouts share it."""

    net: PixelGenerator
    step: Callable[..., tuple[Tensor, PixelState]]  # the same at t = 1
    trained: bool
    note: str  # description of the weights, for labels
    precision: Choice
    device: torch.device


@dataclass(frozen=True)
class PixelInputs:
    """One frame of B cameras; sides are multiples of 16."""

    render: Tensor  # (B, H, W, 3) in [-1, 1]
    opacity: Tensor  # (B, H, W, 1), 0 to 1
    sdmap: Tensor  # (B, H, W, 3) in [-1, 1]; black where there is no map


def load_generator(settings: PixelFixerSettings, device: str = "cpu") -> LoadedGenerator:
    """Build the generator that the settings name, or return it if this process has built it before.

    Raises:
        InputError: Weights that are missing or do not fit.
        FixerError: The device does not work.
    """
    require_device(device, DOING)
    return _load(settings.model_copy(update={"keep_render": True}), device)


@torch.inference_mode()
def fix_frame(
    generator: LoadedGenerator,
    settings: PixelFixerSettings,
    inputs: PixelInputs,
    state: PixelState,
    source: Callable[[int], Tensor],
) -> tuple[Tensor, PixelState]:
    """Fix one frame.

    Args:
        generator: Network.
        settings: Steps and guard.
        inputs: The frame.
        state: Of the same cameras, from `PixelGenerator.start` or the last call.
        source: Returns the source z_1 (Eq. 1) of a flow step by its number, ``(B, H, W, 3)``.

    Returns:
        ``(B, H, W, 3)``, not clipped to [-1, 1], and the state after the frame, whose last output is this one.
    """
    render = inputs.render
    images = render, inputs.opacity, inputs.sdmap, state
    out, after = generator.step(*images, source(0))
    for index, level in enumerate(from_names(settings.steps)[1:], start=1):
        t = level.sigma
        out, after = generator.net(*images, interpolant(out, source(index), t), render.new_full((len(render),), t))
    if settings.keep_render:
        share = render_share(out, render, inputs.opacity, inputs.sdmap, state.output)
        if share is not None:
            out = torch.lerp(out, render, share)
            after = after._replace(output=out.clamp(-1, 1))
    return out, after


@lru_cache(maxsize=4)
def _load(settings: PixelFixerSettings, device: str) -> LoadedGenerator:
    precision = choose_precision(settings.precision, device)
    if settings.weights.bundle is not None:
        bundle = read_bundle(settings.weights.bundle, settings)
        net, trained, note = PixelGenerator.from_state_dict(bundle.parts["generator"], settings.weights.bundle), bundle.trained, bundle.note
    else:
        net, trained, note = _untrained(settings), False, f"untrained ({settings.untrained})"
    net = net.requires_grad_(False).eval().to(device=device, dtype=DTYPES[precision.name])
    step = RecordedStep(net) if device == "cpu" else net
    return LoadedGenerator(net, step, trained, note, precision, torch.device(device))


def _untrained(settings: PixelFixerSettings) -> PixelGenerator:
    if settings.untrained == "refuse":
        found = "no weights, and settings.untrained is 'refuse'"
        raise InputError(DOING, f"{settings.name}, weights.bundle", found, weights_to_give("bundle"))
    given = settings.generator
    sizes = PixelSizes(**given.model_dump())
    net = PixelGenerator.random(sizes, derive_seed("fixer", 0, settings.name))
    if settings.untrained == "identity":
        torch.nn.init.zeros_(net.write.weight)
    return net
