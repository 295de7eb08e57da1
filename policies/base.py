"""Names to policies, and what policies share."""

from __future__ import annotations

import hashlib
import importlib
import inspect
from collections.abc import Callable
from pathlib import Path

import numpy as np

from alpasim_plugin.errors import InputError
from alpasim_plugin.registry import Registry
from alpasim_plugin.types import F64, I64, Policy, Scenario

POLICIES: Registry[Policy] = Registry("policy", "simrun.policies")

PLAN_HORIZON_S = 4.0
PLAN_STEP_US = 100_000


def make_policy(name: str, scenario: Scenario) -> Policy:
    """Return a policy for a scenario.

    ``package.module:Class`` names a class (or function) that is imported and called with the scenario, or without arguments where it
    takes none. Every other name is looked up in `POLICIES`.

    Args:
        name: A registered name, or an import path with a colon.
        scenario: What the policy will drive in. A policy under test should take no more from it than its cameras.

    Raises:
        InputError: The name is unknown, the import fails, or what it makes is not a policy.
    """
    factory, is_import = find_policy(name)
    policy = factory(scenario) if not is_import or _takes_an_argument(factory) else factory()
    if not isinstance(policy, Policy):
        missing = [part for part in ("sensors", "reset", "act") if not hasattr(policy, part)]
        raise InputError(
            "making a policy",
            f"policy {name!r}",
            f"a {type(policy).__name__} without {', '.join(missing)}",
            "give it `sensors`, `reset(seed, route)` and `act(observation)`; see docs/policies.md",
        )
    return policy


def find_policy(name: str) -> tuple[Callable[..., Policy], bool]:
    """Return the factory of a policy and whether its name is an import path.

    Raises:
        InputError: The name is unknown or the import fails.
    """
    is_import = ":" in name and "://" not in name
    return (_import(name) if is_import else POLICIES.get(name)), is_import


def loaded_by(name: str) -> str:
    """Return the SHA-256 of the file that a policy loads by itself, named by its class in ``loads``; "" where it loads none.

    Raises:
        InputError: The name is unknown, the import fails, or the file is not there.
    """
    file: Path | None = getattr(find_policy(name)[0], "loads", None)
    if file is None:
        return ""
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest()
    except OSError as error:
        do = "install the package again, with its weights"
        raise InputError("reading what a policy loads", f"policy {name!r}", str(error), do) from error


def plan_times(t_us: int, horizon_s: float = PLAN_HORIZON_S) -> I64:
    """Return the times ``(T,)`` of a plan made at ``t_us``: now and every 0.1 s up to the horizon."""
    n = round(horizon_s * 1_000_000 / PLAN_STEP_US)
    return t_us + PLAN_STEP_US * np.arange(n + 1, dtype=np.int64)


def seconds(times_us: I64) -> F64:
    """Return the seconds ``(T,)`` from the first of the times; the difference is taken in integers."""
    return np.asarray((times_us - times_us[0]).astype(np.float64) * 1e-6)


def _import(name: str) -> Callable[..., Policy]:
    module_name, _, attribute = name.partition(":")
    try:
        factory: Callable[..., Policy] = getattr(importlib.import_module(module_name), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise InputError(
            "importing a policy",
            f"policy {name!r}",
            f"{type(error).__name__}: {error}",
            "write package.module:Class, with the package on Python's path",
        ) from error
    return factory


def _takes_an_argument(factory: Callable[..., Policy]) -> bool:
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
    try:
        parameters = inspect.signature(factory).parameters.values()
    except ValueError:  # some built-in callables have no signature
        return False
    # A class that defines no constructor shows (*args, **kwargs) of a protocol or none at all; those take nothing.
    return any(p.kind in kinds[:2] for p in parameters)
