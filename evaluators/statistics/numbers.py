"""Format numbers for display: percent with counts, matching decimals, a minus sign (U+2212), and a
dash with a reason where missing.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from evaluators.metrics import MetricInfo

DASH = "\u2014"
NARROW = "\u202f"
ARROWS = {"lower": "\u2193", "higher": "\u2191"}
ARROW_WORDS = {"lower": "lower is better", "higher": "higher is better"}


LABEL = 9  # width of the labels at the end of a command


@dataclass(frozen=True)
class Cell:
    """One printed number.

    Attributes:
        text: What is printed; an em dash where the number is missing.
        note: Shown on hover: the reason of a missing number, or counts behind a present one.
        detail: Second, smaller line: the interval, for rates behind the count, "7/300 (1.0 to 5.0
            %)"; may be empty.
        sort: Key for sorting; None sorts last.
    """

    text: str
    note: str = ""
    detail: str = ""
    sort: float | None = None

    @property
    def missing(self) -> bool:
        """Return whether there is no number."""
        return self.text == DASH


def missing(reason: str) -> Cell:
    """Make the cell of a number that does not exist."""
    return Cell(DASH, note=reason or "not given in summary.json")


def finite(value: Any) -> float | None:
    """Return a finite float, or None for None, NaN, infinities and anything that is not a
    number.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return float(value) if math.isfinite(value) else None


def interval(value: Sequence[float | None] | None) -> tuple[float, float] | None:
    """Read ``[low, high]``; None where either end is missing."""
    low, high = (None, None) if value is None else map(finite, value)
    return None if low is None or high is None else (low, high)


def decimals(*values: float | None, digits: int = 3) -> int:
    """Choose how many decimals show ``digits`` significant digits of the largest of the values, at
    most four.
    """
    largest = max((abs(value) for value in values if value is not None), default=0.0)
    if largest == 0.0:
        return 1
    return min(4, max(0, digits - 1 - math.floor(math.log10(largest))))


def fixed(value: float, places: int, sign: bool = False) -> str:
    """Print with a fixed number of decimals, U+2212 as minus, and no negative zero."""
    text = f"{abs(value):,.{places}f}".replace(",", "\u202f")
    is_zero = not any(character in "123456789" for character in text)
    if value < 0 and not is_zero:
        return "\u2212" + text
    return ("+" if sign and not is_zero else "") + text


def short(value: float | None, unit: str = "") -> str:
    """Print a lone number with a unit; a dash where missing."""
    if value is None:
        return DASH
    return fixed(value, decimals(value)) + (f"\u00a0{unit}" if unit else "")


def scale_and_unit(metric: MetricInfo, unit: str) -> tuple[float, str]:
    """Return factor and unit of a metric's printed differences: points where it is a share."""
    return (100.0, "points") if metric.in_percent else (1.0, unit)


def printed(metric: MetricInfo, *values: float, sign: bool = False) -> list[str]:
    """Print values of a metric in its printed unit, with decimals that match."""
    scale, _ = scale_and_unit(metric, "")
    places = 1 if metric.in_percent else decimals(*(scale * value for value in values))
    return [fixed(scale * value, places, sign=sign) for value in values]


def count_of(mean: float, n: int) -> str:
    """Print "7 of 300" for a rate whose mean is a whole count; empty where it is not (a mean of
    scene means, say).
    """
    k = mean * n
    return f"{round(k)} of {n}" if n > 0 and abs(k - round(k)) < 1e-6 * max(1.0, k) else ""


def duration(seconds: float | None) -> str:
    """Print a time span as s, min or h."""
    if seconds is None:
        return DASH
    if seconds < 120:
        return f"{short(seconds)}\u00a0s"
    minutes = seconds / 60
    return f"{fixed(minutes, 0)}\u00a0min" if minutes < 120 else f"{fixed(minutes / 60, 1)}\u00a0h"


def listed_counts(counts: Mapping[str, int]) -> str:
    """Name every cause with its count."""
    return ", ".join(f"{cause} {count}" for cause, count in counts.items())


def percents(shares: Sequence[float]) -> str:
    """Print the ends of a range of shares, once where they are equal."""
    texts = dict.fromkeys(fixed(100 * share, 1) for share in shares)
    return f"{' to '.join(texts)}\u00a0%"


def plural(n: int, noun: str, many: str = "") -> str:
    """Print a count with its noun; ``many`` is the plural where an s does not make it."""
    return f"{n}\u00a0{noun}" if n == 1 else f"{n}\u00a0{many or noun + 's'}"


def labelled(label: str, text: str) -> str:
    """Print a line of the end of a command."""
    return f"{label:<{LABEL}}{text}"
