"""A file's bytes, text, JSON and XML: a regular file, capped in size, with limits on depth and
numbers, or a four-part error.

Packed data are unpacked to a stated size at most: a few bytes can claim to be terabytes.
"""

from __future__ import annotations

import json
import math
import os
import stat
import zlib
from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, TypeVar, cast
from xml.etree import ElementTree
from xml.parsers import expat

from alpasim_plugin.core.errors import InputError, SimrunError
from alpasim_plugin.core.limits import (
    DEPTH,
    FILE_BYTES,
    JSON_BYTES,
    MEMBERS,
    UNPACKED_BYTES,
    XML_ELEMENTS,
    Bound,
)

if TYPE_CHECKING:
    from pydantic import TypeAdapter

FETCH_AGAIN = "fetch or write the file again; it may be damaged"
_KINDS = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


@contextmanager
def open_regular(
    path: Path | str, bound: Bound = FILE_BYTES, do_this: str | None = None
) -> Iterator[BinaryIO]:
    """Open a regular file for reading, after checking its kind and size on the open file itself.

    A pipe, socket or device is refused without waiting for its other end.

    Args:
        path: File.
        bound: Greatest size.
        do_this: Last part of the errors; None: one that follows from the cause.

    Raises:
        InputError: Missing, unreadable, not a regular file, or larger than the bound.
    """
    try:
        # Without O_NONBLOCK the open of a pipe waits for a writer, for ever.
        handle = os.open(
            path,
            os.O_RDONLY
            | getattr(os, "O_NONBLOCK", 0)
            | getattr(os, "O_CLOEXEC", 0)
            | getattr(os, "O_BINARY", 0),
        )
    except FileNotFoundError as error:
        raise InputError(f"{path}: no such file", do_this or "check the path") from error
    except (OSError, ValueError) as error:  # ValueError: a null character in the name
        reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
        raise InputError(
            f"{path}: it cannot be opened: {reason}",
            do_this or "check the path and its permissions",
        ) from error
    facts = os.fstat(handle)
    if not stat.S_ISREG(facts.st_mode):
        os.close(handle)
        kind = next((name for test, name in _KINDS if test(facts.st_mode)), "no regular file")
        raise InputError(f"{path}: {kind}, not a file", do_this or "give a regular file")
    with os.fdopen(handle, "rb") as stream:
        if facts.st_size > bound.high:
            raise InputError(
                f"{path}: {facts.st_size} bytes, more than {bound.high:.0f} ({bound.name})",
                "give a smaller file",
            )
        try:
            yield stream
        except OSError as error:
            raise InputError(
                f"{path}: it cannot be read: {error.strerror or error}",
                do_this or FETCH_AGAIN,
            ) from error


def exists(path: Path | str) -> bool:
    """Return whether something is at a path; a name that no file can have (too long, a null
    character) is at none.
    """
    try:
        os.stat(path)
    except (OSError, ValueError):
        return False
    return True


def read_bytes(path: Path | str, bound: Bound = FILE_BYTES, do_this: str | None = None) -> bytes:
    """Return a file's bytes; see `open_regular`.

    Raises:
        InputError: As there, or the file grew beyond the bound while it was read.
    """
    parts: list[bytes] = []
    with open_regular(path, bound, do_this) as stream:
        # As much as the file holds, not as the bound allows: a read takes the memory that it is
        # asked for at once.
        size = os.fstat(stream.fileno()).st_size + 1
        while part := stream.read(size):
            parts.append(part)
            if sum(map(len, parts)) > bound.high:
                raise InputError(
                    f"{path}: more than {bound.high:.0f} bytes ({bound.name})",
                    "give a smaller file",
                )
    return b"".join(parts)


def read_text(path: Path | str, bound: Bound = FILE_BYTES, do_this: str | None = None) -> str:
    """Return a file's text, UTF-8; see `read_bytes`.

    Raises:
        InputError: As there, or bytes that are not UTF-8.
    """
    data = read_bytes(path, bound, do_this)
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: byte {error.start} is not UTF-8",
            do_this or "save the file as UTF-8 text",
        ) from error


def check_regular(path: Path | str, bound: Bound = FILE_BYTES, do_this: str | None = None) -> int:
    """Check a file that a library will open by its path; return its size in bytes. See
    `open_regular`.
    """
    with open_regular(path, bound, do_this) as stream:
        return os.fstat(stream.fileno()).st_size


@contextmanager
def parsing(
    where: Path | str, do_this: str = FETCH_AGAIN, what: str = "it cannot be used"
) -> Iterator[None]:
    """Turn whatever a parser raises into the four-part error of the file that it parses.

    The original stays the cause, so ``--debug`` shows where it was raised.

    Args:
        where: The file, or the member of a file.
        do_this: Last part.
        what: What is wrong if anything is, for the third part: "no readable parquet".

    Raises:
        InputError: The block raised anything but a `SimrunError`.
    """
    try:
        yield
    except SimrunError:
        raise
    except Exception as error:
        lines = str(error).strip().splitlines()
        reason = (
            lines[0]
            if lines and not isinstance(error, KeyError)
            else f"{type(error).__name__} {error}"
        )
        raise InputError(f"{where}: {what}: {reason}", do_this) from error


T = TypeVar("T")


def parse_json(data: bytes | str, where: Path | str, do_this: str | None = None) -> Any:
    """Return the plain data of a JSON document.

    Args:
        data: The document, UTF-8.
        where: Its file, for messages.
        do_this: Last part of the errors.

    Raises:
        InputError: Not JSON, nested deeper than the bound, or a number that is not finite (JSON has
            no NaN).
    """
    do_this = do_this or FETCH_AGAIN
    # Besides the parser's own errors: bytes that are not UTF-8, nesting beyond the stack, integers
    # of more than 4300 digits.
    with parsing(where, do_this, "broken JSON"):
        value = json.loads(data)
    _check(value, where, do_this)
    return value


def read_json(path: Path | str, bound: Bound = JSON_BYTES, do_this: str | None = None) -> Any:
    """Return the plain data of a JSON file; see `parse_json` and
    `alpasim_plugin.core.reading.files.read_bytes` for what is refused.
    """
    return parse_json(read_bytes(path, bound, do_this), path, do_this)


def read_json_object(
    path: Path | str, bound: Bound = JSON_BYTES, do_this: str | None = None
) -> dict[str, Any]:
    """Return a JSON file's object; see `read_json`.

    Raises:
        InputError: As there, or the document is no object.
    """
    value = read_json(path, bound, do_this)
    if not isinstance(value, dict):
        raise InputError(f"{path}: {kind_of(value)}, not an object", do_this or FETCH_AGAIN)
    return value


def read_json_as(
    shape: type[T],
    path: Path | str,
    bound: Bound = JSON_BYTES,
    do_this: str | None = None,
) -> T:
    """Return a JSON file's content after checking that it has a shape; see `as_shape`."""
    return as_shape(shape, read_json(path, bound, do_this), path, do_this)


def read_json_lines(
    path: Path | str, bound: Bound = JSON_BYTES, do_this: str | None = None
) -> list[dict[str, Any]]:
    """Return the objects of a file with one JSON object a line; empty lines are skipped.

    Raises:
        InputError: As `read_json`, with the number of the line.
    """
    rows = []
    for n, line in enumerate(read_bytes(path, bound, do_this).splitlines(), 1):
        if not line.strip():
            continue
        value = parse_json(line, f"{path}:{n}", do_this)
        if not isinstance(value, dict):
            raise InputError(f"{path}:{n}: {kind_of(value)}, not an object", do_this or FETCH_AGAIN)
        rows.append(value)
    return rows


def as_shape(shape: type[T], value: Any, where: Path | str, do_this: str | None = None) -> T:
    """Return plain data, as it is, after checking that it has a shape.

    Args:
        shape: A ``typing_extensions.TypedDict`` (``total=False`` for members that may be absent),
            or a type such as ``dict[str, str]``. Types are strict: no text for a number, no list
            for an object. Members that it does not name are not looked at.
        value: Plain data.
        where: Its file, for messages.
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
        raise InputError(f"{where}: {at}: {found}", do_this or FETCH_AGAIN) from None
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


def _check(document: Any, where: Path | str, do_this: str) -> None:
    """Refuse depth beyond the bound, numbers that are not finite and broken text; level by level,
    so that depth costs no stack.
    """
    level, depth = [document], 0
    while level:
        depth += 1
        if depth > DEPTH.high:
            raise InputError(f"{where}: nested deeper than {DEPTH.high:.0f} levels", do_this)
        below: list[Any] = []
        for node in level:
            if type(node) is dict and not all(map(str.isascii, node)):
                _check_text("".join(node), where, do_this)
            for child in (
                node.values() if type(node) is dict else node if type(node) is list else (node,)
            ):
                kind = type(child)
                if kind is dict or kind is list:
                    if child is not node:
                        below.append(child)
                elif kind is str and not child.isascii():
                    _check_text(child, where, do_this)
                elif kind is float and not math.isfinite(child):
                    raise InputError(
                        f"{where}: the number {child}, which JSON does not have", do_this
                    )
        level = below


def _check_text(text: str, where: Path | str, do_this: str) -> None:
    """Refuse half a surrogate pair, which JSON can escape and no file can be written with."""
    try:
        text.encode("utf-8")
    except UnicodeEncodeError as error:
        raise InputError(
            f"{where}: the escape \\u{ord(text[error.start]):04x} alone, half a surrogate pair",
            do_this,
        ) from None


def parse_xml(data: bytes, where: Path | str) -> ElementTree.Element:
    """Return the root of an XML document; a DOCTYPE is refused, so no entity can be defined or
    expanded.

    Raises:
        InputError: Malformed or truncated, a DOCTYPE, an unreadable encoding, or nested deeper or
            larger than the bounds.
    """
    depth = count = 0

    def refuse(*_: Any) -> None:
        raise InputError(
            f"{where}: a DOCTYPE declaration",
            "remove it: entities are not accepted in scenario files",
        )

    def begin(*_: Any) -> None:
        nonlocal depth, count
        depth, count = depth + 1, count + 1
        if depth > DEPTH.high:
            raise InputError(f"{where}: nested deeper than {DEPTH.high:.0f} levels", FETCH_AGAIN)
        if count > XML_ELEMENTS.high:
            raise InputError(
                f"{where}: more than {XML_ELEMENTS.high:.0f} elements",
                "give a smaller map",
            )

    def end(*_: Any) -> None:
        nonlocal depth
        depth -= 1

    scout = expat.ParserCreate()
    scout.StartDoctypeDeclHandler, scout.StartElementHandler, scout.EndElementHandler = (
        refuse,
        begin,
        end,
    )
    try:
        with parsing(where, FETCH_AGAIN, "malformed XML"):
            scout.Parse(data, True)
            return ElementTree.fromstring(data)
    except InputError as error:
        if isinstance(error.__cause__, ValueError | LookupError) and not isinstance(
            error.__cause__, ElementTree.ParseError
        ):
            raise InputError(
                f"{where}: an unreadable text encoding: {error.__cause__}",
                "save the file as UTF-8",
            ) from error
        raise


GZIP = 16 + zlib.MAX_WBITS


def gunzip(data: bytes, most: int, where: Path | str, do_this: str = FETCH_AGAIN) -> bytes:
    """Unpack gzip data.

    Args:
        data: One gzip member; what follows it is ignored.
        most: Bytes that the caller can use; `alpasim_plugin.core.limits.UNPACKED_BYTES` holds in
            any case.
        where: The file, for messages.
        do_this: Last part of the errors.

    Raises:
        InputError: Damaged data, data that end too early, or more than ``most``.
    """
    most = min(most, int(UNPACKED_BYTES.high))
    with parsing(where, do_this, "damaged gzip data"):
        unpacker = zlib.decompressobj(GZIP)
        out = unpacker.decompress(data, most + 1)
    if len(out) > most:
        raise InputError(f"{where}: gzip data of more than {most} bytes", do_this)
    if not unpacker.eof:
        raise InputError(f"{where}: gzip data that end after {len(out)} bytes", do_this)
    return out


def unzstd(data: bytes, expected: int, where: Path | str, do_this: str = FETCH_AGAIN) -> bytes:
    """Unpack a zstd frame of a size that is known; see `gunzip`.

    Raises:
        InputError: Damaged data, or another size than expected.
    """
    import zstandard

    UNPACKED_BYTES.check(expected, where)
    with parsing(where, do_this, "damaged zstd data"):
        out = (
            zstandard.ZstdDecompressor(max_window_size=1 << 27)
            .stream_reader(data)
            .read(expected + 1)
            if expected
            else b""
        )
    if len(out) != expected:
        found = (
            f"more than {expected} bytes"
            if len(out) > expected
            else f"{len(out)} of {expected} bytes"
        )
        raise InputError(f"{where}: zstd data of {found}", do_this)
    return out


def check_names(names: list[str], where: Path | str, bound: Bound = MEMBERS) -> None:
    """Refuse the members of an archive if one could leave it, two share a name, or there are too
    many.

    Raises:
        InputError: They do.
    """
    bound.check(len(names), where)
    seen: set[str] = set()
    for name in names:
        parts = name.replace("\\", "/").split("/")
        if name.startswith("/") or "\\" in name or ".." in parts or "\0" in name:
            raise InputError(
                f"{where}: a member named {name!r}, outside the archive",
                "do not use this file",
            )
        if name in seen:
            raise InputError(f"{where}: member {name!r} twice", "write the archive again")
        seen.add(name)
