"""The kinds of parts, and what a run knows of a part: enough to build it anywhere, and to tell
whether it is still the same.
"""

import hashlib
import inspect
import json
import pickle
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel

from alpasim_plugin import OWN_PACKAGES
from alpasim_plugin.core import interfaces
from alpasim_plugin.core.errors import (
    EvaluatorError,
    FixerError,
    FixerFault,
    InputError,
    PolicyError,
    RendererFault,
    SimrunError,
)
from alpasim_plugin.core.interfaces import complete, contract_error
from alpasim_plugin.core.metric_types import MetricInfo
from alpasim_plugin.core.parts.blame import blaming
from alpasim_plugin.core.parts.source import code_digest, load, make_importable
from alpasim_plugin.core.typed_json import to_plain
from alpasim_plugin.core.types import shielded

# entry points of what calls a fixer of blocks: (runner, make_fixer, settings, first) -> Renderer
MODES = "simrun.fixer_modes"
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
        Kind(
            "renderer",
            "simrun.renderers",
            interfaces.Renderer,
            ("scenario", "cameras", *SESSION, "address"),
        ),
        Kind("fixer", "simrun.fixers", interfaces.Fixer, ("settings", "scene_id", *SESSION)),
        Kind("policy", "simrun.policies", interfaces.Policy, ("scenario", "address")),
        Kind(
            "controller",
            "simrun.controllers",
            interfaces.Controller,
            ("vehicle", "address", "scene_id"),
        ),
        Kind("evaluator", "simrun.evaluators", interfaces.Evaluator, ("preset",)),
        Kind("source", "simrun.sources", interfaces.Source, ()),
    )
}


@dataclass(frozen=True)
class PartSpec:
    """A part, resolved.

    Attributes:
        kind: Its kind.
        name: As a user named it, with everything that was left out filled in: ``onefixer@2``.
        target: ``package.module:attribute`` or ``/path/file.py:attribute`` of its factory.
        settings: Validated settings; None where the part takes none.
        digest: SHA-256 of its code, settings and files. None: its behaviour is decided elsewhere,
            so nothing it did may be reused.
        note: What it is in a few words: "trained", "untrained (identity)".
        trained: Whether its weights were learned; None where it has none.
        files: SHA-256 of every file that it declares, by path.
        code: SHA-256 of its source files, by path; of simrun's own parts none.
        metrics: An evaluator's own metrics.
        controller: A policy's controller.
        is_blind: A policy whose class declares that it has no camera (``sensors = ()``).
        address: What follows ``scheme://`` in the name of a remote part.
        channel: What a rollout has for itself, such as the channel of a bus: rollouts that name the
            same one are driven one at a time. Empty: nothing.
        missing: What must be given before it can be built; empty where nothing is missing.
    """

    kind: KindName
    name: str
    target: str
    settings: BaseModel | None = None
    digest: str | None = None
    note: str = ""
    trained: bool | None = None
    files: Mapping[str, str] = field(default_factory=dict)
    code: Mapping[str, str] = field(default_factory=dict)
    metrics: Mapping[str, MetricInfo] = field(default_factory=dict)
    controller: str = ""
    is_blind: bool = False
    address: str | None = None
    channel: str = ""
    missing: str = ""

    @property
    def is_users(self) -> bool:
        """Tell whether its code is not simrun's, and runs in the process that builds it."""
        return self.target.partition(".")[0] not in OWN_PACKAGES

    @property
    def label(self) -> str:
        """Give the part and its weights in a few words: "onefixer, trained"."""
        name = getattr(self.settings, "name", "") or self.name
        return f"{name}, {self.note}" if self.note else name

    @property
    def unseen(self) -> str:
        """Say what may change the part and is in no key; empty for simrun's own parts."""
        if self.digest is None:
            return (
                "what the remote part does: it has no digest, and is driven again unless --resume"
            )
        if self.code:
            return (
                "files that its code opens by itself and does not declare in `files`; variables of the "
                "environment; installed libraries"
            )
        return ""

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the target before the rest: settings may be objects of a module that only
        `make_importable` lets be found.
        """
        return _restored, (self.target, pickle.dumps(dict(vars(self))))


def _restored(target: str, pickled_fields: bytes) -> PartSpec:
    make_importable(target)
    return PartSpec(**pickle.loads(pickled_fields))


SHORT_DIGEST = 16  # letters


def short_digest(sha256: str) -> str:
    """Return a digest as files and logs that people read name it: ``sha256-`` and its first letters."""
    return f"sha256-{sha256[:SHORT_DIGEST]}"


def digest(value: object) -> str:
    """Return a SHA-256 over the canonical JSON of a value."""
    return hashlib.sha256(json.dumps(value, sort_keys=True, default=str).encode()).hexdigest()


def part_digest(
    modules: Sequence[Path], attribute: str, settings: BaseModel | None, files: Mapping[str, str]
) -> str:
    """Return the digest of a part.

    Args:
        modules: Source files of the module that was named and of the one that defines the factory;
            none for an extension module.
        attribute: The factory in the module.
        settings: Its settings.
        files: SHA-256 by name; a name that is a dotted key of the settings takes the place of the
            path that stands there.
    """
    content = to_plain(settings)
    for name in files:
        *outer, last = name.split(".")
        node: Any = content
        for key in outer:
            node = node.get(key) if isinstance(node, dict) else None
        if isinstance(node, dict) and last in node:
            node[last] = None
    return digest([[code_digest(module) for module in modules], attribute, content, dict(files)])


# whose failure it is; a controller or source that cannot be made is bad input
ERRORS: dict[str, type[SimrunError]] = {
    "renderer": RendererFault,
    "fixer": FixerFault,
    "policy": PolicyError,
    "evaluator": EvaluatorError,
}


def error_of(spec: PartSpec) -> type[SimrunError]:
    """Return the error of a part that cannot be made."""
    if spec.kind == "fixer" and not spec.is_users:
        return FixerError
    return ERRORS.get(spec.kind, InputError)


def build(spec: PartSpec, **arguments: Any) -> Any:
    """Make a part.

    Args:
        spec: The resolved part.
        arguments: Values by name; the factory is given those that its parameters are named after.
            A user's part cannot change them. `alpasim_plugin.core.parts.spec` lists the names by
            kind.

    Raises:
        InputError: The import fails, the factory asks for something else, or what it makes lacks a
            required member; for a policy the last two are a `PolicyError`.
        SimrunError: The factory raised; the error class is that of the part's kind.
    """
    kind = KINDS[spec.kind]
    if spec.is_users:
        arguments = {name: shielded(value) for name, value in arguments.items()}
    arguments = {"settings": spec.settings, "address": spec.address} | arguments
    factory = load(spec.target, spec.kind)
    wanted = _arguments(
        factory, spec, {key: value for key, value in arguments.items() if key in kind.arguments}
    )
    name = f"{spec.kind} {spec.name!r}"
    with blaming(error_of(spec), name, "", spec.is_users):
        return complete(factory(**wanted), kind.interface, name)


def _arguments(
    factory: Callable[..., Any], spec: PartSpec, values: dict[str, Any]
) -> dict[str, Any]:
    """Choose what a factory asks for by the names of its parameters.

    Raises:
        InputError: It has a required parameter that is not one of them (of a policy:
            `PolicyError`).
    """
    try:
        parameters = inspect.signature(factory).parameters.values()
    except ValueError:  # some built-in callables have no signature
        return {}
    named_parameters = [
        parameter
        for parameter in parameters
        if parameter.kind not in (parameter.VAR_POSITIONAL, parameter.VAR_KEYWORD)
    ]
    by_name = {
        parameter.name: parameter
        for parameter in named_parameters
        if parameter.kind is not parameter.POSITIONAL_ONLY and parameter.name in values
    }
    unknown = [
        parameter.name
        for parameter in named_parameters
        if parameter.default is parameter.empty and parameter.name not in by_name
    ]
    if unknown:
        raise contract_error(spec.kind)(
            f"{spec.kind} {spec.name!r}: its factory asks for {', '.join(unknown)}",
            f"give the parameter a default; a {spec.kind} may ask for {', '.join(KINDS[spec.kind].arguments) or 'nothing'}",
        )
    return {name: values[name] for name in by_name}
