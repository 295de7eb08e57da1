"""Name a reconstruction by its content: the scene it shows, how it is fitted, and the version of the code that does so."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from alpasim_plugin.core.types import Scenario
from alpasim_plugin.plugins.parts.source import own_code_digest
from alpasim_plugin.renderers.reconstruction_recipe import recipe_of

BUILD = "alpasim_plugin.renderers.reconstruction_build"  # what it imports decides, with the scene and the recipe, what the model is

# What neither the frames of the logged drive nor the fit depend on. The source's hash is left out because everything it stands for is here,
# the path of a background file because its bytes are.
_NO_MATTER = frozenset(
    {
        "source", "rates", "start_us", "end_us", "warmup_us", "latency", "degradation", "world_origin", "content_hash", "notes",
        "alpasim_map", "behaviour", "path", "source_part", "stop_at_path_end", "varied",
    }
)  # fmt: skip


class Sink(Protocol):
    """What takes bytes: a hash."""

    def update(self, data: bytes, /) -> object:
        """Take more bytes."""
        ...


def reconstruction_key(scenario: Scenario, recipe: object) -> str:
    """Return 32 hexadecimal digits that two reconstructions share only if they are the same.

    Args:
        scenario: The scene; how long it is driven, its rates and how actors behave in a loop do not matter, its log and tracks do.
        recipe: Numbers, texts, arrays, and mappings, sequences and dataclasses of them.

    Raises:
        TypeError: A value of another type.
        OSError: The scenario's background file cannot be read.
    """
    digest = hashlib.blake2b(digest_size=16)
    feed(digest, [own_code_digest(BUILD), recipe, scenario], skip=_NO_MATTER)
    if scenario.background is not None:
        with Path(scenario.background.path).open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def is_reconstructed(scenario: Scenario) -> bool:
    """Tell whether what the renderer ``3dgs`` shows of a scenario is a fit."""
    return scenario.degradation.kind in ("reconstruction", "cycle")


def model_key(scenario: Scenario) -> str | None:
    """Return the key of what the renderer ``3dgs`` shows of a scenario; None where nothing is fitted."""
    if not is_reconstructed(scenario):
        return None
    return reconstruction_key(scenario, recipe_of(scenario))


def feed(sink: Sink, value: Any, skip: frozenset[str] = frozenset()) -> None:
    """Feed a value to a hash, every part with its type and length in front, so that different values give different bytes.

    Args:
        sink: The hash.
        value: See `reconstruction_key`.
        skip: Names of dataclass fields to leave out, wherever they stand.
    """

    def begin(kind: str, length: int) -> None:
        sink.update(f"{kind}:{length};".encode())

    if isinstance(value, np.ndarray):
        begin(f"{value.dtype.str}{value.shape}", value.nbytes)
        sink.update(np.ascontiguousarray(value).tobytes())
    elif is_dataclass(value) and not isinstance(value, type):
        named = [(f.name, getattr(value, f.name)) for f in fields(value) if f.name not in skip]
        begin(type(value).__name__, len(named))
        for name, part in named:
            feed(sink, name)
            feed(sink, part, skip)
    elif isinstance(value, Mapping):
        begin("mapping", len(value))
        for name in sorted(value):
            feed(sink, name)
            feed(sink, value[name], skip)
    elif isinstance(value, Sequence) and not isinstance(value, str | bytes):
        begin("sequence", len(value))
        for part in value:
            feed(sink, part, skip)
    elif value is None or isinstance(value, bool | int | float | str | np.number):
        plain = value.item() if isinstance(value, np.number) else value
        text = f"{type(plain).__name__}={plain!r}".encode()
        begin("value", len(text))
        sink.update(text)
    else:
        raise TypeError(f"no rule to hash a {type(value).__name__}")
