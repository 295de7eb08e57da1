"""Check the user's policies before a run drives, for the pages of its failures."""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial

from alpasim_plugin.core.clock import Clock
from alpasim_plugin.core.errors import InputError, PolicyError, SimrunError
from alpasim_plugin.core.files import content_of, real
from alpasim_plugin.core.files.inputs import Inputs
from alpasim_plugin.core.interfaces import Policy
from alpasim_plugin.core.parts import PartSpec, complete
from alpasim_plugin.core.parts.registry import entries
from alpasim_plugin.core.parts.source import load
from alpasim_plugin.core.subprocesses import parts_print_to_stderr
from alpasim_plugin.core.types import Scenario, SensorSpec
from alpasim_plugin.log.run_folder.records import PolicyCheck
from alpasim_plugin.runs.cameras import CameraRig
from alpasim_plugin.runs.changes import changed_inputs
from alpasim_plugin.runs.execute import HowToRun
from alpasim_plugin.runs.guards import checked_sensors
from alpasim_plugin.runs.local_executor import Lost, run_jobs
from alpasim_plugin.runs.plan import RunPlan
from policies.base import make_policy
from policies.conformance import check_policy

LIMIT_S = 120.0  # of a check that has a core to itself
MOST_LIMIT_S = 600.0  # of one that shares it with others
HANGS = "hangs"
HUNG_SHARE = 0.5  # of the time limit, in one call
NEVER_DRIVES = ("made", "sensors", HANGS)  # breaches that no rollout survives


def frames_asked(policy: PartSpec, scenarios: Iterable[Scenario]) -> int:
    """Return how many camera frames a policy asks for in one rollout of each scenario; one behind
    an address is taken to ask for every camera.

    The policy is built once for each set of cameras.

    Raises:
        InputError: A scenario lacks a camera of the policy, or a period does not fit.
        PolicyError: The policy cannot be made, or its sensors are no sequence of `SensorSpec`.
    """
    built: dict[object, Sequence[SensorSpec]] = {}
    frames = 0
    for scenario in scenarios:
        cameras = scenario.cameras
        key = tuple(
            (camera.name, camera.lens is None, camera.T_rig_camera.tobytes()) for camera in cameras
        )
        if policy.address is not None:
            built[key] = [SensorSpec(camera.name) for camera in cameras]
        elif key not in built:
            made = complete(make_policy(policy.name, scenario), Policy)
            built[key] = checked_sensors(made)
            made.close()
        clock = Clock(scenario.start_us, scenario.end_us, scenario.rates)
        frames += CameraRig(scenario, built[key], clock).count()
    return frames


def check_policies(
    plan: RunPlan,
    earlier_checks: Mapping[str, PolicyCheck],
    how: HowToRun,
    noticed: Callable[[str], None],
) -> dict[str, PolicyCheck]:
    """Return what `policies.conformance.check_policy` finds in each policy of the user's own,
    by name.

    Of shipped policies the cameras alone are checked, and nothing of those behind an address. The
    time that a plan takes is no breach: a run need not keep it.

    Args:
        plan: The run.
        earlier_checks: What an earlier command of the run found; a policy in which it found no
            breach is not checked again while its digest and the files that it read are the same.
        how: Workers and the time limit of a rollout.
        noticed: Called with one line for each breach.

    Raises:
        InputError: A scenario lacks a camera of a policy.
        PolicyError: No policy of the run can be made and says which cameras it uses.
    """
    shipped = {part.target for part in entries("policy").values() if part.is_shipped}
    scenarios = list(plan.scenarios.values())
    checks: dict[str, PolicyCheck] = {}
    todo = []
    for policy in plan.policies:
        before = earlier_checks.get(policy.name)
        if before is not None and _holds_still(before, policy):
            checks[policy.name] = before
        elif policy.target in shipped:
            frames_asked(policy, scenarios)
        elif policy.address is None:
            todo.append(policy)
        if policy.address is not None:
            _check_address(policy, scenarios)
    checks |= _checked(todo, scenarios, how)
    unmade = [
        text for check in checks.values() for name, text in check.breaches if name in NEVER_DRIVES
    ]
    if len(unmade) == len(plan.policies):
        raise PolicyError(unmade[0], "Correct the policy; nothing was driven.")
    for policy in todo:
        for _, sentence in checks[policy.name].breaches:
            noticed(f"check of {policy.name}: {sentence}")
    return checks


def _checked(
    policies: Sequence[PartSpec], scenarios: Sequence[Scenario], how: HowToRun
) -> dict[str, PolicyCheck]:
    """Check policies in worker processes, and return what was found by name.

    Raises:
        InputError: A scenario lacks a camera of a policy.
    """
    limit_s = how.limit_s or default_limit_s(os.getloadavg()[0], os.cpu_count() or 1)
    results = run_jobs(
        partial(_check, scenarios),
        policies,
        min(how.threads.workers, len(policies)),
        how.threads.per_worker,
        limit_s,
        parts_of=lambda policy: policy.name,
    )
    checks = {}
    for policy, result in results:
        if isinstance(result, Lost):
            result = _of_lost(result, limit_s)
        if isinstance(result, InputError):
            raise result
        checks[policy.name] = replace(result, digest=policy.digest)
    return checks


def _holds_still(before: PolicyCheck, policy: PartSpec) -> bool:
    """Tell whether a check would find the same again: no breach, which may come from the world outside,
    and nothing that the policy is made of, or read, is another one.
    """
    if before.breaches or policy.digest is None or before.digest != policy.digest:
        return False
    return not changed_inputs(before.inputs)


def _check_address(policy: PartSpec, scenarios: Iterable[Scenario]) -> None:
    """Let a policy behind an address refuse scenarios whose images cannot be sent to it.

    Raises:
        InputError: It does.
    """
    factory = load(policy.target, "policy")
    for scenario in scenarios if hasattr(factory, "check_scenario") else ():
        factory.check_scenario(scenario, policy.address)


def hanging(checks: Mapping[str, PolicyCheck]) -> dict[str, str]:
    """Return by policy what `check_policies` found, where it hung in the check or ended its
    process: what would drive it would hang, or end, as well.
    """
    return {
        policy: sentence
        for policy, check in checks.items()
        for name, sentence in check.breaches
        if name == HANGS
    }


def default_limit_s(load: float, cores: int) -> float:
    """Return how many seconds the check of a policy may take where no time limit is given: longer
    where processes share the cores, since a healthy policy takes longer there as well.

    Args:
        load: Mean number of processes that run or wait for a core.
        cores: Of the machine.

    Example:
        >>> [default_limit_s(load, 2) for load in (0.0, 2.0, 5.0, 50.0)]
        [120.0, 120.0, 300.0, 600.0]
    """
    return min(max(LIMIT_S, LIMIT_S * load / cores), MOST_LIMIT_S)


def _of_lost(lost: Lost, limit_s: float) -> PolicyCheck:
    """Return what the check of a policy found whose process was lost."""
    sentence = f"the check did not end: {lost.reason}"
    name = "ends"
    culprit = lost.culprit
    if culprit is not None:
        sentence = culprit.error(lost.reason).message
        is_slow = lost.is_late and lost.hung_s < HUNG_SHARE * limit_s
        name = name if is_slow else HANGS
    return PolicyCheck(None, breaches=((name, sentence),))


def _check(scenarios: Sequence[Scenario], policy: PartSpec) -> PolicyCheck | InputError:
    """Check one policy, in a worker."""
    try:
        with parts_print_to_stderr(), Inputs() as inputs:
            with suppress(PolicyError):  # the check says more of it
                frames_asked(policy, scenarios)
            report = check_policy(policy.name, scenarios[0])
    except InputError as error:
        return error
    except SimrunError as error:
        return PolicyCheck(None, breaches=(("made", error.message),))
    breaches = [check for check in report.checks if not check.ok and check.name != "latency"]
    return PolicyCheck(
        None,
        breaches=tuple((check.name, check.sentence) for check in breaches),
        notes=tuple((note.name, note.sentence) for note in report.notes),
        inputs=_beside_digest(policy, inputs),
    )


def _beside_digest(policy: PartSpec, inputs: Inputs) -> dict[str, str]:
    """Return what a policy read that its digest does not cover and that is still there, by path."""
    held = {str(real(path)) for path in (*policy.code, *policy.files)}
    return {
        path: content
        for path, content in inputs.files.items()
        if path not in held and content_of(path) == content
    }
