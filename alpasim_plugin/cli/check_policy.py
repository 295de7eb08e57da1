"""``simrun check-policy``: the conformance test of a policy. ``simrun check-driver``: the
pre-flight check of an AlpaSim driver.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import typer

from alpasim_plugin.alpasim.client.driver import AlpasimPolicy
from alpasim_plugin.alpasim.client.preflight import (
    LIMIT_S,
    DriveTimes,
    Finding,
    findings,
    outside_view,
    resident_mib,
    tolerances,
)
from alpasim_plugin.cli.options import Json, Overrides
from alpasim_plugin.core.errors import InfrastructureError, PolicyError, SimrunError
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.core.subprocesses import parts_print_to_stderr
from alpasim_plugin.core.types import Scenario
from alpasim_plugin.runs.cell import make_renderer
from alpasim_plugin.runs.rollout import run_rollout
from evaluators import reduce_rollout, score
from evaluators.metrics.outcomes import OUTCOMES, POLICY_FAULT, in_words
from policies.conformance import check_policy as run_checks
from scenarios.load import load_scenario
from scenarios.suite import expand

BROKEN = 1
ATTEMPTS = 2  # at a scene in which the driver is lost

CHECK_POLICY_EPILOG = """
Examples:

- `simrun check-policy lane-camera`

- `simrun check-policy my_policy.py:Mine --scenario smoke/curve`

Exit codes: 0 every check passed; 1 the policy breaks its contract, or could not be made; 2 it cannot be found.
"""


def check_policy(
    policy: Annotated[str, Positional("A policy's name, package.module:Class, or file.py:Class.")],
    scenario: Annotated[
        str | None, Flag("Scenario whose cameras it gets; by default one camera ahead.")
    ] = None,
    latency_limit_ms: Annotated[float, Flag("Longest median time of a plan.", min=0.0)] = 100.0,
    as_json: Json = False,
) -> None:
    """Call a policy in fixed situations and name every breach of its contract: shapes, frames,
    units, time, determinism.

    Nothing is rendered or scored; it takes seconds. Run it before the first drive.
    """
    with parts_print_to_stderr():
        report = run_checks(
            policy, None if scenario is None else load_scenario(scenario), latency_limit_ms
        )
    if as_json:
        checks = [
            {"check": check.name, "ok": check.ok, "found": check.sentence}
            for check in report.checks
        ]
        latency_ms = dict(zip(("p50", "max"), report.latency_ms, strict=True))
        print(
            json.dumps(
                {
                    "policy": policy,
                    "ok": report.ok,
                    "checks": checks,
                    "notes": report.notes,
                    "latency_ms": latency_ms,
                }
            )
        )
    else:
        print(report)
    raise typer.Exit(0 if report.ok else BROKEN)


CHECK_DRIVER_EPILOG = """
Examples:

- `simrun check-driver 127.0.0.1:50052`

- `simrun check-driver my-driver:6000 --scenario scenes/one.usdz --set 'cameras=[{width: 576, height: 320}]'`

- `simrun check-driver 127.0.0.1:50052 --scenario suites/hard`
"""


def check_driver(
    address: Annotated[
        str, Positional("The driver, with options as after alpasim://.", metavar="HOST:PORT")
    ],
    scenario: Annotated[
        str, Flag("What it drives through: a scenario, or a suite.")
    ] = "smoke/curve",
    renderer: Annotated[str, Flag("Renderer of its frames.")] = "clean",
    overrides: Overrides = (),
    limit_ms: Annotated[
        float, Flag("Longest drive call; the challenge allows 100.", min=0.1)
    ] = LIMIT_S * 1000,
    as_json: Json = False,
) -> None:
    """Check a driver before it is submitted: rollouts in AlpaSim's order of calls, its times, its
    plans, and what it must tolerate.

    Exit codes: 0 nothing failed; 1 a check failed; 4 the driver cannot be reached.
    """
    times = DriveTimes()
    drives: list[Drive] = []
    policy: AlpasimPolicy | None = None
    for ref in expand(scenario, ("timing.timeline=alpasim", *overrides)):
        scene = load_scenario(ref.path, ref.seed, ref.overrides)
        try:
            made = AlpasimPolicy(scene, address)
        except InfrastructureError as error:
            if policy is None:
                raise
            drives.append(Drive(scene.scene_id, 0, lost=1, failed=error))
            break
        if policy is not None:
            policy.service.close()
        policy = made
        drives.append(rehearse(scene, policy, renderer, times))
    assert policy is not None, "a scenario stands for one scene at least"
    failed = next((one.failed for one in drives if one.failed is not None), None)
    found = [
        *findings(times, failed, sum(one.warmup for one in drives), limit_ms / 1000),
        *over_scenes(drives),
    ]
    found += [*tolerances(policy.service, scene.scene_id), *outside_view()]
    worst = 1 if any(one.result == "failed" for one in found) else 0
    if as_json:
        facts = {
            "driver": policy.facts()["driver"],
            "checks": [one.__dict__ for one in found],
        }
        print(json.dumps({**facts, "scenes": [one.facts() for one in drives], "exit_code": worst}))
    else:
        print(f"driver  {policy.facts()['driver']}")
        for one in found:
            print(f"{one.result:7} {one.name}: {one.text}")
    raise typer.Exit(worst)


@dataclass
class Drive:
    """A scene of the rehearsal.

    Attributes:
        scene: Its id.
        warmup: Queries in which empty plans are accepted.
        outcomes: How it ended, by name; None where the driver was lost at every attempt.
        lost: Attempts in which the connection was lost.
        failed: What ended it early.
        resident_mib: Memory of the driver afterwards, where it can be seen.
    """

    scene: str
    warmup: int
    outcomes: tuple[str, ...] | None = None
    lost: int = 0
    failed: SimrunError | None = None
    resident_mib: float | None = None

    def facts(self) -> dict[str, Any]:
        """Return what JSON says of it."""
        ended = None if self.outcomes is None else in_words(self.outcomes)
        return {
            "scene": self.scene,
            "ended": ended,
            "lost": self.lost,
            "resident_mib": self.resident_mib,
        }


def rehearse(scene: Scenario, policy: AlpasimPolicy, renderer: str, times: DriveTimes) -> Drive:
    """Drive a scene and name its outcomes; where the driver is lost, wait until it is there again
    and begin anew.
    """
    out = Drive(scene.scene_id, scene.warmup_us // scene.rates.policy_us + 1)
    times.watch(policy.service)
    for _ in range(ATTEMPTS):
        try:
            log = run_rollout(scene, make_renderer(renderer, scene), policy).log()
            values = reduce_rollout(score(log, scene.scene, preset="paper"), "paper").as_dict()
            out.outcomes = tuple(
                name
                for name in OUTCOMES
                if values.get(name, {}).get("valid") and values[name]["value"] >= 0.5
            )
            out.failed = None
        except PolicyError as error:
            out.outcomes, out.failed = (POLICY_FAULT,), error
        except InfrastructureError as error:
            out.lost, out.failed = out.lost + 1, error
            policy.forget_session()
        if out.failed is None or out.outcomes is not None or not _is_back(policy):
            break
    out.resident_mib = resident_mib(policy.service.target)
    return out


def _is_back(policy: AlpasimPolicy) -> bool:
    try:
        policy.service.wait_ready()
    except InfrastructureError:
        return False
    return True


def over_scenes(drives: Sequence[Drive]) -> list[Finding]:
    """Return what the scenes show together: lost connections, and the driver's memory."""
    lost = sum(one.lost for one in drives)
    text = f"{lost} lost connections in {len(drives)} scenes; {sum(one.outcomes is None for one in drives)} scenes without an outcome"
    found = [Finding("the connection lasts", "failed" if lost else "passed", text)]
    seen = [one.resident_mib for one in drives if one.resident_mib is not None]
    if len(seen) > 1:
        text = f"{seen[0]:.0f} MiB after the first scene, {max(seen):.0f} at most, {seen[-1]:.0f} after the last; without children and GPU"
        found.append(Finding("memory of the driver", "noted", text))
    return found
