"""Parquet and Arrow tables: rows and bytes by their header, columns by type."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.limits import FILE_BYTES, TABLE_BYTES, TABLE_COLUMNS, TABLE_ROWS
from alpasim_plugin.core.reading.files import FETCH_AGAIN, check_regular, parsing

Kind = Literal["text", "integer", "number", "flag"]


def read_parquet(
    path: Path | str,
    columns: Mapping[str, Kind] | None = None,
    do_this: str = FETCH_AGAIN,
    only: bool = False,
) -> Any:
    """Return a parquet file as an Arrow table.

    Args:
        path: File.
        columns: Columns that must be there, by type; null values are allowed. None checks none.
        do_this: Last part of the errors.
        only: Read these columns alone.

    Raises:
        InputError: Unreadable or no parquet, more rows or bytes than the bounds, a column missing
            or of another type.
    """
    check_regular(path, FILE_BYTES, do_this)
    return _read(str(path), path, columns, do_this, only)


def parse_parquet(
    data: bytes,
    where: Path | str,
    columns: Mapping[str, Kind] | None = None,
    do_this: str = FETCH_AGAIN,
) -> Any:
    """Return a parquet document as an Arrow table; see `read_parquet`."""
    return _read(io.BytesIO(data), where, columns, do_this, False)


def check_columns(
    table: Any,
    columns: Mapping[str, Kind],
    where: Path | str,
    do_this: str = FETCH_AGAIN,
) -> None:
    """Refuse a table that lacks a column or has one of another type.

    Raises:
        InputError: It does; the columns that are there are named.
    """
    names: Sequence[str] = table.column_names
    for name, kind in columns.items():
        if names.count(name) != 1:
            shown = ", ".join(names[:12])
            found = (
                f"no column {name!r}, only {shown}"
                if name not in names
                else f"column {name!r} {names.count(name)} times"
            )
            raise InputError(f"{where}: {found}", do_this)
        type_ = table.schema.field(name).type
        if not _is(type_, kind):
            raise InputError(f"{where}: column {name!r} of {type_}, wanted {kind}", do_this)


def _is(type_: Any, kind: Kind) -> bool:
    import pyarrow as pa

    t = pa.types
    if t.is_dictionary(type_):
        type_ = type_.value_type
    if t.is_null(type_):  # a column of nothing but nulls
        return True
    match kind:
        case "text":
            return bool(t.is_string(type_) or t.is_large_string(type_))
        case "integer":
            return bool(t.is_integer(type_))
        case "number":
            return bool(t.is_integer(type_) or t.is_floating(type_))
    return bool(t.is_boolean(type_))


def check_parquet(
    path: Path | str, columns: Mapping[str, Kind], do_this: str = FETCH_AGAIN
) -> list[str]:
    """Check the header of a parquet file that is read in parts later, and return its columns; see
    `read_parquet` for what is refused.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    check_regular(path, FILE_BYTES, do_this)
    _check_size(str(path), path, do_this)
    with parsing(path, do_this, "no readable parquet"):
        empty = pq.read_schema(str(path)).empty_table()
    assert isinstance(empty, pa.Table)
    check_columns(empty, columns, path, do_this)
    return list(empty.column_names)


def _read(
    source: Any,
    where: Path | str,
    columns: Mapping[str, Kind] | None,
    do_this: str,
    only: bool,
) -> Any:
    import pyarrow.parquet as pq

    _check_size(source, where, do_this)
    with parsing(where, do_this, "no readable parquet"):
        if hasattr(source, "seek"):
            source.seek(0)
        table = pq.ParquetFile(source).read(columns=list(columns) if only and columns else None)
        table.validate(full=True)
    if columns is not None:
        check_columns(table, columns, where, do_this)
    return table


def _check_size(source: Any, where: Path | str, do_this: str) -> None:
    """Refuse more rows, columns or unpacked bytes than the bounds, by the header."""
    import pyarrow.parquet as pq

    with parsing(where, do_this, "no readable parquet"):
        facts = pq.read_metadata(source)
        TABLE_ROWS.check(facts.num_rows, where)
        TABLE_COLUMNS.check(facts.num_columns, where)
        chunks = [
            facts.row_group(i).column(j)
            for i in range(facts.num_row_groups)
            for j in range(facts.num_columns)
        ]
        # Runs of equal values take no space in the file: what they become in memory counts.
        TABLE_BYTES.check(
            sum(max(chunk.total_uncompressed_size, 8 * chunk.num_values) for chunk in chunks),
            where,
        )
