"""``simrun list``: names for the command line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal

from alpasim_plugin.cli.options import Json
from alpasim_plugin.core.flags import Positional
from alpasim_plugin.plugins.parts import names, unidentified
from alpasim_plugin.plugins.parts.loading import load
from alpasim_plugin.plugins.parts.resolve import declaration_of, note_of

EPILOG = "Example: `simrun list scenarios`"

Listed = Literal["renderers", "fixers", "policies", "controllers", "evaluators", "sources", "scenarios", "metrics", "presets"]


def list_parts(
    kind: Annotated[Listed, Positional("What to list.")],
    as_json: Json = False,
) -> None:
    """List renderers, fixers, policies, other parts, shipped scenarios, metrics or presets, one a line with one line of help."""
    tables: dict[str, Callable[[], dict[str, str]]] = {
        "renderers": _renderers,
        "fixers": _fixers,
        "policies": lambda: names("policy"),
        "controllers": lambda: names("controller"),
        "evaluators": lambda: names("evaluator"),
        "sources": lambda: names("source"),
        "scenarios": _scenarios,
        "metrics": _metrics,
        "presets": _presets,
    }
    known = tables[kind]()
    if as_json:
        print(json.dumps(known))
        return
    width = max((len(name) for name in known), default=0)
    for name, help_text in known.items():
        print(f"{name:<{width}}  {help_text}")


def _renderers() -> dict[str, str]:
    """Return every renderer, and the fixers that a renderer may be named by: each stands for ``NAME+3dgs``."""
    return names("renderer") | {name: f"3dgs, repaired by the fixer {name}: {text}" for name, text in names("fixer").items()}


def _fixers() -> dict[str, str]:
    """Return every fixer with its help and whose weights it has."""
    listed = {}
    for name, help_text in names("fixer").items():
        spec = unidentified("fixer", name)
        factory = load(spec.target, "fixer")
        help_text = getattr(factory, "help", {}).get(name, help_text)
        listed[name] = f"{help_text} [{note_of(spec, declaration_of(factory, spec.settings, Path()))}]"
    return listed


def _scenarios() -> dict[str, str]:
    from scenarios.library import shipped

    return shipped()


def _metrics() -> dict[str, str]:
    from evaluators.metrics import table_of
    from evaluators.metrics.score import resolve_plugins

    return {name: facts.help for name, facts in table_of(resolve_plugins()).items()}


def _presets() -> dict[str, str]:
    from evaluators.metrics.presets import described

    return described()
