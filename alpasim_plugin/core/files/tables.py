"""Parquet tables: rows and bytes by their header, columns by type. Texts are read as codes of a
dictionary, since a file holds a text once that a million rows repeat; what the rows become in memory
is counted before they are decoded.
"""

from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any, Literal

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.limits import (
    SCENE_TABLE_BYTES,
    TABLE_BYTES,
    TABLE_COLUMNS,
    TABLE_ROWS,
    TABLE_TEXT_BYTES,
    TABLE_VALUES,
    Bound,
)
from alpasim_plugin.core.files.reading import FETCH_AGAIN, check_regular, parsing
from alpasim_plugin.core.json_types import JsonObject

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
    file, schema = _open(path, path, do_this, TABLE_BYTES)
    table = _read(file, schema, path, do_this, TABLE_TEXT_BYTES)
    check_columns(table, columns, path, do_this)
    return table


def parse_rows(
    data: bytes, location: Path | str, do_this: str = FETCH_AGAIN
) -> tuple[Any, list[JsonObject]]:
    """Return a parquet document's Arrow schema and its rows as plain data, whose lists and objects
    take many times what the table takes.

    Raises:
        InputError: As `read_parquet`, with narrower bounds, or more values than the bound.
    """
    import pyarrow as pa

    source = pa.BufferReader(data)
    file, schema = _open(source, location, do_this, SCENE_TABLE_BYTES)
    facts = file.metadata
    values = 0
    for group in range(facts.num_row_groups):
        for column in range(facts.num_columns):
            chunk = facts.row_group(group).column(column)
            values += chunk.num_values * (1 + chunk.path_in_schema.count("."))
    TABLE_VALUES.check(values, location)
    table = _read(file, schema, location, do_this, SCENE_TABLE_BYTES)
    return table.schema, table.to_pylist()


def check_parquet(
    path: Path | str, columns: Mapping[str, Kind], do_this: str = FETCH_AGAIN
) -> list[str]:
    """Check the header of a parquet file that is read in parts later, and return its columns; see
    `read_parquet` for what is refused.
    """
    _, schema = _open(path, path, do_this, TABLE_BYTES)
    empty = schema.empty_table()
    check_columns(empty, columns, path, do_this)
    return list(empty.column_names)


def _read(
    file: Any,
    schema: Any,
    location: Path | str,
    do_this: str,
    text_bound: Bound,
) -> Any:
    """Return what `_open` opened as a table of the types that the file states."""
    with parsing(location, do_this, NO_PARQUET):
        table = file.read()
        table.validate(full=True)
        check_text(table, location, text_bound)
        return table.cast(schema)


def check_text(table: Any, location: Path | str, bound: Bound) -> None:
    """Refuse a table whose texts, which it holds once for all rows that repeat them, take more than
    the bound where each row has its own.

    Raises:
        InputError: They do.
    """
    size = sum(_text_bytes(chunk) for column in table.columns for chunk in column.chunks)
    bound.check(size, location)


def _text_bytes(array: Any) -> int:
    """Return how many bytes the texts of an Arrow array take where each value has its own; those in
    its lists and objects count, others than codes of a dictionary do not.
    """
    import pyarrow as pa
    import pyarrow.compute as pc

    if pa.types.is_dictionary(array.type):
        if not is_text(array.type.value_type):
            return 0
        lengths = pc.binary_length(array.dictionary)
        return pc.sum(pc.take(lengths, array.indices)).as_py() or 0
    if pa.types.is_struct(array.type):
        return sum(_text_bytes(array.field(i)) for i in range(array.type.num_fields))
    if pa.types.is_list(array.type) or pa.types.is_large_list(array.type):
        return _text_bytes(array.values)
    return 0


def is_text(type_: Any) -> bool:
    """Tell whether an Arrow type holds text or bytes of any length."""
    import pyarrow.types as t

    tests = (t.is_string, t.is_large_string, t.is_binary, t.is_large_binary)
    return any(test(type_) for test in tests)


def _open(source: Any, location: Path | str, do_this: str, bound: Bound) -> tuple[Any, Any]:
    """Open a parquet file; refuse more rows, columns or unpacked bytes than the bounds, by its
    header.

    Returns:
        The file, which reads texts as codes of a dictionary, and the schema that it states.
    """
    import pyarrow.parquet as pq

    if source is location:
        check_regular(source, do_this=do_this)
    with parsing(location, do_this, NO_PARQUET):
        file = pq.ParquetFile(source, page_checksum_verification=True)
        facts = file.metadata
        TABLE_ROWS.check(facts.num_rows, location)
        TABLE_COLUMNS.check(facts.num_columns, location)
        schema = file.schema_arrow
        texts = _text_columns(facts, schema)
        sizes = [
            _size_in_memory(facts, i, j, texts)
            for i in range(facts.num_row_groups)
            for j in range(facts.num_columns)
        ]
        bound.check(sum(sizes), location)
        if texts:
            file = pq.ParquetFile(
                source, metadata=facts, read_dictionary=texts, page_checksum_verification=True
            )
    return file, schema


def _text_columns(facts: Any, schema: Any) -> list[str]:
    """Return the paths of the columns that hold texts, those in lists and objects included."""
    columns = [facts.schema.column(i) for i in range(facts.num_columns)]
    at_top = {field.name for field in schema if is_text(field.type)}
    return [
        column.path
        for column in columns
        if column.path in at_top or ("." in column.path and column.logical_type.type == "STRING")
    ]


def _size_in_memory(facts: Any, group: int, column: int, texts: Collection[str]) -> int:
    """Return at least how many bytes a column of a group of rows takes in memory: runs of equal
    values take no space in the file. Of texts that are decoded at once, it is the most.

    Args:
        facts: Metadata of the file.
        group: Number of the group.
        column: Number of the column.
        texts: Paths of the columns that are read as codes.
    """
    chunk = facts.row_group(group).column(column)
    value_bytes = 8
    if chunk.physical_type == "FIXED_LEN_BYTE_ARRAY":
        value_bytes = max(facts.schema.column(column).length, value_bytes)
    elif chunk.physical_type == "BYTE_ARRAY" and chunk.path_in_schema not in texts:
        value_bytes = max(chunk.total_uncompressed_size, value_bytes)  # one text for all values
    return int(max(chunk.total_uncompressed_size, value_bytes * chunk.num_values))


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
