"""Configuration files: YAML with positions, ``extends``, dotted overrides, and pydantic validation with four-part errors."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from alpasim_plugin.config_validate import validate
from alpasim_plugin.errors import InputError
from alpasim_plugin.yaml_marks import Document, Key, Mark, parse

__all__ = ["Document", "Mark", "apply_overrides", "load_yaml", "parse_scalar", "validate"]

MAX_BYTES = 16 * 1024 * 1024


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
        loc = _assign(data, key.strip(), value, where, doing)
        for old in [k for k in marks if k[: len(loc)] == loc]:
            del marks[old]
        marks[loc] = Mark(where, 0, 0)
    return Document(data, marks, document.path, document.sources, (*document.overrides, *overrides))


def _load(path: Path, doing: str, chain: tuple[Path, ...]) -> Document:
    resolved = path.resolve()
    if resolved in chain:
        raise InputError(doing, str(path), f"extends itself through {' -> '.join(str(p) for p in chain)}", "break the cycle of extends")
    raw = _read(path, doing)
    data, marks = parse(raw.decode("utf-8"), str(path), doing)
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
            merged, merged_marks = _merge(merged, merged_marks, base.data, base.marks, ())
            sources.extend(base.sources)
        data, marks = _merge(merged, merged_marks, data, marks, ())
    sources.append((str(path), hashlib.sha256(raw).hexdigest()))
    return Document(data, marks, str(path), tuple(sources))


def _read(path: Path, doing: str) -> bytes:
    try:
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise InputError(doing, str(path), f"{size} bytes, more than {MAX_BYTES}", "split the file or use a data file")
        raw = path.read_bytes()
        raw.decode("utf-8")
    except UnicodeDecodeError as e:
        raise InputError(doing, str(path), f"byte {e.start} is not UTF-8", "save the file as UTF-8 text") from e
    except OSError as e:
        raise InputError(doing, str(path), f"{e.strerror or e}", "check the path and its permissions") from e
    return raw


def _merge(a: Any, a_marks: Mapping[Key, Mark], b: Any, b_marks: Mapping[Key, Mark], loc: Key) -> tuple[Any, dict[Key, Mark]]:
    """Merge b over a: mappings key by key, all else replaced."""
    if not (isinstance(a, dict) and isinstance(b, dict)):
        kept = {k: m for k, m in a_marks.items() if k[: len(loc)] != loc}
        return b, {**kept, **{k: m for k, m in b_marks.items() if k[: len(loc)] == loc}}
    out, marks = dict(a), dict(a_marks)
    if loc in b_marks:
        marks[loc] = b_marks[loc]
    for key, value in b.items():
        if key in out:
            out[key], marks = _merge(out[key], marks, value, b_marks, (*loc, key))
        else:
            out[key] = value
            marks.update({k: m for k, m in b_marks.items() if k[: len(loc) + 1] == (*loc, key)})
    return out, marks


def _copy(data: Any) -> Any:
    if isinstance(data, dict):
        return {k: _copy(v) for k, v in data.items()}
    return [_copy(v) for v in data] if isinstance(data, list) else data


def _assign(data: Any, key: str, value: Any, where: str, doing: str) -> Key:
    """Set a dotted key in place and return its path."""
    parts = key.split(".")
    loc: list[str | int] = []
    node = data
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
            node[step] = value
        else:
            node = node[step]
    return tuple(loc)


def _item(items: list[Any], part: str, where: str, doing: str) -> int:
    ids = [item.get("id") if isinstance(item, dict) else None for item in items]
    if part in ids:
        return ids.index(part)
    if part.isdecimal() and int(part) < len(items):
        return int(part)
    known = ", ".join(str(i) for i in ids if i) or f"0..{len(items) - 1}"
    raise InputError(doing, where, f"no list item {part!r}", f"use one of: {known}")
