"""The kinds of parts, and what the factory of each may ask for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from alpasim_plugin.plugins import interfaces

KindName = Literal["renderer", "fixer", "policy", "controller", "evaluator", "source"]


@dataclass(frozen=True)
class Kind:
    """One kind of part.

    Attributes:
        name: Singular word for messages and specs.
        group: Entry-point group through which other packages add parts.
        interface: What a built part is.
        arguments: Parameters by which a factory may ask for what is known when a part is built.
    """

    name: KindName
    group: str
    interface: Any
    arguments: tuple[str, ...]


SESSION = ("seed", "device", "threads")
KINDS: dict[str, Kind] = {
    kind.name: kind
    for kind in (
        Kind("renderer", "simrun.renderers", interfaces.Renderer, ("scenario", *SESSION, "address")),
        Kind("fixer", "simrun.fixers", interfaces.Fixer, ("settings", "scene_id", *SESSION)),
        Kind("policy", "simrun.policies", interfaces.Policy, ("scenario", "address")),
        Kind("controller", "simrun.controllers", interfaces.Controller, ("vehicle", "address", "scene_id")),
        Kind("evaluator", "simrun.evaluators", interfaces.Evaluator, ("preset",)),
        Kind("source", "simrun.sources", interfaces.Source, ()),
    )
}
