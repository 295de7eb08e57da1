"""From a resolved part to the part itself, with the defaults of the optional members that it does not define."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from alpasim_plugin.core.errors import EvaluatorError, FixerError, InputError, PolicyError, RendererError, SimrunError
from alpasim_plugin.plugins.interfaces import complete, contract_error
from alpasim_plugin.plugins.parts.loading import load
from alpasim_plugin.plugins.parts.spec import KINDS, PartSpec

ERRORS: dict[str, type[SimrunError]] = {
    "renderer": RendererError,
    "fixer": FixerError,
    "policy": PolicyError,
    "evaluator": EvaluatorError,
}  # whose failure it is; a controller or source that cannot be made is bad input


def build(spec: PartSpec, **known: Any) -> Any:
    """Make a part.

    Args:
        spec: The resolved part.
        known: What the factory may ask for by naming a parameter so; `alpasim_plugin.plugins.parts.spec` lists the names by kind.

    Raises:
        InputError: The import fails, the factory asks for something else, or what it makes lacks a required member; for a policy the
            last two are a `PolicyError`.
        SimrunError: The factory raised; the error class is that of the part's kind.
    """
    kind = KINDS[spec.kind]
    known = {"settings": spec.settings, "address": spec.address} | known
    factory = load(spec.target, spec.kind)
    wanted = _arguments(factory, spec, {key: value for key, value in known.items() if key in kind.arguments})
    try:
        part = factory(**wanted)
    except SimrunError:
        raise
    except Exception as error:  # a part of any origin: the cause is chained
        raise ERRORS.get(spec.kind, InputError)(
            f"making a {spec.kind}", f"{spec.kind} {spec.name!r}", f"{type(error).__name__}: {error}", "run with --debug for the traceback"
        ) from error
    return complete(part, kind.interface, f"{spec.kind} {spec.name!r}")


def _arguments(factory: Callable[..., Any], spec: PartSpec, known: dict[str, Any]) -> dict[str, Any]:
    """Choose what a factory asks for by the names of its parameters.

    Raises:
        InputError: It has a required parameter that is not one of them (of a policy: `PolicyError`).
    """
    try:
        parameters = inspect.signature(factory).parameters.values()
    except ValueError:  # some built-in callables have no signature
        return {}
    named = [p for p in parameters if p.kind in (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)]
    positional = [p.name for p in parameters if p.kind is inspect.Parameter.POSITIONAL_ONLY and p.default is inspect.Parameter.empty]
    unknown = positional + [p.name for p in named if p.name not in known and p.default is inspect.Parameter.empty]
    if unknown:
        raise contract_error(spec.kind)(
            f"making a {spec.kind}",
            f"{spec.kind} {spec.name!r}",
            f"its factory asks for {', '.join(unknown)}",
            f"give the parameter a default; a {spec.kind} may ask for {', '.join(KINDS[spec.kind].arguments) or 'nothing'}",
        )
    return {p.name: known[p.name] for p in named if p.name in known}
