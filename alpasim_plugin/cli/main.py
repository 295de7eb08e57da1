"""Entry point of ``simrun``: verbs, the default verb ``run``, and one place that turns errors into exit codes."""

from __future__ import annotations

import difflib
import json
import os
import sys
import traceback
from pathlib import Path

import typer

from alpasim_plugin.cli import bench, compare, doctor, fork, gate, listing, refine, report, run, score, train
from alpasim_plugin.errors import InputError, SimrunError

app = typer.Typer(
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help="Closed-loop evaluation of driving policies behind a renderer.\n\n"
    "Without a verb `run` is meant: `simrun --renderer clean,3dgs smoke/straight`.\n\n"
    "Exit codes: 0 pass, 1 gate failed, 2 bad input or usage, 3 undecided, 4 rollouts could not be run, "
    "5 evaluator failure, 130 interrupted.",
)
app.command("run", epilog=run.EPILOG)(run.run)
app.command("score", epilog=score.EPILOG)(score.score)
app.command("compare", epilog=compare.EPILOG)(compare.compare)
app.command("gate", epilog=gate.EPILOG)(gate.gate)
app.command("report", epilog=report.EPILOG)(report.report)
app.command("list", epilog=listing.EPILOG)(listing.list_parts)
app.command("doctor", epilog=doctor.EPILOG)(doctor.doctor)
app.command("refine", epilog=refine.EPILOG)(refine.refine)
app.command("fork", epilog=fork.FORK_EPILOG)(fork.fork)
app.command("probe", epilog=fork.PROBE_EPILOG)(fork.probe)
app.add_typer(bench.app, name="bench")
app.add_typer(train.app, name="train")

VERBS = ("run", "score", "compare", "gate", "report", "list", "doctor", "refine", "fork", "probe", "bench", "train")
OWN_OPTIONS = ("--help", "--install-completion", "--show-completion")


def with_verb(args: list[str]) -> list[str]:
    """Insert the verb ``run`` where the first word is none.

    Example:
        >>> with_verb(["--renderer", "clean", "smoke/straight"])
        ['run', '--renderer', 'clean', 'smoke/straight']
        >>> with_verb(["list", "renderers"])
        ['list', 'renderers']

    Raises:
        InputError: A word that is no file and nearly a verb.
    """
    if not args or args[0] in VERBS + OWN_OPTIONS:
        return args
    near = [] if args[0].startswith("-") or Path(args[0]).exists() else difflib.get_close_matches(args[0], VERBS, 1, 0.7)
    if near:
        found = f"neither a verb nor a scenario; {near[0]} is one"
        raise InputError("reading the command line", args[0], found, f"type 'simrun {near[0]}', or 'simrun --help' for all verbs")
    return ["run", *args]


def run_command(args: list[str]) -> int:
    """Run one command line and return its exit code; errors are printed, as JSON on stdout with ``--json``."""
    try:
        app(args=with_verb(args), prog_name="simrun")
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
    """Run the process's command line and exit with its code.

    The working directory is searched for ``--policy package.module:Class`` last, after everything that is installed.
    """
    if os.getcwd() not in sys.path:
        sys.path.append(os.getcwd())
    sys.exit(run_command(sys.argv[1:]))


if __name__ == "__main__":
    main()
