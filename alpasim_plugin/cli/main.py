"""Entry point of ``simrun``: verbs, the default verb ``run``, and the mapping of errors and signals
to exit codes.

Only light modules are imported here. A verb's module is imported when the verb is used: some need
torch, which takes seconds to load.
"""

import contextlib
import difflib
import errno
import os
import re
import shlex
import sys
import threading
import time
import traceback
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup, TyperOption

from alpasim_plugin.cli.signals import leave_at_once, stoppable
from alpasim_plugin.core.errors import (
    InfrastructureError,
    InputError,
    InternalError,
    SimrunError,
    Stopped,
    is_interruption,
)
from alpasim_plugin.core.files.places import damaged_kernels
from alpasim_plugin.core.garbage import collect_seldom
from alpasim_plugin.core.kept_threads import end_kept_threads
from alpasim_plugin.core.lazy import installed_names
from alpasim_plugin.core.printing import (
    drop_unwritten,
    keep_stdout_for_document,
    print_any_character,
    say,
    say_document,
    warn,
)

THREADS_S = 2.0  # for threads of parts, after the last line is printed

# Panel of the help page -> verb -> module of this package and its function, and one line of help,
# which is the first of the function's docstring.
PANELS: dict[str, dict[str, tuple[str, str]]] = {
    "Bring in": {
        "import": (
            "import_drive:app",
            "Make a scenario of a recorded drive, or of a trained model.",
        ),
        "refine": (
            "refine:refine",
            "Refine a video with a fixer, block by block, at any length in constant memory.",
        ),
    },
    "Drive": {
        "run": (
            "run:run",
            "Drive scenarios behind renderers, score the rollouts and write a report.",
        ),
        "fork": (
            "fork:fork",
            "Continue a logged rollout from an instant with another renderer, policy or seed.",
        ),
    },
    "Read results": {
        "compare": (
            "compare:compare",
            "Print means, paired differences with intervals, and verdicts.",
        ),
        "gate": (
            "gate:gate",
            "Check a run against a gate, or test the gate itself on deliberately broken renderers.",
        ),
        "report": (
            "view:report",
            "Write report.html, summary.md and junit.xml of a run again and print its table.",
        ),
        "score": (
            "score:score",
            "Score rollout logs, AlpaSim's or ours, without rendering; the files are those of a run.",
        ),
        "view": (
            "view:view",
            "Replay rollouts on an offline page, or draw a scenario.",
        ),
        "why": ("why:why", "Show how a rollout failed, on one offline page."),
    },
    "AlpaSim and other tools": {
        "serve": (
            "serve:serve",
            "Serve AlpaSim's renderer service, or with `--policy` a policy as AlpaSim's driver.",
        ),
        "export": (
            "export:export",
            "Write a run for other tools: AlpaSim run folders and scenes, or one scene, policy and seed as a recording for Foxglove and Rerun.",
        ),
    },
    "Extend and check": {
        "list": (
            "list:list_names",
            "List renderers, fixers, policies, scenarios, metrics, presets or runs.",
        ),
        "new": (
            "new:new",
            "Write a working policy, scenario, renderer, fixer or metric with a test, to begin from.",
        ),
        "check": (
            "check:app",
            "Verify a run folder, a policy, a renderer or an AlpaSim driver.",
        ),
        "doctor": (
            "doctor:doctor",
            "Test each part on a small case and report what works, what does not, and what to do.",
        ),
        "docs": ("docs:docs", "Read a page of the documentation in the terminal, or list all."),
    },
}
# Options whose value may be a list, or in brackets hold one.
LISTS = ("--renderer", "--policy", "--seeds", "--preset", "--set", "--fixer", "--split")
OUR_VERBS = "alpasim_plugin."  # what their modules' names begin with
PLUGIN_PANEL = "From installed packages"
PLUGIN_GROUP = "simrun.commands"
# Verbs that an optional package of ours brings.
LABORATORY_VERBS = ("train", "bench")
LABORATORY = (
    "Install the laboratory in the clone of simrun: pip install -e alpasim_plugin/lab; beside a "
    "wheel of simrun, the laboratory's wheel (simrun docs install)."
)
ANYWHERE = ("--json", "-q", "--quiet", "--debug")
OWN_OPTIONS = ("--help", "-h", "--version", "--install-completion", "--show-completion")
COMPLETION = "_SIMRUN_COMPLETE"  # set by a shell that asks what a Tab offers
PIPE_CLOSED = 141  # as shells count a process that SIGPIPE ended
HELP = """Closed-loop evaluation of driving policies behind a renderer.

The default verb is `run`: `simrun --renderer clean,3dgs smoke/straight`.

Exit codes: 0 pass, 1 gate failed, 2 bad input or usage, 3 undecided, 4 rollouts could not be run, 5 evaluator failure, 70 an error of
simrun itself, 130, 143 or 129 stopped by SIGINT, SIGTERM or SIGHUP, 141 the reader of the output has gone.
"""


@cache
def verbs() -> dict[str, str]:
    """Return every verb and its ``module:attribute``: ours, and those that installed packages
    register in the group `PLUGIN_GROUP`.

    Raises:
        InputError: A package claims a name that is taken.
    """
    own_verbs = {
        verb: f"alpasim_plugin.cli.{target}"
        for panel in PANELS.values()
        for verb, (target, _) in panel.items()
    }
    return own_verbs | installed_names(PLUGIN_GROUP, own_verbs)


class Verb(TyperCommand):
    """A verb whose module is imported when it is used; until then it has one line of help."""

    def make_context(self, info_name: Any, args: Any, parent: Any = None, **extra: Any) -> Any:
        """Parse the words of the verb by its own command."""
        command = load_verb(str(self.name))
        if any(word == "" or re.fullmatch("--[a-z-]+=", word) for word in args):
            raise InputError(
                f"simrun {self.name}: a word, or the value of an option, is empty",
                "Leave it out, or name what is meant ('.' for this folder); a variable of the shell may not be set.",
            )
        # Of an option that takes one value and stands twice, the last would win.
        options = [option for option in command.params if isinstance(option, TyperOption)]
        for option in options:
            words = [word for word in args if word.partition("=")[0] in option.opts]
            if len(words) > 1 and not option.multiple and not option.is_flag:
                raise InputError(f"{words[0]}: given {len(words)} times", "Give it once.")
        return command.make_context(info_name, args, parent, **extra)


class Verbs(TyperGroup):
    """The group of all verbs."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of the verbs in the order of the help page."""
        return list(verbs())

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a verb without importing its module."""
        for panel, group in PANELS.items():
            if cmd_name in group:
                return Verb(cmd_name, help=group[cmd_name][1], rich_help_panel=panel)
        if cmd_name in verbs():
            text = f"See simrun {cmd_name} --help."
            return Verb(cmd_name, help=text, rich_help_panel=PLUGIN_PANEL)
        return None


def load_verb(verb: str) -> Any:
    """Import the module of a verb and return its command.

    A verb is a `typer.Typer`, or a function whose parameters Typer or
    `alpasim_plugin.cli.options.command_of` understands. Its help is its docstring; below it stands
    ``VERB_EPILOG`` or ``EPILOG`` of its module.
    """
    from alpasim_plugin.cli.options import click_command, typer_of

    module_name, _, name = verbs()[verb].partition(":")
    try:
        module = import_module(module_name)
    except ModuleNotFoundError as error:
        if verb not in LABORATORY_VERBS or not module_name.startswith(str(error.name)):
            raise
        raise InputError(
            f"simrun {verb}: the laboratory is registered without its modules", LABORATORY
        ) from error
    target = getattr(module, name)
    if not isinstance(target, typer.Typer):
        epilog = getattr(module, f"{name.upper()}_EPILOG", getattr(module, "EPILOG", None))
        target = typer_of({verb: (target, epilog)})
    return click_command(target)


app = typer.Typer(
    cls=Verbs,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help=HELP,
    context_settings={"help_option_names": ["-h", "--help"]},
)


@app.callback()
def own_options(
    version: bool = typer.Option(False, "--version", help="Print the version and leave."),
) -> None:
    """Take the options that stand before a verb."""


def usual(args: list[str]) -> list[str]:
    """Return a command line in one form: ``help VERB`` and ``version`` as options, a list with
    spaces beside its commas as one word where an option takes one, ``--json`` and ``-q`` behind the
    verb.

    Example:
        >>> usual(["help", "list"]), usual(["--renderer", "clean,", "3dgs", "smoke/curve"])
        (['list', '--help'], ['--renderer', 'clean,3dgs', 'smoke/curve'])

    Raises:
        InputError: A comma stands between two words of which no list is made.
    """
    words = _with_joined_lists(args)
    if words[:1] == ["help"]:
        is_known = len(words) == 1 or words[1] in verbs()
        return [*words[1:2], "--help"] if is_known else words[1:2]
    if words and words[0] in ("version", "-v", "-V"):
        return ["--version", *words[1:]]
    if len(words) > 1 and words[0] in ANYWHERE and words[1] in verbs():
        return [words[1], words[0], *words[2:]]
    return words


def _with_joined_lists(args: list[str]) -> list[str]:
    """Join the words of a list with spaces beside its commas, where an option takes a list."""
    words: list[str] = []
    for word in args:
        is_seeds = words[-2:-1] == ["--seeds"] and not word.strip(",").isdecimal()
        has_comma = bool(words) and (words[-1].endswith(",") or word.startswith(","))
        if is_seeds or not has_comma or word.startswith("-"):
            words.append(word)
            continue
        option, equals, _ = words[-1].partition("=")
        if not equals or not option.startswith("-"):
            option = words[-2] if len(words) > 1 else ""
        if option not in LISTS:
            raise InputError(
                f"{words[-1]} {word}: a comma between two words, where no list stands",
                "Write spaces alone; after a name that ends with a comma write a slash.",
            )
        words[-1] += word
    return words


def with_verb(args: list[str]) -> list[str]:
    """Insert the verb ``run`` if the first word is not a verb.

    Example:
        >>> with_verb(["--renderer", "clean", "smoke/straight"])
        ['run', '--renderer', 'clean', 'smoke/straight']
        >>> with_verb(["list", "renderers"])
        ['list', 'renderers']

    Raises:
        InputError: The first word is neither a file nor a verb, or is the verb of a package that is
            not installed.
    """
    if not args or args[0] in verbs() or args[0] in OWN_OPTIONS:
        return args
    if args[0] in LABORATORY_VERBS:
        raise InputError(
            f"simrun {args[0]}: the verb is not installed",
            LABORATORY,
        )
    first, hyphen, second = args[0].partition("-")
    if hyphen and first in verbs() and not os.path.exists(Path(args[0])):
        raise InputError(
            f"{args[0]}: neither a verb nor a scenario",
            f"Type '{shlex.join(['simrun', first, second, *args[1:]])}'.",
        )
    if re.fullmatch(r"[\w-]+", args[0]) and args[0][0] != "-" and not os.path.exists(Path(args[0])):
        near = difflib.get_close_matches(args[0].lower(), verbs(), 1, 0.7)
        guess = f"Type 'simrun {near[0]}'; the" if near else "The"
        if near or len(args) == 1:
            raise InputError(
                f"{args[0]}: neither a verb nor a scenario",
                f"{guess} verbs are {', '.join(verbs())}.",
            )
    return ["run", *args]


def asks_json(args: list[str]) -> bool:
    """Tell whether a command line asks for one JSON document.

    Example:
        >>> asks_json(["list", "presets", "--json"]), asks_json(["list", "presets", "-q"])
        (True, False)
    """
    return "--json" in args


def _document_is_ours(args: list[str]) -> bool:
    """Tell whether the command writes one JSON document through `say_document`; a verb of another
    package prints by itself.
    """
    if not asks_json(args):
        return False
    try:
        verb = "".join(usual(args)[:1])
        return verbs().get(verb, OUR_VERBS).startswith(OUR_VERBS)
    except SimrunError:
        return True


def _run(args: list[str]) -> int:
    """Parse and run one command line; errors of usage are `InputError`."""
    args = usual(args)
    if args[:1] == ["--version"]:
        from alpasim_plugin import __version__

        if asks_json(args):
            say_document({"version": __version__})
        else:
            say(f"simrun {__version__}")
        return 0
    try:
        os.getcwd()
    except OSError as error:
        raise InputError(
            f"the working folder: {error.strerror}", "Change into a folder that exists."
        ) from error
    words = with_verb(args) or ["--help"]
    if words[0] in verbs():
        load_verb(words[0])  # until it is imported, a signal ends the process at once
    command = typer.main.get_command(app)
    try:
        with stoppable(), command.make_context("simrun", list(words)) as context:
            command.invoke(context)
    except typer.Exit as leaving:
        return leaving.exit_code if args else InputError.exit_code
    except typer.TyperException as error:
        message = error.format_message()
        errors = getattr(error.__cause__, "errors", None)  # of pydantic, which Typer asks
        if errors is not None:
            from alpasim_plugin.core.files.reading import wanted_of

            problem = errors()[0]
            detail = f"{problem['input']!r}, wanted {wanted_of(problem)}"
            if problem["type"] == "value_error":  # a choice, whose error says all of it
                detail = str(problem["ctx"]["error"])
            message = message.replace(error.message, detail)
        refused_by = getattr(error, "ctx", None)  # errors of options have one
        verb = refused_by.command_path if refused_by else "simrun"
        raise InputError(f"{verb}: {message}", _right_form(verb, message)) from error
    return 0


# Words of other tools -> the option that they stand for.
SHORT_FORMS = {
    "-r": "--renderer",
    "-p": "--policy",
    "-s": "--seeds",
    "-o": "--out",
    "-n": "--workers",
}
# Beginning of a message -> the command that was meant.
EXAMPLES = {
    "simrun run: Missing argument 'SCENARIO...'": "simrun --renderer clean --policy lane-camera smoke/curve",
    "simrun new: Invalid value for 'kind'": "simrun new policy my_policy",
    "simrun new: Missing argument": "simrun new policy my_policy",
}


def _right_form(verb: str, message: str) -> str:
    """Return the hint to a command line that cannot be read: the option or command that was probably
    meant, and where all are listed.
    """
    word = message.removeprefix("No such option: ").split(" ")[0].rstrip(".")
    if message.startswith("No such option: ") and word in SHORT_FORMS:
        return f"Write {SHORT_FORMS[word]}. See '{verb} --help'."
    for beginning, example in EXAMPLES.items():
        if f"{verb}: {message}".startswith(beginning):
            return f"Write for example '{example}'. See '{verb} --help'."
    return f"See '{verb} --help'."


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
        if isinstance(leaving.__context__, BrokenPipeError):
            return PIPE_CLOSED  # rich leaves with 1, which would read as a failed gate
        return leaving.code if isinstance(leaving.code, int) else 2 * (leaving.code is not None)
    except BrokenPipeError:
        drop_unwritten()
        return PIPE_CLOSED
    except (SimrunError, Stopped) as error:
        failure = error
    except BaseException as error:  # an interrupt without a signal is some code's own
        if is_interruption(error):
            raise
        failure = _unforeseen(error, " ".join(["simrun", *args]))
        failure.__cause__ = error
    if "--debug" in args and isinstance(failure, SimrunError):
        warn(*"".join(traceback.format_exception(failure)).splitlines())
    with contextlib.suppress(OSError):  # nobody can be told; the exit code still says it
        if asks_json(args):
            say_document({"error": failure.as_dict(), "exit_code": failure.exit_code})
        else:
            warn(*str(failure).splitlines())
    drop_unwritten()
    return failure.exit_code


def _unforeseen(error: BaseException, command: str) -> SimrunError:
    """Return the error for what no part of the program has foreseen; a path that the system refuses
    is bad input.
    """
    damaged = damaged_kernels(error)
    if damaged is not None:
        return damaged
    if _lacks_memory(error):
        return InfrastructureError(
            f"{command}: out of memory or of address space: {error}",
            "Use fewer --workers, free memory, or raise the limits of `ulimit -a`.",
        )
    if isinstance(error, OSError):
        if error.errno == errno.EROFS and not error.filename:
            return InfrastructureError(
                f"{command}: {error.strerror}, of a file without a name",
                "Let this user write to /dev/shm, where programs share memory.",
            )
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            return InfrastructureError(
                f"{command}: {error.strerror}: {error.filename or 'where the output goes'}",
                "Free space, then give the same command again.",
            )
        if error.filename:
            return InputError(
                f"{error.filename}: {error.strerror}",
                "Correct the path, or let this user read and write it.",
            )
    return InternalError.of(error, command)


def _lacks_memory(error: BaseException) -> bool:
    """Tell whether the machine, or a limit that it sets, refused memory, a thread or a process; a
    library that is mapped into too little address space is an `ImportError`.
    """
    if isinstance(error, OSError):
        return error.errno in (errno.ENOMEM, errno.EAGAIN) and not error.filename
    text = str(error)
    return (
        isinstance(error, MemoryError)
        or (isinstance(error, ImportError) and "failed to map segment" in text)
        or (isinstance(error, ImportError) and "cannot allocate memory" in text.lower())
        or (isinstance(error, RuntimeError) and "can't start new thread" in text)
    )


def main() -> None:
    """Run the process's command line and exit with its code."""
    leave_at_once()
    collect_seldom()
    print_any_character()
    if COMPLETION in os.environ:
        app(prog_name="simrun")
    if _document_is_ours(sys.argv[1:]):
        keep_stdout_for_document()
    code = run_command(sys.argv[1:])
    end_kept_threads()
    _leave_threads_behind(code)
    sys.exit(code)


def _leave_threads_behind(code: int) -> None:
    """End the process where a part has started a thread that is no daemon: Python would wait for it
    without end.
    """
    others = [thread for thread in threading.enumerate() if thread is not threading.main_thread()]
    until_s = time.monotonic() + THREADS_S
    for thread in others:
        if not thread.daemon:
            thread.join(max(until_s - time.monotonic(), 0.0))
    if any(thread.is_alive() and not thread.daemon for thread in others):
        from alpasim_plugin.alpasim.client.child import end_children  # only where a part ran

        end_children()
        drop_unwritten()
        os._exit(code)


if __name__ == "__main__":
    main()
