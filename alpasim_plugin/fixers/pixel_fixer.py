"""The generator in pixels as a streaming session: one frame in, one frame out, a history per
camera, every frame guarded.

`fix_frame` is one frame through the network, tensors in and tensors out: source (Eq. 1), flow steps
(Eq. 2), the harmlessness guard. Its state goes in and comes out, and nothing else is remembered.
Several cameras are a batch.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.core.devices import download
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.interfaces import BlockRule, Fixer
from alpasim_plugin.core.types import OPACITY_MEAN, U8, Frame
from alpasim_plugin.fixers import guard
from alpasim_plugin.fixers.guard import render_share
from alpasim_plugin.fixers.network.pixel_generator import (
    GRID_PX,
    PixelState,
    content_key,
    noise_key,
    sparse_source,
)
from alpasim_plugin.fixers.network.schedule import from_names, interpolant
from alpasim_plugin.fixers.pixel_network import LoadedGenerator, load_generator
from alpasim_plugin.fixers.pixel_settings import PixelFixerSettings
from alpasim_plugin.fixers.settings import FixerSettings
from alpasim_plugin.fixers.trust import trust_facts, trust_sums
from alpasim_plugin.fixers.views import (
    HALF,
    Views,
    check_continues,
    group_views,
    planes_of,
    stacked,
)


@dataclass(frozen=True)
class PixelInputs:
    """One frame of B cameras; sides are multiples of 16 ``scale``."""

    render: Tensor  # (B, H, W, 3) in [-1, 1]
    opacity: Tensor  # (B, H, W, 1), 0 to 1
    sdmap: Tensor  # (B, H, W, 3) in [-1, 1]; black where there is no map
    references: Tensor | None = None  # (B, K, H, W, 4) uint8, colour and where it holds
    scale: int = 1  # the network looks at images that are this many times smaller


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
        ``(B, H, W, 3)``, not clipped to [-1, 1], and the state after the frame, whose last output
        is this one.
    """
    render = inputs.render

    def predict(z: Tensor, t: Tensor | None) -> tuple[Tensor, PixelState]:
        images = render, inputs.opacity, inputs.sdmap
        predicted: tuple[Tensor, PixelState] = generator.net(
            *images, state, z, t, inputs.references, inputs.scale, generator.operations
        )
        return predicted

    out, after = predict(source(0), None)
    for index, level in enumerate(from_names(settings.steps)[1:], start=1):
        t = render.new_full((len(render),), level.sigma)
        out, after = predict(interpolant(out, source(index), level.sigma), t)
    if settings.keep_render:
        share = render_share(out, render, inputs.opacity, inputs.sdmap, state.output)
        if share is not None:
            out = torch.lerp(out, render, share * (1 - after.recorded))
            after = after._replace(output=out.clamp(-1, 1))
    return out, after


@dataclass(frozen=True)
class CameraHistory:
    """The past of one camera."""

    state: PixelState  # of one view
    frames: int  # fixed so far
    t_us: int  # of the last
    raw: Tensor  # (H, W, 3) uint8, the last render
    fixed: Tensor  # like it, the last output as generated, also if the guard returned the raw frame


class PixelFixer(Fixer):
    """Repair the frames of one rollout one by one. A step may hold other cameras than the step
    before; each has its own history.

    Args:
        settings: Weights, steps, precision, guard.
        scene_id, seed: Key of the noise, with camera, frame (its index or its content, see
            `PixelFixerSettings.noise`) and pixel.
        device: ``cpu`` or ``cuda``.
        threads: Torch threads of this process; None leaves their number.

    Raises:
        InputError: Settings of another fixer, or weights that are missing or do not fit.
    """

    blocks = BlockRule(1, 1)

    def __init__(
        self,
        settings: FixerSettings,
        scene_id: str,
        seed: int = 0,
        device: str = "cpu",
        threads: int | None = None,
    ) -> None:
        if not isinstance(settings, PixelFixerSettings):
            raise InputError(
                f"{settings.name}: settings of type {type(settings).__name__}",
                "take them from fixer_settings(name)",
            )
        if threads is not None:
            torch.set_num_threads(threads)
        self.settings, self.scene_id = settings, scene_id
        self.generator = load_generator(settings, device)
        self.trained = self.generator.trained
        at = f"@{len(settings.steps)}" if len(settings.steps) > 1 else ""
        self.label = f"{settings.name}{at}, {self.generator.note}, {settings.precision}"
        self.reset(seed)

    def reset(self, seed: int) -> None:
        """Drop the history of every camera and use the noise of another seed."""
        self.seed = seed
        self._history: dict[str, CameraHistory] = {}

    def step(self, block: Sequence[Frame], maps: Sequence[U8]) -> Sequence[Frame]:
        """Fix one frame of some cameras and add them to their histories.

        Args:
            block: One frame per camera.
            maps: Semantic maps of the same frames, or empty: nothing is drawn; ignored unless the
                settings say ``uses_map``.

        Returns:
            As many frames, same order, times and cameras. Opacity and depth remain the render's.

        Raises:
            InputError: Frames that do not continue the rollout, or are none (see
                `views.group_views`).
            RendererError: An opacity that is not a number or outside [0, 1].
        """
        out, self._history = self._advance(block, maps, self._history)
        return out

    def advance(
        self, frame: Frame, sdmap: U8 | None, past: CameraHistory | None
    ) -> tuple[Frame, CameraHistory]:
        """Fix one frame of one camera from a given past; the session's own histories are neither
        read nor changed.

        A past is never written to: histories can be forked, kept and continued in any order.

        Args:
            frame: The render.
            sdmap: Its semantic map; None: nothing is drawn.
            past: What an earlier call returned for the frame before; None: the first frame.

        Returns:
            The frame, and the past of the next one.

        Raises:
            InputError, RendererError: See `step`.
        """
        pasts = {} if past is None else {frame.camera: past}
        (fixed,), after = self._advance([frame], () if sdmap is None else [sdmap], pasts)
        return fixed, after[frame.camera]

    def _advance(
        self, block: Sequence[Frame], maps: Sequence[U8], pasts: Mapping[str, CameraHistory]
    ) -> tuple[tuple[Frame, ...], dict[str, CameraHistory]]:
        drawn = maps if self.settings.uses_map else ()
        views = group_views(block, drawn, 1, on_device=True)
        for view in views:
            check_continues(view, pasts)
        out, after = list(block), dict(pasts)
        for view in views:
            fixed = self._fix(view, block, pasts)
            for camera, (index,), (frame, history) in zip(
                view.cameras, view.index, fixed, strict=True
            ):
                out[index] = frame
                after[camera] = history
        return tuple(out), after

    def _fix(
        self, view: Views, block: Sequence[Frame], histories: Mapping[str, CameraHistory]
    ) -> list[tuple[Frame, CameraHistory]]:
        """Fix the frame of each camera of a view; return it and the camera's past for the next."""
        start = self.generator.net.start
        device = self.generator.device
        frames = [block[index] for (index,) in view.index]
        drawn = [] if isinstance(view.rgb, np.ndarray) else planes_of(frames)
        raw = torch.as_tensor(view.rgb[:, 0]).to(device)
        inputs = to_inputs(
            replace(view, rgb=raw[:, None]), device, self.settings.scale_of(*view.shape)
        )
        pasts = [histories.get(camera) for camera in view.cameras]
        states = [
            start(inputs.render[b : b + 1], inputs.scale) if past is None else past.state
            for b, past in enumerate(pasts)
        ]
        counts = [0 if past is None else past.frames for past in pasts]
        height, width = view.shape

        def source(draw: int) -> Tensor:
            everywhere = self.settings.holes == "everywhere"
            if self.settings.holes == "render" or (view.alpha is None and not everywhere):
                return inputs.render
            frames = counts
            if self.settings.noise == "content":
                contents = zip(view.t_us, raw.cpu().numpy(), strict=True)
                frames = [content_key(t_us[0], rgb) for t_us, rgb in contents]
            keys = [
                noise_key(self.scene_id, self.seed, camera, draw, frame)
                for camera, frame in zip(view.cameras, frames, strict=True)
            ]
            opacity = torch.zeros_like(inputs.opacity) if everywhere else inputs.opacity
            return sparse_source(inputs.render, opacity, keys)

        joined = PixelState(*(torch.cat(parts) for parts in zip(*states, strict=True)))
        video, after = fix_frame(self.generator, self.settings, inputs, joined, source)
        visible = slice(None), slice(height), slice(width)
        output = after.output[visible]
        levels = _grey_levels(output)
        before = [
            (levels[b], raw[b]) if past is None else (past.fixed, past.raw)
            for b, past in enumerate(pasts)
        ]
        fixed_before, raw_before = (torch.stack(parts) for parts in zip(*before, strict=True))
        images, measured, sums, *rest = download(
            levels,
            guard.measures(video[visible], levels, raw, fixed_before, raw_before),
            trust_sums(output, after.render[visible], after.recorded[visible]),
            *(planes.pairs for planes in drawn),
            *(planes.alpha.mean() for planes in drawn),
        )
        pairs, opacity = rest[: len(drawn)], rest[len(drawn) :]
        if not all([planes.had_room(int(n)) for planes, n in zip(drawn, pairs, strict=True)]):
            return self._fix(*_drawn_again(view, block), histories)
        fixed = []
        for b, (frame, event) in enumerate(zip(frames, guard.failures(measured), strict=True)):
            state = PixelState(*(part[b : b + 1] for part in after))
            if event == guard.NAN:  # it would stay in the state for ever
                state = start(inputs.render[b : b + 1], inputs.scale)
            history = CameraHistory(state, counts[b] + 1, view.t_us[b][0], raw[b], levels[b])
            events, facts = frame.events, dict(frame.facts)
            if frame.pending is not None:  # nobody has looked at the render yet
                events += guard.render_events(measured[b])
            if opacity:
                facts[OPACITY_MEAN] = round(float(opacity[b]), 5)
            if event:  # the render is returned, and nothing of the network's
                frame = frame.changed(references=(), events=(*events, event), facts=facts)
            else:
                facts |= trust_facts(sums[b], height, width)
                frame = frame.changed(references=(), events=events, facts=facts, rgb=images[b])
            fixed.append((frame, history))
        return fixed


def _grey_levels(images: Tensor) -> Tensor:
    """Convert images in [-1, 1] to bytes, rounded to nearest; what is no number becomes black."""
    levels = (images * HALF).add_(HALF).round_().clamp_(0, 255)
    return levels.nan_to_num_(0.0).to(torch.uint8)


def _drawn_again(view: Views, block: Sequence[Frame]) -> tuple[Views, Sequence[Frame]]:
    """Return a view that lacks splats, and its block, drawn again by the device."""
    frames = list(block)
    mine = [index for (index,) in view.index]
    again = [planes.again() for planes in planes_of([frames[index] for index in mine])]
    for index, planes in zip(mine, again, strict=True):
        frames[index] = frames[index].changed(on_device=planes)
    rgb, alpha = stacked(again)
    return replace(view, rgb=rgb[:, None], alpha=alpha[:, None]), frames


def to_inputs(view: Views, device: torch.device | str = "cpu", scale: int = 1) -> PixelInputs:
    """Convert one frame of views to tensors: ``x / 127.5 - 1``, edges repeated up to multiples of
    16 ``scale``.
    """
    height, width = view.shape
    right, below = -width % (GRID_PX * scale), -height % (GRID_PX * scale)

    def image(plane: Any) -> Tensor:
        x = torch.as_tensor(plane[:, 0]).to(device)
        if right or below:
            rows = torch.arange(height + below, device=device).clamp_(max=height - 1)
            columns = torch.arange(width + right, device=device).clamp_(max=width - 1)
            x = x[:, rows][:, :, columns]
        return x

    render = image(view.rgb).float().div_(HALF).sub_(1)
    opacity = (
        torch.ones_like(render[..., :1]) if view.alpha is None else image(view.alpha)[..., None]
    )
    sdmap = (
        torch.full_like(render, -1.0)
        if view.maps is None
        else image(view.maps).float().div_(HALF).sub_(1)
    )
    references = None
    if view.references is not None:
        padding = (0, 0, 0, right, 0, below)
        references = F.pad(torch.as_tensor(view.references[:, 0]).to(device), padding)
    return PixelInputs(render, opacity, sdmap, references, scale)
