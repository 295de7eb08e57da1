"""One block through the networks: encode, mix (Eq. 1), flow (Eq. 2), decode, write the history.
Tensors in, tensors out.

A run leaves the history unchanged: it may be repeated from the same state, with other frames, any
number of times. `BlockPipeline.keep` adds its result to the history. Only one draft is open at a
time, for the cache has one open block. A `StageClock` adds up the time of each stage.

On a GPU a block is recorded as CUDA graphs once its shapes repeat, and replayed from then on
(`block_fixers.graphs`): one recording for the block, one for the cache write, per rollout. Timing
the stages runs them one by one, so it disables recordings.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from torch import Tensor

from alpasim_plugin.block_fixers.graphs import CudaRecorder, Function, GraphedFunction, Recorder
from alpasim_plugin.block_fixers.kv_cache import RollingCache
from alpasim_plugin.block_fixers.networks import Networks, decode
from alpasim_plugin.block_fixers.sampling import (
    finalise,
    mixed_source,
    opacity_mask,
    opacity_values,
    sample_block,
    sources_needed,
)
from alpasim_plugin.block_fixers.settings import OneFixerSettings
from alpasim_plugin.block_fixers.streaming import State
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers.network.schedule import from_names

STAGES = ("encode", "source", "dit", "decode", "cache write")  # of `BlockPipeline`, in order
TIMED = (
    "encode",
    "dit",
    "decode",
    "cache write",
)  # what tables show: mixing noise into the source takes next to nothing
Stage = Callable[[str], AbstractContextManager[object]]


class StageClock:
    """Add up the wall time of named stages; what `BlockPipeline` takes as its ``stage``.

    Args:
        device: On an accelerator, queued work is waited for at both ends of a stage.
    """

    def __init__(self, device: torch.device | str = "cpu") -> None:
        self._device = torch.device(device)
        self.ms: dict[str, float] = {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Time one pass through a stage."""
        begin = self.now()
        yield
        self.ms[name] = self.ms.get(name, 0.0) + (self.now() - begin) * 1e3

    def now(self) -> float:
        """Return seconds, with the device's queue empty."""
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)
        return time.perf_counter()

    def take(self) -> dict[str, float]:
        """Return the milliseconds by stage since the last call."""
        ms, self.ms = self.ms, {}
        return ms


def no_clock(name: str) -> AbstractContextManager[object]:
    """Run a stage untimed."""
    return nullcontext()


def condition_of(
    settings: OneFixerSettings, z_map: Tensor, z_render: Tensor, opacity: Tensor | None
) -> Tensor:
    """Return what the transformer sees besides its source ``(B, channels, T, h, w)``.

    Args:
        settings: Say which of the inputs it sees.
        z_map, z_render: ``(B, 16, T, h, w)``.
        opacity: From `opacity_input`.
    """
    parts = [
        z_map,
        *([z_render] if settings.render_input else []),
        *([] if opacity is None else [opacity]),
    ]
    return torch.cat(parts, dim=1) if len(parts) > 1 else z_map


def opacity_input(
    settings: OneFixerSettings, rgb: Tensor, alpha: Tensor | None, first: bool
) -> Tensor | None:
    """Return the opacity for the transformer's blocks, None where they do not embed it; no opacity
    is an opaque render.
    """
    if not settings.opacity_input:
        return None
    return opacity_values(torch.ones_like(rgb[:, :1]) if alpha is None else alpha, first)


def map_video(settings: OneFixerSettings, rgb: Tensor, sdmap: Tensor | None) -> Tensor | None:
    """Return the map's frames, or what the settings put in the place of none: black frames, or None
    for zero latents.
    """
    return torch.full_like(rgb, -1.0) if sdmap is None and settings.no_map == "black" else sdmap


@dataclass(eq=False)
class History:
    """The transformer's cache, the state at its end, and the open block."""

    cache: RollingCache
    fix: Function  # the block, as it is or through a recording
    finalise: Function  # the cache write
    kept: PipelineState | None = None
    draft: PipelineState | None = None
    write: Callable[[], None] = field(
        default=lambda: None, repr=False
    )  # adds the open block to the cache


@dataclass(frozen=True, eq=False)
class PipelineState:
    """State of a rollout before a block. Everything is immutable but the cache, which `History`
    guards.
    """

    latent: int  # absolute index of the next block's first latent
    encoder: State | None  # render and map views as one batch
    decoder: State | None
    with_map: bool | None  # None before the first block
    history: History


class BlockPipeline:
    """Run blocks of views through the networks of a fixer.

    Args:
        networks: Shared, never written to.
        settings: Window, steps, history, source, decoder.
        stage: Called as ``with stage(name):`` around ``encode``, ``source``, ``dit``, ``decode``
            and ``cache write``, for timing.
        recorder: Makes recordings; None takes CUDA graphs on a GPU unless the settings say
            ``graphs: off``, and nothing elsewhere.
    """

    def __init__(
        self,
        networks: Networks,
        settings: OneFixerSettings,
        stage: Stage = no_clock,
        recorder: Recorder | None = None,
    ) -> None:
        self.networks, self.settings, self.stage = networks, settings, stage
        self.schedule = from_names(settings.steps)
        if recorder is None and settings.graphs != "off" and networks.device.type == "cuda":
            recorder = CudaRecorder(networks.device)
        self.recorder = recorder

    @property
    def draws(self) -> int:
        """How many draws of noise a block takes."""
        return sources_needed(self.schedule, self.settings.history)

    def start(self, batch: int, height: int, width: int) -> PipelineState:
        """Return the state before a rollout's first block.

        Args:
            batch: Number of views.
            height, width: Pixels, multiples of 16.
        """
        cache = self.networks.dit.new_cache(
            batch, height // 8, width // 8, self.settings.window, self.settings.sink
        )
        assert isinstance(cache, RollingCache), "a cache for inference"
        parts = partial(self._fix, cache), partial(self._finalise, cache)
        fix, finalise = (
            parts
            if self.recorder is None
            else (GraphedFunction(part, self.recorder) for part in parts)
        )
        history = History(cache, fix, finalise)
        history.kept = PipelineState(0, None, None, None, history)
        return history.kept

    @torch.inference_mode()
    def run(
        self,
        state: PipelineState,
        rgb: Tensor,
        alpha: Tensor | None,
        sdmap: Tensor | None,
        noise: Sequence[Tensor],
    ) -> tuple[Tensor, PipelineState]:
        """Fix one block.

        Args:
            state: From `start` or an earlier run; a draft's state is kept first.
            rgb: ``(B, 3, T, H, W)`` render in [-1, 1]; T is ``1 + 4 (block_latents - 1)`` in the
                first block, then ``4 block_latents``.
            alpha: ``(B, 1, T, H, W)`` opacity, or None where all is opaque.
            sdmap: ``(B, 3, T, H, W)`` semantic map in [-1, 1], or None for the whole rollout; then
                ``no_map`` says what takes its place.
            noise: `draws` standard normal tensors ``(B, 16, block_latents, H / 8, W / 8)``.

        Returns:
            ``(B, 3, T, H, W)``, not clipped to [-1, 1], and the state after the block, still a
            draft.

        Raises:
            InputError: A state that is out of date, a map in some blocks of a rollout only, or
                another shape.
        """
        self.keep(state)
        settings = self.settings
        if state.with_map not in (None, sdmap is not None):
            found = (
                "a map after blocks without one"
                if sdmap is not None
                else "no map after blocks with one"
            )
            raise InputError(
                f"latent {state.latent}: {found}",
                "give the map in every block of a rollout, or in none",
            )
        with self.stage("source"):
            mask = (
                None
                if alpha is None or settings.holes == "render"
                else opacity_mask(alpha, first=state.latent == 0)
            )
            opacity = opacity_input(settings, rgb, alpha, first=state.latent == 0)
        cache, history = state.history.cache, state.history
        shown = map_video(settings, rgb, sdmap)
        block = (
            rgb,
            alpha,
            shown,
            mask,
            opacity,
            list(noise[: len(self.schedule)]),
            state.encoder,
            state.decoder,
        )
        out, z_0, condition, encoder, decoder = self._call(history, history.fix, *block)
        new = PipelineState(
            state.latent + z_0.shape[2], encoder, decoder, sdmap is not None, history
        )

        def write() -> None:
            if settings.history == "finalise":
                self._call(history, history.finalise, z_0, noise[-1], condition)
            cache.commit()

        history.draft, history.write = new, write
        return out, new

    def _call(self, history: History, function: Function, *args: object) -> Any:
        """Run a part of the block that is open in the cache, through its recording where there is
        one.
        """
        if not isinstance(function, GraphedFunction):
            return function(*args)
        if self.stage is not no_clock:
            return function.eagerly(*args)
        history.cache.begin(self.settings.block_latents)
        return function(*args, key=history.cache.visible)

    def _fix(
        self,
        cache: RollingCache,
        rgb: Tensor,
        alpha: Tensor | None,
        sdmap: Tensor | None,
        mask: Tensor | None,
        opacity: Tensor | None,
        noise: Sequence[Tensor],
        encoder: State | None,
        decoder: State | None,
    ) -> tuple[Tensor, Tensor, Tensor, State, State]:
        """Fix the frames of a block; writes only to the open block of the cache.

        Returns:
            Frames, latents, the condition, and both codecs' states after the block.
        """
        nets = self.networks
        with self.stage("encode"):
            views = rgb if sdmap is None else torch.cat([rgb, sdmap])
            latents, encoder = nets.vae.encode_next(views, encoder)
            z_render, z_map = latents[: len(rgb)].float(), latents[len(rgb) :].float()
            z_map = torch.zeros_like(z_render) if sdmap is None else z_map
        with self.stage("source"):
            if self.settings.holes == "everywhere":
                sources = list(noise)
            else:
                sources = [
                    z_render if mask is None else mixed_source(z_render, mask, eps) for eps in noise
                ]
            condition = condition_of(self.settings, z_map, z_render, opacity)
        with self.stage("dit"):
            z_0 = sample_block(
                nets.dit,
                sources,
                nets.text,
                condition,
                cache,
                self.schedule,
                "last-forward",
                commit=False,
            )
        with self.stage("decode"):
            out, decoder = decode(nets, self.settings, z_0, rgb, alpha, decoder)
        return out, z_0, condition, encoder, decoder

    def _finalise(self, cache: RollingCache, z_0: Tensor, eps: Tensor, z_map: Tensor) -> None:
        nets = self.networks
        finalise(nets.finalise_dit, z_0, eps, nets.text, z_map, cache, commit=False)

    @torch.inference_mode()
    def keep(self, state: PipelineState) -> PipelineState:
        """Add the block that led to ``state`` to the history; does nothing if it is part of it
        already.

        Raises:
            InputError: Another run or later blocks came since.
        """
        history = state.history
        if state is history.draft:
            with self.stage("cache write"):
                history.write()
            history.kept, history.draft, history.write = state, None, lambda: None
        elif state is not history.kept:
            raise InputError(
                f"latent {state.latent}: an out-of-date state: another run or later blocks came since",
                "continue from the newest state, or start a new rollout",
            )
        return state

    @torch.inference_mode()
    def drop_history(self, state: PipelineState) -> PipelineState:
        """Return a state at the same latent without NaN: the KV cache is emptied, NaN in the
        codecs' states becomes 0.
        """
        history = state.history
        history.cache.reset(state.latent)

        def clean(codec: State | None) -> State | None:
            return (
                None
                if codec is None
                else tuple(torch.nan_to_num(part, 0.0, 0.0, 0.0) for part in codec)
            )

        history.kept = PipelineState(
            state.latent, clean(state.encoder), clean(state.decoder), state.with_map, history
        )
        history.draft, history.write = None, lambda: None
        return history.kept
