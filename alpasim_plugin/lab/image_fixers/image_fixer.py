"""Image models as a streaming session: one frame in, one frame out, every frame guarded.

DiFix3D+, DiffusionHarmonizer and GSFix3D repair a frame by itself; the temporal DiffusionHarmonizer
also looks at its last four outputs, as they were shown. Cameras of one size in a step are one
batch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.block_fixers.clips import SIDE, Clip, crop_clip, to_clip, to_images
from alpasim_plugin.block_fixers.networks import LATENT, load_networks
from alpasim_plugin.block_fixers.onefixer import latent_noise
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.interfaces import BlockRule, Fixer
from alpasim_plugin.core.types import U8, Frame
from alpasim_plugin.fixers import guard
from alpasim_plugin.fixers.settings import FixerSettings
from alpasim_plugin.fixers.views import Views, check_continues, group_views
from alpasim_plugin.lab.image_fixers.pipeline import fix_images, sample_window
from alpasim_plugin.lab.image_fixers.settings import (
    MaplessSettings,
    NoiseWindowSettings,
    RenderStepSettings,
)


@dataclass(frozen=True)
class ImageHistory:
    """The past of one camera."""

    frames: int  # fixed so far: index of the next frame's noise
    t_us: int  # of the last
    raw: U8  # (H, W, 3) the last render
    fixed: U8  # (H, W, 3) the last output as generated, also if the guard returned the raw frame
    # (H, W, 3) last outputs as returned, newest first; as many as the network looks at
    references: tuple[U8, ...]


class MaplessFixer(Fixer):
    """What the sessions without a map have in common: networks, label, times and the key of the
    noise.

    Args:
        settings: Of the session's kind.
        scene_id, seed: Key of the noise.
        device: ``cpu`` or ``cuda``.
        threads: Torch threads that this process may use; as many are used as pay. None leaves their
            number.

    Raises:
        InputError: Weights that are missing or do not fit.
    """

    def __init__(
        self, settings: MaplessSettings, scene_id: str, seed: int, device: str, threads: int | None
    ) -> None:
        if threads is not None:
            torch.set_num_threads(threads)
        self.scene_id = scene_id
        self.networks = load_networks(settings, device)
        self.trained = self.networks.trained
        count = len(settings.network_times)
        self.label = f"{settings.name}{f'@{count}' if count > 1 else ''}, {self.networks.note}"
        self.reset(seed)


class ImageFixer(MaplessFixer):
    """Repair the frames of one rollout one by one. A step may hold other cameras than the step
    before.

    Args:
        settings: Of `RenderStepSettings`, or of `NoiseWindowSettings` with windows of one frame.
        scene_id, seed: Key of the noise, with the camera and the frame's index in the rollout.
        device, threads: See `MaplessFixer`.

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
        if (
            not isinstance(settings, RenderStepSettings | NoiseWindowSettings)
            or settings.is_offline
        ):
            problem = f"settings of type {type(settings).__name__}" + (
                " for whole clips" if settings.is_offline else ""
            )
            raise InputError(
                f"{settings.name}: {problem}",
                "take them from fixer_settings(name)",
            )
        self.settings = settings
        super().__init__(settings, scene_id, seed, device, threads)

    def reset(self, seed: int) -> None:
        """Drop the history of every camera and use the noise of another seed."""
        self.seed = seed
        self._history: dict[str, ImageHistory] = {}

    def step(self, block: Sequence[Frame], maps: Sequence[U8]) -> Sequence[Frame]:
        """Fix one frame of some cameras and add them to their histories.

        Args:
            block: One frame per camera.
            maps: Ignored: these models have no input for a map.

        Returns:
            As many frames, same order, times and cameras. Opacity and depth remain the render's.

        Raises:
            InputError: Frames that do not continue the rollout, or are none (see
                `views.group_views`).
            RendererError: An opacity that is not a number or outside [0, 1].
        """
        views = group_views(block, (), 1)
        for view in views:
            check_continues(view, self._history)
        out = list(block)
        after = dict(self._history)
        for view in views:
            pasts = [self._history.get(camera) for camera in view.cameras]
            video = crop_clip(self._run(view, pasts), view.size)
            images = to_images(video, view.size)[:, 0]
            for b, past in enumerate(pasts):
                (i,), raw = view.index[b], view.rgb[b, 0]
                before = None if past is None else (past.fixed, past.raw)
                event = guard.check_frames(
                    video[b].transpose(0, 1), images[b : b + 1], raw[None], before
                )[0]
                out[i] = (
                    replace(block[i], events=(*block[i].events, event))
                    if event
                    else replace(block[i], rgb=images[b])
                )
                after[view.cameras[b]] = self._continued(
                    past, view.t_us[b][0], raw, images[b], out[i].rgb
                )
        self._history = after
        return tuple(out)

    def _run(self, view: Views, pasts: Sequence[ImageHistory | None]) -> Tensor:
        """Return the fixed frames ``(B, 3, 1, H, W)``, padded and not clipped."""
        clip = to_clip(view, 1, self.networks.device)
        if isinstance(self.settings, NoiseWindowSettings):
            return sample_window(
                self.networks,
                self.settings,
                clip.rgb,
                clip.alpha,
                self._noise(view, clip, pasts),
            )
        out = torch.empty_like(clip.rgb)
        wanted = self.settings.references
        # A camera's first frames have too few outputs before them: they are fixed by themselves, in
        # a batch of their own.
        joined = [
            b
            for b, past in enumerate(pasts)
            if past is not None and len(past.references) == wanted > 0
        ]
        for rows in (joined, [b for b in range(len(pasts)) if b not in joined]):
            if rows:
                references = (
                    self._references(view, [pasts[b] for b in rows]) if rows is joined else None
                )
                out[rows] = fix_images(
                    self.networks, self.settings, clip.rgb[rows], clip.alpha[rows], references
                )
        return out

    def _references(self, view: Views, pasts: Sequence[ImageHistory | None]) -> Tensor:
        rgb = np.stack([np.stack(past.references) for past in pasts if past is not None])
        return to_clip(
            replace(view, rgb=rgb, alpha=None, maps=None), rgb.shape[1], self.networks.device
        ).rgb

    def _noise(self, view: Views, clip: Clip, pasts: Sequence[ImageHistory | None]) -> Tensor:
        assert isinstance(self.settings, NoiseWindowSettings)
        shape = (LATENT, clip.rgb.shape[3] // SIDE, clip.rgb.shape[4] // SIDE)
        noise = []
        for camera, past in zip(view.cameras, pasts, strict=True):
            index = 0 if past is None or self.settings.noise == "fixed" else past.frames
            noise += latent_noise(
                self.scene_id, self.seed, [camera], 1, range(index, index + 1), shape
            )
        return torch.cat(noise).to(self.networks.device)

    def _continued(
        self, past: ImageHistory | None, t_us: int, raw: U8, fixed: U8, displayed: U8
    ) -> ImageHistory:
        count = self.settings.references if isinstance(self.settings, RenderStepSettings) else 0
        frames, references = (0, ()) if past is None else (past.frames, past.references)
        return ImageHistory(frames + 1, t_us, raw, fixed, (displayed, *references)[:count])
