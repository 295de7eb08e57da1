"""The options of the command line, each stated once: as an annotated field of a job's dataclass, or
as an annotated parameter of a verb.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Sequence
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from types import GenericAlias, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import typer

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.core.limits import SEED, SEEDS
from alpasim_plugin.log.run_folder.schema import RUN_INFO

FIXER_PREFIX = "fixer."
HELP_NAMES = {"help_option_names": ["-h", "--help"]}

Run = Annotated[Path | None, Positional("A run folder; by default the newest below runs/.")]
Json = Annotated[bool, Flag("Print one JSON document on stdout.", "--json")]
Debug = Annotated[bool, Flag("Show tracebacks.")]
Quiet = Annotated[bool, Flag("No progress, only the result.")]
RunFolder = Annotated[
    Path | None, Flag("Run folder; by default one below runs/ named after the command.")
]
Overrides = Annotated[
    tuple[str, ...], Flag("Override a scenario key: key=value. Repeatable.", "--set")
]
Overwrite = Annotated[bool, Flag("Replace files that exist.")]
Every = Annotated[bool, Flag("Print every metric, not only the headline ones.", "--all")]
Preset = Annotated[str, Flag("Evaluator preset.", names="preset")]
Presets = Annotated[str, Flag("Evaluator presets, separated by commas.", names="preset")]
Evaluators = Annotated[
    tuple[str, ...], Flag("A further evaluator, package.module:Class. Repeatable.", "--evaluator")
]
Device = Annotated[Literal["cpu", "cuda"], Flag("Where to compute.")]
Seed = Annotated[int, Flag("Seed of the noise.", min=0)]
Workers = Annotated[
    int | None,
    Flag("Worker processes; by default one per core. The result does not depend on them.", min=1),
]
Report = Annotated[
    bool,
    Flag("Write report.html now; `simrun report RUN` writes it later.", "--report/--no-report"),
]


@dataclass(frozen=True)
class What:
    """What is driven."""

    scenarios: Annotated[
        tuple[str, ...],
        Positional(
            "Scenario or suite YAML, a folder of them, a shipped name, or a recorded log.",
            names="scenario",
            required=True,
        ),
    ] = ()
    renderer: Annotated[
        str,
        Flag(
            "Renderers, comma-separated: a name, `FIXER`, `FIXER+RENDERER`, or `package.module:Class`.",
            names="renderer",
        ),
    ] = "3dgs"
    policy: Annotated[
        str,
        Flag(
            "Policies, comma-separated: a name, `package.module:Class`, `file.py:Class` or `exec:COMMAND`.",
            names="policy",
        ),
    ] = "lane-camera"
    seeds: Annotated[str, Flag("How many seeds (3 means 0,1,2), or a list such as 4,7.")] = "1"
    overrides: Annotated[
        tuple[str, ...],
        Flag(
            "Override a scenario key, key=value, or with [RENDERER:]fixer. a fixer's. Repeatable.",
            "--set",
        ),
    ] = ()
    source: Annotated[
        str | None,
        Flag("Reader of the recorded log: a name, or package.module:Class.", names="source"),
    ] = None

    @property
    def renderers(self) -> list[str]:
        """Give the names of the renderers."""
        from alpasim_plugin.core.parts import split_names

        return split_names(self.renderer)

    @property
    def of_fixer(self) -> tuple[str, ...]:
        """Give the settings of fixers among the overrides, as `alpasim_plugin.runs.plan.RunOptions`
        has them.
        """
        return split_overrides(self.overrides)[1]

    @property
    def of_scene(self) -> tuple[str, ...]:
        """Give the overrides of scenarios."""
        return split_overrides(self.overrides)[0]


@dataclass(frozen=True)
class Where:
    """Where rollouts run."""

    workers: Workers = None
    executor: Annotated[
        str,
        Flag("`local`, or `ray[:HOST:PORT]` with what a worker needs: `ray?cores=2&memory=8`."),
    ] = "local"

    def arguments(self) -> dict[str, Any]:
        """Return the arguments of the same meaning of `execute_run` and `execute_decision`.

        Raises:
            InputError: There is no such executor, or it cannot be given what a worker needs.
        """
        from alpasim_plugin.runs.executors.choice import parse_executor

        return {"workers": self.workers, "executor": parse_executor(self.executor)}


@dataclass(frozen=True)
class Care:
    """How a run is kept and reported."""

    report: Report = True
    wait: Annotated[
        bool,
        Flag("If another process is writing the run folder, wait instead of failing."),
    ] = False
    time_limit: Annotated[
        float | None,
        Flag("Seconds after which a rollout that hangs is ended and reported.", min=0.001),
    ] = None

    def arguments(self) -> dict[str, Any]:
        """Return the arguments of the same meaning of `execute_run` and `execute_decision`."""
        return {"report": self.report, "wait": self.wait, "limit_s": self.time_limit}


class Only:
    """Beside a dataclass of options in a verb's signature: the fields that the verb takes; the
    others keep their default.
    """

    def __init__(self, *names: str) -> None:
        self.names = names


def command_of(function: Callable[..., None]) -> Callable[..., None]:
    """Return the function that Typer is given for a verb.

    A parameter that is a dataclass of flags is taken apart into one option for each flag, and put
    together again for the call. Annotations of Typer's own are left as they are, and ``--debug`` is
    added where the verb does not have it.
    """
    hints = get_type_hints(function, include_extras=True)
    parts: list[inspect.Parameter] = []
    groups: dict[str, tuple[Any, list[str]]] = {}
    for parameter in inspect.signature(function).parameters.values():
        kind, *facts = _parted(hints[parameter.name])
        if not is_dataclass(kind):
            parts.append(_option(parameter.name, hints[parameter.name], parameter.default))
            continue
        made = _options_of(
            kind, next((fact.names for fact in facts if isinstance(fact, Only)), None)
        )
        groups[parameter.name] = kind, [part.name for part in made]
        parts += made
    has_debug = "debug" in hints
    if not has_debug:
        parts.append(
            _option("debug", Debug, False)
        )  # read from the command line by cli.main, before any option is parsed

    def call(**given: Any) -> None:
        values = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in given.items()
        }
        values |= {part.name: () for part in parts if part.name in many and not values[part.name]}
        for name, (kind, names) in groups.items():
            values[name] = kind(**{field: values.pop(field) for field in names})
        if not has_debug:
            del values["debug"]
        function(**values)

    many = {part.name for part in parts if _is_list(part.annotation)}
    call.__doc__ = function.__doc__
    call.__annotations__ = {part.name: part.annotation for part in parts} | {"return": None}
    vars(call)["__signature__"] = inspect.Signature(parts)
    return call


def _parted(hint: Any) -> tuple[Any, ...]:
    return get_args(hint) if get_origin(hint) is Annotated else (hint,)


def _is_list(hint: Any) -> bool:
    kind = _parted(hint)[0]
    return any(
        get_origin(one) is list
        for one in (get_args(kind) if get_origin(kind) in (Union, UnionType) else (kind,))
    )


def _options_of(kind: Any, only: Sequence[str] | None) -> list[inspect.Parameter]:
    hints = get_type_hints(kind, include_extras=True)
    made = []
    for field in fields(kind):
        has_flag = any(
            isinstance(fact, Flag | Positional) for fact in _parted(hints[field.name])[1:]
        )
        if has_flag and (only is None or field.name in only):
            default = inspect.Parameter.empty if field.default is MISSING else field.default
            made.append(_option(field.name, hints[field.name], default))
    return made


def _option(name: str, hint: Any, default: Any) -> inspect.Parameter:
    """Return a parameter of Typer's for one flag or argument; a tuple is a repeatable one."""
    kind, *facts = _parted(hint)
    fact = next((fact for fact in facts if isinstance(fact, Flag | Positional)), None)
    if fact is not None:
        if get_origin(kind) is tuple:
            many: Any = GenericAlias(list, (get_args(kind)[0],))
            is_required = default is inspect.Parameter.empty or (
                isinstance(fact, Positional) and fact.required
            )
            kind, default = (many, inspect.Parameter.empty) if is_required else (many | None, None)
        hint = Annotated[kind, _info(name, fact)]
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=hint)


def _info(name: str, fact: Flag | Positional) -> Any:
    offered = _names(fact.names) if fact.names else None
    if isinstance(fact, Positional):
        return typer.Argument(help=fact.help, metavar=fact.metavar, autocompletion=offered)
    written = [fact.name or f"--{name.replace('_', '-')}", *([fact.also] if fact.also else [])]
    return typer.Option(
        *written,
        help=fact.help,
        min=fact.min,
        max=fact.max,
        metavar=fact.metavar,
        envvar=fact.variable,
        autocompletion=offered,
    )


def _names(kind: str) -> Callable[[str], list[str]]:
    """Return what a Tab offers: names of one kind, the last of several behind commas; none with a
    colon, at which shells end words.
    """

    def offer(incomplete: str) -> list[str]:
        from alpasim_plugin.core.parts import names
        from evaluators import PRESETS
        from scenarios.suite import shipped_names, suites

        before, comma, last = incomplete.rpartition(",")
        known = {"preset": lambda: [*PRESETS], "scenario": lambda: [*shipped_names(), *suites()]}
        known["renderer"] = lambda: [*names("renderer"), *names("fixer")]
        found = known[kind]() if kind in known else names(kind)  # type: ignore[arg-type]
        return [
            before + comma + name for name in found if name.startswith(last) and ":" not in name
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
    of_scene, of_fixer = [], []
    for text in overrides:
        key, equals, value = text.partition("=")
        renderer, fixer, rest = key.rpartition(FIXER_PREFIX)
        if fixer and (not renderer or renderer.endswith(":")):
            of_fixer.append(renderer + rest + equals + value)
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


def parse_seeds(text: str) -> list[int]:
    """Parse ``--seeds``.

    Example:
        >>> parse_seeds("3"), parse_seeds("4,7")
        ([0, 1, 2], [4, 7])

    Raises:
        InputError: Not a positive count nor a list of non-negative integers of 63 bits.
    """
    try:
        values = [int(part) for part in text.split(",") if part.strip()]
    except ValueError:
        values = []
    if "," not in text and len(values) == 1 and values[0] > 0:
        SEEDS.check(values[0], f"--seeds {text}")
        return list(range(values[0]))
    if "," in text and values and all(SEED.holds(value) for value in values):
        SEEDS.check(len(values), "--seeds")
        return values
    raise InputError(
        f"--seeds {text}: neither a count from 1 up nor a list of seeds from 0 to 2^63 - 1",
        "write a count such as 3, or a list such as 4,7",
    )


def check_preset(preset: str) -> None:
    """Refuse a preset that is not there.

    Raises:
        InputError: It is unknown.
    """
    from evaluators import PRESETS

    if preset not in PRESETS:
        raise InputError(
            f"--preset {preset}: no such preset",
            f"known: {', '.join(PRESETS)}",
        )


def refuse_existing(path: Path | None, option: str, overwrite: bool = False) -> None:
    """Refuse to write over a file.

    Raises:
        InputError: It exists, and ``--overwrite`` was not given.
    """
    if path is not None and path.exists() and not overwrite:
        raise InputError(f"{option} {path}: the file exists already", "Name another file.")


def run_or_newest(run: Path | None) -> Path:
    """Return the run folder that was named, or the newest one below ``runs/``.

    Raises:
        InputError: None was named and there is none.
    """
    if run is not None and run != Path("."):
        return run
    if run is not None and (run / RUN_INFO).exists():
        return run
    found = [*Path("runs").glob(f"*/{RUN_INFO}"), *Path("runs").glob(f"*/*/{RUN_INFO}")]
    if not found:
        raise InputError("runs/: no run folder below it", "Name a run folder, or drive one first.")
    return max(found, key=lambda path: path.stat().st_mtime_ns).parent


def run_and_cell(path: Path | None) -> tuple[Path, str]:
    """Return the run folder of ``RUN/CELL`` and the cell, which is empty where a run was named.

    Raises:
        InputError: No run folder is at or above the path.
    """
    folder = run_or_newest(path)
    root = next((one for one in (folder, *folder.parents) if (one / RUN_INFO).exists()), None)
    if root is None:
        raise InputError(
            f"{folder}: no run folder at it or above it",
            "Name RUN or RUN/RENDERER/POLICY/SCENE/SEED, as in the tables of the run.",
        )
    cell = folder.relative_to(root).as_posix()
    return root, "" if cell == "." else cell
