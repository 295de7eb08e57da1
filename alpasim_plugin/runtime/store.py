"""Files that are either whole or absent: written beside their place and renamed."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from alpasim_plugin.errors import InfrastructureError, InputError


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file atomically.

    Raises:
        InfrastructureError: The disk refused (full, read-only, quota); what stood at ``path`` before is untouched.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise disk_error(path.parent, error) from error
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise disk_error(path, error) from error


def disk_error(path: Path, error: OSError) -> InfrastructureError:
    """Name a failed write in four parts."""
    full = error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
    room = "free disk space and run the same command again; finished rollouts are kept"
    do = room if full else "make the folder writable, or name another one"
    return InfrastructureError("writing a result", str(path), f"{error.strerror or error}", do)


def write_json(path: Path, value: Any) -> None:
    """Write JSON atomically; NaN and infinity are refused since no JSON reader has to accept them."""
    write_bytes(path, (json.dumps(value, indent=1, allow_nan=False) + "\n").encode())


def read_json(path: Path) -> Any:
    """Read JSON.

    Raises:
        InputError: The file is missing or is not JSON.
    """
    try:
        return json.loads(path.read_text())
    except FileNotFoundError as error:
        raise InputError("reading a run", str(path), "no such file", "name a folder written by simrun") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError("reading a run", str(path), f"not JSON: {error}", "restore the file or run again") from error


def write_table(path: Path, rows: Sequence[Mapping[str, Any]], schema: pa.Schema) -> None:
    """Write rows as parquet atomically, in the order given."""
    columns = {field.name: pa.array([row.get(field.name) for row in rows], type=field.type) for field in schema}
    sink = pa.BufferOutputStream()
    pq.write_table(pa.table(columns, schema=schema), sink, compression="zstd")
    write_bytes(path, sink.getvalue().to_pybytes())


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
