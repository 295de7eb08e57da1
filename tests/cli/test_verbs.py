"""What every verb of ``simrun`` has in common, found by walking over all that are registered."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
import typer

from alpasim_plugin.cli.main import VERBS, make_app


def verbs_below(command: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield every command that does something, with the words that call it."""
    if hasattr(command, "commands"):
        for name, inner in command.commands.items():
            yield from verbs_below(inner, (*path, name))
    else:
        yield path, command


ALL = dict(item for verb in VERBS for item in verbs_below(typer.main.get_command(make_app(verb))))


def test_all_verbs_are_walked_over() -> None:
    assert {path[0] for path in ALL} == set(VERBS)
    assert {("train", "fixer"), ("train", "pairs-sheet"), ("bench", "quality")} <= set(ALL)


@pytest.mark.parametrize("path", sorted(ALL), ids=" ".join)
def test_every_verb_takes_json_and_debug_and_shows_an_example(path: tuple[str, ...]) -> None:
    command = ALL[path]
    options = {name for parameter in command.params for name in parameter.opts}
    assert {"--json", "--debug"} <= options
    assert f"simrun {' '.join(path)}" in (command.epilog or "") or command.hidden or path == ("run",)


def test_the_listing_shows_each_verb_with_the_first_line_of_its_own_help() -> None:
    listed: Any = typer.main.get_command(make_app(None))
    assert list(listed.commands) == list(VERBS)
    for verb in VERBS:
        own: Any = typer.main.get_command(make_app(verb))
        first = (own.commands[verb].help or "").split("\n\n")[0].replace("\n", " ").strip()
        assert listed.commands[verb].help == first, verb


def test_a_listing_loads_no_numerical_library() -> None:
    code = "import sys; from alpasim_plugin.cli.main import run_command; run_command(['--help']); print('numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip().endswith("False")
