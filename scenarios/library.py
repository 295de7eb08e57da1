"""The scenarios and suites that come with the package, by name, and what a path or a name stands for."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from pathlib import Path

import yaml

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.io.reading import exists

LIBRARY = Path(__file__).resolve().parent


def shipped_names() -> dict[str, Path]:
    """Return the shipped scenarios: name without ending, to file. Suites are not among them."""
    files = (file for file in sorted(LIBRARY.glob("*/*.yaml")) if file.parent.name not in ("suites", "base"))
    return {f"{file.parent.name}/{file.stem}": file for file in files}


def suites() -> dict[str, Path]:
    """Return the shipped suites: ``suites/NAME`` to file."""
    return {f"suites/{file.stem}": file for file in sorted((LIBRARY / "suites").glob("*.yaml"))}


def shipped() -> dict[str, str]:
    """Return every shipped scenario and suite with its one-line description."""
    # The plain loader of libyaml: positions of keys, which messages about other people's files need, take most of a listing's time.
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    found = {**shipped_names(), **suites()}
    return {name: str(yaml.load(file.read_text(), loader).get("description", "")) for name, file in found.items()}


def find(path_or_name: str | Path) -> Path:
    """Return the path of an existing file or folder, or of a shipped scenario's file.

    Raises:
        InputError: Neither exists; the nearest shipped names are given.
    """
    path, shipped = Path(path_or_name), shipped_names()
    if exists(path):
        return path
    name = str(path_or_name).removesuffix(".yaml")
    if name in shipped:
        return shipped[name]
    raise unknown("reading a scenario", str(path_or_name), "scenario", shipped)


def unknown(doing: str, text: str, kind: str, names: Mapping[str, Path]) -> InputError:
    """Make the error for a text that is neither a path nor one of the shipped names, with the nearest of these."""
    try:
        Path(text).stat()
    except PermissionError as error:  # it may be there
        found = f"{error.strerror}: a folder on the way to it may not be searched"
        return InputError(doing, text, found, "let this user search and read it")
    except (OSError, ValueError):
        pass
    name = text.removesuffix(".yaml")
    near = difflib.get_close_matches(name, list(names), n=3, cutoff=0.5)
    if not near:
        last_parts = [one.rsplit("/", 1)[-1] for one in names]
        near = difflib.get_close_matches(name.rsplit("/", 1)[-1], last_parts, n=3, cutoff=0.5)
    hint = f"did you mean {' or '.join(near)}? " if near else ""
    found = f"no such file or folder, and no shipped {kind} has that name"
    return InputError(doing, text, found, f"{hint}give a path, or a name that 'simrun list scenarios' shows")
