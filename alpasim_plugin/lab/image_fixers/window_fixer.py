"""Windows over a clip, and the cross-fade that joins what was made in them.

Windows over a whole clip: the session of a fixer that needs later frames (3DGS-Enhancer).

A clip is one block. Every window is fixed by itself, from noise of its own; where windows overlap,
the later one fades in over the one before, linearly and in pixels. A frame needs those after it in
its window, which a closed loop has not driven yet: such a fixer is refused there.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.block_fixers.clips import SIDE, crop_clip, to_clip, to_images
from alpasim_plugin.block_fixers.networks import LATENT
from alpasim_plugin.block_fixers.onefixer import latent_noise
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.interfaces import BlockRule
from alpasim_plugin.core.types import F32, U8, Frame
from alpasim_plugin.fixers import guard
from alpasim_plugin.fixers.settings import FixerSettings
from alpasim_plugin.fixers.views import Views, group_views
from alpasim_plugin.lab.image_fixers.image_fixer import MaplessFixer
from alpasim_plugin.lab.image_fixers.pipeline import sample_window
from alpasim_plugin.lab.image_fixers.settings import NoiseWindowSettings

WHOLE_CLIP = sys.maxsize  # frames of a block: as many as there are


def windows(frames: int, length: int, stride: int) -> list[range]:
    """Return windows of ``length`` frames that begin ``stride`` apart; the last one ends where the
    clip ends.

    A clip that is shorter than a window has one, of the clip's length.

    Example:
        >>> [(w.start, w.stop) for w in windows(60, 25, 17)]
        [(0, 25), (17, 42), (34, 59), (35, 60)]
        >>> len(windows(198, 25, 17)), len(windows(900, 25, 17)), windows(9, 25, 17)
        (12, 53, [range(0, 9)])
    """
    last = max(frames - length, 0)
    starts = [*range(0, last, stride), last]
    return [range(start, min(start + length, frames)) for start in starts]


def fade_in(window: range, previous: range | None, overlap: int) -> F32:
    """Return the weight of a window's frames over what the windows before it made,
    ``(len(window),)``.

    It rises linearly over the first ``overlap`` frames and is 1 from there on, and everywhere in a
    clip's first window.

    Example:
        >>> fade_in(range(17, 42), range(25), 8)[:9].round(3).tolist()
        [0.111, 0.222, 0.333, 0.444, 0.556, 0.667, 0.778, 0.889, 1.0]
    """
    weights = np.ones(len(window), dtype=np.float32)
    if previous is not None:
        n = min(overlap, len(range(window.start, previous.stop)))
        weights[:n] = np.arange(1, n + 1) / (n + 1)
    return weights


class WindowFixer(MaplessFixer):
    """Repair a whole clip in overlapping windows.

    Args:
        settings: Of `NoiseWindowSettings`.
        scene_id, seed: Key of the noise, with the camera and the latent's index, counted through
            the windows.
        device, threads: See `MaplessFixer`.

    Raises:
        InputError: Settings of another fixer, or weights that are missing or do not fit.
    """

    blocks = BlockRule(WHOLE_CLIP, WHOLE_CLIP)

    def __init__(
        self,
        settings: FixerSettings,
        scene_id: str,
        seed: int = 0,
        device: str = "cpu",
        threads: int | None = None,
    ) -> None:
        if not isinstance(settings, NoiseWindowSettings):
            raise InputError(
                f"{settings.name}: settings of type {type(settings).__name__}",
                "take them from fixer_settings(name)",
            )
        self.settings = settings
        super().__init__(settings, scene_id, seed, device, threads)

    def reset(self, seed: int) -> None:
        """Take another clip, with the noise of another seed."""
        self.seed = seed
        self._is_done = False

    def step(self, block: Sequence[Frame], maps: Sequence[U8]) -> Sequence[Frame]:
        """Fix a clip.

        Args:
            block: All its frames, of any cameras.
            maps: Ignored: this model has no input for a map.

        Returns:
            As many frames, same order, times and cameras. Opacity and depth remain the render's.

        Raises:
            InputError: A second block, or frames that are none (see `views.group_views`).
            RendererError: An opacity that is not a number or outside [0, 1].
        """
        if self._is_done:
            raise InputError(
                f"{self.settings.name}: a second block: windows reach over a whole clip",
                "give all frames of a clip in one block, or reset for another",
            )
        out = list(block)
        for view in group_views(block, (), WHOLE_CLIP):
            video = self._run(view)
            images = to_images(video, view.size)
            for b, source_frames in enumerate(view.index):
                events = guard.check_frames(video[b].transpose(0, 1), images[b], view.rgb[b], None)
                for t, event in enumerate(events):
                    i = source_frames[t]
                    out[i] = (
                        replace(block[i], events=(*block[i].events, event))
                        if event
                        else replace(block[i], rgb=images[b, t])
                    )
        self._is_done = True
        return tuple(out)

    def _run(self, view: Views) -> Tensor:
        """Return the fixed frames ``(B, 3, T, H, W)`` in [-1, 1], not clipped, on the CPU."""
        settings = self.settings
        parts = windows(view.size.frames, settings.window_frames, settings.stride_frames)
        out = torch.empty(len(view.cameras), 3, view.size.frames, *view.shape)
        for index, window in enumerate(parts):
            made = self._sample(view, window, index)
            # Frames that the windows before reach into this one
            begun = parts[index - 1].stop - window.start if index else 0
            share = torch.from_numpy(
                fade_in(window, parts[index - 1] if index else None, settings.fade_frames)
            )[:begun, None, None]
            window_frames = out[:, :, window.start : window.stop]
            window_frames[:, :, :begun].lerp_(made[:, :, :begun], share)
            window_frames[:, :, begun:] = made[:, :, begun:]
        return out

    def _sample(self, view: Views, window: range, index: int) -> Tensor:
        """Return window ``index`` of the clip ``(B, 3, len(window), H, W)``; a short clip's last
        frame is repeated up to a window.
        """
        frames = slice(window.start, window.stop)
        settings = self.settings
        alpha = None if view.alpha is None else view.alpha[:, frames]
        cut = replace(view, rgb=view.rgb[:, frames], alpha=alpha, maps=None)
        clip = to_clip(cut, settings.window_frames, self.networks.device)
        first = 0 if settings.noise == "fixed" else index * settings.latents
        shape = (LATENT, clip.rgb.shape[3] // SIDE, clip.rgb.shape[4] // SIDE)
        (eps,) = latent_noise(
            self.scene_id, self.seed, view.cameras, 1, range(first, first + settings.latents), shape
        )
        made = sample_window(
            self.networks, settings, clip.rgb, clip.alpha, eps.to(self.networks.device)
        )
        return crop_clip(made, cut.size).cpu()
