"""The options of the command line, each stated once: as an annotated field of a job's dataclass, or
as an annotated parameter of a verb.
"""

import inspect
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import typer
from typer.core import TyperArgument

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.escape import shorten
from alpasim_plugin.core.files.limits import SEED, SEEDS
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.core.parts.grammar import split_label
from alpasim_plugin.log.run_folder.schema import RUN_INFO, SUMMARY

FIXER_PREFIX = "fixer."
METAVARS = {str: "TEXT", int: "NUMBER", float: "NUMBER", Path: "PATH", bool: " "}

Run = Annotated[Path | None, Positional("A run folder; default: the newest.")]
Json = Annotated[bool, Flag("Print one JSON document on stdout.", "--json")]
Debug = Annotated[bool, Flag("Show tracebacks.", "--debug")]
Overrides = Annotated[
    tuple[str, ...], Flag("Override a scenario key: key=value. Repeatable.", "--set")
]
Overwrite = Annotated[bool, Flag("Replace files that exist.", "--overwrite")]
Evaluators = Annotated[
    tuple[str, ...], Flag("A further evaluator, package.module:Class. Repeatable.", "--evaluator")
]


def command_of(verb: Callable[..., None]) -> Callable[..., None]:
    """Return the function that Typer receives for a verb.

    A parameter that is a dataclass of flags becomes one option for each flag, and is put together
    again for the call. ``--debug`` is added where the verb does not have it; `cli.main` reads it.
    """
    hints = get_type_hints(verb, include_extras=True)
    options = []
    dataclasses: dict[str, tuple[Any, list[str]]] = {}
    for parameter in inspect.signature(verb).parameters.values():
        hint = hints[parameter.name]
        if not is_dataclass(hint):
            options.append(_option(parameter.name, hint, parameter.default))
            continue
        of_fields = get_type_hints(hint, include_extras=True)
        flags = [
            _option(field.name, of_fields[field.name], field.default)
            for field in fields(hint)
            if _flag_of(of_fields[field.name]) is not None
        ]
        dataclasses[parameter.name] = hint, [flag.name for flag in flags]
        options += flags
    if "debug" not in hints:
        options.append(_option("debug", Debug, False))

    def call(**arguments: Any) -> None:
        values = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in arguments.items()
        }
        for name, (kind, names) in dataclasses.items():
            values[name] = kind(**{field: values.pop(field) for field in names})
        if "debug" not in hints:
            del values["debug"]
        verb(**values)

    call.__doc__ = verb.__doc__
    call.__annotations__ = {option.name: option.annotation for option in options}
    vars(call)["__signature__"] = inspect.Signature(options)
    return call


def typer_of(
    verbs: Mapping[str, tuple[Callable[..., None], str | None]], help_text: str | None = None
) -> typer.Typer:
    """Return the Typer application of verbs, each with its epilog; one alone has no name."""
    app = typer.Typer(
        help=help_text,
        add_completion=False,
        rich_markup_mode="markdown",
        context_settings={"help_option_names": ["-h", "--help"]},
    )
    for name, (verb, epilog) in verbs.items():
        app.command(name, epilog=epilog)(command_of(verb))
    return app


def click_command(app: typer.Typer) -> Any:
    """Return the command of an application; the help shows no Python type beside a list of arguments."""
    command = typer.main.get_command(app)
    for inner in (command, *getattr(command, "commands", {}).values()):
        for parameter in inner.params:
            if isinstance(parameter, TyperArgument) and parameter.nargs != 1:
                vars(parameter)["display_type_rich"] = lambda ctx: None
    return command


def _flag_of(hint: Any) -> Flag | Positional | None:
    facts = get_args(hint)[1:] if get_origin(hint) is Annotated else ()
    return next((fact for fact in facts if isinstance(fact, Flag | Positional)), None)


def _option(name: str, hint: Any, default: Any) -> inspect.Parameter:
    """Return Typer's parameter for one flag or argument; a tuple becomes a repeatable one.

    Annotations of Typer's own are left as they are.
    """
    flag = _flag_of(hint)
    if flag is not None:
        kind = get_args(hint)[0]
        if get_origin(kind) is tuple:
            kind = list[get_args(kind)[0]]  # type: ignore[misc]  # a type that is computed
            default = [] if default == () else default
        offered = _completion(flag.names) if flag.names else None
        info: Any
        if isinstance(flag, Positional):
            info = typer.Argument(
                help=flag.help, metavar=flag.metavar, autocompletion=offered, show_default=False
            )
        else:
            parts = get_args(kind) if get_origin(kind) in (list, UnionType) else (kind,)
            names = [flag.name or f"--{name.replace('_', '-')}", flag.also]
            info = typer.Option(
                *filter(None, names),
                help=flag.help,
                min=flag.min,
                max=flag.max,
                metavar=flag.metavar or METAVARS.get(parts[0]),
                autocompletion=offered,
            )
        hint = Annotated[kind, info]
    default = inspect.Parameter.empty if default is MISSING else default
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=hint)


def _completion(kind: str) -> Callable[[str], list[str]]:
    """Return what a Tab offers: names of one kind, the last of several behind commas; none with a
    colon, at which shells end words.
    """

    def offer(incomplete: str) -> list[str]:
        from alpasim_plugin.core.parts import names
        from evaluators import PRESETS
        from scenarios.suite import shipped_names, suites

        if kind == "preset":
            candidates = [*PRESETS]
        elif kind == "scenario":
            candidates = [*shipped_names(), *suites()]
        elif kind == "renderer":
            candidates = [*names("renderer"), *names("fixer")]
        else:
            candidates = [*names(kind)]  # type: ignore[arg-type]  # the kinds of parts
        before, comma, last = incomplete.rpartition(",")
        return [
            before + comma + name
            for name in candidates
            if name.startswith(last) and ":" not in name
        ]

    return offer


def split_policies(text: str) -> list[str]:
    """Split ``--policy`` at its commas, but not at those in the quotes of a command.

    Example:
        >>> split_policies("lane-camera, exec:python drive.py --size '576,320'")
        ['lane-camera', "exec:python drive.py --size '576,320'"]
    """
    parts = re.findall(r"""(?:'[^']*'|"[^"]*"|[^,])+""", text)
    return [part.strip() for part in parts if part.strip()]


def split_overrides(overrides: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Separate the overrides of scenarios from those of fixers: ``fixer.KEY=VALUE``, or
    ``RENDERER:fixer.KEY=VALUE`` for one of them.

    Example:
        >>> split_overrides(["timing.warmup_us=400000", "fixer.mode=chunk", "difix:fixer.weights.bundle=d.safetensors"])
        (('timing.warmup_us=400000',), ('mode=chunk', 'difix:weights.bundle=d.safetensors'))
    """
    of_scene = []
    of_fixer = []
    for text in overrides:
        label, setting = split_label(text)
        if setting.startswith(FIXER_PREFIX):
            fixer_setting = setting.removeprefix(FIXER_PREFIX)
            of_fixer.append(f"{label}:{fixer_setting}" if label else fixer_setting)
        else:
            of_scene.append(text)
    return tuple(of_scene), tuple(of_fixer)


def fixer_overrides(texts: Sequence[str]) -> list[str]:
    """Return ``--set`` values without their prefix ``fixer.``.

    Raises:
        InputError: A value without this prefix.
    """
    for text in texts:
        if not text.startswith(FIXER_PREFIX):
            raise InputError(
                f"--set {text}: not a key of the fixer",
                f"write --set {FIXER_PREFIX}key=value",
            )
    return [text.removeprefix(FIXER_PREFIX) for text in texts]


SHOWN = 80  # characters of a value in a message


def parse_seeds(text: str) -> list[int]:
    """Parse ``--seeds``.

    Example:
        >>> parse_seeds("3"), parse_seeds("4,7")
        ([0, 1, 2], [4, 7])

    Raises:
        InputError: Not a positive count nor a list of non-negative integers of 63 bits.
    """
    parts = [part.strip() for part in text.split(",") if part.strip()]
    is_whole = all(re.fullmatch("[0-9]{1,19}", part) for part in parts)  # 63 bits have 19 digits
    values = [int(part) for part in parts] if is_whole else []
    if "," not in text and len(values) == 1 and values[0] > 0:
        SEEDS.check(values[0], f"--seeds {text}")
        return list(range(values[0]))
    if "," in text and values and all(SEED.holds(value) for value in values):
        SEEDS.check(len(values), "--seeds")
        return values
    raise InputError(
        f"--seeds {shorten(text, SHOWN)}: neither a count from 1 up nor a list of seeds from 0 to 2^63 - 1",
        "write a count such as 3, or a list such as 4,7",
    )


def refuse_existing(path: Path | None, option: str) -> None:
    """Refuse to write over a file, or into a folder that is not there.

    Raises:
        InputError: It exists, or its folder does not.
    """
    if path is not None and not os.path.isdir(path.parent):
        raise InputError(f"{option} {path}: there is no folder {path.parent}", "Make it first.")
    if path is not None and os.path.exists(path):
        raise InputError(f"{option} {path}: the file exists already", "Name another file.")


def run_or_newest(run: Path | None) -> Path:
    """Return the run folder that was named, or the newest one below ``runs/``, a finished one if
    there is any.

    Raises:
        InputError: What was named is no run folder, or none was named and there is none.
    """
    if run is not None:
        if os.path.exists(run / RUN_INFO):
            return run
        raise InputError(f"{run}: not a run folder", "Name one that 'simrun list runs' shows.")
    infos = [*Path("runs").glob(f"*/{RUN_INFO}"), *Path("runs").glob(f"*/*/{RUN_INFO}")]
    if not infos:
        raise InputError("runs/: no run folder below it", "Name a run folder, or drive one first.")

    def age(path: Path) -> tuple[bool, int]:
        return os.path.exists(path.with_name(SUMMARY)), path.stat().st_mtime_ns

    return max(infos, key=age).parent


def run_and_cell(path: Path | None) -> tuple[Path, str]:
    """Return the run folder of ``RUN/CELL`` and the cell, which is empty where a run was named.

    ``.`` stands for the newest run below ``runs/`` where the working folder is no run folder.

    Raises:
        InputError: No run folder is at or above the path.
    """
    is_newest = path is None or (path == Path() and not os.path.exists(Path(RUN_INFO)))
    folder = run_or_newest(None) if is_newest or path is None else path
    for root in (folder, *folder.parents):
        if os.path.exists(root / RUN_INFO):
            return root, "/".join(folder.relative_to(root).parts).removeprefix("rollouts/")
    raise InputError(
        f"{folder}: no run folder at it or above it",
        "Name RUN or RUN/RENDERER/POLICY/SCENE/SEED, as in the tables of the run.",
    )
