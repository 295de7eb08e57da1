"""What can be named, found the same way in every process, and from a name on the command line to a
resolved part.
"""

import inspect
import os
import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import file_sha256
from alpasim_plugin.core.files.config import Document, apply_overrides, guess, validate
from alpasim_plugin.core.interfaces import Declaration, require_methods
from alpasim_plugin.core.lazy import installed
from alpasim_plugin.core.parts.grammar import (
    parse_renderer,
    split_label,
    split_settings,
    split_steps,
)
from alpasim_plugin.core.parts.registry import RegisteredPart, default_settings, entries
from alpasim_plugin.core.parts.source import (
    absolute_target,
    classes_of,
    code_files,
    file_of,
    is_target,
    load,
    no_such_file,
    require_unedited,
    split_address,
)
from alpasim_plugin.core.parts.spec import (
    KINDS,
    MODES,
    KindName,
    PartSpec,
    digest,
    part_digest,
)


def names(kind: KindName) -> dict[str, str]:
    """Return every registered name of a kind with one line of help, shipped parts first."""
    return {name: entry.help for name, entry in entries(kind).items()}


def find(kind: KindName, name: str) -> RegisteredPart:
    """Return the part with a name.

    Raises:
        InputError: Unknown name (with the nearest known one), or a name claimed twice.
    """
    choices = entries(kind)
    if name in choices:
        return choices[name]
    raise _unknown(kind, name, choices)


def _unknown(kind: str, name: str, choices: Collection[str]) -> InputError:
    file = Path(name if name.endswith(".py") else f"{name}.py")
    if name.endswith(".py") or os.path.isfile(file):
        if not os.path.isfile(file):
            return no_such_file(kind, file)
        classes = classes_of(file)
        if not classes:
            return InputError(f"{file}: it has no class", f"Write the {kind} as a class in it.")
        named = " or ".join(f"{file}:{name}" for name in classes)
        return InputError(
            f"{file}: a file, and not which of its classes is the {kind}",
            f"Name its {kind}: {named}.",
        )
    for other in ("renderer", "fixer", "policy", "controller"):
        if name in entries(other):
            option = "renderer" if other == "fixer" else other
            return InputError(
                f"name {name!r}: a {other}, not a {kind}", f"Write --{option} {name}."
            )
    return InputError(
        f"name {name!r}: no {kind} has that name",
        f"{guess(name, choices)}known: {', '.join(choices)}; or name one of your own as package.module:Class",
    )


BASE = "3dgs"  # the renderer below a fixer where nothing else is said
# whose shipped parts declare nothing; a test holds them to it
PLAIN_KINDS = ("renderer", "evaluator", "controller")


@dataclass(frozen=True)
class RendererSpec:
    """A renderer, or a fixer over one.

    Example:
        >>> str(resolve_renderer("onefixer@2")), str(resolve_renderer("clean"))
        ('onefixer@2+3dgs', 'clean')
    """

    name: str  # as a user named it: what tables show
    base: PartSpec
    fixer: PartSpec | None = None

    def __str__(self) -> str:
        return self.base.name if self.fixer is None else f"{self.fixer.name}+{self.base.name}"

    @property
    def digest(self) -> str | None:
        """Give what identifies both; None where either has no digest."""
        parts = [part.digest for part in (self.base, self.fixer) if part is not None]
        return None if None in parts else digest(parts)


def require_installed(
    names_in_file: Iterable[str | None], location: Path | str, named: Collection[str | None] = ()
) -> None:
    """Refuse names of parts that a file holds, unless the parts are installed: a file is data, and
    what it names does not run.

    Args:
        names_in_file: Names of parts as `resolve` and `resolve_renderer` take them; None is no name.
        location: The file, for messages.
        named: What the user named on the command line; it may be the same.

    Raises:
        InputError: A name stands for code of a file or of a module, for an address, or for a
            command.
    """
    for name in names_in_file:
        if name is not None and name not in named and ":" in split_settings(name)[0]:
            raise InputError(
                f"{location}: it names {name}, which is not installed; nothing runs because a file names it",
                "name it on the command line if you trust it and the command has an option for it",
            )


def resolve(kind: KindName, name: str, overrides: Sequence[str] = ()) -> PartSpec:
    """Resolve the name of a part.

    Args:
        kind: Its kind.
        name: A registered name (a fixer also as ``NAME@STEPS``), ``package.module:Class``,
            ``path/file.py:Class``, ``scheme://address`` where a part is registered as
            ``scheme://``, or ``exec:COMMAND``.
        overrides: ``KEY=VALUE`` of its settings.

    Raises:
        InputError: Unknown name (with the nearest), a failing import, a bad setting or address, or
            a declared file that cannot be read.
    """
    spec = unidentified(kind, name, overrides)
    return _described(
        spec, None if _declares_nothing(kind, spec.target) else load(spec.target, kind)
    )


def unidentified(kind: KindName, name: str, overrides: Sequence[str] = ()) -> PartSpec:
    """Resolve a name as far as building the part needs it: no file is read, and there is no digest.
    See `resolve`.
    """
    plain, steps = split_steps(name) if kind == "fixer" else (name, None)
    address = None
    if is_target(plain):
        target = absolute_target(plain)
    else:
        scheme, remote_address = split_address(name)
        if scheme:
            plain = scheme
            address = remote_address
        target = find(kind, plain).target
    at_steps = () if steps is None else (f"steps={steps}",)
    if _declares_nothing(kind, target):
        return PartSpec(kind, name, target, None, address=address)
    factory = load(target, kind)
    if address is not None and hasattr(factory, "check_address"):
        factory.check_address(address)
    channel = factory.channel_of(address) if hasattr(factory, "channel_of") else ""
    overrides = (*at_steps, *overrides)
    model: Any = getattr(factory, "settings_model", None)
    if model is None:
        default = default_settings(kind)
        model = None if default is None else load(default, kind)
    if model is None:
        settings = None
    elif hasattr(model, "load"):
        settings = model.load(plain, overrides)
    else:
        settings = validate(
            model, apply_overrides(Document({}, {}, f"the defaults of {plain}"), overrides)
        )
    return PartSpec(kind, name, target, settings, address=address, channel=channel)


def resolve_renderer(name: str, overrides: Sequence[str] = ()) -> RendererSpec:
    """Resolve ``RENDERER``, ``FIXER`` (over `BASE`) or ``FIXER+RENDERER``; ``@STEPS`` and
    ``[KEY=VALUE,...]`` belong to the fixer.

    Args:
        name: Renderer and fixer as `resolve` takes them: ``clean``, ``onefixer@2``,
            ``onefixer[references=0]``, ``onefixer+my.module:MyRenderer``.
        overrides: ``KEY=VALUE`` of the fixer's settings, ignored where there is none;
            ``RENDERER:KEY=VALUE`` counts for the renderer of that name alone.

    Raises:
        InputError: As `resolve`; a step count without a fixer; a fixer of whole clips, or one
            without the weights that it needs.
    """
    renderers = entries("renderer")
    fixers = entries("fixer")
    parsed = parse_renderer(name, fixers)
    bracket_settings = parsed.settings
    base = parsed.base
    front = f"{parsed.part}@{parsed.steps}" if parsed.steps else parsed.part
    _require_file_or_fixer(parsed.part, fixers)
    if not base and (front in renderers or "://" in front or _is_renderer(parsed.part)):
        if bracket_settings:
            raise InputError(
                f"renderer {name!r}: {front!r} is no fixer: it has no settings for brackets",
                "leave the brackets out, or name a fixer: onefixer[references=0]",
            )
        return RendererSpec(name, resolve("renderer", front))
    if not is_target(front) and split_steps(front)[0] not in fixers:
        if base and front in renderers and split_steps(base)[0] in fixers:
            raise InputError(
                f"renderer {name!r}: the fixer stands before the renderer", f"Write {base}+{front}."
            )
        raise _unknown("renderer or fixer", front, [*renderers, *fixers])
    fixer = resolve("fixer", front, (*overrides_of(name, overrides), *bracket_settings))
    if bracket_settings:
        fixer = replace(fixer, name=f"{fixer.name}[{','.join(bracket_settings)}]")
    _check_in_loop(fixer)
    return RendererSpec(name, resolve("renderer", base or BASE), fixer)


def _require_file_or_fixer(part: str, fixers: Collection[str]) -> None:
    """Refuse a path with a plus that leads to no file: what stands before the plus may have been
    meant as a fixer.
    """
    file, _, _ = part.rpartition(":")
    first, plus, _ = file.partition("+")
    if plus and file.endswith(".py") and not os.path.isfile(file):
        raise InputError(
            f"renderer {part!r}: there is no file {file}, and no fixer {first!r}",
            f"{guess(first, fixers)}name a file that exists, as FILE.py:Class, or a fixer before the +",
        )


def _check_in_loop(fixer: PartSpec) -> None:
    """Refuse a fixer of whole clips, and one without the weights that it needs."""
    settings: Any = fixer.settings
    if getattr(settings, "is_offline", False):
        raise InputError(
            f"fixer {fixer.name!r}: its first frame needs {settings.unit.lookahead_frames} frames "
            "after it, which a closed loop has not driven yet",
            f"fix recorded clips with it: simrun refine --fixer {fixer.name}",
        )
    if fixer.missing:
        raise InputError(f"fixer {fixer.name!r}: {fixer.note}", fixer.missing)


def _is_renderer(name: str) -> bool:
    """Tell whether a target is a renderer, by what it can do."""
    if not is_target(name):
        return False
    part = load(absolute_target(name), "renderer or fixer")
    return hasattr(part, "render") or not hasattr(part, "step")


def overrides_of(renderer: str, overrides: Sequence[str]) -> tuple[str, ...]:
    """Return the settings of one renderer's fixer: those for all, then those for it alone.

    Example:
        >>> overrides_of("difix", ["difix:window=2", "precision=bf16", "gsfix3d:steps=4"])
        ('precision=bf16', 'window=2')
    """
    named = [split_label(text) for text in overrides]
    specific = (text for label, text in named if label == renderer)
    return (*(text for label, text in named if not label), *specific)


def declaration_of(factory: Any, settings: BaseModel | None) -> Declaration:
    """Return what a factory declares: the result of its ``describe(settings)``, or its attributes
    of the same names as `Declaration`'s.
    """
    if hasattr(factory, "describe"):
        return factory.describe(settings)
    files = getattr(factory, "files", {})
    if not isinstance(files, Mapping):
        files = {str(path): Path(path) for path in files}
    attributes = {
        key: getattr(factory, key, None) for key in ("trained", "note", "is_remote", "missing")
    }
    stated: dict[str, Any] = {
        key: value for key, value in attributes.items() if isinstance(value, bool | str)
    }
    return Declaration(files=files, **stated)


def note_of(spec: PartSpec, declared: Declaration) -> str:
    """Return what a part is in a few words, where it does not say so itself."""
    if declared.note or declared.trained is None:
        return declared.note or ("no network" if spec.kind == "fixer" else "")
    return "trained" if declared.trained else "untrained"


def _declares_nothing(kind: KindName, target: str) -> bool:
    """Tell whether a factory need not be imported before it is used: shipped parts of some kinds
    have nothing to declare.

    Those behind an address have: they are remote.
    """
    return kind in PLAIN_KINDS and any(
        part.target == target and part.is_shipped and not part.is_addressed
        for part in entries(kind).values()
    )


def _modules_of(spec: PartSpec, factory: Any) -> list[Path]:
    """Return the files of the modules that define a part; more follow by their imports."""
    module = file_of(spec.target)
    modules = [] if module is None else [module]
    if inspect.isclass(factory) or inspect.isfunction(factory):
        # A package may only pass on what another module defines.
        home = getattr(sys.modules.get(factory.__module__), "__file__", None)
        if home is not None and Path(home) not in modules:
            modules.append(Path(home))
    mode = installed(MODES).get(str(getattr(spec.settings, "loop_mode", "")))
    mode_file = None if mode is None else file_of(mode.value)
    if mode_file is not None:
        # What calls a fixer of blocks shapes its frames, and no import leads there.
        modules.append(mode_file)
    return modules


def _described(spec: PartSpec, factory: Any) -> PartSpec:
    """Return a part with what its factory declares: files, digest, note and the like."""
    module = file_of(spec.target)
    modules = _modules_of(spec, factory)
    if factory is not None:
        for file in modules:
            require_unedited(file)
    if inspect.isclass(factory) and spec.kind != "policy":  # whose contract is under test
        require_methods(factory, KINDS[spec.kind].interface, f"{spec.kind} {spec.name!r}")
    declared = declaration_of(factory, spec.settings)
    folder = module.parent if module else Path()
    paths = {key: folder / path for key, path in declared.files.items()}
    shas = {
        key: file_sha256(
            path, f"correct a path of the {spec.kind} {spec.name!r}, or install it again"
        )
        for key, path in paths.items()
    }
    digest = None
    if not declared.is_remote:
        attribute = spec.target.rpartition(":")[2]
        digest = part_digest(modules, attribute, spec.settings, shas)
    return replace(
        spec,
        digest=digest,
        note=note_of(spec, declared),
        trained=declared.trained,
        files={str(paths[key]): sha for key, sha in shas.items()},
        code={path: sha for module in modules for path, sha in code_files(module).items()},
        metrics=dict(getattr(factory, "metrics", {})) if spec.kind == "evaluator" else {},
        controller=str(getattr(factory, "controller", "bicycle")) if spec.kind == "policy" else "",
        is_blind=spec.kind == "policy" and not getattr(factory, "sensors", True),
        missing=declared.missing,
    )
