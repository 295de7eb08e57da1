"""The generator in pixels, from weights or untrained, loaded once per process and recorded once a shape repeats.

The network has some forty small operations, and Python between them takes a tenth of a frame's time on a CPU. A recording (TorchScript,
frozen weights) runs the same operations without it.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, Literal

import torch
from torch import Tensor, nn

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import derive_seed
from alpasim_plugin.fixers.bundle import read_bundle, weights_to_give
from alpasim_plugin.fixers.gather import gather_beside_cpu, gather_cells_cpu, likeness_cpu, mix_cpu, offsets_cpu
from alpasim_plugin.fixers.pixel_settings import PixelFixerSettings
from alpasim_plugin.nets.machine_probe import Choice, choose_precision, require_device
from alpasim_plugin.nets.pixel_generator import GatheredCells, PixelGenerator, PixelSizes, PixelState
from alpasim_plugin.nets.reference_blend import BesideCells, BlendHeads

DOING = "loading the network of a fixer"
DTYPES: Mapping[Literal["fp32", "bf16"], torch.dtype] = {"fp32": torch.float32, "bf16": torch.bfloat16}
AFTER = 8  # frames of a shape before it is recorded: recording takes as long as some thirty frames


@dataclass(frozen=True, eq=False)
class LoadedGenerator:
    """A generator ready to run; read-only and stateless, so rollouts share it."""

    net: PixelGenerator
    step: Callable[..., tuple[Tensor, PixelState]]  # the same at t = 1
    trained: bool
    note: str  # description of the weights, for labels
    precision: Choice
    device: torch.device


def load_generator(settings: PixelFixerSettings, device: str = "cpu") -> LoadedGenerator:
    """Build the generator that the settings name, or return it if this process has built it before.

    Raises:
        InputError: Weights that are missing or do not fit.
        FixerError: The device does not work.
    """
    require_device(device, DOING)
    return _load(settings.model_copy(update={"keep_render": True}), device)


@lru_cache(maxsize=4)
def _load(settings: PixelFixerSettings, device: str) -> LoadedGenerator:
    precision = choose_precision(settings.precision, device)
    if settings.weights.bundle is not None:
        bundle = read_bundle(settings.weights.bundle, settings)
        net, trained, note = PixelGenerator.from_state_dict(bundle.parts["generator"], settings.weights.bundle), bundle.trained, bundle.note
    else:
        net, trained, note = _untrained(settings), False, f"untrained ({settings.untrained})"
    net = net.requires_grad_(False).eval().to(device=device, dtype=DTYPES[precision.name])
    if device == "cpu" and net.blend is not None:
        net.blend.likeness, net.blend.offsets = likeness_cpu, offsets_cpu
    step = RecordedStep(net) if device == "cpu" else partial(_step_on, net)
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


def _step_on(
    net: PixelGenerator, render: Tensor, opacity: Tensor, sdmap: Tensor, state: PixelState, source: Tensor, references: Tensor | None = None
) -> tuple[Tensor, PixelState]:
    """Call a generator at t = 1 on another device."""
    out: tuple[Tensor, PixelState] = net(render, opacity, sdmap, state, source, None, references)
    return out


class RecordedStep:
    """Call a generator on the CPU at t = 1; equal to calling the network, to rounding.

    Args:
        net: In evaluation mode, never written to.
        after: Calls of a shape before it is recorded; None records nothing.
    """

    def __init__(self, net: PixelGenerator, after: int | None = AFTER) -> None:
        self._step, self._after = _Step(net).eval(), after
        self._calls: Counter[tuple[int, ...]] = Counter()
        self.recorded: dict[tuple[int, ...], Any] = {}

    def __call__(
        self, render: Tensor, opacity: Tensor, sdmap: Tensor, state: PixelState, source: Tensor, references: Tensor | None = None
    ) -> tuple[Tensor, PixelState]:
        """Return the clean frame and the state after it; see `PixelGenerator.forward`."""
        reads = references is not None and self._step.net.blend is not None
        beside = gather_beside_cpu(references, render) if reads and references is not None else ()
        tensors = *gather_cells_cpu(render, opacity, sdmap, state, source), render, *state, *beside
        shape = *render.shape, *(part.shape[0] for part in beside)
        self._calls[shape] += 1
        if self._after is not None and shape not in self.recorded and self._calls[shape] > self._after:
            self.recorded[shape] = _record(self._step, tensors)
        out, hidden, kept, frames, *heads = self.recorded.get(shape, self._step)(*tensors)
        recorded = torch.zeros_like(render[..., :1])
        if heads and references is not None:
            out, recorded = mix_cpu(out, references, BlendHeads(*heads))
        return out, PixelState(out.clamp(-1, 1), render, hidden, kept, frames, recorded)


class _Step(nn.Module):
    """The generator with tensors alone for arguments and results."""

    def __init__(self, net: PixelGenerator) -> None:
        super().__init__()
        self.net = net

    def forward(self, coarse: Tensor, fine: Tensor, render: Tensor, *others: Tensor) -> tuple[Tensor, ...]:
        kept = len(PixelState._fields)
        beside = BesideCells(*others[kept:]) if len(others) > kept else None
        made = self.net.before_blend(GatheredCells(coarse, fine), render, PixelState(*others[:kept]), None, beside)
        return (*made[:-1], *(made.heads or ()))


def _record(step: _Step, tensors: tuple[Tensor, ...]) -> Any:
    with torch.inference_mode(False), torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        plain = tuple(tensor.clone() for tensor in tensors)  # a recording of inference tensors could not be frozen
        return torch.jit.freeze(torch.jit.trace(step, plain, check_trace=False))  # type: ignore[no-untyped-call]
