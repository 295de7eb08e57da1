"""Arrow IPC files: what their compressed buffers become in memory is counted before they are
unpacked.

A file ends with a footer that lists its blocks; each block is a message, a FlatBuffers document,
with a body of buffers. A compressed buffer begins with its unpacked size.

Source: Arrow Columnar Format 1.5, "IPC File Format" and ``format/Message.fbs``, ``File.fbs``; the
binary form of tables and vectors is that of FlatBuffers' "Internals".
"""

import struct
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from alpasim_plugin.core.files.limits import (
    SOURCE_BYTES,
    TABLE_COLUMNS,
    TABLE_ROWS,
    TABLE_TEXT_BYTES,
    UNPACKED_BYTES,
)
from alpasim_plugin.core.files.tables import check_text

LEAST_UNPACKED_BYTES = SOURCE_BYTES.high  # any file may unpack to so much
PACKED = 8  # times its own size, a larger file to so much
MAGIC = b"ARROW1"
FOOTER_END = struct.Struct("<i6s")  # size of the footer, magic
BLOCK = struct.Struct("<qi4xq")  # offset of a message, its size, size of its body
BUFFER = struct.Struct("<qq")  # offset in a body, size
CONTINUED = b"\xff\xff\xff\xff"  # before the size of a message
NOT_PACKED = -1  # the unpacked size of a buffer that is stored as it is
# Numbers of members in their tables
FOOTER_DICTIONARIES = 2
FOOTER_BATCHES = 3
MESSAGE_KIND = 1
MESSAGE_HEADER = 2
DICTIONARY_DATA = 1
BATCH_ROWS = 0
BATCH_BUFFERS = 2
BATCH_COMPRESSION = 3
# Kinds of messages
DICTIONARY_BATCH = 2
RECORD_BATCH = 3


class Damaged(ValueError):
    """A file that is not as the format says."""


def read_arrow(data: Any, location: Path | str) -> Any:
    """Return an Arrow IPC file as a table.

    Args:
        data: A buffer of the whole file, such as of a memory map; nothing of it is copied.
        location: Names it in errors.

    Raises:
        ValueError: It is no such file, or damaged.
        InputError: More columns, rows, unpacked bytes or text than the bounds.
    """
    import pyarrow as pa

    view = memoryview(data).cast("B")
    rows, size = _rows_and_size(view)
    TABLE_ROWS.check(rows, location)
    most = min(max(LEAST_UNPACKED_BYTES, PACKED * len(view)), UNPACKED_BYTES.high)
    replace(UNPACKED_BYTES, high=most).check(size, location)
    table = pa.ipc.open_file(pa.BufferReader(data)).read_all()
    TABLE_COLUMNS.check(table.num_columns, location)
    table.validate(full=True)
    check_text(table, location, TABLE_TEXT_BYTES)
    return table


def _rows_and_size(view: memoryview) -> tuple[int, int]:
    """Return the rows of a file, and how many bytes its packed buffers become; what is not packed
    stays where it is.
    """
    try:
        size, magic = FOOTER_END.unpack_from(view, len(view) - FOOTER_END.size)
        if magic != MAGIC or not 0 < size <= len(view) - FOOTER_END.size:
            raise Damaged("no Arrow IPC file")
        end = len(view) - FOOTER_END.size
        footer = _Table.root(view[end - size : end])
        rows = 0
        unpacked = 0
        for member in (FOOTER_DICTIONARIES, FOOTER_BATCHES):
            for offset, message_size, body_size in footer.structs(member, BLOCK):
                batch = _batch(view[offset : offset + message_size])
                begin = offset + message_size
                body = view[begin : begin + body_size]
                rows += batch.number(BATCH_ROWS, "<q")
                if batch.has(BATCH_COMPRESSION):
                    unpacked += sum(_unpacked_sizes(batch, body))
    except (struct.error, IndexError) as error:
        raise Damaged(f"a damaged Arrow IPC file: {error}") from error
    return rows, unpacked


def _batch(message: memoryview) -> "_Table":
    """Return the batch of rows of a message, of one that holds a dictionary the dictionary's."""
    start = 8 if message[:4] == CONTINUED else 4
    document = _Table.root(message[start:])
    kind = document.number(MESSAGE_KIND, "<B")
    if kind not in (DICTIONARY_BATCH, RECORD_BATCH):
        raise Damaged(f"a damaged Arrow IPC file: a message of kind {kind} among its batches")
    header = document.table(MESSAGE_HEADER)
    return header.table(DICTIONARY_DATA) if kind == DICTIONARY_BATCH else header


def _unpacked_sizes(batch: "_Table", body: memoryview) -> Iterator[int]:
    """Yield the size that each buffer of a packed batch states."""
    for offset, size in batch.structs(BATCH_BUFFERS, BUFFER):
        if size > 0:
            (stated,) = struct.unpack_from("<q", body, offset)
            yield size if stated == NOT_PACKED else max(stated, size)


class _Table:
    """A table of a FlatBuffers document: its members, by number, stand where a second table of
    offsets says.
    """

    def __init__(self, view: memoryview, begin: int) -> None:
        self._view = view
        self._begin = begin
        (back,) = struct.unpack_from("<i", view, begin)
        self._members = begin - back

    @classmethod
    def root(cls, view: memoryview) -> "_Table":
        """Return the outermost table of a document."""
        (begin,) = struct.unpack_from("<I", view, 0)
        return cls(view, begin)

    def has(self, member: int) -> bool:
        """Tell whether a member is there."""
        return self._offset(member) != 0

    def number(self, member: int, form: str) -> int:
        """Return a number; 0 where it is left out."""
        offset = self._offset(member)
        if not offset:
            return 0
        (value,) = struct.unpack_from(form, self._view, self._begin + offset)
        return int(value)

    def table(self, member: int) -> "_Table":
        """Return an inner table."""
        return _Table(self._view, self._target(member))

    def structs(self, member: int, form: struct.Struct) -> Iterator[tuple[int, ...]]:
        """Yield the structs of a vector."""
        if not self.has(member):
            return
        vector = self._target(member)
        (count,) = struct.unpack_from("<I", self._view, vector)
        for number in range(count):
            yield form.unpack_from(self._view, vector + 4 + number * form.size)

    def _offset(self, member: int) -> int:
        (size,) = struct.unpack_from("<H", self._view, self._members)
        if 4 + 2 * member >= size:
            return 0
        (offset,) = struct.unpack_from("<H", self._view, self._members + 4 + 2 * member)
        return int(offset)

    def _target(self, member: int) -> int:
        place = self._begin + self._offset(member)
        (forward,) = struct.unpack_from("<I", self._view, place)
        return place + int(forward)
