"""JSON with limits on size, depth and numbers, and JSON of a stated shape."""

from __future__ import annotations

import json
import math
from collections.abc import Hashable
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.io.limits import DEPTH, JSON_BYTES, Bound
from alpasim_plugin.io.reading.files import FETCH_AGAIN, parsing, read_bytes

if TYPE_CHECKING:
    from pydantic import TypeAdapter

T = TypeVar("T")


def parse_json(data: bytes | str, where: Path | str, doing: str, do_this: str | None = None) -> Any:
    """Return the plain data of a JSON document.

    Args:
        data: The document, UTF-8.
        where: Its file, for messages.
        doing: What the caller is doing, for messages.
        do_this: Last part of the errors.

    Raises:
        InputError: Not JSON, nested deeper than the bound, or a number that is not finite (JSON has no NaN).
    """
    do_this = do_this or FETCH_AGAIN
    # Besides the parser's own errors: bytes that are not UTF-8, nesting beyond the stack, integers of more than 4300 digits.
    with parsing(doing, where, do_this, "broken JSON"):
        value = json.loads(data)
    _check(value, where, doing, do_this)
    return value


def read_json(path: Path | str, doing: str, bound: Bound = JSON_BYTES, do_this: str | None = None) -> Any:
    """Return the plain data of a JSON file; see `parse_json` and `alpasim_plugin.io.reading.files.read_bytes` for what is refused."""
    return parse_json(read_bytes(path, doing, bound, do_this), path, doing, do_this)


def read_json_object(path: Path | str, doing: str, bound: Bound = JSON_BYTES, do_this: str | None = None) -> dict[str, Any]:
    """Return a JSON file's object; see `read_json`.

    Raises:
        InputError: As there, or the document is no object.
    """
    value = read_json(path, doing, bound, do_this)
    if not isinstance(value, dict):
        raise InputError(doing, str(path), f"{kind_of(value)}, not an object", do_this or FETCH_AGAIN)
    return value


def read_json_as(shape: type[T], path: Path | str, doing: str, bound: Bound = JSON_BYTES, do_this: str | None = None) -> T:
    """Return a JSON file's content after checking that it has a shape; see `as_shape`."""
    return as_shape(shape, read_json(path, doing, bound, do_this), path, doing, do_this)


def read_json_lines(path: Path | str, doing: str, bound: Bound = JSON_BYTES, do_this: str | None = None) -> list[dict[str, Any]]:
    """Return the objects of a file with one JSON object a line; empty lines are skipped.

    Raises:
        InputError: As `read_json`, with the number of the line.
    """
    rows = []
    for n, line in enumerate(read_bytes(path, doing, bound, do_this).splitlines(), 1):
        if not line.strip():
            continue
        value = parse_json(line, f"{path}:{n}", doing, do_this)
        if not isinstance(value, dict):
            raise InputError(doing, f"{path}:{n}", f"{kind_of(value)}, not an object", do_this or FETCH_AGAIN)
        rows.append(value)
    return rows


def as_shape(shape: type[T], value: Any, where: Path | str, doing: str, do_this: str | None = None) -> T:
    """Return plain data, as it is, after checking that it has a shape.

    Args:
        shape: A ``typing_extensions.TypedDict`` (``total=False`` for members that may be absent), or a type such as ``dict[str, str]``.
            Types are strict: no text for a number, no list for an object. Members that it does not name are not looked at.
        value: Plain data.
        where: Its file, for messages.
        doing: What the caller is doing, for messages.
        do_this: Last part of the error.

    Raises:
        InputError: The first member that is missing or of another type, by its path.
    """
    from pydantic import ValidationError

    try:
        _adapter(cast(Hashable, shape)).validate_python(value, strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        at = ".".join(str(part) for part in first["loc"]) or "the document"
        wanted = first["msg"].replace("Input should be", "wanted")
        found = "missing" if first["type"] == "missing" else f"{kind_of(first['input'])}, {wanted}"
        raise InputError(doing, str(where), f"{at}: {found}", do_this or FETCH_AGAIN) from None
    return cast("T", value)


@lru_cache(maxsize=64)
def _adapter(shape: Any) -> TypeAdapter[Any]:
    from pydantic import TypeAdapter

    return TypeAdapter(shape)


def kind_of(value: Any) -> str:
    """Name the kind of a plain value, with the value where it is short."""
    match value:
        case None:
            return "nothing"
        case bool() | int() | float():
            return f"the value {str(value)[:40]}"
        case str():
            return f"the text {value[:40]!r}"
        case list() | tuple():
            return f"a list of {len(value)}"
        case dict():
            return f"an object of {len(value)}"
    return f"a {type(value).__name__}"


def _check(document: Any, where: Path | str, doing: str, do_this: str) -> None:
    """Refuse depth beyond the bound, numbers that are not finite and text that is none; level by level, so that depth costs no stack."""
    level, depth = [document], 0
    while level:
        depth += 1
        if depth > DEPTH.high:
            raise InputError(doing, str(where), f"nested deeper than {DEPTH.high:.0f} levels", do_this)
        below: list[Any] = []
        for node in level:
            if type(node) is dict and not all(map(str.isascii, node)):
                _check_text("".join(node), where, doing, do_this)
            for child in node.values() if type(node) is dict else node if type(node) is list else (node,):
                kind = type(child)
                if kind is dict or kind is list:
                    if child is not node:
                        below.append(child)
                elif kind is str and not child.isascii():
                    _check_text(child, where, doing, do_this)
                elif kind is float and not math.isfinite(child):
                    raise InputError(doing, str(where), f"the number {child}, which JSON does not have", do_this)
        level = below


def _check_text(text: str, where: Path | str, doing: str, do_this: str) -> None:
    """Refuse half a surrogate pair, which JSON can escape and no file can be written with."""
    try:
        text.encode("utf-8")
    except UnicodeEncodeError as error:
        found = f"the escape \\u{ord(text[error.start]):04x} alone, half a surrogate pair"
        raise InputError(doing, str(where), found, do_this) from None
