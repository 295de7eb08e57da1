"""What is expected before the first scene: how far the truth is from the threshold. It makes a decision fast, never wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.types import F64

# Bets on the planned distance, half of it, twice and four times it; the share of the capital that each begins with; and the share that it
# may risk on one scene. Small bets that risk little survive the scene that changes for the worse among many that do not change; large bets
# that risk nearly all decide fast where nothing changes. Measured against other mixtures in docs/experiments/sequential.md.
MIXTURE: tuple[tuple[float, float, float], ...] = ((0.5, 0.15, 0.3), (1.0, 0.5, 0.5), (2.0, 0.2, 0.8), (4.0, 0.15, 0.98))
MULTIPLES, LOG_SHARES, AT_RISK = (np.array(column) for column in zip(*MIXTURE, strict=True))
LOG_SHARES = np.log(LOG_SHARES)


@dataclass(frozen=True)
class Plan:
    """How large bets are.

    Attributes:
        distance: Expected distance of the true mean from the threshold, in the metric's unit; None: such that half of ``horizon`` suffices.
        horizon: Most scenes that can be driven.
        alpha: Chance of a wrong decision.
    """

    distance: float | None
    horizon: int
    alpha: float

    @property
    def log_bar(self) -> float:
        """Give the log of the e-value at which a claim is made: 1 / alpha."""
        return -math.log(self.alpha)

    def rate(self, variance: F64) -> F64:
        """Return the bet that grows fastest at the planned distance, distance / variance, for variances of any shape."""
        if self.distance is not None:
            return np.asarray(self.distance / variance)
        return np.asarray(np.sqrt(4.0 * self.log_bar / (self.horizon * variance)))
