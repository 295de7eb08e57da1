"""What a suite of some size can show at all, before anything is driven."""

from __future__ import annotations

import math
from collections.abc import Sequence

from evaluators.statistics.intervals import TAIL

RISES = (0.05, 0.1, 0.2)  # of the rate of an event
SIZES = (3, 6, 14, 42, 84, 210)  # cells


def chance_seen(rise: float, cells: int) -> float:
    """Return the chance that a gate about its suite sees an event that is new in a share of cells:
    one new event of a repeatable policy is red.

    Example:
        >>> [round(100 * chance_seen(rise, 14)) for rise in RISES]
        [51, 77, 96]
    """
    return 1.0 - (1.0 - rise) ** cells


def scenes_for_claim(rise: float, tail: float = TAIL) -> int:
    """Return how many scenes without any new event show that its rate in other scenes has risen by
    less (exact bound).

    Args:
        rise: Of the rate.
        tail: The chance of a wrong claim that is accepted.

    Example:
        >>> [scenes_for_claim(0.05), scenes_for_claim(0.1), scenes_for_claim(0.1, 0.05)]
        [72, 36, 29]
    """
    return math.ceil(math.log(tail) / math.log1p(-rise))


def size_text(cells: int) -> str:
    """Say what a gate about its suite can show with a number of cells.

    Example:
        >>> size_text(14).replace(chr(0xa0), " ")
        '14 pairs: an event that is new in 5, 10, 20 % of drives is seen with a chance of 51, 77, 96 %'
    """
    pairs = "1\u00a0pair" if cells == 1 else f"{cells}\u00a0pairs"
    rises = ", ".join(f"{100 * rise:g}" for rise in RISES)
    chances = ", ".join(f"{100 * chance_seen(rise, cells):.0f}" for rise in RISES)
    return (
        f"{pairs}: an event that is new in {rises}\u00a0% of drives is seen with a chance of "
        f"{chances}\u00a0%"
    )


def size_table(sizes: Sequence[int] = SIZES) -> list[str]:
    """Return the table of docs/ci.md, line by line."""
    heads = " | ".join(f"+{100 * rise:g} points" for rise in RISES)
    lines = [f"| pairs | {heads} |", "|---:|" + "---:|" * len(RISES)]
    for cells in sizes:
        shares = " | ".join(f"{100 * chance_seen(rise, cells):.0f} %" for rise in RISES)
        lines.append(f"| {cells} | {shares} |")
    needed = " | ".join(f"{scenes_for_claim(rise)}" for rise in RISES)
    lines.append(f"| scenes for a claim about others | {needed} |")
    needed = " | ".join(f"{scenes_for_claim(rise, 2 * TAIL)}" for rise in RISES)
    lines.append(f"| the same at one-sided 95 % | {needed} |")
    return lines
