"""Configuration files: YAML with positions, ``extends``, dotted overrides, and pydantic validation
with four-part errors.

An error of a file says where in it, and the nearest valid key.
"""

from __future__ import annotations

import difflib
import hashlib
import json
import math
import types as pytypes
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.escape import shorten
from alpasim_plugin.core.limits import YAML_BYTES
from alpasim_plugin.core.reading import read_bytes
from alpasim_plugin.core.yaml_positions import Document, Key, Mark, parse

__all__ = ["Document", "Mark", "apply_overrides", "load_yaml", "parse_scalar", "validate"]


MOST_READ = 64  # files of one document, through extends


def load_yaml(path: str | Path) -> Document:
    """Read a YAML file and everything that its ``extends:`` list names.

    ``extends`` (a list of paths relative to the file, or one path) is merged first to last, then
    the file itself on top: mappings key by key, everything else replaced as a whole.

    Raises:
        InputError: Missing or unreadable file, YAML syntax (with line and column), duplicate or
            non-text key, a bound exceeded, or a cycle of ``extends``.
    """
    return _load(Path(path), (), [])


def parse_scalar(text: str, with_what: str) -> Any:
    """Parse one YAML value from a string, for overrides.

    Raises:
        InputError: Not valid YAML.
    """
    data, _ = parse(text, with_what, override=True)
    return data


def apply_overrides(
    document: Document,
    overrides: Sequence[str],
    origin: str = "--set",
) -> Document:
    """Set dotted keys: ``road.lane_width_m=3.2``, ``actors.lead.speed_mps=8`` (list items by index
    or by their ``id``).

    Raises:
        InputError: An override without ``=``, a path through a scalar, or a list item that does not
            exist.
    """
    if not overrides:
        return document
    data, marks = _copy(document.data), dict(document.marks)
    for text in overrides:
        key, equals, value_text = text.partition("=")
        where = f"{origin} {text}"
        if not equals or not key.strip():
            raise InputError(
                f"{where}: no KEY=VALUE", "write for example --set road.lane_width_m=3.2"
            )
        value = parse_scalar(value_text, where)
        loc, before = _assign(data, key.strip(), value, where)
        for old in _paths(before, loc):
            marks.pop(old, None)
        marks[loc] = Mark(where, 0, 0)
    return Document(data, marks, document.path, document.sources, (*document.overrides, *overrides))


def _load(path: Path, chain: tuple[Path, ...], read: list[Path]) -> Document:
    """Read a file and its bases; ``read`` counts every reading: files that name each other twice
    double at each step.
    """
    resolved = path.resolve()
    if resolved in chain:
        raise InputError(
            f"{path}: extends itself through {' -> '.join(str(p) for p in chain)}",
            "break the cycle of extends",
        )
    read.append(resolved)
    if len(read) > MOST_READ:
        raise InputError(
            f"{path}: more than {MOST_READ} files to read, {len(set(read))} different ones",
            "name each base once in extends",
        )
    raw = read_bytes(path, YAML_BYTES)
    try:
        text = raw.decode("utf-8")
    except UnicodeDecodeError as e:
        raise InputError(
            f"{path}: byte {e.start} is not UTF-8", "save the file as UTF-8 text"
        ) from e
    data, marks = parse(text, str(path))
    sources: list[tuple[str, str]] = []
    if isinstance(data, dict) and "extends" in data:
        at = marks.get(("extends",), Mark(str(path), 1, 1))
        names = data.pop("extends")
        marks = {k: m for k, m in marks.items() if k[:1] != ("extends",)}
        names = [names] if isinstance(names, str) else names
        if not isinstance(names, list) or not all(isinstance(n, str) for n in names):
            raise InputError(
                f"{at}: extends: {names!r}", "give a list of paths, relative to this file"
            )
        merged: Any = {}
        merged_marks: dict[Key, Mark] = {}
        for name in names:
            base_path = resolved.parent / name
            if not base_path.is_file():
                raise InputError(
                    f"{at}: extends {name!r}, but {base_path} does not exist",
                    "correct the path",
                )
            base = _load(base_path, (*chain, resolved), read)
            merged, merged_marks = _merged(merged, merged_marks, base.data, base.marks)
            sources.extend(base.sources)
        data, marks = _merged(merged, merged_marks, data, marks)
    sources.append((str(path), hashlib.sha256(raw).hexdigest()))
    return Document(data, marks, str(path), tuple(sources))


def _merged(
    a: Any, a_marks: Mapping[Key, Mark], b: Any, b_marks: Mapping[Key, Mark]
) -> tuple[Any, dict[Key, Mark]]:
    """Merge b over a, with the positions of what is left of both."""
    replaced: set[Key] = set()
    data = _merge(a, b, (), replaced)
    kept = {
        key: mark
        for key, mark in a_marks.items()
        if not any(key[:n] in replaced for n in range(len(key) + 1))
    }
    return data, {**kept, **b_marks}


def _merge(a: Any, b: Any, loc: Key, replaced: set[Key]) -> Any:
    """Merge b over a: mappings key by key, all else replaced; notes the paths that were."""
    if not (isinstance(a, dict) and isinstance(b, dict)):
        replaced.add(loc)
        return b
    return a | {
        key: _merge(a[key], value, (*loc, key), replaced) if key in a else value
        for key, value in b.items()
    }


def _copy(data: Any) -> Any:
    if isinstance(data, dict):
        return {k: _copy(v) for k, v in data.items()}
    return [_copy(v) for v in data] if isinstance(data, list) else data


def _assign(data: Any, key: str, value: Any, where: str) -> tuple[Key, Any]:
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
            step = _item(node, part, where)
        else:
            raise InputError(
                f"{where}: {'.'.join(map(str, loc)) or 'the file'} holds a value, not keys",
                "shorten the path",
            )
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
    inside = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    for key, child in inside:
        yield from _paths(child, (*loc, key))


def _item(items: list[Any], part: str, where: str) -> int:
    ids = [item.get("id") if isinstance(item, dict) else None for item in items]
    if part in ids:
        return ids.index(part)
    if part.isdecimal() and int(part) < len(items):
        return int(part)
    known = ", ".join(str(i) for i in ids if i) or f"0..{len(items) - 1}"
    raise InputError(f"{where}: no list item {part!r}", f"use one of: {known}")


EXAMINED, EXPLAINED = 200, 4  # problems of one file: those put in order, and those put into words
M = TypeVar("M", bound=BaseModel)


def validate(model: type[M], document: Document) -> M:
    """Validate a document strictly (no text for a number, no unknown key).

    Raises:
        InputError: The first problem in file order, with its position and a hint; the others are
            listed after it.
    """
    _refuse_non_finite(document, document.data, ())
    try:
        # JSON mode is strict about types and still lets a list fill a tuple.
        return model.model_validate_json(json.dumps(document.data), strict=True)
    except ValidationError as e:
        raise _as_input_error(model, document, e) from None


def _refuse_non_finite(document: Document, data: Any, loc: Key) -> None:
    if isinstance(data, dict):
        for key, value in data.items():
            _refuse_non_finite(document, value, (*loc, key))
    elif isinstance(data, list):
        for i, value in enumerate(data):
            _refuse_non_finite(document, value, (*loc, i))
    elif isinstance(data, float) and not math.isfinite(data):
        raise document.error(loc, f"{dotted(loc)} = {data}", "give a finite number")


def dotted(loc: Sequence[str | int]) -> str:
    """Write a key path as ``actors[0].speed_mps``."""
    out = ""
    for part in loc:
        out += f"[{part}]" if isinstance(part, int) else f".{part}" if out else str(part)
    return out or "the file"


def _as_input_error(
    model: type[BaseModel], document: Document, error: ValidationError
) -> InputError:
    items = error.errors(include_url=False)[:EXAMINED]
    placed = []
    for item in items:
        loc = tuple(item["loc"])
        if not _follows_from_another(item, items):
            known = _in_document(document.data, loc)
            placed.append((document.mark(known), item, loc, known))
    # File order, so that the first problem shown is the first that a reader of the file meets.
    placed.sort(key=lambda p: (p[0].file, p[0].line, p[0].column))
    texts = [
        (mark, *_explain(model, document, item, loc, known))
        for mark, item, loc, known in placed[:EXPLAINED]
    ]
    mark, found, hint = texts[0]
    if len(placed) > 1:
        rest = "; ".join(f"{m}: {f}" for m, f, _ in texts[1:])
        found = f"{shorten(found, 180)} (and {error.error_count() - len(items) + len(placed) - 1} more: {rest})"
    return InputError(f"{mark}: {found}", hint)


def _follows_from_another(item: Any, items: Sequence[Any]) -> bool:
    """Say whether a problem is only the shadow of another one.

    A list whose items are wrong counts as too short as well; a misspelt key leaves the right one
    missing.
    """
    loc = tuple(item["loc"])
    if item["type"] == "too_short":
        return any(len(o["loc"]) > len(loc) and tuple(o["loc"][: len(loc)]) == loc for o in items)
    if item["type"] == "missing":
        extra = [
            str(o["loc"][-1])
            for o in items
            if o["type"] == "extra_forbidden" and tuple(o["loc"][:-1]) == loc[:-1]
        ]
        return bool(difflib.get_close_matches(str(loc[-1]), extra, n=1, cutoff=0.6))
    return False


def _in_document(data: Any, loc: Key) -> Key:
    """Drop the parts of a pydantic location that are union tags or missing keys."""
    out: list[str | int] = []
    for part in loc:
        if isinstance(data, dict) and part in data:
            data = data[str(part)]
        elif isinstance(data, list) and isinstance(part, int) and part < len(data):
            data = data[part]
        else:
            continue
        out.append(part)
    return tuple(out)


def _explain(
    model: type[BaseModel], document: Document, item: Any, loc: Key, known: Key
) -> tuple[str, str]:
    kind = item["type"]
    ctx = item.get("ctx", {})
    value = item.get("input")
    name = dotted(known)
    if kind == "extra_forbidden":
        keys = sorted({k for m in _models_at(model, loc[:-1]) for k in m.model_fields})
        near = difflib.get_close_matches(str(loc[-1]), keys, n=1, cutoff=0.6)
        hint = f"did you mean {near[0]!r}? " if near else ""
        place = f"in {dotted(known[:-1])}" if known[:-1] else "at the top level"
        return f"unknown key {str(loc[-1])!r} {place}", f"{hint}valid keys: {', '.join(keys)}"
    if kind == "missing":
        return f"{name} has no {str(loc[-1])!r}", f"add {loc[-1]}: {_wanted(model, loc)}"
    if kind in ("union_tag_invalid", "literal_error", "enum"):
        given = str(ctx.get("tag", value))
        options = [
            o.strip("' ")
            for o in str(ctx.get("expected_tags") or ctx.get("expected", ""))
            .replace(" or ", ", ")
            .split(",")
        ]
        near = difflib.get_close_matches(given, options, n=1, cutoff=0.5)
        hint = f"did you mean {near[0]!r}? " if near else ""
        key = (
            f"{name}.{str(ctx['discriminator']).strip(chr(39))}" if "discriminator" in ctx else name
        )
        return f"{key} is {given!r}", f"{hint}valid: {', '.join(options)}"
    if kind == "union_tag_not_found":
        options = sorted({str(t) for m in _models_at(model, loc) for t in _tags(m)})
        return f"{name} has no 'kind'", f"add kind: {' | '.join(options)}"
    if kind in ("value_error", "assertion_error"):
        text = str(ctx.get("error", item["msg"]))
        found, _, hint = text.partition(" | ")
        return f"{name}: {found}", hint or "correct the value"
    if kind.endswith("_type") or kind.endswith("_parsing"):
        return (
            f"{name} = {_short(value)} ({_kind_of(value)})",
            f"{item['msg'].replace('Input should be', 'give')}",
        )
    if kind in ("too_short", "too_long"):
        bound = (
            f"at least {ctx['min_length']}"
            if kind == "too_short"
            else f"at most {ctx['max_length']}"
        )
        return f"{name} = {_short(value)}", f"give {bound} item{'s' if bound[-2:] != ' 1' else ''}"
    return f"{name} = {_short(value)}", item["msg"].replace(
        "Input should be", "give a value"
    ).replace("Input should", "the value should")


def _short(value: Any) -> str:
    """Write a value of a file; only the beginning of a long list or object."""
    if isinstance(value, list | dict) and len(value) > 8:
        return f"{'list' if isinstance(value, list) else 'keys'} of {len(value)}"
    return shorten(repr(value), 80)


def _kind_of(value: Any) -> str:
    names = {
        dict: "keys",
        list: "a list",
        str: "text",
        bool: "true or false",
        int: "a whole number",
        float: "a number",
    }
    return names.get(type(value), "nothing")


def _wanted(model: type[BaseModel], loc: Key) -> str:
    for m in _models_at(model, loc[:-1]):
        field = m.model_fields.get(str(loc[-1]))
        if field is not None:
            return (field.description or "see the schema").split(". ")[0].rstrip(".")
    return "see the schema"


def _tags(model: type[BaseModel]) -> list[Any]:
    field = model.model_fields.get("kind")
    return list(get_args(field.annotation)) if field is not None else []


def _models_at(model: type[BaseModel], loc: Key) -> list[type[BaseModel]]:
    """Return the models that may stand at a pydantic location (several where a union is not decided
    by a tag).
    """
    current: list[Any] = [model]
    for part in loc:
        current = [deeper for node in current for deeper in _step(node, part)]
    return [m for node in current for m in _unwrap(node)]


def _step(node: Any, part: str | int) -> Iterator[Any]:
    if isinstance(part, int):
        for plain in _plain(node):
            if get_origin(plain) in (list, tuple):
                yield from [a for a in get_args(plain) if a is not Ellipsis][:1]
        return
    models = list(_unwrap(node))
    tagged = [m for m in models if part in _tags(m)]
    if tagged:
        yield from tagged
        return
    for m in models:
        if part in m.model_fields:
            yield m.model_fields[part].annotation
    for plain in _plain(node):
        if get_origin(plain) is dict:
            yield get_args(plain)[1]


def _plain(annotation: Any) -> Iterator[Any]:
    origin = get_origin(annotation)
    if origin is Annotated:
        yield from _plain(get_args(annotation)[0])
    elif origin in (Union, pytypes.UnionType):
        for option in get_args(annotation):
            yield from _plain(option)
    elif origin is not Literal:
        yield annotation


def _unwrap(annotation: Any) -> Iterator[type[BaseModel]]:
    for plain in _plain(annotation):
        if isinstance(plain, type) and issubclass(plain, BaseModel):
            yield plain
