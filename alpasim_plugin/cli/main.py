"""Entry point of ``simrun``: verbs, the default verb ``run``, and the mapping of errors and signals to exit codes.

Only light modules are imported here: until a verb's own are loaded, a signal ends the process without a traceback.
"""

from __future__ import annotations

import difflib
import json
import sys
import traceback
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from alpasim_plugin.core.errors import InputError, SimrunError
from alpasim_plugin.process.signals import Stopped, leave_at_once, stoppable

if TYPE_CHECKING:
    import typer

# Verb -> module of this package, its command or group, its epilog, and the first line of its help. Only the verb that was typed is
# imported: some need torch, which takes seconds to load.
VERBS: dict[str, tuple[str, str, str, str]] = {
    "run": (
        "run", "run", "EPILOG",
        "Drive scenarios behind one or more renderers, score the drives, and write a run folder with a report.",
    ),
    "score": ("score", "score", "EPILOG", "Score rollout logs, AlpaSim's or ours, without rendering; the files are those of a run."),
    "compare": (
        "compare", "compare", "EPILOG",
        "Print paired differences on shared scene-seed cells, with verdicts; cells without a pair are listed.",
    ),
    "aggregate": (
        "aggregate", "aggregate", "EPILOG",
        "Print means, intervals and verdicts over the rollouts of several runs; tables of millions of rows are streamed.",
    ),
    "decide": ("decide", "decide", "EPILOG", "Drive scenes in random order until it is decided whether a renderer is worse than another."),
    "gate": ("gate", "gate", "EPILOG", "Judge a run by a gate, or test the gate itself on deliberately broken renderers."),
    "check": ("check", "check", "EPILOG", "Read every file of a run folder, compare it with its digest, and say what is damaged."),
    "report": ("report", "report", "EPILOG", "Write report.html, summary.md and junit.xml of a run again and print its table."),
    "view": (
        "view", "view", "EPILOG",
        "Replay rollouts in a browser: cameras side by side, a map from above, metrics over time, events; offline, or of a running run.",
    ),
    "runs": (
        "runs", "runs", "EPILOG",
        "List run folders: what was driven, with what, when, and how far it came; filtered, and with metrics side by side.",
    ),
    "export": (
        "export", "export", "EPILOG",
        "Write a run for other tools: AlpaSim run folders and scenes, or one scene, policy and seed as a recording for Foxglove or Rerun.",
    ),
    "serve-policy": (
        "serve_policy", "serve_policy", "EPILOG",
        "Serve a policy as AlpaSim's EgodriverService, so that AlpaSim's runtime drives it.",
    ),
    "check-driver": (
        "check_driver", "check_driver", "EPILOG",
        "Check a driver before it is submitted: a rollout in AlpaSim's order of calls, its times, its plans, and what it must tolerate.",
    ),
    "list": (
        "listing", "list_parts", "EPILOG",
        "List renderers, fixers, policies, other parts, shipped scenarios or metrics, one a line with one line of help.",
    ),
    "check-policy": (
        "check_policy", "check_policy", "EPILOG",
        "Drive a policy through painted situations and name every breach of its contract: shapes, frames, units, time, determinism.",
    ),
    "doctor": ("doctor", "doctor", "EPILOG", "Test each part on a small case and report what works, what does not, and what to do."),
    "preview": (
        "preview", "preview", "EPILOG",
        "Draw a scenario before it is driven: map, road users over time, and the camera along the recorded drive.",
    ),
    "new": ("new", "new", "EPILOG", "Write a working policy, scenario, renderer, fixer or metric with a test, to begin from."),
    "refine": ("refine", "refine", "EPILOG", "Refine a video with a fixer, block by block, at any length in constant memory."),
    "fork": ("fork", "fork", "FORK_EPILOG", "Continue a logged rollout from an instant on with another renderer, policy or seed."),
    "probe": (
        "fork", "probe", "PROBE_EPILOG",
        "Query the policy at a logged rollout's poses behind several renderers and measure the distance between its plans.",
    ),
    "serve": ("serve", "serve", "EPILOG", "Serve AlpaSim's renderer service: our renderer, or OneFixer in front of any other renderer."),
    "completion": (
        "completion", "completion", "EPILOG",
        "Print a script that completes verbs, options, and the names of renderers, policies and scenarios.",
    ),
    "bench": ("bench", "app", "", "Measure speed and error of parts."),
    "train": ("train", "app", "", "Make training data and train networks."),
    "judge": ("judge", "app", "", "Check, freeze and describe the judges: networks that measure images (docs/lab/judges.md)."),
}  # fmt: skip
OWN_OPTIONS = ("--help",)


def with_verb(args: list[str]) -> list[str]:
    """Insert the verb ``run`` if the first word is not a verb.

    Example:
        >>> with_verb(["--renderer", "clean", "smoke/straight"])
        ['run', '--renderer', 'clean', 'smoke/straight']
        >>> with_verb(["list", "renderers"])
        ['list', 'renderers']

    Raises:
        InputError: The first word is no file and resembles a verb.
    """
    if not args or args[0] in (*VERBS, *OWN_OPTIONS):
        return args
    near = [] if args[0].startswith("-") or Path(args[0]).exists() else difflib.get_close_matches(args[0], VERBS, 1, 0.7)
    if near:
        found = f"neither a verb nor a scenario; {near[0]} is one"
        raise InputError("reading the command line", args[0], found, f"type 'simrun {near[0]}', or 'simrun --help' for all verbs")
    return ["run", *args]


def make_app(verb: str | None) -> typer.Typer:
    """Return the command line with one verb, or with all verbs for the help page."""
    import typer

    app = typer.Typer(
        no_args_is_help=True,
        rich_markup_mode="markdown",
        pretty_exceptions_enable=False,
        add_completion=False,  # `simrun completion` needs no Python at a Tab
        help="Closed-loop evaluation of driving policies behind a renderer.\n\n"
        "The default verb is `run`: `simrun --renderer clean,3dgs smoke/straight`.\n\n"
        "Exit codes: 0 pass, 1 gate failed, 2 bad input or usage, 3 undecided, 4 rollouts could not be run, "
        "5 evaluator failure, 130, 143 or 129 stopped by SIGINT, SIGTERM or SIGHUP.",
    )
    app.callback()(lambda: None)  # without it, an app of one command has no verbs
    if verb in VERBS:
        module_name, name, epilog, _ = VERBS[verb]
        module = import_module(f"alpasim_plugin.cli.{module_name}")
        if epilog:
            app.command(verb, epilog=getattr(module, epilog))(getattr(module, name))
        else:
            app.add_typer(getattr(module, name), name=verb)
        return app
    for listed, (*_, text) in VERBS.items():
        app.command(listed, help=text)(lambda: None)
    return app


def run_command(args: list[str]) -> int:
    """Run one command line and return its exit code; errors are printed, as JSON on stdout with ``--json``."""
    try:
        args = with_verb(args)
        app = make_app(next(iter(args), None))
        with stoppable():
            app(args=args, prog_name="simrun")
    except Stopped as stop:
        if "--json" in args:
            print(json.dumps({"error": stop.as_dict(), "exit_code": stop.exit_code}))
        else:
            print(stop, file=sys.stderr)
        return stop.exit_code
    except SystemExit as leaving:
        return leaving.code if isinstance(leaving.code, int) else 0 if leaving.code is None else 2
    except SimrunError as error:
        if "--debug" in args:
            traceback.print_exc()
        if "--json" in args:
            print(json.dumps({"error": error.as_dict(), "exit_code": error.exit_code}))
        else:
            print(error, file=sys.stderr)
        return error.exit_code
    return 0


def main() -> None:
    """Run the process's command line and exit with its code."""
    leave_at_once()
    sys.exit(run_command(sys.argv[1:]))


if __name__ == "__main__":
    main()
