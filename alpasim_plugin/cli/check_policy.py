"""``simrun check-policy``: the conformance test of a policy. ``simrun check-driver``: the pre-flight check of an AlpaSim driver."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from alpasim_plugin.alpasim.client.driver import AlpasimPolicy
from alpasim_plugin.alpasim.client.preflight import LIMIT_S, DriveTimes, findings, outside_view, tolerances
from alpasim_plugin.cli.options import Json, Overrides
from alpasim_plugin.core.errors import PolicyError
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.process.subprocesses import parts_print_to_stderr
from alpasim_plugin.runtime.cell import make_renderer
from alpasim_plugin.runtime.rollout import run_rollout
from policies.conformance import check_policy as run_checks
from scenarios.load import load_scenario

BROKEN = 1

CHECK_POLICY_EPILOG = """
Examples:

- `simrun check-policy lane-camera`

- `simrun check-policy my_policy.py:Mine --scenario smoke/curve`

Exit codes: 0 every check passed; 1 the policy breaks its contract, or could not be made; 2 it cannot be found.
"""


def check_policy(
    policy: Annotated[str, Positional("A policy's name, package.module:Class, or file.py:Class.")],
    scenario: Annotated[str | None, Flag("Scenario whose cameras it gets; by default one camera ahead.")] = None,
    latency_limit_ms: Annotated[float, Flag("Longest median time of a plan.", min=0.0)] = 100.0,
    as_json: Json = False,
) -> None:
    """Call a policy in fixed situations and name every breach of its contract: shapes, frames, units, time, determinism.

    Nothing is rendered or scored; it takes seconds. Run it before the first drive.
    """
    with parts_print_to_stderr():
        report = run_checks(policy, None if scenario is None else load_scenario(scenario), latency_limit_ms)
    if as_json:
        checks = [{"check": check.name, "ok": check.ok, "found": check.sentence} for check in report.checks]
        latency_ms = dict(zip(("p50", "max"), report.latency_ms, strict=True))
        print(json.dumps({"policy": policy, "ok": report.ok, "checks": checks, "notes": report.notes, "latency_ms": latency_ms}))
    else:
        print(report)
    raise typer.Exit(0 if report.ok else BROKEN)


CHECK_DRIVER_EPILOG = """
Examples:

- `simrun check-driver 127.0.0.1:50052`

- `simrun check-driver my-driver:6000 --scenario scenes/one.usdz --set 'cameras=[{width: 576, height: 320}]'`
"""


def check_driver(
    address: Annotated[str, Positional("The driver, with options as after alpasim://.", metavar="HOST:PORT")],
    scenario: Annotated[str, Flag("What it drives through.")] = "smoke/curve",
    renderer: Annotated[str, Flag("Renderer of its frames.")] = "clean",
    overrides: Overrides = (),
    limit_ms: Annotated[float, Flag("Longest drive call; the challenge allows 100.", min=0.1)] = LIMIT_S * 1000,
    as_json: Json = False,
) -> None:
    """Check a driver before it is submitted: a rollout in AlpaSim's order of calls, its times, its plans, and what it must tolerate.

    Exit codes: 0 nothing failed; 1 a check failed; 4 the driver cannot be reached.
    """
    scene = load_scenario(scenario, overrides=("timing.timeline=alpasim", *(overrides)))
    policy, times, failed = AlpasimPolicy(scene, address), DriveTimes(), None
    times.watch(policy.service)
    try:
        run_rollout(scene, make_renderer(renderer, scene), policy)
    except PolicyError as error:
        failed = error
    warmup = scene.warmup_us // scene.rates.policy_us + 1
    found = [*findings(times, failed, warmup, limit_ms / 1000), *tolerances(policy.service, scene.scene_id), *outside_view()]
    worst = 1 if any(one.result == "failed" for one in found) else 0
    if as_json:
        print(json.dumps({"driver": policy.facts()["driver"], "checks": [one.__dict__ for one in found], "exit_code": worst}))
    else:
        print(f"driver  {policy.facts()['driver']}")
        for one in found:
            print(f"{one.result:7} {one.name}: {one.text}")
    raise typer.Exit(worst)
