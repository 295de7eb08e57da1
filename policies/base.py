"""Policies by name, and what policies share."""

from __future__ import annotations

import numpy as np

from alpasim_plugin.core.types import F64, I64, Policy, Scenario
from alpasim_plugin.plugins.parts import build, unidentified

PLAN_HORIZON_S = 5.0  # AlpaSim's minADE needs samples that reach its longest horizon, 5 s; shorter ones lose all four metrics
PLAN_STEP_US = 100_000


def make_policy(name: str, scenario: Scenario) -> Policy:
    """Return a policy for a scenario.

    Args:
        name: A policy as `alpasim_plugin.plugins.parts.resolve` takes it: a registered name, ``package.module:Class`` or ``file.py:Class``.
        scenario: What the policy will drive in. A policy under test should take no more from it than its cameras.

    Raises:
        InputError: The name is unknown, the import fails, or what it makes is not a policy.
        PolicyError: The policy raised while it was made.
    """
    policy: Policy = build(unidentified("policy", name), scenario=scenario)
    return policy


def plan_times(t_us: int, horizon_s: float = PLAN_HORIZON_S) -> I64:
    """Return the times ``(T,)`` of a plan made at ``t_us``: now and every 0.1 s up to the horizon."""
    n = round(horizon_s * 1_000_000 / PLAN_STEP_US)
    return t_us + PLAN_STEP_US * np.arange(n + 1, dtype=np.int64)


def seconds(times_us: I64) -> F64:
    """Return the seconds ``(T,)`` from the first of the times; the difference is taken in integers."""
    return np.asarray((times_us - times_us[0]).astype(np.float64) * 1e-6)
