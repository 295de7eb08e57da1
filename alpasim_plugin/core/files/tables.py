"""Parquet tables: rows and bytes by their header, columns by type."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.limits import TABLE_BYTES, TABLE_COLUMNS, TABLE_ROWS
from alpasim_plugin.core.files.reading import FETCH_AGAIN, check_regular, parsing

NO_PARQUET = "no readable parquet"

Kind = Literal["text", "integer", "number", "flag"]


def read_parquet(
    path: Path | str,
    columns: Mapping[str, Kind],
    do_this: str = FETCH_AGAIN,
) -> Any:
    """Return a parquet file as an Arrow table.

    Args:
        path: File.
        columns: Columns that must be there, by type; null values are allowed.
        do_this: Hint of the errors.

    Raises:
        InputError: Unreadable or no parquet, more rows or bytes than the bounds, a column missing
            or of another type.
    """
    file = _open(path, path, do_this)
    with parsing(path, do_this, NO_PARQUET):
        table = file.read()
        table.validate(full=True)
    check_columns(table, columns, path, do_this)
    return table


def parse_parquet(data: bytes, location: Path | str, do_this: str = FETCH_AGAIN) -> Any:
    """Return a parquet document as an Arrow table; see `read_parquet`."""
    import pyarrow as pa

    file = _open(pa.BufferReader(data), location, do_this)
    with parsing(location, do_this, NO_PARQUET):
        table = file.read()
        table.validate(full=True)
    return table


def check_parquet(
    path: Path | str, columns: Mapping[str, Kind], do_this: str = FETCH_AGAIN
) -> list[str]:
    """Check the header of a parquet file that is read in parts later, and return its columns; see
    `read_parquet` for what is refused.
    """
    empty = _open(path, path, do_this).schema_arrow.empty_table()
    check_columns(empty, columns, path, do_this)
    return list(empty.column_names)


def _open(source: Any, location: Path | str, do_this: str) -> Any:
    """Open a parquet file; refuse more rows, columns or unpacked bytes than the bounds, by its
    header.
    """
    import pyarrow.parquet as pq

    if source is location:
        check_regular(source, do_this=do_this)
    with parsing(location, do_this, NO_PARQUET):
        file = pq.ParquetFile(source, page_checksum_verification=True)
        facts = file.metadata
        TABLE_ROWS.check(facts.num_rows, location)
        TABLE_COLUMNS.check(facts.num_columns, location)
        size = 0
        for i in range(facts.num_row_groups):
            for j in range(facts.num_columns):
                chunk = facts.row_group(i).column(j)
                # Runs of equal values take no space in the file: what they become in memory counts.
                size += max(chunk.total_uncompressed_size, 8 * chunk.num_values)
        TABLE_BYTES.check(size, location)
    return file


def check_columns(
    table: Any,
    columns: Mapping[str, Kind],
    location: Path | str,
    do_this: str = FETCH_AGAIN,
) -> None:
    """Refuse a table that lacks a column, has it twice, or has one of another type.

    Raises:
        InputError: It does; the columns that are there are named.
    """
    import pyarrow.types as t

    tests = {
        "text": (t.is_string, t.is_large_string),
        "integer": (t.is_integer,),
        "number": (t.is_integer, t.is_floating),
        "flag": (t.is_boolean,),
    }
    names = table.column_names
    for name, kind in columns.items():
        if names.count(name) != 1:
            count_text = "several columns" if name in names else "no column"
            raise InputError(
                f"{location}: {count_text} {name!r} among {', '.join(names[:12])}", do_this
            )
        type_ = table.schema.field(name).type
        held = type_.value_type if t.is_dictionary(type_) else type_
        # A column of nothing but nulls has a type of its own.
        if not any(test(held) for test in (t.is_null, *tests[kind])):
            raise InputError(f"{location}: column {name!r} of {type_}, wanted {kind}", do_this)
