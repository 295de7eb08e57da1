"""What every verb of ``simrun`` has in common, found by walking over all that are registered."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import typer

from alpasim_plugin.cli.main import VERBS, app


def verbs_below(command: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield every command that does something, with the words that call it."""
    if hasattr(command, "commands"):
        for name, inner in command.commands.items():
            yield from verbs_below(inner, (*path, name))
    else:
        yield path, command


ALL = dict(verbs_below(typer.main.get_command(app)))


def test_all_verbs_are_walked_over() -> None:
    assert {path[0] for path in ALL} == set(VERBS)
    assert {("train", "fixer"), ("train", "pairs-sheet"), ("bench", "quality")} <= set(ALL)


@pytest.mark.parametrize("path", sorted(ALL), ids=" ".join)
def test_every_verb_takes_json_and_debug_and_shows_an_example(path: tuple[str, ...]) -> None:
    command = ALL[path]
    options = {name for parameter in command.params for name in parameter.opts}
    assert {"--json", "--debug"} <= options
    assert f"simrun {' '.join(path)}" in (command.epilog or "") or path == ("run",)
