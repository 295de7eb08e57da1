"""What can be named: built-in parts and those of installed packages, found the same way in every process."""

from __future__ import annotations

import difflib
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import entry_points

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.plugins.parts.builtin import BUILTIN
from alpasim_plugin.plugins.parts.kinds import KINDS, KindName


@dataclass(frozen=True)
class Entry:
    """A named part."""

    name: str
    target: str  # package.module:attribute
    help: str


def names(kind: KindName) -> dict[str, str]:
    """Return every known name of a kind with one line of help, built-in names first."""
    return {name: entry.help for name, entry in entries(kind).items()}


def entries(kind: KindName) -> Mapping[str, Entry]:
    """Return every known part of a kind by name, built-in ones first.

    Raises:
        InputError: Two packages claim one name.
    """
    return _entries(kind, tuple(sys.path))


def find(kind: KindName, name: str) -> Entry:
    """Return the part with a name.

    Raises:
        InputError: Unknown name (with the nearest known one), or a name claimed twice.
    """
    known = entries(kind)
    if name in known:
        return known[name]
    near = difflib.get_close_matches(name, known, n=1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    do = f"{hint}known: {', '.join(known)}; or name one of your own as package.module:Class"
    raise InputError(f"looking up a {kind}", f"name {name!r}", f"no {kind} has that name", do)


@lru_cache(maxsize=64)
def _entries(kind: KindName, path: tuple[str, ...]) -> Mapping[str, Entry]:
    """Read the table; scanning the installed packages takes tens of milliseconds and changes only with the import path."""
    found = {name: Entry(name, target, help_text) for name, (target, help_text) in BUILTIN[kind].items()}
    for point in entry_points(group=KINDS[kind].group):
        other = found.get(point.name)
        if other is not None and other.target != point.value:
            raise InputError(
                f"loading {kind} plugins",
                f"entry point {point.name!r} = {point.value!r}",
                f"the name is taken by {other.target}",
                "uninstall one of the two packages or rename its entry point",
            )
        found[point.name] = Entry(point.name, point.value, f"from {point.value}")
    return found
