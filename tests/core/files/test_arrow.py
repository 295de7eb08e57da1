"""Arrow IPC files: equal tables, what unpacks to too much, and damaged bytes."""

import io

import numpy as np
import pyarrow as pa
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import arrow
from alpasim_plugin.core.files.arrow import read_arrow

TABLE = pa.table(
    {
        "x": np.arange(3000.0),
        "name": pa.array(["left", None, "right"] * 1000).dictionary_encode(),
        "box": pa.array([[1.0, 2.0], [], None] * 1000),
    }
)


def written(table, compression=None, rows=1000):
    stream = io.BytesIO()
    options = pa.ipc.IpcWriteOptions(compression=compression)
    with pa.ipc.new_file(stream, table.schema, options=options) as writer:
        writer.write_table(table, max_chunksize=rows)
    return stream.getvalue()


@pytest.mark.parametrize("compression", [None, "zstd", "lz4"])
def test_a_file_is_read_as_it_was_written(compression):
    data = written(TABLE, compression)
    assert read_arrow(pa.py_buffer(data), "a.arrow").equals(TABLE)
    empty = written(TABLE.slice(0, 0), compression)
    assert read_arrow(pa.py_buffer(empty), "a.arrow").num_rows == 0


def test_what_unpacks_to_far_more_than_the_file_is_refused(monkeypatch):
    monkeypatch.setattr(arrow, "LEAST_UNPACKED_BYTES", 1_000_000)
    table = pa.table({"x": np.zeros(200_000)})
    with pytest.raises(InputError, match="unpacked size"):
        read_arrow(pa.py_buffer(written(table, "zstd", 50_000)), "a.arrow")
    assert read_arrow(pa.py_buffer(written(table)), "a.arrow").equals(table)


def test_rows_and_unpacked_sizes_are_those_of_the_table():
    table = pa.table({"x": np.zeros(200_000)})
    for rows in (50_000, 200_000):
        assert arrow._rows_and_size(memoryview(written(table, "zstd", rows))) == (
            200_000,
            1_600_000,
        )
    assert arrow._rows_and_size(memoryview(written(table))) == (200_000, 0)


def test_a_text_that_rows_repeat_counts_for_each(monkeypatch):
    indices = pa.array(np.zeros(20_000, dtype=np.int32))
    table = pa.table({"x": pa.DictionaryArray.from_arrays(indices, ["x" * 100_000])})
    with pytest.raises(InputError, match="text of a table"):
        read_arrow(pa.py_buffer(written(table, rows=20_000)), "a.arrow")


def test_damaged_files_are_refused_and_nothing_else_is_raised():
    data = written(TABLE, "zstd")
    random = np.random.Generator(np.random.Philox(0))
    refused = 0
    for number in range(300):
        changed = bytearray(data[: random.integers(len(data))] if number % 3 == 0 else data)
        for place in random.integers(max(len(changed) - 600, 0), len(changed) + 1, 3):
            changed[place : place + 1] = random.bytes(1)
        try:
            read_arrow(pa.py_buffer(bytes(changed)), "a.arrow")
        except (InputError, ValueError, KeyError, OSError, pa.ArrowException):
            refused += 1
    assert refused > 150
    for data in (b"", b"ARROW1", b"\x00" * 64, b"ARROW1" + b"\xff" * 40 + b"ARROW1"):
        with pytest.raises(ValueError, match="Arrow"):
            read_arrow(pa.py_buffer(data), "a.arrow")
