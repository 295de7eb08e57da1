"""Pydantic errors as four-part errors with the position in the file and the nearest valid key."""

from __future__ import annotations

import difflib
import json
import math
import types as pytypes
from collections.abc import Iterator, Sequence
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.escape import shorten
from alpasim_plugin.io.yaml_positions import Document, Key

EXAMINED, EXPLAINED = 200, 4  # problems of one file: those put in order, and those put into words
M = TypeVar("M", bound=BaseModel)


def validate(model: type[M], document: Document, doing: str = "reading a configuration") -> M:
    """Validate a document strictly (no text for a number, no unknown key).

    Raises:
        InputError: The first problem in file order, with its position and a hint; the others are listed after it.
    """
    _refuse_non_finite(document, document.data, (), doing)
    try:
        # JSON mode is strict about types and still lets a list fill a tuple.
        return model.model_validate_json(json.dumps(document.data), strict=True)
    except ValidationError as e:
        raise _as_input_error(model, document, e, doing) from None


def _refuse_non_finite(document: Document, data: Any, loc: Key, doing: str) -> None:
    if isinstance(data, dict):
        for key, value in data.items():
            _refuse_non_finite(document, value, (*loc, key), doing)
    elif isinstance(data, list):
        for i, value in enumerate(data):
            _refuse_non_finite(document, value, (*loc, i), doing)
    elif isinstance(data, float) and not math.isfinite(data):
        raise document.error(doing, loc, f"{dotted(loc)} = {data}", "give a finite number")


def dotted(loc: Sequence[str | int]) -> str:
    """Write a key path as ``actors[0].speed_mps``."""
    out = ""
    for part in loc:
        out += f"[{part}]" if isinstance(part, int) else f".{part}" if out else str(part)
    return out or "the file"


def _as_input_error(model: type[BaseModel], document: Document, error: ValidationError, doing: str) -> InputError:
    items = error.errors(include_url=False)[:EXAMINED]
    placed = []
    for item in items:
        loc = tuple(item["loc"])
        if not _follows_from_another(item, items):
            known = _in_document(document.data, loc)
            placed.append((document.mark(known), item, loc, known))
    # File order, so that the first problem shown is the first that a reader of the file meets.
    placed.sort(key=lambda p: (p[0].file, p[0].line, p[0].column))
    texts = [(mark, *_explain(model, document, item, loc, known)) for mark, item, loc, known in placed[:EXPLAINED]]
    mark, found, hint = texts[0]
    if len(placed) > 1:
        rest = "; ".join(f"{m}: {f}" for m, f, _ in texts[1:])
        found = f"{shorten(found, 180)} (and {error.error_count() - len(items) + len(placed) - 1} more: {rest})"
    return InputError(doing, str(mark), found, hint)


def _follows_from_another(item: Any, items: Sequence[Any]) -> bool:
    """Say whether a problem is only the shadow of another one.

    A list whose items are wrong counts as too short as well; a misspelt key leaves the right one missing.
    """
    loc = tuple(item["loc"])
    if item["type"] == "too_short":
        return any(len(o["loc"]) > len(loc) and tuple(o["loc"][: len(loc)]) == loc for o in items)
    if item["type"] == "missing":
        extra = [str(o["loc"][-1]) for o in items if o["type"] == "extra_forbidden" and tuple(o["loc"][:-1]) == loc[:-1]]
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


def _explain(model: type[BaseModel], document: Document, item: Any, loc: Key, known: Key) -> tuple[str, str]:
    kind, ctx, value = item["type"], item.get("ctx", {}), item.get("input")
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
        options = [o.strip("' ") for o in str(ctx.get("expected_tags") or ctx.get("expected", "")).replace(" or ", ", ").split(",")]
        near = difflib.get_close_matches(given, options, n=1, cutoff=0.5)
        hint = f"did you mean {near[0]!r}? " if near else ""
        key = f"{name}.{str(ctx['discriminator']).strip(chr(39))}" if "discriminator" in ctx else name
        return f"{key} is {given!r}", f"{hint}valid: {', '.join(options)}"
    if kind == "union_tag_not_found":
        options = sorted({str(t) for m in _models_at(model, loc) for t in _tags(m)})
        return f"{name} has no 'kind'", f"add kind: {' | '.join(options)}"
    if kind in ("value_error", "assertion_error"):
        text = str(ctx.get("error", item["msg"]))
        found, _, hint = text.partition(" | ")
        return f"{name}: {found}", hint or "correct the value"
    if kind.endswith("_type") or kind.endswith("_parsing"):
        return f"{name} = {_short(value)} ({_kind_of(value)})", f"{item['msg'].replace('Input should be', 'give')}"
    if kind in ("too_short", "too_long"):
        bound = f"at least {ctx['min_length']}" if kind == "too_short" else f"at most {ctx['max_length']}"
        return f"{name} = {_short(value)}", f"give {bound} item{'s' if bound[-2:] != ' 1' else ''}"
    return f"{name} = {_short(value)}", item["msg"].replace("Input should be", "give a value").replace("Input should", "the value should")


def _short(value: Any) -> str:
    """Write a value of a file; only the beginning of a long list or object."""
    if isinstance(value, list | dict) and len(value) > 8:
        return f"{'list' if isinstance(value, list) else 'keys'} of {len(value)}"
    return shorten(repr(value), 80)


def _kind_of(value: Any) -> str:
    names = {dict: "keys", list: "a list", str: "text", bool: "true or false", int: "a whole number", float: "a number"}
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
    """Return the models that may stand at a pydantic location (several where a union is not decided by a tag)."""
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
