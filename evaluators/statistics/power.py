"""What a suite of some size can show at all, before anything is driven."""

from __future__ import annotations

import math
from collections.abc import Sequence

import scipy  # its submodules load on first use

from evaluators.statistics.intervals import TAIL
from evaluators.statistics.numbers import plural

RISES = (0.05, 0.1, 0.2)  # of the rate of an event
SIZES = (3, 6, 14, 42, 84, 210)  # cells


def chance_seen(rise: float, cells: int, needed: int = 1) -> float:
    """Return the chance that a gate about its suite sees an event that is new in a share of cells.

    Args:
        rise: That share.
        cells: That are compared.
        needed: New events that are red: of a repeatable policy, one more than are accepted.

    Example:
        >>> [round(100 * chance_seen(rise, 14)) for rise in RISES]
        [51, 77, 96]
        >>> round(100 * chance_seen(0.2, 14, 6))
        4
    """
    if needed > cells:
        return 0.0
    return 1.0 - float(scipy.special.bdtr(needed - 1, cells, rise))


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


def rise_left_open(scenes: int, tail: float = TAIL) -> float:
    """Return by how much the rate of an event may have risen in other scenes, where some scenes have
    no new one (exact bound).

    Example:
        >>> round(rise_left_open(72), 2), round(rise_left_open(36), 2)
        (0.05, 0.1)
    """
    return float(1.0 - tail ** (1.0 / scenes)) if scenes else 1.0


def size_text(cells: int, needed: int = 1, is_noisy: bool = False) -> str:
    """Say what a gate about its suite can show with a number of cells.

    Args:
        cells: That are compared.
        needed: As for `chance_seen`.
        is_noisy: The policy is not repeatable: events that are gone speak against new ones.

    Example:
        >>> size_text(14).replace(chr(0xa0), " ")
        '14 pairs: an event that is new in 5, 10, 20 % of drives is seen with a chance of 51, 77, 96 %'
    """
    rises = ", ".join(f"{100 * rise:g}" for rise in RISES)
    chances = ", ".join(f"{100 * chance_seen(rise, cells, needed):.0f}" for rise in RISES)
    text = (
        f"{plural(cells, 'pair')}: an event that is new in {rises}\u00a0% of drives is seen with a "
        f"chance of {chances}\u00a0%"
    )
    if needed == 1:
        return text
    return f"{text} (it takes {needed} new ones{' and none gone' if is_noisy else ''})"


def claim_size_text(scenes: int) -> str:
    """Say what a gate about other scenes can show with a number of scenes.

    Example:
        >>> claim_size_text(60).replace(chr(0xa0), " ")
        '60 scenes: without any new event they show that its rate in others has risen by less than 6 points'
    """
    points = f"{100 * rise_left_open(scenes):.2g}\u00a0points"
    return (
        f"{plural(scenes, 'scene')}: without any new event they show that its rate in others has "
        f"risen by less than {points}"
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
