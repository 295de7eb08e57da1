"""What a metric is, in one object."""

import math
from dataclasses import KW_ONLY, dataclass
from typing import Literal

# how much more often a flag may be set where neither it nor a gate says otherwise
RATE_MARGIN = 0.02
Aggregation = Literal["mean", "median", "max", "min", "last"]
Direction = Literal["lower", "higher", "none"]


@dataclass(frozen=True)
class MetricInfo:
    """What one metric is: tables, charts, gates, headlines and pages take what they say about it
    from here.

    Attributes:
        unit: Empty for flags and ratios.
        direction: The better side.
        aggregation: Over the scored steps of one rollout.
        help: One line.
        is_flag: It is 0 or 1 per step; its mean over rollouts is a rate.
        derived: It exists per rollout only, computed in the reduction.
        is_headline: Reports lead with it.
        is_primary: It is a run's one primary question, declared before a run by standing in its
            run.json; no other metric is.
        is_share: It is a fraction that is printed in percent; flags are anyway.
        name: Given by the mapping that holds the metric.
        label: What sentences and charts call it; empty: its name.
        margin: How much worse is accepted where no gate says otherwise, in its unit; None: 2 points
            for flags, nothing for the others.
        limits: Least and greatest possible value, None where there is no bound; a flag or a share
            lies in [0, 1].
        formula: How a step's value is computed, for docs/metrics.md, whose symbols it uses; empty:
            as ``help`` says.
        invalid: When a step has no value, for docs/metrics.md.
        reference: Which point is measured, and in which frame, for docs/metrics.md.
        curve: Place among the curves over time that a viewer shows first, from 1; 0: only when
            asked for.
        cap: How much of a scene's distance counts in a verdict; None: 40 margins of a difference.
        event: Flag of what lies beyond the cap, about which a verdict on the distance says nothing.
    """

    unit: str
    direction: Direction
    aggregation: Aggregation
    help: str
    is_flag: bool = False
    derived: bool = False
    is_headline: bool = False
    is_share: bool = False
    _: KW_ONLY
    is_primary: bool = False
    name: str = ""
    label: str = ""
    margin: float | None = None
    limits: tuple[float | None, float | None] = (None, None)
    formula: str = ""
    invalid: str = "never"
    reference: str = ""
    curve: int = 0
    cap: float | None = None
    event: str = ""

    @property
    def words(self) -> str:
        """Give what sentences call the metric."""
        return self.label or self.name

    @property
    def in_percent(self) -> bool:
        """Tell whether values are printed in percent: rates, and shares."""
        return self.is_flag or self.is_share

    @property
    def accepted(self) -> float:
        """Give the margin that holds where no gate sets one, in the metric's unit."""
        if self.margin is not None:
            return self.margin
        return RATE_MARGIN if self.is_flag else 0.0

    @property
    def value_range(self) -> tuple[float, float]:
        """Give the least and the greatest possible value; infinite where there is no bound."""
        if self.is_flag or self.is_share:
            return 0.0, 1.0
        low, high = self.limits
        return -math.inf if low is None else low, math.inf if high is None else high

    @property
    def difference_range(self) -> tuple[float, float]:
        """Give the least and the greatest possible difference of two values."""
        low, high = self.value_range
        return low - high, high - low
