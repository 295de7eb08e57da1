"""``simrun completion SHELL``: a script that completes verbs, options and names in the shell itself, so that a Tab starts no Python."""

from __future__ import annotations

import inspect
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import typer

from alpasim_plugin.cli.completion_shells import SCRIPTS
from alpasim_plugin.cli.main import VERBS
from alpasim_plugin.plugins.parts import names
from evaluators import PRESETS
from scenarios.library import shipped_names, suites

EPILOG = """
Examples:

- `simrun completion bash > ~/.local/share/bash-completion/completions/simrun`

- `simrun completion zsh > ~/.zfunc/_simrun`: `fpath=(~/.zfunc $fpath); autoload -U compinit; compinit` in `~/.zshrc`

- `simrun completion fish > ~/.config/fish/completions/simrun.fish`

Write it again after an update or after installing parts of other packages: the names stand in the script.
"""

Shell = Literal["bash", "zsh", "fish"]
FILES = "@files"  # in place of words: the shell's own files and folders
RENDERERS, POLICIES, SCENARIOS = "@renderers", "@policies", "@scenarios"
BY_NAME = {
    "preset": " ".join(PRESETS), "renderer": RENDERERS, "renderers": RENDERERS, "baseline": RENDERERS,
    "policy": POLICIES, "scenarios": SCENARIOS, "scenario": SCENARIOS, "scene": SCENARIOS, "scenes": SCENARIOS,
}  # fmt: skip


@dataclass(frozen=True)
class Completed:
    """What follows one command.

    Attributes:
        words: The command after ``simrun``: ``("train", "fixer")``.
        options: What follows each of its options: words, `FILES` or another mark, or ``""`` for anything; None: the option takes no value.
        positional: What its arguments are, in the same terms.
    """

    words: tuple[str, ...]
    options: dict[str, str | None]
    positional: str


def completion(
    shell: Annotated[Shell, typer.Argument(help="Which shell.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """Print a script that completes verbs, options, and the names of renderers, policies and scenarios."""
    del debug
    script = SCRIPTS[shell](commands(), known_names())
    print(json.dumps({"shell": shell, "script": script}) if as_json else script, end="\n" if as_json else "")


def known_names() -> dict[str, str]:
    """Return the names behind each mark, those of installed packages among them; what holds a colon is left out: shells end words there."""
    lists = {
        RENDERERS: [*names("renderer"), *names("fixer")],
        POLICIES: names("policy"),
        SCENARIOS: [*shipped_names(), *suites()],
    }
    return {mark: " ".join(name for name in found if ":" not in name) for mark, found in lists.items()}


def commands() -> list[Completed]:
    """Return every command, read off the functions that the command line calls."""
    return [found for verb in VERBS for found in _of_verb(verb)]


def _of_verb(verb: str) -> Iterator[Completed]:
    module, attribute, epilog, _ = VERBS[verb]
    home = getattr(import_module(f"alpasim_plugin.cli.{module}"), attribute)
    if epilog:
        yield _read((verb,), home)
        return
    for one in home.registered_commands:
        yield _read((verb, one.name or one.callback.__name__.replace("_", "-")), one.callback)


def _read(words: tuple[str, ...], function: Callable[..., Any]) -> Completed:
    options: dict[str, str | None] = {"--help": None}
    positional = ""
    hints = get_type_hints(function, include_extras=True)
    for name in inspect.signature(function).parameters:
        kind, *facts = get_args(hints[name])
        written = [one for fact in facts for one in (fact.default, *(fact.param_decls or ())) if isinstance(one, str)]
        flags = [flag for one in written if one.startswith("-") for flag in one.split("/")]  # the first one stands where a default would
        follows = _follows(name, kind, words)
        if any(isinstance(fact, typer.models.ArgumentInfo) for fact in facts):
            positional = positional or follows
            continue
        for flag in flags or [f"--{name.replace('_', '-')}"]:
            options[flag] = None if kind is bool else follows
    return Completed(words, options, positional)


def _follows(name: str, kind: Any, words: tuple[str, ...]) -> str:
    kind = next((one for one in get_args(kind) if one is not type(None)), kind) if get_origin(kind) in (Union, UnionType) else kind
    if get_origin(kind) is Literal:
        return " ".join(map(str, get_args(kind)))
    inner = get_args(kind)[0] if get_origin(kind) is list else kind
    if name in BY_NAME:
        return BY_NAME[name]
    return FILES if inner is Path or name in ("run", "runs", "logs", "second") else ""
