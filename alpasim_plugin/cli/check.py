"""``simrun check``: verify a run folder, a policy, a renderer or an AlpaSim driver before it is
relied on.
"""

from typing import Annotated

import typer

from alpasim_plugin.alpasim.client.driver import BUDGET_S, DriverPolicy
from alpasim_plugin.alpasim.client.preflight import (
    DriveTimes,
    findings,
    tolerances,
)
from alpasim_plugin.cli.driver_sessions import driver_at, session_findings
from alpasim_plugin.cli.options import Json, Run, run_or_newest, typer_of
from alpasim_plugin.cli.output import show
from alpasim_plugin.core.errors import InfrastructureError, PolicyError, SimrunError
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.core.subprocesses import parts_print_to_stderr
from alpasim_plugin.core.types import RolloutLog, Scene
from alpasim_plugin.log.run_folder.check import inspect_files, inspect_run
from alpasim_plugin.log.run_folder.manifests import read_run_json
from alpasim_plugin.runs.cameras import recorded_requests
from alpasim_plugin.runs.guards import checked_frames
from alpasim_plugin.runs.renderer import make_renderer
from alpasim_plugin.runs.rollout import run_rollout
from alpasim_plugin.runs.tables import again
from evaluators import reduce_rollout, score
from evaluators.metrics.outcomes import OUTCOMES, in_words
from evaluators.statistics.numbers import plural
from policies.conformance import check_policy as run_checks
from scenarios.load import load_scenario
from scenarios.suite import expand

BROKEN = 1
FRAMES = 3  # that a renderer is asked for

RUN_EPILOG = """
Example: `simrun check run runs/nightly`

Exit codes: 0 whole; 1 damaged or unfinished, the command of the run repairs it; 2 not a run folder.
"""
POLICY_EPILOG = """
Examples:

- `simrun check policy lane-camera`

- `simrun check policy my_policy.py:Mine --scenario smoke/curve`

Exit codes: 0 every check passed; 1 the policy breaks its contract, or could not be made; 2 it cannot be found.
"""
RENDERER_EPILOG = """
Example: `simrun check renderer my_renderer.py:Mine --scenario smoke/curve`

Exit codes: 0 its frames are valid; 2 the renderer breaks its contract or cannot be found.
"""
DRIVER_EPILOG = """
Examples:

- `simrun check driver 127.0.0.1:50052`

- `simrun check driver my-driver:6000 --scenario scenes/one.usdz`

- `simrun check driver "exec:env ALPASIM_DRIVER_PORT={port} python driver.py"`: its root is read-only, and it is started anew

Exit codes: 0 nothing failed; 1 a check failed; 4 the driver cannot be reached.
"""


def check_run(run: Run = None, as_json: Json = False) -> None:
    """Compare every file of a run with its digest.

    Nothing is written. The command of the run drives damaged and unfinished rollouts again.
    """
    root = run_or_newest(run)
    inspection = inspect_run(root, full=True)
    problems = [str(damage) for damage in (*inspect_files(root), *inspection.damage)]
    problems += [f"{cell}: the rollout is unfinished" for cell in inspection.unfinished]
    code = BROKEN if problems else 0
    facts = {
        "run": str(root),
        "whole": not problems,
        "exit_code": code,
        "rollouts": len(inspection.cells),
        "unfinished": len(inspection.unfinished),
        "tables_only": inspection.tables_only,
        "damage": problems,
    }
    lines = problems
    if inspection.tables_only:
        lines = [*lines, "the folder has no rollouts, only tables"]
    state = "damaged or unfinished" if problems else "whole"
    counts = f"{plural(len(inspection.cells), 'rollout')}, {plural(len(problems), 'problem')}"
    lines = [*lines, f"{counts}: {state}"]
    if problems:
        lines.append(again(read_run_json(root)))
    show(as_json, facts, *lines)
    raise typer.Exit(code)


def check_policy(
    policy: Annotated[str, Positional("A policy's name, package.module:Class, or file.py:Class.")],
    scenario: Annotated[
        str | None,
        Flag(
            "Scenario that it receives and drives in; default: a straight road with a camera ahead "
            "and two to the sides."
        ),
    ] = None,
    as_json: Json = False,
) -> None:
    """Call a policy in fixed situations and name every breach of its contract.

    Nothing is rendered or scored; it takes seconds. Run it before the first rollout.
    """
    scene = None if scenario is None else load_scenario(scenario)
    with parts_print_to_stderr():
        report = run_checks(policy, scene)
    facts = {
        "policy": policy,
        "ok": report.ok,
        "checks": [
            {"check": check.name, "ok": check.ok, "found": check.sentence}
            for check in report.checks
        ],
        "notes": [note.sentence for note in report.notes],
        "latency_ms": dict(zip(("p50", "max"), report.latency_ms, strict=True)),
    }
    show(as_json, facts, *str(report).splitlines())
    raise typer.Exit(0 if report.ok else BROKEN)


def check_renderer(
    renderer: Annotated[str, Positional("A renderer or fixer as for `run --renderer`.")],
    scenario: Annotated[str, Flag("Scenario that it renders.")] = "smoke/curve",
    as_json: Json = False,
) -> None:
    """Check a few frames along the recorded path: shape, type, camera and time."""
    scene = load_scenario(scenario)
    with parts_print_to_stderr():
        session = make_renderer(renderer, scene)
        shapes = []
        for number in range(FRAMES):
            t_us = scene.start_us + number * scene.rates.camera_us
            frames = checked_frames(session, recorded_requests(scene, t_us))
            shapes += [list(frame.rgb.shape) for frame in frames]
    facts = {"renderer": renderer, "ok": True, "frames": len(shapes), "shapes": shapes}
    height, width, _ = shapes[0]
    show(
        as_json, facts, f"{renderer}: {len(shapes)} frames of {width}x{height}, every check passed"
    )


def _outcomes(log: RolloutLog, scene: Scene) -> tuple[str, ...]:
    """Return the outcomes of a logged rollout, by the paper's preset."""
    values = reduce_rollout(score(log, scene, preset="paper"), "paper").values
    measured = {name: values[name] for name in OUTCOMES if name in values}
    return tuple(
        name for name, entry in measured.items() if entry.value is not None and entry.value >= 0.5
    )


def check_driver(
    address: Annotated[
        str,
        Positional(
            "The driver, with options as after alpasim://, or the command that starts it.",
            metavar="HOST:PORT|exec:COMMAND",
        ),
    ],
    scenario: Annotated[
        str, Flag("What it drives through: a scenario, or a suite.")
    ] = "smoke/curve",
    limit_ms: Annotated[
        float, Flag("Longest drive call; the challenge allows 100.", min=0.1)
    ] = BUDGET_S * 1000,
    as_json: Json = False,
) -> None:
    """Check an AlpaSim driver: order of calls, times, plans, several sessions, and what it must
    tolerate.
    """
    times = DriveTimes()
    ended: dict[str, str] = {}
    policy: DriverPolicy | None = None
    failed: SimrunError | None = None
    warmup = 0
    for ref in expand(scenario, ("timing.timeline=alpasim",)):
        scene = load_scenario(ref.path, ref.seed, ref.overrides)
        if policy is not None:
            policy.service.close()
        policy = driver_at(scene, address)
        times.watch(policy.service)
        warmup += scene.warmup_us // scene.rates.policy_us + 1
        try:
            log = run_rollout(scene, make_renderer("clean", scene), policy).log()
            ended[scene.scene_id] = in_words(_outcomes(log, scene.scene))
        except (PolicyError, InfrastructureError) as error:
            ended[scene.scene_id], failed = error.message, failed or error
            if isinstance(error, InfrastructureError):
                break
    assert policy is not None, "a scenario stands for one scene at least"
    checks = [
        *findings(times, failed, warmup, limit_ms / 1000),
        *tolerances(policy.service, scene.scene_id),
        *([] if isinstance(failed, InfrastructureError) else session_findings(scene, address)),
    ]
    code = BROKEN if any(check.result == "failed" for check in checks) else 0
    driver = policy.facts()["driver"]
    facts = {
        "driver": driver,
        "checks": [vars(check) for check in checks],
        "scenes": ended,
        "exit_code": code,
    }
    lines = [f"{check.result:7} {check.name}: {check.text}" for check in checks]
    show(as_json, facts, f"driver  {driver}", *lines)
    raise typer.Exit(code)


app = typer_of(
    {
        "run": (check_run, RUN_EPILOG),
        "policy": (check_policy, POLICY_EPILOG),
        "renderer": (check_renderer, RENDERER_EPILOG),
        "driver": (check_driver, DRIVER_EPILOG),
    },
    "Verify a run folder, a policy, a renderer or an AlpaSim driver.",
)
