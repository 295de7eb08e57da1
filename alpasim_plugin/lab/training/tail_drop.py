"""ArtiFixer's augmentation: the render is hidden from a random frame on, so that the network learns
to go on without it.

Source: ArtiFixer's trainer. A hidden frame is black with opacity 0. Latents are hidden as a whole,
    as the max-pooled mask of Eq. 1 hides
them: the latent that covers the last shown frame is shown, and holds the render of all its frames
    (the original blackens the rest of them
before the encoder).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from alpasim_plugin.block_fixers.clips import GROUP
from alpasim_plugin.block_fixers.sampling import OPACITY_CHANNELS
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.lab.training.shared_rollout import Sample


@dataclass(frozen=True)
class TailDrop:
    """Hide the whole render with probability ``whole``, otherwise its last U{0 .. T - 1} of T
    frames: about 45 % stay in sight.
    """

    whole: float = 0.1

    def shown_frames(self, frames: int, rng: np.random.Generator) -> int:
        """Draw how many frames of a clip are shown, from its start."""
        hidden = frames if rng.random() < self.whole else int(rng.integers(frames))
        return frames - hidden

    def __call__(self, s: Sample, seed: int, index: int) -> Sample:
        """Return the batch with its clips' tails hidden: mask 0, and opacity 0 in the condition's
        last channels.
        """
        rng = stream("training", seed, "artifixer.tail", index)
        n = s.z_0.shape[2]
        m = s.m.clone()
        condition = s.condition.clone()
        for b in range(len(m)):
            frame_count = self.shown_frames(1 + GROUP * (n - 1), rng)
            latents = 0 if not frame_count else 1 + -(-(frame_count - 1) // GROUP)
            m[b, :, latents:] = 0
            condition[b, -OPACITY_CHANNELS:, latents:] = 0
        return replace(s, m=m, condition=condition)
