"""OneFixer as a streaming session: one causal flow step per block, a history per rollout and camera, every frame guarded.

Frames are grouped into views (`views`), run through the networks (`pipeline`), looked at (`guard`) and handed back as frames. The session
holds what the past is: the pipeline's state, and the last frame of every camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from alpasim_plugin.errors import InputError
from alpasim_plugin.fixers import guard
from alpasim_plugin.fixers.networks import LATENT, load_networks
from alpasim_plugin.fixers.noise import latent_noise
from alpasim_plugin.fixers.pipeline import BlockPipeline, PipelineState, no_clock
from alpasim_plugin.fixers.settings import FixerSettings, OneFixerSettings
from alpasim_plugin.fixers.stage_clock import TIMED, StageClock
from alpasim_plugin.fixers.views import DOING, SIDE, Views, group_views, to_clip, to_images
from alpasim_plugin.nets.clips import SIDE as LATENT_SIDE
from alpasim_plugin.nets.clips import crop_clip
from alpasim_plugin.types import U8, BlockRule, Fixer, Frame


@dataclass(frozen=True)
class Past:
    """Where the cameras of one size stand after their last block."""

    cameras: tuple[str, ...]
    shape: tuple[int, int]  # height and width of their images
    state: PipelineState
    last_t_us: tuple[int, ...] = ()  # per camera; empty before the first block
    last_fixed: U8 | None = None  # (B, H, W, 3) as decoded, also where the guard passed the raw frame on
    last_raw: U8 | None = None  # (B, H, W, 3)


@dataclass(frozen=True)
class Draft:
    """A block that has been fixed but is not the past yet."""

    views: Views
    images: U8  # (B, T, H, W, 3)
    events: tuple[tuple[str, ...], ...]  # per camera and frame, "" where it is fine
    state: PipelineState


class OneFixer(Fixer):
    """Repair the frames of one rollout block by block.

    Args:
        settings: Sizes, weights, window, steps, precision.
        scene_id, seed: Key of the noise, with the camera and the latent's index.
        device: ``cpu`` or ``cuda``.
        threads: Torch threads of this process; None leaves their number.

    Raises:
        InputError: Settings of another fixer, or weights that are missing or do not fit.
    """

    def __init__(self, settings: FixerSettings, scene_id: str, seed: int = 0, device: str = "cpu", threads: int | None = None) -> None:
        if not isinstance(settings, OneFixerSettings):
            found = f"settings of type {type(settings).__name__}"
            raise InputError("making a fixer", settings.name, found, "take them from fixer_settings(name)")
        if threads is not None:
            torch.set_num_threads(threads)
        self.settings, self.scene_id, self.seed = settings, scene_id, seed
        self.networks = load_networks(settings, device)
        # On an accelerator a clock would wait for every stage and forbid recordings; there the block is timed as a whole.
        self._clock = StageClock(device) if self.networks.device.type == "cpu" else None
        self.pipeline = BlockPipeline(self.networks, settings, self._clock or no_clock)
        self.blocks = BlockRule(1, 1) if settings.history == "none" else BlockRule.of_latents(settings.block_latents)
        self.trained = self.networks.trained
        at = f"@{len(settings.steps)}" if len(settings.steps) > 1 else ""
        self.label = f"{settings.name}{at}, {self.networks.note}"
        self.reset(seed)

    @property
    def stage_ms(self) -> dict[str, float]:  # type: ignore[override]  # computed when it is read
        """Wall time by stage since the session was made, milliseconds; sums that only grow. Empty where stages are not timed."""
        return {} if self._clock is None else {name: self._clock.ms.get(name, 0.0) for name in TIMED}

    def reset(self, seed: int) -> None:
        """Forget all history and take the noise of another seed."""
        self.seed = seed
        self._done = 0
        self._past: tuple[Past, ...] = ()
        self._drafts: tuple[Draft, ...] = ()

    def preview(self, block: Sequence[Frame], maps: Sequence[U8]) -> Sequence[Frame]:
        """Fix the block in progress; the history stays as it was.

        Args:
            block: Frames of the rollout's cameras, at most as many per camera as ``blocks`` says. The cameras stay the same.
            maps: Semantic maps of the same frames, or empty; ignored unless the settings say ``uses_map``.

        Returns:
            As many frames, same order, times and cameras. Opacity and depth remain the render's.

        Raises:
            InputError: A block that does not continue the rollout, or is not one (see `views.group_views`).
            RendererError: An opacity that is not a number or outside [0, 1].
        """
        views = self._views(block, maps)
        if not self._is_drafted(views):
            self._drafts = tuple(self._fix(view, past) for view, past in zip(views, self._past, strict=True))
        return self._frames(block)

    def step(self, block: Sequence[Frame], maps: Sequence[U8]) -> Sequence[Frame]:
        """Fix a block and make it the past. A block equal to the last preview's is not computed again. See `preview`."""
        fixed = self.preview(block, maps)
        self._past = tuple(self._keep(draft) for draft in self._drafts)
        self._drafts = ()
        self._done += 1
        return fixed

    def _views(self, block: Sequence[Frame], maps: Sequence[U8]) -> tuple[Views, ...]:
        """Group a block and check that it continues the rollout; a rollout's first block opens its history."""
        views = group_views(block, maps if self.settings.uses_map else (), self.blocks.frames(self._done))
        given, known = ([(part.cameras, part.shape) for part in parts] for parts in (views, self._past))
        if given != known and not self._done:
            self._past, self._drafts = tuple(self._open(view) for view in views), ()
        elif given != known:
            do = "give the same cameras at the same sizes in every block, or reset"
            raise InputError(DOING, f"block {self._done}", f"cameras and sizes {given} after {known}", do)
        for view, past in zip(views, self._past, strict=True) if self._done else ():
            for camera, times, last in zip(view.cameras, view.t_us, past.last_t_us, strict=True):
                if times[0] <= last:
                    found = f"a frame at {times[0]} us after one at {last} us"
                    raise InputError(DOING, f"camera {camera!r}, block {self._done}", found, "give frames in the order of time, or reset")
        return views

    def _open(self, view: Views) -> Past:
        height, width = (side + -side % SIDE for side in view.shape)
        return Past(view.cameras, view.shape, self.pipeline.start(len(view.cameras), height, width))

    def _is_drafted(self, views: Sequence[Views]) -> bool:
        drafts = [draft.views for draft in self._drafts]
        return len(drafts) == len(views) and all(view.same(draft) for view, draft in zip(views, drafts, strict=True))

    def _fix(self, view: Views, past: Past) -> Draft:
        clip = to_clip(view, self.blocks.frames(self._done), self.networks.device)
        shape = (LATENT, clip.rgb.shape[3] // LATENT_SIDE, clip.rgb.shape[4] // LATENT_SIDE)
        first = self._done if self.settings.history == "none" else past.state.latent
        latents = range(first, first + self.settings.block_latents)
        drawn = latent_noise(self.scene_id, self.seed, view.cameras, self.pipeline.draws, latents, shape)
        noise = [eps.to(self.networks.device) for eps in drawn]
        video, state = self.pipeline.run(past.state, clip.rgb, clip.alpha, clip.maps, noise)
        video = crop_clip(video, view.size)
        images = to_images(video, view.size)
        events = []
        for b in range(len(view.cameras)):
            before = None if past.last_fixed is None or past.last_raw is None else (past.last_fixed[b], past.last_raw[b])
            events.append(tuple(guard.judge(video[b], images[b], view.rgb[b], before)))
        return Draft(view, images, tuple(events), state)

    def _keep(self, draft: Draft) -> Past:
        poisoned = any(guard.NAN in events for events in draft.events)
        view = draft.views
        if self.settings.history == "none":
            state = self._open(view).state
        else:
            state = self.pipeline.forget(draft.state) if poisoned else self.pipeline.keep(draft.state)
        return Past(view.cameras, view.shape, state, tuple(times[-1] for times in view.t_us), draft.images[:, -1], view.rgb[:, -1])

    def _frames(self, block: Sequence[Frame]) -> tuple[Frame, ...]:
        out = list(block)
        for draft in self._drafts:
            for b, mine in enumerate(draft.views.index):
                for t, i in enumerate(mine):
                    event = draft.events[b][t]
                    out[i] = replace(block[i], events=(*block[i].events, event)) if event else replace(block[i], rgb=draft.images[b, t])
        return tuple(out)
