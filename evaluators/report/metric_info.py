"""Display of a metric; its definition is in `evaluators.metrics`.

Unit and direction come with the numbers in ``summary.json``; a metric of a third party that this process has not loaded is shown all
the same, without a line of meaning.
"""

from __future__ import annotations

from collections.abc import Iterable

from evaluators.metrics import METRICS

# What the report leads with; the other metrics are one click away.
HEADLINE = tuple(name for name, facts in METRICS.items() if facts.is_headline)


def ordered(names: Iterable[str]) -> list[str]:
    """Sort metric names: headline ones, then the known ones in the order of `METRICS`, then the others by name."""
    rank = {name: index for index, name in enumerate((*HEADLINE, *(name for name in METRICS if name not in HEADLINE)))}
    return sorted(set(names), key=lambda name: (rank.get(name, len(rank)), name))


def meaning(name: str) -> str:
    """Give one line of help, or "" for a metric that is not declared here."""
    return METRICS[name].help if name in METRICS else ""


def is_rate(name: str, unit: str) -> bool:
    """Return whether a metric counts rollouts, so that its mean is a fraction with "k of n" behind it."""
    return not unit and name in METRICS and METRICS[name].is_flag


def in_percent(name: str, unit: str) -> bool:
    """Return whether a metric is printed in percent: rates, and shares without a unit."""
    return is_rate(name, unit) or (not unit and name in METRICS and METRICS[name].is_share)
