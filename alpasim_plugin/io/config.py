"""Configuration files: YAML with positions, ``extends``, dotted overrides, and pydantic validation with four-part errors."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.io.config_validate import validate
from alpasim_plugin.io.limits import YAML_BYTES
from alpasim_plugin.io.reading import read_bytes
from alpasim_plugin.io.yaml_positions import Document, Key, Mark, parse

__all__ = ["Document", "Mark", "apply_overrides", "load_yaml", "parse_scalar", "validate"]


def load_yaml(path: str | Path, doing: str = "reading a configuration") -> Document:
    """Read a YAML file and everything that its ``extends:`` list names.

    ``extends`` (a list of paths relative to the file, or one path) is merged first to last, then the file itself on top: mappings
    key by key, everything else replaced as a whole.

    Raises:
        InputError: Missing or unreadable file, YAML syntax (with line and column), duplicate or non-text key, a bound exceeded,
            or a cycle of ``extends``.
    """
    return _load(Path(path), doing, ())


def parse_scalar(text: str, doing: str, with_what: str) -> Any:
    """Parse one YAML value from a string, for overrides.

    Raises:
        InputError: Not valid YAML.
    """
    data, _ = parse(text, with_what, doing, override=True)
    return data


def apply_overrides(document: Document, overrides: Sequence[str], doing: str = "applying overrides", origin: str = "--set") -> Document:
    """Set dotted keys: ``road.lane_width_m=3.2``, ``actors.lead.speed_mps=8`` (list items by index or by their ``id``).

    Raises:
        InputError: An override without ``=``, a path through a scalar, or a list item that does not exist.
    """
    if not overrides:
        return document
    data, marks = _copy(document.data), dict(document.marks)
    for text in overrides:
        key, equals, value_text = text.partition("=")
        where = f"{origin} {text}"
        if not equals or not key.strip():
            raise InputError(doing, where, "no KEY=VALUE", "write for example --set road.lane_width_m=3.2")
        value = parse_scalar(value_text, doing, where)
        loc, before = _assign(data, key.strip(), value, where, doing)
        for old in _paths(before, loc):
            marks.pop(old, None)
        marks[loc] = Mark(where, 0, 0)
    return Document(data, marks, document.path, document.sources, (*document.overrides, *overrides))


def _load(path: Path, doing: str, chain: tuple[Path, ...]) -> Document:
    resolved = path.resolve()
    if resolved in chain:
        raise InputError(doing, str(path), f"extends itself through {' -> '.join(str(p) for p in chain)}", "break the cycle of extends")
    raw = read_bytes(path, doing, YAML_BYTES)
    try:
        text = raw.decode("utf-8")
    except UnicodeDecodeError as e:
        raise InputError(doing, str(path), f"byte {e.start} is not UTF-8", "save the file as UTF-8 text") from e
    data, marks = parse(text, str(path), doing)
    sources: list[tuple[str, str]] = []
    if isinstance(data, dict) and "extends" in data:
        at = marks.get(("extends",), Mark(str(path), 1, 1))
        names = data.pop("extends")
        marks = {k: m for k, m in marks.items() if k[:1] != ("extends",)}
        names = [names] if isinstance(names, str) else names
        if not isinstance(names, list) or not all(isinstance(n, str) for n in names):
            raise InputError(doing, str(at), f"extends: {names!r}", "give a list of paths, relative to this file")
        merged: Any = {}
        merged_marks: dict[Key, Mark] = {}
        for name in names:
            base_path = resolved.parent / name
            if not base_path.is_file():
                raise InputError(doing, str(at), f"extends {name!r}, but {base_path} does not exist", "correct the path")
            base = _load(base_path, doing, (*chain, resolved))
            merged, merged_marks = _merged(merged, merged_marks, base.data, base.marks)
            sources.extend(base.sources)
        data, marks = _merged(merged, merged_marks, data, marks)
    sources.append((str(path), hashlib.sha256(raw).hexdigest()))
    return Document(data, marks, str(path), tuple(sources))


def _merged(a: Any, a_marks: Mapping[Key, Mark], b: Any, b_marks: Mapping[Key, Mark]) -> tuple[Any, dict[Key, Mark]]:
    """Merge b over a, with the positions of what is left of both."""
    replaced: set[Key] = set()
    data = _merge(a, b, (), replaced)
    kept = {key: mark for key, mark in a_marks.items() if not any(key[:n] in replaced for n in range(len(key) + 1))}
    return data, {**kept, **b_marks}


def _merge(a: Any, b: Any, loc: Key, replaced: set[Key]) -> Any:
    """Merge b over a: mappings key by key, all else replaced; notes the paths that were."""
    if not (isinstance(a, dict) and isinstance(b, dict)):
        replaced.add(loc)
        return b
    return a | {key: _merge(a[key], value, (*loc, key), replaced) if key in a else value for key, value in b.items()}


def _copy(data: Any) -> Any:
    if isinstance(data, dict):
        return {k: _copy(v) for k, v in data.items()}
    return [_copy(v) for v in data] if isinstance(data, list) else data


def _assign(data: Any, key: str, value: Any, where: str, doing: str) -> tuple[Key, Any]:
    """Set a dotted key in place; return its path and what stood there, None if nothing did."""
    parts = key.split(".")
    loc: list[str | int] = []
    node, before = data, None
    for n, part in enumerate(parts):
        last = n == len(parts) - 1
        if isinstance(node, dict):
            step: str | int = part
            if not last:
                node.setdefault(part, {})
        elif isinstance(node, list):
            step = _item(node, part, where, doing)
        else:
            raise InputError(doing, where, f"{'.'.join(map(str, loc)) or 'the file'} holds a value, not keys", "shorten the path")
        loc.append(step)
        if last:
            before = node.get(step) if isinstance(node, dict) else node[int(step)]
            node[step] = value
        else:
            node = node[step]
    return tuple(loc), before


def _paths(value: Any, loc: Key) -> Iterator[Key]:
    """Yield the path of a value and of everything in it."""
    yield loc
    inside = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, child in inside:
        yield from _paths(child, (*loc, key))


def _item(items: list[Any], part: str, where: str, doing: str) -> int:
    ids = [item.get("id") if isinstance(item, dict) else None for item in items]
    if part in ids:
        return ids.index(part)
    if part.isdecimal() and int(part) < len(items):
        return int(part)
    known = ", ".join(str(i) for i in ids if i) or f"0..{len(items) - 1}"
    raise InputError(doing, where, f"no list item {part!r}", f"use one of: {known}")
