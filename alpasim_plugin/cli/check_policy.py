"""``simrun check-policy``: the conformance test of a policy, from the command line."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from alpasim_plugin.cli.options import Json
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.process.stdout import parts_print_to_stderr
from policies.conformance import check_policy as run_checks
from scenarios.load import load_scenario

BROKEN = 1

EPILOG = """
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
