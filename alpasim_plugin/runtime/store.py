"""Read and write the files of a run: JSON, and the schemas of its parquet tables."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from alpasim_plugin.io import reading
from alpasim_plugin.io.atomic import atomic_file, write_bytes

GROUP_ROWS = 1 << 20  # rows of a row group: what is held in memory


def read_json(path: Path) -> Any:
    """Read JSON.

    Raises:
        InputError: The file is missing or is not JSON.
    """
    return reading.read_json(path, "reading a run", do_this="restore the file or run again")


def write_table(path: Path, rows: Sequence[Mapping[str, Any]], schema: pa.Schema) -> None:
    """Write rows as parquet atomically, in the order given."""
    columns = {field.name: pa.array([row.get(field.name) for row in rows], type=field.type) for field in schema}
    write_parquet(path, pa.table(columns, schema=schema))


def write_parquet(path: Path, table: pa.Table) -> None:
    """Write a table as parquet atomically, compressed with zstd."""
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd")
    write_bytes(path, sink.getvalue().to_pybytes())


def write_parquet_parts(path: Path, schema: pa.Schema, parts: Iterable[Path]) -> None:
    """Write the rows of many parquet files into one, atomically and in order, in the memory of one row group.

    Args:
        path: The file.
        schema: Of all parts.
        parts: The files.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as partial, pq.ParquetWriter(partial, schema, compression="zstd") as writer:
        held: list[pa.Table] = []
        rows = 0
        for part in parts:
            with pq.ParquetFile(part) as file:
                held.append(file.read(use_threads=False))  # a few kilobytes each
            rows += len(held[-1])
            if rows >= GROUP_ROWS:
                writer.write_table(pa.concat_tables(held))
                held, rows = [], 0
        writer.write_table(pa.concat_tables(held) if held else schema.empty_table())


STEPS_SCHEMA = pa.schema(
    [
        ("renderer", pa.string()),
        ("policy", pa.string()),
        ("scene", pa.string()),
        ("seed", pa.int64()),
        ("t_us", pa.int64()),
        ("metric", pa.string()),
        ("value", pa.float64()),
        ("valid", pa.bool_()),
        ("reason", pa.string()),
    ]
)


def steps_schema(of_logs: bool) -> pa.Schema:
    """Return the schema of ``steps.parquet``; tables of scored logs name the log's folder in ``rollout``."""
    return pa.schema([*STEPS_SCHEMA, pa.field("rollout", pa.string())]) if of_logs else STEPS_SCHEMA


def rollouts_schema(metrics: Sequence[str], of_logs: bool = False) -> pa.Schema:
    """Return the schema of ``rollouts.parquet`` for a list of metric names; see `steps_schema` for ``of_logs``."""
    fields: list[tuple[str, pa.DataType]] = [
        ("renderer", pa.string()),
        ("policy", pa.string()),
        ("scene", pa.string()),
        ("seed", pa.int64()),
        *([("rollout", pa.string())] if of_logs else []),
        ("status", pa.string()),
        ("failure_class", pa.string()),
        ("failure", pa.string()),
        ("path", pa.string()),
        ("wall_s", pa.float64()),
        ("frames", pa.int64()),
        ("steps", pa.int64()),
    ]
    for metric in metrics:
        fields += [(metric, pa.float64()), (f"{metric}_valid", pa.bool_())]
    return pa.schema(fields)
