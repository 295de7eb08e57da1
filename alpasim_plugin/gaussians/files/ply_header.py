"""Parse PLY headers and hand out elements as structured arrays, without interpreting them.

The container is the Stanford polygon format: an ASCII header that lists elements and their properties, then the rows of each
element in header order. Everything is found by name; offsets come from the header alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.io.limits import GAUSSIANS
from alpasim_plugin.io.reading.files import open_regular

_MAX_HEADER_BYTES = 1 << 20
MAX_PROPERTIES = 512  # the highest degree of colour takes 62
_SCALAR_CODES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_ENDIAN = {"binary_little_endian": "<", "binary_big_endian": ">"}
_EXPORT_AGAIN = "export the file again as a binary PLY, or copy it again if the transfer broke off"


@dataclass(frozen=True)
class PlyElement:
    """Name one element of a PLY file.

    Attributes:
        name: Element name, such as ``vertex``.
        count: Number of rows.
        dtype: Row layout, or None if the element has list properties (its row size then varies).
        offset: Byte position of its first row in the file, or None if an element before it has list properties.
    """

    name: str
    count: int
    dtype: np.dtype[np.void] | None
    offset: int | None

    @property
    def properties(self) -> tuple[str, ...]:
        """Return the property names in file order; empty for an element with list properties."""
        return () if self.dtype is None or self.dtype.names is None else self.dtype.names


@dataclass(frozen=True)
class PlyHeader:
    """Hold what a PLY header says: the file, its elements in order and its comments."""

    path: Path
    elements: tuple[PlyElement, ...]
    comments: tuple[str, ...]

    def element(self, name: str) -> PlyElement:
        """Return the element called `name`.

        Raises:
            InputError: No such element.
        """
        for element in self.elements:
            if element.name == name:
                return element
        raise InputError(
            "reading a PLY file",
            f"{self.path}, element {name!r}",
            f"no such element; the file has {[e.name for e in self.elements]}",
            "name one of the elements of the file",
        )


def read_ply_header(path: Path | str) -> PlyHeader:
    """Read and check the header of a binary PLY file.

    Raises:
        InputError: Missing file, not a PLY, ASCII body, malformed header line, or an impossible count.
    """
    path = Path(path)
    lines, body_offset = _header_lines(path)
    byte_order = ""
    comments: list[str] = []
    pending: list[tuple[str, int, list[tuple[str, str]] | None]] = []
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0] in ("ply", "end_header", "obj_info"):
            continue
        if words[0] == "comment":
            comments.append(line[len("comment") :].strip())
        elif words[0] == "format" and len(words) == 3:
            byte_order = _byte_order(path, words[1])
        elif words[0] == "element" and len(words) == 3:
            pending.append((words[1], _count(path, number, words[2]), []))
        elif words[0] == "property" and pending and len(words) >= 3:
            pending[-1] = _with_property(path, number, pending[-1], words, byte_order)
        else:
            raise _bad_line(path, number, line)
    if not byte_order:
        raise InputError("reading a PLY header", str(path), "no format line", _EXPORT_AGAIN)
    return PlyHeader(path, _place(pending, body_offset), tuple(comments))


def read_ply_element(header: PlyHeader, name: str) -> NDArray[np.void]:
    """Read all rows of one element.

    Returns:
        Structured array ``(count,)`` with the file's property names and types.

    Raises:
        InputError: Unknown element, list properties in the way, or the file ends too early.
    """
    element = header.element(name)
    if element.dtype is None or element.offset is None:
        raise InputError(
            "reading a PLY file",
            f"{header.path}, element {name!r}",
            "list properties, so rows have no fixed size" if element.dtype is None else "it follows list properties",
            "give a Gaussian model; meshes with faces are not one",
        )
    have = header.path.stat().st_size - element.offset
    need = element.count * element.dtype.itemsize
    if need > have:
        rows = max(have, 0) // element.dtype.itemsize
        raise InputError(
            "reading a PLY file",
            f"{header.path}, element {name!r}",
            f"the header announces {element.count} rows of {element.dtype.itemsize} bytes, the file ends after {rows}",
            _EXPORT_AGAIN,
        )
    return np.fromfile(header.path, dtype=element.dtype, count=element.count, offset=element.offset)


def _header_lines(path: Path) -> tuple[list[str], int]:
    """Return the header's lines and the byte position after it."""
    with open_regular(path, "reading a PLY file") as stream:
        head = stream.read(_MAX_HEADER_BYTES)
    if head[:3] != b"ply" or head[3:4] not in (b"\n", b"\r"):
        raise InputError("reading a PLY file", str(path), f"first bytes {head[:4]!r}, expected b'ply'", "give a PLY file")
    marker = head.find(b"\nend_header")
    end = head.find(b"\n", marker + 1) if marker >= 0 else -1
    if end < 0:
        raise InputError("reading a PLY header", str(path), f"no end_header in the first {len(head)} bytes", _EXPORT_AGAIN)
    return head[:end].decode("ascii", errors="replace").splitlines(), end + 1


def _byte_order(path: Path, word: str) -> str:
    if word in _ENDIAN:
        return _ENDIAN[word]
    raise InputError(
        "reading a PLY file",
        str(path),
        f"format {word!r}; only {', '.join(_ENDIAN)} can hold Gaussians without loss",
        "export the file again as a binary PLY",
    )


def _count(path: Path, number: int, word: str) -> int:
    if not (word.isascii() and word.isdigit()):
        raise InputError("reading a PLY header", f"{path}, line {number}", f"element count {word!r}, not a whole number", _EXPORT_AGAIN)
    count = int(word) if len(word) <= 20 else 10**20
    GAUSSIANS.check(count, "reading a PLY header", f"{path}, line {number}", "element count")
    return count


def _with_property(
    path: Path,
    number: int,
    element: tuple[str, int, list[tuple[str, str]] | None],
    words: list[str],
    byte_order: str,
) -> tuple[str, int, list[tuple[str, str]] | None]:
    """Return the element with one more property; a list property turns the layout into None."""
    name, count, fields = element
    if words[1] == "list" or fields is None:
        return name, count, None
    if len(fields) >= MAX_PROPERTIES or words[1] not in _SCALAR_CODES or not byte_order or any(words[2] == known for known, _ in fields):
        raise _bad_line(path, number, " ".join(words))
    return name, count, [*fields, (words[2], byte_order + _SCALAR_CODES[words[1]])]


def _place(pending: list[tuple[str, int, list[tuple[str, str]] | None]], body_offset: int) -> tuple[PlyElement, ...]:
    """Give each element its row layout and byte position."""
    offset: int | None = body_offset
    elements = []
    for name, count, fields in pending:
        dtype = None if fields is None else np.dtype(fields)
        elements.append(PlyElement(name, count, dtype, offset))
        offset = None if dtype is None or offset is None else offset + count * dtype.itemsize
    return tuple(elements)


def _bad_line(path: Path, number: int, line: str) -> InputError:
    return InputError("reading a PLY header", f"{path}, line {number}", f"a line that means nothing here: {line[:80]!r}", _EXPORT_AGAIN)
