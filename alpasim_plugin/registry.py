"""Names to factories, with third-party entries by entry point. Duplicates are refused; unknown names list what is known."""

from __future__ import annotations

import difflib
import sys
from collections.abc import Callable, Iterator
from functools import lru_cache
from importlib.metadata import EntryPoint, entry_points
from typing import Generic, TypeVar

from alpasim_plugin.errors import InputError

T = TypeVar("T")


@lru_cache(maxsize=64)
def _installed(group: str, path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    """Return the installed entry points of a group. Reading them takes tens of milliseconds; they change only with the import path."""
    return tuple(entry_points(group=group))


class Registry(Generic[T]):
    """A table of named factories for one kind of part.

    Args:
        kind: Singular word for messages ("renderer").
        group: Entry-point group through which other packages add names ("simrun.renderers").
    """

    def __init__(self, kind: str, group: str) -> None:
        self.kind, self.group = kind, group
        self._builtin: dict[str, Callable[..., T]] = {}
        self._help: dict[str, str] = {}

    def register(self, name: str, help_text: str = "") -> Callable[[Callable[..., T]], Callable[..., T]]:
        """Add a factory under a name; used as a decorator.

        Raises:
            InputError: The name is taken.
        """

        def add(factory: Callable[..., T]) -> Callable[..., T]:
            if name in self._builtin:
                raise InputError(f"registering a {self.kind}", f"name {name!r}", "that name is taken", "choose another name")
            self._builtin[name] = factory
            self._help[name] = help_text or (factory.__doc__ or "").strip().split("\n")[0]
            return factory

        return add

    def names(self) -> dict[str, str]:
        """Return every known name with one line of help, built-in names first."""
        return {**self._help, **{name: f"from {ep.value}" for name, ep in self._plugins().items()}}

    def __contains__(self, name: str) -> bool:
        return name in self._builtin or name in self._plugins()

    def __iter__(self) -> Iterator[str]:
        return iter(self.names())

    def get(self, name: str) -> Callable[..., T]:
        """Return the factory of a name.

        Raises:
            InputError: Unknown name (with the nearest known one), or a name claimed twice.
        """
        if name in self._builtin:
            return self._builtin[name]
        plugins = self._plugins()
        if name in plugins:
            factory: Callable[..., T] = plugins[name].load()
            return factory
        near = difflib.get_close_matches(name, list(self.names()), n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        raise InputError(
            f"looking up a {self.kind}",
            f"name {name!r}",
            f"no {self.kind} has that name",
            f"{hint}known: {', '.join(self.names())}",
        )

    def _plugins(self) -> dict[str, EntryPoint]:
        found: dict[str, EntryPoint] = {}
        for ep in _installed(self.group, tuple(sys.path)):
            if ep.name in self._builtin or ep.name in found:
                raise InputError(
                    f"loading {self.kind} plugins",
                    f"entry point {ep.name!r} = {ep.value!r}",
                    "that name is already taken",
                    "uninstall one of the two packages or rename its entry point",
                )
            found[ep.name] = ep
        return found
