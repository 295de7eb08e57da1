"""OneFixer as a streaming session: one causal flow step per block, a history per rollout and camera,
every frame guarded.

Frames are grouped into views (`views`), run through the networks (`pipeline`), checked (`guard`)
and returned as frames. The session holds the history: the pipeline's state, and the last frame of
every camera.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.block_fixers.clips import (
    SIDE,
    TOKEN_PX,
    crop_clip,
    to_clip,
    to_images,
)
from alpasim_plugin.block_fixers.networks import LATENT, load_networks
from alpasim_plugin.block_fixers.pipeline import BlockPipeline, PipelineState
from alpasim_plugin.block_fixers.settings import OneFixerSettings
from alpasim_plugin.core.devices import upload
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.interfaces import BlockRule, Fixer
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import U8, Frame
from alpasim_plugin.fixers import guard
from alpasim_plugin.fixers.views import Views, group_views


def latent_noise(
    scene_id: str,
    seed: int,
    cameras: Sequence[str],
    draws: int,
    latents: range,
    shape: tuple[int, int, int],
) -> list[Tensor]:
    """Draw standard normal latents.

    Args:
        scene_id, seed: Key of the rollout.
        cameras: Names of the views in the batch.
        draws: Per latent: one per flow step, and one for a cache write by a forward.
        latents: Absolute indices in the rollout.
        shape: Channels, height and width of a latent.

    Returns:
        Per draw ``(B, C, T, h, w)`` float32, on the CPU so that every device sees the same numbers.
    """

    def one(draw: int, camera: str, index: int) -> np.ndarray:
        return stream(scene_id, seed, f"fixer/{camera}/{draw}", index).standard_normal(
            shape, np.float32
        )

    views = [
        [np.stack([one(draw, camera, i) for i in latents], axis=1) for camera in cameras]
        for draw in range(draws)
    ]
    return [torch.from_numpy(np.stack(view)) for view in views]


@dataclass(frozen=True)
class ViewsHistory:
    """History of the cameras of one size."""

    cameras: tuple[str, ...]
    shape: tuple[int, int]  # height and width of their images
    state: PipelineState
    # per camera the last frame as decoded, also if the guard returned the raw one, and the raw one
    last: tuple[tuple[U8, U8], ...] = ()


@dataclass(frozen=True)
class PendingBlock:
    """A fixed block that is not part of the history yet."""

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
        InputError: Weights that are missing or do not fit.
    """

    def __init__(
        self,
        settings: OneFixerSettings,
        scene_id: str,
        seed: int = 0,
        device: str = "cpu",
        threads: int | None = None,
    ) -> None:
        if threads is not None:
            torch.set_num_threads(threads)
        self.settings, self.scene_id, self.seed = settings, scene_id, seed
        self.networks = load_networks(settings, device)
        self.pipeline = BlockPipeline(self.networks, settings)
        self.blocks = BlockRule.of_latents(settings.block_latents)
        self.trained = self.networks.trained
        step_suffix = f"@{len(settings.steps)}" if len(settings.steps) > 1 else ""
        self.label = f"{settings.name}{step_suffix}, {self.networks.note}"
        self.reset(seed)

    def reset(self, seed: int) -> None:
        """Drop the history and use the noise of another seed."""
        self.seed = seed
        self._done = 0
        self._history: tuple[ViewsHistory, ...] = ()
        self._pending: tuple[PendingBlock, ...] = ()

    def preview(self, block: Sequence[Frame], maps: Sequence[U8]) -> Sequence[Frame]:
        """Fix the block in progress; the history stays as it was.

        Args:
            block: Frames of the rollout's cameras, at most as many per camera as ``blocks`` says.
                The cameras stay the same.
            maps: Semantic maps of the same frames, or empty; ignored unless the settings say
                ``uses_map``.

        Returns:
            As many frames, same order, times and cameras. Opacity and depth remain the render's.

        Raises:
            InputError: A block that does not continue the rollout, or is not one (see
                `views.group_views`).
            RendererError: An opacity that is not a number or outside [0, 1].
        """
        views = group_views(
            block, maps if self.settings.uses_map else (), self.blocks.frames(self._done)
        )
        layout, first_layout = (
            [(part.cameras, part.shape) for part in parts] for parts in (views, self._history)
        )
        if layout != first_layout and not self._done:
            self._history = tuple(self._open(view) for view in views)
            self._pending = ()
        elif layout != first_layout:
            raise InputError(
                f"block {self._done}: cameras and sizes {layout} after {first_layout}",
                "give the same cameras at the same sizes in every block, or reset",
            )
        pending = [block.views for block in self._pending]
        if not (
            len(pending) == len(views)
            and all(view.equals(before) for view, before in zip(views, pending, strict=True))
        ):
            self._pending = tuple(
                self._fix(view, history) for view, history in zip(views, self._history, strict=True)
            )
        return self._with_images(block)

    def _with_images(self, block: Sequence[Frame]) -> tuple[Frame, ...]:
        """Return the frames with the pending block's images; where the network failed, the event in
        place of an image.
        """
        frames = list(block)
        for fixed in self._pending:
            for b, indices in enumerate(fixed.views.index):
                for t, i in enumerate(indices):
                    event = fixed.events[b][t]
                    if event:
                        frames[i] = replace(block[i], events=(*block[i].events, event))
                    else:
                        frames[i] = replace(block[i], rgb=fixed.images[b, t])
        return tuple(frames)

    def step(self, block: Sequence[Frame], maps: Sequence[U8]) -> Sequence[Frame]:
        """Fix a block and add it to the history. A block equal to the last preview's is not
        computed again. See `preview`.
        """
        fixed = self.preview(block, maps)
        self._history = tuple(self._keep(block) for block in self._pending)
        self._pending = ()
        self._done += 1
        return fixed

    def _open(self, view: Views) -> ViewsHistory:
        height, width = (side + -side % TOKEN_PX for side in view.shape)
        return ViewsHistory(
            view.cameras, view.shape, self.pipeline.start(len(view.cameras), height, width)
        )

    def _fix(self, view: Views, history: ViewsHistory) -> PendingBlock:
        clip = to_clip(view, self.blocks.frames(self._done), self.networks.device)
        shape = (LATENT, clip.rgb.shape[3] // SIDE, clip.rgb.shape[4] // SIDE)
        first = history.state.latent
        latents = range(first, first + self.settings.block_latents)
        noise_arrays = latent_noise(
            self.scene_id, self.seed, view.cameras, self.pipeline.draws, latents, shape
        )
        noise = [upload(eps, self.networks.device) for eps in noise_arrays]
        video, state = self.pipeline.run(history.state, clip.rgb, clip.alpha, clip.maps, noise)
        video = crop_clip(video, view.size)
        images = to_images(video, view.size)
        events = []
        for b in range(len(view.cameras)):
            before = history.last[b] if history.last else None
            events.append(
                tuple(guard.check_frames(video[b].transpose(0, 1), images[b], view.rgb[b], before))
            )
        return PendingBlock(view, images, tuple(events), state)

    def _keep(self, block: PendingBlock) -> ViewsHistory:
        has_nan = any(guard.NAN in events for events in block.events)
        view = block.views
        keep = self.pipeline.drop_history if has_nan else self.pipeline.keep
        return ViewsHistory(
            view.cameras,
            view.shape,
            keep(block.state),
            tuple(zip(block.images[:, -1], view.rgb[:, -1], strict=True)),
        )
