"""What is expected before the first scene: how far the truth is from the threshold. It makes a decision fast, never wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.types import F64

# Half of the distance that is bet on, in standard deviations of the sum over all scenes up to the ceiling. A test with a ceiling that is
# just large enough for 80 % power has 1.4; smaller bets gain nothing, whatever the plan.
USUAL_SLOPE, LEAST_SLOPE = 1.4, 1.0


@dataclass(frozen=True)
class Plan:
    """How large bets are.

    Attributes:
        distance: Expected distance of the true mean from the threshold, in the metric's unit; None: such that ``horizon`` just suffices.
        horizon: Most scenes that can be driven.
        alpha: Evidence of 1 / alpha is aimed at: the chance of a wrong decision, divided by the number of answers that share it.
    """

    distance: float | None
    horizon: int
    alpha: float

    @property
    def log_bar(self) -> float:
        """Give the log of the e-value that is aimed at: 1 / alpha."""
        return -math.log(self.alpha)

    def slope(self, spread: F64) -> F64:
        """Return the slope of the line that is bet on (`line.py`), for standard deviations of a scene of any shape."""
        if self.distance is None:
            return np.full_like(spread, USUAL_SLOPE)
        return np.asarray(np.maximum(LEAST_SLOPE, 0.5 * self.distance * math.sqrt(self.horizon) / spread))
