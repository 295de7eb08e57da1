"""A file's bytes, text, JSON and XML: a regular file, capped in size, or an error that names it.

Packed data are unpacked to a stated size at most: a few bytes can claim to be terabytes.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import stat
from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from io import BufferedReader
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast
from xml.etree import ElementTree
from xml.parsers import expat

from alpasim_plugin.core.errors import InputError, SimrunError
from alpasim_plugin.core.files.inputs import ABSENT, content_digest, note_absent, note_opened
from alpasim_plugin.core.files.limits import (
    ARCHIVE_BYTES,
    DEPTH,
    FILE_BYTES,
    JSON_BYTES,
    MEMBERS,
    PARSED_VALUES,
    UNPACKED_BYTES,
    XML_ELEMENTS,
    XML_MARKS,
    XML_TAG_BYTES,
    Bound,
)
from alpasim_plugin.core.json_types import JsonObject, JsonView

if TYPE_CHECKING:
    from pydantic import TypeAdapter, ValidationError

CHECK_PATH = "check the path and its permissions"
XML_PIECE_BYTES = 1 << 20
FETCH_AGAIN = "fetch or write the file again; it may be damaged"

T = TypeVar("T")


@contextmanager
def open_regular(
    path: Path | str, bound: Bound = FILE_BYTES, do_this: str = CHECK_PATH
) -> Iterator[BufferedReader]:
    """Open a regular file for reading, after checking its kind and size on the open file itself.

    A pipe, socket or device is refused without waiting for its other end. The file enters the
    records that are open (`alpasim_plugin.core.files.inputs`).

    Args:
        path: File.
        bound: Greatest size.
        do_this: Hint of the errors.

    Raises:
        InputError: Missing, unreadable, not a regular file, or larger than the bound.
    """
    try:
        # Without O_NONBLOCK the open of a pipe waits for a writer, for ever.
        handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    except (OSError, ValueError) as error:  # ValueError: a null character in the name
        if isinstance(error, FileNotFoundError):
            note_absent(path)
        raise InputError(
            f"{path}: no such file that can be opened: {getattr(error, 'strerror', error)}", do_this
        ) from error
    state = os.fstat(handle)
    if not stat.S_ISREG(state.st_mode):
        os.close(handle)
        kind = "a folder" if stat.S_ISDIR(state.st_mode) else "a pipe or a device"
        raise InputError(f"{path}: {kind}, not a file", do_this)
    with os.fdopen(handle, "rb") as stream:
        if state.st_size > bound.high:
            raise InputError(
                f"{path}: {state.st_size} bytes, more than {bound.high:.0f} ({bound.name})",
                "give a smaller file",
            )
        try:
            note_opened(path, stream)
            yield stream
        except OSError as error:
            raise InputError(f"{path}: it cannot be read: {error.strerror}", do_this) from error


def natural_order(name: str) -> tuple[str, str]:
    """Return the key that sorts names as people count: ``2.jpg`` before ``10.jpg``.

    Example:
        >>> sorted(["10.jpg", "2.jpg", "1.jpg"], key=natural_order)
        ['1.jpg', '2.jpg', '10.jpg']
    """
    return re.sub(r"\d+", lambda digits: digits.group().zfill(20), name), name


def some_of(names: Sequence[str], most: int = 5) -> str:
    """Return the first names in a sentence, and how many more there are."""
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")


def contents(path: Path) -> str:
    """Say what a path is, for messages: a file, or a folder with its first names."""
    if not os.path.isdir(path):
        return "a file"
    names = sorted((member.name for member in path.iterdir()), key=natural_order)
    return f"a folder with {some_of(names) or 'nothing'}"


def real(path: Path | str) -> Path:
    """Return where a path leads through links; unlike `Path.resolve` it goes through circles of links
    without an error.
    """
    return Path(os.path.realpath(path))


def inside(folder: Path, name: str) -> Path | None:
    """Return the path of a name that a file of a folder holds; None where nothing is there, or where
    it leads out of the folder.
    """
    path = folder / name
    return path if os.path.exists(path) and real(path).is_relative_to(real(folder)) else None


def check_regular(path: Path | str, bound: Bound = FILE_BYTES, do_this: str = CHECK_PATH) -> None:
    """Check a file that a library will open by its path; see `open_regular`."""
    with open_regular(path, bound, do_this):
        pass


def read_bytes(path: Path | str, bound: Bound = FILE_BYTES, do_this: str = CHECK_PATH) -> bytes:
    """Return a file's bytes; see `open_regular`."""
    with open_regular(path, bound, do_this) as stream:
        return stream.read(os.fstat(stream.fileno()).st_size)


def file_sha256(path: Path | str, do_this: str = CHECK_PATH) -> str:
    """Return the SHA-256 of a file's content in hexadecimal; see `open_regular`."""
    with open_regular(path, ARCHIVE_BYTES, do_this) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def content_of(path: Path | str) -> str:
    """Return the SHA-256 of a file's content, which is remembered while the file's size and time of
    change stay, or `ABSENT` where there is no such file; it enters the open records.

    Raises:
        InputError: There is something that cannot be read; see `open_regular`.
    """
    if not os.path.exists(path):
        note_absent(path)
        return ABSENT
    with open_regular(path, ARCHIVE_BYTES) as stream:
        return content_digest(stream)


def read_text(path: Path | str, bound: Bound = FILE_BYTES, do_this: str = CHECK_PATH) -> str:
    """Return a file's text; see `open_regular`.

    Raises:
        InputError: As there, or bytes that are not UTF-8.
    """
    data = read_bytes(path, bound, do_this)
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(
            f"{path}: byte {error.start} is not UTF-8", "save the file as UTF-8 text"
        ) from error


@contextmanager
def parsing(
    location: Path | str, do_this: str = FETCH_AGAIN, problem: str = "it cannot be used"
) -> Iterator[None]:
    """Turn whatever a parser raises into an error that names the file that it parses.

    The original stays the cause, so ``--debug`` shows where it was raised.

    Args:
        location: The file, or the member of a file.
        do_this: Hint.
        problem: What is wrong if anything is: "no readable parquet".

    Raises:
        InputError: The block raised anything but a `SimrunError`.
    """
    try:
        yield
    except SimrunError:
        raise
    except Exception as error:
        reason = str(error).strip().partition("\n")[0]
        if isinstance(error, KeyError) or not reason:
            reason = f"{type(error).__name__} {error}"
        raise InputError(f"{location}: {problem}: {reason}", do_this) from error


def parse_json(data: bytes | str, location: Path | str, do_this: str = FETCH_AGAIN) -> Any:
    """Return the plain data of a JSON document.

    Args:
        data: The document, UTF-8.
        location: Its file, for messages.
        do_this: Hint of the errors.

    Raises:
        InputError: Not JSON, more values than the bound, nested too deep, a number that is not
            finite (JSON has no NaN), or half a surrogate pair, which no file can be written with.
    """
    check_values(data, location)
    with parsing(location, do_this, "broken JSON"):
        value = json.loads(data)
        json.dumps(value, ensure_ascii=False, allow_nan=False).encode()  # numbers and text as above
    return value


def check_values(data: bytes | str, location: Path | str) -> None:
    """Refuse a JSON document that may have more values than the bound, before it is parsed: as many
    as it has commas and opening brackets, those in its texts included.

    Raises:
        InputError: It has more.
    """
    if isinstance(data, bytes):
        marks = sum(data.count(mark) for mark in (b",", b"[", b"{"))
    else:
        marks = sum(data.count(mark) for mark in (",", "[", "{"))
    PARSED_VALUES.check(marks, location)


def read_json(path: Path | str, do_this: str = FETCH_AGAIN) -> Any:
    """Return the plain data of a JSON file; see `read_bytes` and `parse_json`."""
    return parse_json(read_bytes(path, JSON_BYTES, do_this), path, do_this)


def read_json_object(path: Path | str, do_this: str = FETCH_AGAIN) -> JsonObject:
    """Return a JSON file's object; see `read_json`.

    Raises:
        InputError: As there, or the document is no object.
    """
    return as_shape(JsonObject, read_json(path, do_this), path, do_this)


def read_json_as(shape: type[T], path: Path | str, do_this: str = FETCH_AGAIN) -> T:
    """Return a JSON file's content after checking that it has a shape; see `as_shape`."""
    return as_shape(shape, read_json(path, do_this), path, do_this)


def read_json_lines(path: Path | str, do_this: str = FETCH_AGAIN) -> list[JsonObject]:
    """Return the objects of a file with one JSON object a line; empty lines are skipped.

    Raises:
        InputError: As `read_json`, with the number of the line.
    """
    rows = []
    data = read_bytes(path, JSON_BYTES, do_this)
    check_values(data, path)
    for n, line in enumerate(data.splitlines(), 1):
        if line.strip():
            location = f"{path}:{n}"
            rows.append(
                as_shape(JsonObject, parse_json(line, location, do_this), location, do_this)
            )
    return rows


def as_shape(shape: type[T], value: Any, location: Path | str, do_this: str = FETCH_AGAIN) -> T:
    """Return plain data, as it is, after checking that it has a shape.

    Args:
        shape: A ``typing_extensions.TypedDict`` (``total=False`` for members that may be absent),
            or a type such as ``dict[str, str]``. Types are strict: no text for a number, no list
            for an object. Members that it does not name are not looked at.
        value: Plain data.
        location: Its file, for messages.
        do_this: Hint of the error.

    Raises:
        InputError: The first member that is missing or of another type, by its path.
    """
    from pydantic import ValidationError

    try:
        _adapter(cast(Hashable, shape)).validate_python(value, strict=True)
    except ValidationError as error:
        raise InputError(f"{location}: {_first_problem(error)}", do_this) from None
    return cast("T", value)


def read_record(
    record: type[T], data: bytes, location: Path | str, do_this: str = FETCH_AGAIN
) -> T:
    """Return the record that a JSON document holds.

    Args:
        record: A frozen dataclass; its members may be dataclasses, dictionaries and tuples of them.
            Types are strict. Members of the document that it does not name are not looked at.
        data: The document, as `parse_json` accepts it.
        location: Its file, for messages.
        do_this: Hint of the error.

    Raises:
        InputError: The first member that is missing or of another type, by its path.
    """
    from pydantic import ValidationError

    check_values(data, location)
    try:
        return cast("T", _adapter(cast(Hashable, record)).validate_json(data, strict=True))
    except ValidationError as error:
        raise InputError(f"{location}: {_first_problem(error)}", do_this) from None


def _first_problem(error: ValidationError) -> str:
    """Say which member is missing or has another type than it should."""
    first = error.errors(include_url=False)[0]
    member = ".".join(str(part) for part in first["loc"]) or "the document"
    if first["type"] == "missing":
        return f"{member}: missing"
    return f"{member}: {kind_of(first['input'])}, wanted {wanted_of(first)}"


# type of a problem that pydantic finds -> what it wants instead
WANTED = {
    "string_type": "text",
    "int_type": "an integer",
    "int_from_float": "an integer",
    "int_parsing": "an integer",
    "float_type": "a number",
    "float_parsing": "a number",
    "finite_number": "a finite number",
    "bool_type": "true or false",
    "list_type": "a list",
    "tuple_type": "a list",
    "dict_type": "an object of keys and values",
    "dataclass_type": "an object of keys and values",
    "model_type": "an object of keys and values",
    "greater_than": "a number greater than {gt:g}",
    "greater_than_equal": "a number greater than or equal to {ge:g}",
    "less_than": "a number less than {lt:g}",
    "less_than_equal": "a number less than or equal to {le:g}",
    "too_short": "at least {min_length} of them",
    "too_long": "at most {max_length} of them",
    "string_too_short": "a text of at least {min_length} letters",
    "string_too_long": "a text of at most {max_length} letters",
}


def wanted_of(problem: JsonView) -> str:
    """Say what a value should be instead, of a problem as pydantic lists it."""
    words = WANTED.get(problem["type"])
    if words is None:
        return str(problem["msg"]).removeprefix("Input should be ")
    return words.format(**problem.get("ctx", {}))


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
        case list() | dict():
            return f"{'a list' if isinstance(value, list) else 'an object'} of {len(value)}"
    return f"a {type(value).__name__}"


def parse_xml(data: bytes, location: Path | str) -> ElementTree.Element:
    """Return the root of an XML document; a DOCTYPE is refused, so no entity can be defined or
    expanded.

    Raises:
        InputError: Malformed or truncated, a DOCTYPE, an unreadable encoding, or nested deeper or
            larger than the bounds.
    """
    depth = 0
    count = 0

    def refuse(*_: Any) -> None:
        raise InputError(
            f"{location}: a DOCTYPE declaration",
            "remove it: entities are not accepted in scenario files",
        )

    def begin(*_: Any) -> None:
        nonlocal depth, count
        depth += 1
        count += 1
        DEPTH.check(depth, location)
        XML_ELEMENTS.check(count, location)

    def end(*_: Any) -> None:
        nonlocal depth
        depth -= 1

    XML_MARKS.check(data.count(b"<") + data.count(b"="), location)
    scout = expat.ParserCreate()
    scout.StartDoctypeDeclHandler = refuse
    scout.StartElementHandler = begin
    scout.EndElementHandler = end
    with parsing(location, FETCH_AGAIN, "malformed XML"):
        # Piece by piece: a parser holds all attributes of an element before it calls back.
        for offset in range(0, len(data), XML_PIECE_BYTES):
            piece = data[offset : offset + XML_PIECE_BYTES]
            scout.Parse(piece, False)
            unfinished = offset + len(piece) - max(scout.CurrentByteIndex, 0)
            XML_TAG_BYTES.check(unfinished, location)
        scout.Parse(b"", True)
        return ElementTree.fromstring(data)


def unzstd(data: bytes, expected: int, location: Path | str, do_this: str = FETCH_AGAIN) -> bytes:
    """Unpack a zstd frame of a size that is known.

    Raises:
        InputError: Damaged data, or another size than expected.
    """
    import zstandard

    UNPACKED_BYTES.check(expected, location)
    with parsing(location, do_this, "damaged zstd data"):
        reader = zstandard.ZstdDecompressor(max_window_size=1 << 27).stream_reader(data)
        unpacked = reader.read(expected + 1)
    if len(unpacked) != expected:
        raise InputError(f"{location}: zstd data of another size than {expected} bytes", do_this)
    return unpacked


def check_names(names: list[str], location: Path | str) -> None:
    """Refuse the members of an archive if one could leave it, two share a name, or there are too
    many.

    Raises:
        InputError: They do.
    """
    MEMBERS.check(len(names), location)
    if len(set(names)) < len(names):
        raise InputError(f"{location}: two members of one name", "write the archive again")
    for name in names:
        if name.startswith("/") or "\\" in name or ".." in name.split("/") or "\0" in name:
            raise InputError(
                f"{location}: a member named {name!r}, outside the archive", "do not use this file"
            )
