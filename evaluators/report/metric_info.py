"""What a reader needs to know about a metric: its place in the tables, one line of meaning, and whether it is a rate.

Unit and direction come with the numbers in ``summary.json``; a metric of a third party that this process has not loaded is shown all
the same, without a line of meaning.
"""

from __future__ import annotations

from collections.abc import Iterable

from evaluators.metrics import METRICS

# What the report leads with; the other metrics are one click away.
HEADLINE = ("collision_at_fault", "collision_any", "offroad", "route_distance_m", "progress")

ORDER = (
    *HEADLINE,
    "collision_front",
    "collision_lateral",
    "collision_rear",
    "offroad_or_collision",
    "offroad_or_collision_at_fault",
    "wrong_lane",
    "offroad_margin_m",
    "min_distance_to_obstacle_m",
    "min_distance_to_lane_boundary_m",
    "dist_to_gt_trajectory",
    "dist_to_gt_location",
    "plan_deviation",
    "progress_rel",
)

SHARES = ("progress", "progress_rel", "progress_rel_to_total", "progress_clipped_rel")  # fractions, not counts of rollouts


def ordered(names: Iterable[str]) -> list[str]:
    """Sort metric names: the known ones as in `ORDER`, then the others by name."""
    rank = {name: index for index, name in enumerate(ORDER)}
    return sorted(set(names), key=lambda name: (rank.get(name, len(rank)), name))


def meaning(name: str) -> str:
    """Give one line of help, or "" for a metric that is not declared here."""
    return METRICS[name].help if name in METRICS else ""


def is_rate(name: str, unit: str) -> bool:
    """Tell whether a metric counts rollouts, so that its mean is a fraction with "k of n" behind it."""
    return not unit and name in METRICS and METRICS[name].is_flag


def in_percent(name: str, unit: str) -> bool:
    """Tell whether a metric is printed in percent: rates, and shares without a unit."""
    return is_rate(name, unit) or (not unit and name in SHARES)
