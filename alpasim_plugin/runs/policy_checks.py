"""Check the user's policies before a run drives, for the pages of its failures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from alpasim_plugin.core.errors import PolicyError, SimrunError
from alpasim_plugin.core.parts import PartSpec
from alpasim_plugin.core.parts.spec import BUILTIN
from alpasim_plugin.core.subprocesses import parts_print_to_stderr
from alpasim_plugin.core.types import Scenario
from alpasim_plugin.runs.execute import HowToRun
from alpasim_plugin.runs.executors.local import Lost, run_jobs
from alpasim_plugin.runs.plan import RunPlan
from policies.conformance import check_policy

LIMIT_S = 120.0


def check_policies(
    plan: RunPlan, known: Mapping[str, Any], how: HowToRun, noticed: Callable[[str], None]
) -> dict[str, Any]:
    """Return what `policies.conformance.check_policy` finds in each policy of the user's own: its
    digest, and by ``breaches`` and ``notes`` a name and a sentence each.

    Shipped policies are not checked, nor those behind an address. The time that a plan takes is no
    breach: a run need not keep it.

    Args:
        plan: The run.
        known: What an earlier command of the run found; a policy of the same digest is not checked
            again.
        how: Workers and the time limit of a rollout.
        noticed: Called with one line for each breach.

    Raises:
        PolicyError: No policy of the run can be made.
    """
    shipped = {target for target, _ in BUILTIN["policy"].values()}
    found: dict[str, Any] = {}
    todo: list[PartSpec] = []
    for policy in plan.policies:
        before = known.get(policy.name)
        if policy.digest is not None and before and before["digest"] == policy.digest:
            found[policy.name] = before
        elif policy.target not in shipped and policy.address is None:
            todo.append(policy)
    scenario = next(iter(plan.scenarios.values()))
    workers = min(how.threads.workers, len(todo))
    limit_s = how.limit_s if how.threads.workers == 1 else how.limit_s or LIMIT_S
    check = partial(_check, scenario)
    for policy, result in run_jobs(check, todo, workers, how.threads.per_worker, limit_s):
        if isinstance(result, Lost):
            result = {
                "breaches": [["ends", f"the check did not end: {result.reason}"]],
                "notes": [],
            }
        found[policy.name] = {"digest": policy.digest, **result}
    unmade = [text for one in found.values() for name, text in one["breaches"] if name == "made"]
    if len(unmade) == len(plan.policies):
        raise PolicyError(unmade[0], "Correct the policy; nothing was driven.")
    for policy in todo:
        for _, sentence in found[policy.name]["breaches"]:
            noticed(f"check of {policy.name}: {sentence}")
    return found


def _check(scenario: Scenario, policy: PartSpec) -> dict[str, Any]:
    """Check one policy, in a worker."""
    try:
        with parts_print_to_stderr():
            report = check_policy(policy.name, scenario)
    except SimrunError as error:
        return {"breaches": [["made", error.message]], "notes": []}
    breaches = [one for one in report.checks if not one.ok and one.name != "latency"]
    kinds = {"breaches": breaches, "notes": report.notes}
    return {kind: [[one.name, one.sentence] for one in of_kind] for kind, of_kind in kinds.items()}
