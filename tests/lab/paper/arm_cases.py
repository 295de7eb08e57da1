"""Arms whose quality is known, over twelve clips."""

from __future__ import annotations

import numpy as np

from alpasim_plugin.lab.paper.measured import Measured

CLIPS = [f"clip-{i}" for i in range(12)]


def arms(**shift: float) -> Measured:
    """Return arms whose PSNR is a clip's own level plus the arm's shift and a little noise."""
    rng = np.random.default_rng(0)
    level = {clip: 24 + 3 * rng.normal() for clip in CLIPS}
    return Measured(
        {
            arm: {c: {"psnr_db": level[c] + by + 0.1 * rng.normal()} for c in CLIPS}
            for arm, by in shift.items()
        }
    )
