"""Entry point of ``simrun``: verbs, the default verb ``run``, and the mapping of errors and signals
to exit codes.

Only light modules are imported here: until a verb's own are loaded, a signal ends the process
without a traceback.
"""

from __future__ import annotations

import ast
import contextlib
import difflib
import errno
import json
import os
import select
import sys
import traceback
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from alpasim_plugin.core import places
from alpasim_plugin.core.errors import InfrastructureError, InputError, InternalError, SimrunError
from alpasim_plugin.core.lazy import installed_names
from alpasim_plugin.core.signals import Stopped, leave_at_once, stoppable

if TYPE_CHECKING:
    import typer

# Verb -> module of this package and its function, by the groups of the help page. Only the verb
# that was typed is imported: some need torch, which takes seconds to load.
GROUPS: dict[str, dict[str, str]] = {
    "Bring in": {"import": "import_drive:app"},
    "Drive": {
        "run": "run:run",
        "fork": "fork:fork",
        "refine": "refine:refine",
    },
    "Read results": {
        "score": "score:score",
        "compare": "compare:compare",
        "aggregate": "compare:aggregate",
        "gate": "gate:gate",
        "report": "view:report",
        "runs": "runs:runs",
    },
    "Look": {"why": "fork:why", "view": "view:view", "preview": "preview:preview"},
    "AlpaSim": {
        "serve": "serve:serve",
        "serve-policy": "serve:serve_policy",
        "check-driver": "check_policy:check_driver",
        "export": "export:export",
    },
    "Extend": {
        "list": "new:list_parts",
        "new": "new:new",
        "check-policy": "check_policy:check_policy",
    },
    "Check and read": {"check": "check:check", "doctor": "doctor:doctor", "docs": "docs:docs"},
}
PLUGINS = "From installed packages"
GROUP = "simrun.commands"
OF_EXTRA = {
    "adapt": "lab",
    "train": "lab",
    "judge": "lab",
    "bench": "lab",
}  # verbs that an optional package of ours brings
OWN_OPTIONS = ("--help", "--version", "--install-completion", "--show-completion")
PIPE_CLOSED = 141  # as shells count a process that SIGPIPE ended
READING = "reading the command line"
HELP = """Closed-loop evaluation of driving policies behind a renderer.

The default verb is `run`: `simrun --renderer clean,3dgs smoke/straight`.

Exit codes: 0 pass, 1 gate failed, 2 bad input or usage, 3 undecided, 4 rollouts could not be run, 5 evaluator failure, 70 an error of
simrun itself, 130, 143 or 129 stopped by SIGINT, SIGTERM or SIGHUP, 141 the reader of the output has gone.
"""


@cache
def verbs() -> dict[str, str]:
    """Return every verb and its ``module:attribute``: ours, and those that installed packages
    register in the group `GROUP`.

    Raises:
        InputError: A package claims a name that is taken.
    """
    own = {
        verb: f"alpasim_plugin.cli.{target}"
        for group in GROUPS.values()
        for verb, target in group.items()
    }
    return own | installed_names(GROUP, own, "command")


def with_verb(args: list[str]) -> list[str]:
    """Insert the verb ``run`` if the first word is not a verb.

    Example:
        >>> with_verb(["--renderer", "clean", "smoke/straight"])
        ['run', '--renderer', 'clean', 'smoke/straight']
        >>> with_verb(["list", "renderers"])
        ['list', 'renderers']

    Raises:
        InputError: The first word is no file and resembles a verb, or is the verb of a package that
            is not installed.
    """
    if not args or args[0] in verbs() or args[0] in OWN_OPTIONS:
        return args
    if args[0] in OF_EXTRA:
        extra = OF_EXTRA[args[0]]
        raise InputError(
            f"simrun {args[0]}: the verb is not installed",
            f"install the extra that brings it: pip install 'alpasim-onefixer[{extra}]'",
        )
    near = (
        []
        if args[0].startswith("-") or Path(args[0]).exists()
        else difflib.get_close_matches(args[0], verbs(), 1, 0.7)
    )
    if near:
        raise InputError(
            f"{args[0]}: neither a verb nor a scenario; {near[0]} is one",
            f"type 'simrun {near[0]}', or 'simrun --help' for all verbs",
        )
    return ["run", *args]


def make_app(verb: str | None) -> typer.Typer:
    """Return the command line with one verb, or with all verbs for the help page.

    A verb is a `typer.Typer`, or a function whose parameters Typer or
    `alpasim_plugin.cli.options.command_of` understands. Its help is its docstring; below it stands
    ``VERB_EPILOG`` or ``EPILOG`` of its module.
    """
    import typer

    app = typer.Typer(
        no_args_is_help=True, rich_markup_mode="markdown", pretty_exceptions_enable=False, help=HELP
    )

    @app.callback()
    def own(
        version: bool = typer.Option(False, "--version", help="Print the version and leave."),
    ) -> None:
        """Take the options that stand before a verb."""

    if verb in verbs():
        from alpasim_plugin.cli.options import command_of

        module_name, _, name = verbs()[verb].partition(":")
        module = import_module(module_name)
        found = getattr(module, name)
        if isinstance(found, typer.Typer):
            app.add_typer(found, name=verb)
        else:
            epilog = getattr(module, f"{name.upper()}_EPILOG", getattr(module, "EPILOG", None))
            app.command(verb, epilog=epilog)(command_of(found))
        return app
    panels = {listed: panel for panel, group in GROUPS.items() for listed in group}
    for listed in (*panels, *(name for name in verbs() if name not in panels)):
        app.command(
            listed, help=first_line(verbs()[listed]), rich_help_panel=panels.get(listed, PLUGINS)
        )(lambda: None)
    return app


def first_line(target: str) -> str:
    """Return the first line of a verb's help, read off its source: of a function's docstring, or of
    the ``help`` of a `typer.Typer`.

    The module is not imported; where it has no source, the line says where the verb comes from.
    """
    module, _, name = target.partition(":")
    try:
        spec = find_spec(module)
    except ImportError:  # of the package that it lies in
        spec = None
    if spec is None or spec.origin is None or not spec.origin.endswith(".py"):
        return f"from {target}"
    for node in ast.parse(Path(spec.origin).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef) and node.name == name:
            return (ast.get_docstring(node) or "").partition("\n")[0]
        if (
            isinstance(node, ast.Assign)
            and ast.unparse(node.targets[0]) == name
            and isinstance(node.value, ast.Call)
        ):
            for keyword in node.value.keywords:
                if keyword.arg == "help" and isinstance(keyword.value, ast.Constant):
                    return str(keyword.value.value).partition("\n")[0]
    return f"from {target}"


def _run(args: list[str]) -> int:
    """Parse and run one command line; errors of usage are `InputError`."""
    if args[:1] == ["--version"]:
        from alpasim_plugin import __version__

        print(json.dumps({"version": __version__}) if "--json" in args else f"simrun {__version__}")
        return 0
    args = with_verb(args)
    import typer

    command = typer.main.get_command(make_app(next(iter(args), None)))
    usage_error: Any = typer.BadParameter.__bases__[
        0
    ]  # its module is another one in other versions of typer
    try:
        with stoppable(), command.make_context("simrun", list(args)) as context:
            command.invoke(context)
    except typer.Exit as leaving:
        return leaving.exit_code
    except usage_error as error:
        if (
            type(error).__name__ == "NoArgsIsHelpError"
        ):  # simrun alone, or a verb with verbs of its own
            print(error.ctx.get_help(), file=sys.stderr)
            return InputError.exit_code
        where = error.ctx.command_path if error.ctx else "simrun"
        raise InputError(
            f"{where}: {error.format_message().replace('Value error, ', '')}",
            f"'{where} --help' lists what it takes",
        ) from error
    return 0


def run_command(args: list[str]) -> int:
    """Run one command line and return its exit code; errors are printed, as JSON on stdout with
    ``--json``.

    Nothing is raised: what is not one of our errors is an `InternalError`.
    """
    failure: SimrunError | Stopped
    try:
        code = _run(args)
        if sys.stdout is not None:
            sys.stdout.flush()  # here a full disk is still an error with a text
        return code
    except SystemExit as leaving:
        if isinstance(
            leaving.__context__, BrokenPipeError
        ):  # rich leaves with 1, which would read as a failed gate
            return PIPE_CLOSED
        return leaving.code if isinstance(leaving.code, int) else 0 if leaving.code is None else 2
    except (SimrunError, Stopped) as error:
        failure = error
    except Exception as error:
        if isinstance(error, BrokenPipeError) and _reader_is_gone():
            _drop_unwritten_output()
            return PIPE_CLOSED
        failure = _unforeseen(error, args)
    if "--debug" in args and isinstance(failure, SimrunError):
        traceback.print_exception(failure)
    with contextlib.suppress(OSError):  # nobody can be told; the exit code still says it
        if "--json" in args:
            print(
                json.dumps({"error": failure.as_dict(), "exit_code": failure.exit_code}), flush=True
            )
        else:
            print(failure, file=sys.stderr, flush=True)
    _drop_unwritten_output()
    return failure.exit_code


def _unforeseen(error: Exception, args: list[str]) -> SimrunError:
    """Say in four parts what no part of the program has foreseen."""
    command = " ".join(["simrun", *args])
    if isinstance(error, MemoryError):
        return InfrastructureError(
            f"{command}: out of memory: {error}",
            "use fewer --workers, or free memory",
        )
    if isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT):
        where = error.filename or "where the output goes"
        return InfrastructureError(
            f"{command}: {error.strerror}: {where}",
            "free space, then give the same command again",
        )
    if isinstance(error, PermissionError) and error.filename:
        return InputError(
            f"{error.filename}: {error.strerror}",
            "let this user read and write it, or name another",
        )
    if (
        isinstance(error, OSError) and places.nothing_is_writable()
    ):  # of a library that needs a folder for itself
        return InfrastructureError(f"{command}: no folder can be written: {error}", places.DO_THIS)
    failure = InternalError.of(error, command)
    failure.__cause__ = error
    return failure


def _reader_is_gone() -> bool:
    """Tell whether standard output is a pipe or socket whose other end is closed."""
    try:
        poll = select.poll()
        poll.register(sys.stdout.fileno(), 0)
        return any(event & select.POLLERR for _, event in poll.poll(0))
    except (OSError, ValueError, AttributeError):  # closed, or no file at all
        return False


def _drop_unwritten_output() -> None:
    """Drop what was printed and cannot be written, so that Python does not fail on it at its
    end.
    """
    try:
        sys.stdout.flush()
    except (OSError, ValueError, AttributeError):
        with contextlib.suppress(OSError, ValueError, AttributeError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _complete() -> None:
    """Answer a Tab, for which a shell runs the program with the words so far in its environment;
    only the typed verb is imported.
    """
    variable, joint = (
        ("COMP_WORDS", "\n") if "COMP_WORDS" in os.environ else ("_TYPER_COMPLETE_ARGS", " ")
    )
    text = os.environ.get(variable, "")
    number = int(os.environ.get("COMP_CWORD", "0")) or len(text.split()) - (not text.endswith(" "))
    first = [*text.split(), "", ""][1]
    verb: str | None = first
    if first.startswith("-") or (number > 1 and first not in verbs()):
        verb = "run"
        os.environ[variable] = text.replace(joint, f"{joint}run{joint}", 1)
        os.environ["COMP_CWORD"] = str(number + 1)
    make_app(verb if number > 1 or verb == "run" else None)(prog_name="simrun")


def main() -> None:
    """Run the process's command line and exit with its code."""
    leave_at_once()
    if "_SIMRUN_COMPLETE" in os.environ:
        _complete()
    sys.exit(run_command(sys.argv[1:]))


if __name__ == "__main__":
    main()
