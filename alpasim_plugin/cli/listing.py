"""``simrun list``: what can be named on the command line."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Annotated, Literal

import typer

from alpasim_plugin.renderers import RENDERERS
from evaluators import METRICS
from policies import POLICIES
from scenarios.suite import shipped

EPILOG = "Example: `simrun list scenarios`"


def list_parts(
    kind: Annotated[Literal["renderers", "fixers", "policies", "scenarios", "metrics"], typer.Argument(help="What to list.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """List renderers, fixers, policies, shipped scenarios or metrics, one a line with one line of help."""
    del debug
    tables: dict[str, Callable[[], dict[str, str]]] = {
        "renderers": RENDERERS.names,
        "fixers": _fixers,
        "policies": POLICIES.names,
        "scenarios": shipped,
        "metrics": lambda: {name: facts.help for name, facts in METRICS.items()},
    }
    known = tables[kind]()
    if as_json:
        print(json.dumps(known))
        return
    width = max((len(name) for name in known), default=0)
    for name, help_text in known.items():
        print(f"{name:<{width}}  {help_text}")


def _fixers() -> dict[str, str]:
    """Return every fixer with its help and whose weights it has; as a renderer each stands for ``NAME+3dgs``."""
    from alpasim_plugin.fixers import FIXERS  # loads torch
    from alpasim_plugin.fixers.card import fixer_card

    return {name: f"{help_text} [{fixer_card(name).note}]" for name, help_text in FIXERS.names().items()}
