"""What a path or a name stands for: the scenarios and suites that ship, and suites: lists of
scenarios with seeds and overrides.
"""

import difflib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import yaml
from pydantic import Field

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import read_text, real
from alpasim_plugin.core.files.config import load_yaml, validate
from alpasim_plugin.core.files.limits import LISTED, SEED, SEEDS
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.core.parts import names as part_names
from scenarios.schema_parts import Part, field, within
from scenarios.sources import import_advice, source_of

LIBRARY = Path(__file__).resolve().parent

MOST_SUITES = 256  # read for one argument, through suites of suites


def shipped_names() -> dict[str, Path]:
    """Return the shipped scenarios: name without ending, to file. Suites are not among them."""
    files = (
        file
        for file in sorted(LIBRARY.glob("*/*.yaml"))
        if file.parent.name not in ("suites", "base")
    )
    return {f"{file.parent.name}/{file.stem}": file for file in files}


def suites() -> dict[str, Path]:
    """Return the shipped suites: ``suites/NAME`` to file."""
    return {f"suites/{file.stem}": file for file in sorted((LIBRARY / "suites").glob("*.yaml"))}


def shipped() -> dict[str, str]:
    """Return every shipped scenario and suite with its one-line description, and of a scenario the
    faults that it catches.
    """
    # The plain loader of libyaml: positions of keys, which messages about other people's files
    # need, take most of a listing's time.
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    files = {**shipped_names(), **suites()}
    facts = {name: yaml.load(read_text(file), loader) for name, file in files.items()}
    return {
        name: f"{keys.get('description', '')}{_caught_words(keys.get('catches', ()))}"
        for name, keys in facts.items()
    }


def _caught_words(faults: Sequence[str]) -> str:
    return f" [catches {', '.join(faults)}]" if faults else ""


def find(path_or_name: str | Path) -> Path:
    """Return the path of an existing file or folder, or of a shipped scenario's file.

    Raises:
        InputError: Neither exists; the nearest shipped names are given.
    """
    path = Path(path_or_name)
    shipped = shipped_names()
    if os.path.exists(path):
        return path
    name = str(path_or_name).removesuffix(".yaml")
    if name in shipped:
        return shipped[name]
    raise unknown(str(path_or_name), "scenario", shipped)


def unknown(text: str, kind: str, names: Mapping[str, Path]) -> InputError:
    """Make the error for a text that is neither a path nor one of the shipped names, with the
    nearest of these.
    """
    try:
        Path(text).stat()
    except PermissionError as error:  # it may be there
        fault = f"{error.strerror}: a folder on the way to it may not be searched"
        return InputError(f"{text}: {fault}", "let this user search and read it")
    except (OSError, ValueError):
        pass
    for part in ("renderer", "fixer", "policy"):
        if text in part_names(part):
            option = "--policy" if part == "policy" else "--renderer"
            return InputError(f"{text}: a {part}, not a {kind}", f"Write {option} {text}.")
    name = text.removesuffix(".yaml")
    files = [path.name for path in Path().glob("*.y*ml")]
    by_last = {suite.rsplit("/", 1)[-1]: suite for suite in names}
    last = difflib.get_close_matches(name.rsplit("/", 1)[-1], by_last, 3, 0.6)
    near = (
        difflib.get_close_matches(name, list(names), 3, 0.5)
        or [by_last[name] for name in last]
        or difflib.get_close_matches(text, files, cutoff=0.8)
    )
    hint = f"did you mean {' or '.join(near)}? " if near else ""
    fault = f"no such file or folder, and no shipped {kind} has that name"
    return InputError(
        f"{text}: {fault}", f"{hint}give a path, or a name that 'simrun list scenarios' shows"
    )


@dataclass(frozen=True)
class ScenarioRef:
    """One scenario to load: ``load_scenario(path, seed, overrides, source)``."""

    path: str
    seed: int | None = None  # scene seed; None: the file's own
    overrides: tuple[str, ...] = ()
    source: str | None = None  # who reads a recorded log; None: the source that recognises it


class SuiteItem(Part):
    """One entry of a suite."""

    path: str = Field(
        min_length=1,
        description="Scenario, suite or folder (relative to this file), or a shipped name.",
    )
    seeds: tuple[Annotated[int, within(SEED)], ...] = Field(
        default=(), max_length=int(SEEDS.high), description="Scene seeds; none: the file's own."
    )
    set: JsonObject = field("Dotted key to value, as --set would.", {})


class SuiteSpec(Part):
    """A suite file."""

    version: Literal[1] = field("Version of this schema: 1.")
    description: str = field("One sentence for people.", "")
    scenarios: tuple[Annotated[str, Field(min_length=1)] | SuiteItem, ...] = Field(
        min_length=1,
        max_length=int(LISTED.high),
        description="Entries: a path or name, or {path, seeds, set}.",
    )


def load_suite(path_or_name: str | Path) -> list[ScenarioRef]:
    """Return the scenarios of a suite file, of a folder, of a shipped suite (``suites/smoke`` or
    ``smoke``), or of one scenario.

    A folder gives every scenario file directly inside it, sorted by name; its suite files are left
    out.

    Raises:
        InputError: Nothing there, an empty folder, or a bad suite file.
    """
    return _expand(str(path_or_name), None, [])


def expand(
    item: str, overrides: Sequence[str] = (), source: str | None = None
) -> list[ScenarioRef]:
    """Return what one command-line argument stands for, with overrides on top of the suite's own.

    With a ``source`` the argument is the path of one recorded log, which that source reads.
    """
    if source is not None:
        return [ScenarioRef(item, None, tuple(overrides), source)]
    return [
        ScenarioRef(ref.path, ref.seed, (*ref.overrides, *overrides)) for ref in load_suite(item)
    ]


def _expand(text: str, base: Path | None, opened: list[Path]) -> list[ScenarioRef]:
    """Return the scenarios that a name stands for; ``opened`` collects the suites on the way."""
    path = _locate(text, base)
    if os.path.isdir(path):
        return _in_folder(path)
    if path.suffix not in (".yaml", ".yml") or "scenarios" not in _head(path):
        return [ScenarioRef(str(path))]
    opened.append(path)
    if len(opened) > MOST_SUITES:
        raise InputError(
            f"{path}: more than {MOST_SUITES} suites to read, {len(set(opened))} different ones",
            "name each suite once",
        )
    document = load_yaml(path)
    spec = validate(SuiteSpec, document)
    out = []
    for i, entry in enumerate(spec.scenarios):
        item = SuiteItem(path=entry) if isinstance(entry, str) else entry
        try:
            refs = _expand(item.path, real(path).parent, opened)
        except InputError as e:
            mark = document.mark(("scenarios", i))
            raise InputError(f"{mark}: {e.message}", e.hint) from e
        extra = tuple(f"{key}={json.dumps(value)}" for key, value in item.set.items())
        out += [
            ScenarioRef(ref.path, seed, (*ref.overrides, *extra))
            for ref in refs
            for seed in (item.seeds or (ref.seed,))
        ]
    return out


def _in_folder(path: Path) -> list[ScenarioRef]:
    """Return the recorded log that a folder is, or the scenario files that lie in it."""
    if source_of(path) is not None:
        return [ScenarioRef(str(path))]
    files = [
        file
        for file in sorted(path.iterdir())
        if file.suffix in (".yaml", ".yml") and "scenarios" not in _head(file)
    ]
    if not files:
        raise InputError(
            f"{path}: a folder without scenario files",
            import_advice(path) or "give a folder of scenario .yaml files, or a log folder",
        )
    return [ScenarioRef(str(file)) for file in files]


def _locate(text: str, base: Path | None) -> Path:
    candidates = [Path(os.path.normpath(base / text))] if base is not None else []
    candidates.append(Path(text))
    for path in candidates:
        if os.path.exists(path):
            return path
    names = {**shipped_names(), **suites()}
    name = text.removesuffix(".yaml")
    for key in (name, f"suites/{name}"):
        if key in names:
            return names[key]
    raise unknown(text, "scenario or suite", names)


def _head(path: Path) -> JsonObject:
    """Return a file's plain data, or nothing where it is not a mapping."""
    data = load_yaml(path).data
    return data if isinstance(data, dict) else {}
