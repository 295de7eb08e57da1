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
    kind: Annotated[Literal["renderers", "policies", "scenarios", "metrics"], typer.Argument(help="What to list.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks.")] = False,
) -> None:
    """List renderers, policies, shipped scenarios or metrics, one a line with one line of help."""
    del debug
    tables: dict[str, Callable[[], dict[str, str]]] = {
        "renderers": RENDERERS.names,
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
