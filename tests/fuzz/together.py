"""Damage to files of a run folder that belong together: the schema says which columns the tables
share, and JSON follows the tables.
"""

from __future__ import annotations

import io
import json
import random
from collections.abc import Callable
from functools import cache
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from alpasim_plugin.log.run_folder.schema import (
    KEYS,
    ROLLOUTS_TABLE,
    STEPS_TABLE,
    VALID,
    Column,
    columns_of,
    metrics_in,
)

Files = dict[str, bytes]
Tables = dict[str, pa.Table]
Texts = dict[str, str]
SCHEMAS = (ROLLOUTS_TABLE, STEPS_TABLE)
NAMES = (
    "",
    "x" * 5000,
    "../../../etc/passwd",
    "\x1b[31m",
    "<script>alert(1)</script>",
    "a/b",
    "nan",
    "\u202e",
    "clean",
    "null",
    " ",
    "\n",
)
NUMBERS = (1e308, -1e308, float("inf"), float("-inf"), float("nan"), 1e-308, -1.0, 0.0, 1e9, 0.5)
WHOLES = (0, -1, 2**63 - 1, -(2**63), 10**9, 1)


def damaged_together(files: Files, rng: random.Random, root: str = "run/") -> Files:
    """Return the files of a run folder after one to three changes, each of which is made in every
    file that holds what is changed.

    Args:
        files: By path; what lies below ``root`` is the run folder.
        rng: Where chance comes from.
        root: Of the run folder.
    """
    tables = {one.name: _table(files[root + one.name]) for one in SCHEMAS}
    documents = {name: data.decode() for name, data in files.items() if name.endswith(".json")}
    for _ in range(rng.choice((1, 1, 2, 3))):
        rng.choice(CHANGES)(tables, documents, rng)
    out = files | {name: document.encode() for name, document in documents.items()}
    for name, table in tables.items():
        sink = io.BytesIO()
        pq.write_table(table, sink)
        out[root + name] = sink.getvalue()
    return out


def _rename(tables: Tables, documents: Texts, rng: random.Random) -> None:
    """Rename a renderer, policy, scene, status or metric wherever it stands."""
    column = rng.choice(
        [
            c.name
            for c in ROLLOUTS_TABLE.columns
            if c.kind == "text" and c.name in tables[ROLLOUTS_TABLE.name].column_names
        ]
    )
    values = [v for v in tables[ROLLOUTS_TABLE.name][column].to_pylist() if isinstance(v, str)]
    if not values:
        return
    old, new = rng.choice(values), rng.choice(NAMES)
    for name, table in tables.items():
        if column in table.column_names:
            found = [new if value == old else value for value in table[column].to_pylist()]
            tables[name] = _with(table, column, found, pa.string())
    _replace(documents, old, new)


def _rename_metric(tables: Tables, documents: Texts, rng: random.Random) -> None:
    table = tables[ROLLOUTS_TABLE.name]
    metrics = metrics_in(table.column_names)
    if not metrics:
        return
    old, new = rng.choice(metrics), rng.choice(NAMES)
    renamed = {old: new, old + VALID: new + VALID}
    tables[ROLLOUTS_TABLE.name] = table.rename_columns(
        [renamed.get(name, name) for name in table.column_names]
    )
    steps = tables[STEPS_TABLE.name]
    if "metric" in steps.column_names:
        found = [new if value == old else value for value in steps["metric"].to_pylist()]
        tables[STEPS_TABLE.name] = _with(steps, "metric", found, pa.string())
    _replace(documents, old, new)


def _extreme(tables: Tables, documents: Texts, rng: random.Random) -> None:
    """Set values of a column to extreme ones, in all tables that have it."""
    column = rng.choice(_columns(tables))
    choices: tuple[Any, ...] = {
        "text": NAMES,
        "integer": WHOLES,
        "number": NUMBERS,
        "flag": (True, False),
    }[column.kind]
    value, share = rng.choice((*choices, None)), rng.choice((1.0, 0.5, 0.1))
    types = {"text": pa.string(), "integer": pa.int64(), "number": pa.float64(), "flag": pa.bool_()}
    for name, table in tables.items():
        if column.name in table.column_names:
            found = [
                value if rng.random() < share else old for old in table[column.name].to_pylist()
            ]
            tables[name] = _with(table, column.name, found, types[column.kind])


def _other_type(tables: Tables, documents: Texts, rng: random.Random) -> None:
    column, kind = rng.choice(_columns(tables)), rng.randrange(5)
    for name, table in tables.items():
        if column.name in table.column_names:
            n = table.num_rows
            arrays = (["x"] * n, [[1.0]] * n, [{"a": 1}] * n, [b"\xff"] * n, [2**40] * n)
            tables[name] = _set(table, column.name, pa.array(arrays[kind]))


def _drop_column(tables: Tables, documents: Texts, rng: random.Random) -> None:
    column = rng.choice(_columns(tables))
    for name, table in tables.items():
        if column.name in table.column_names:
            tables[name] = table.drop_columns([column.name])


def _rows(tables: Tables, documents: Texts, rng: random.Random) -> None:
    """Remove or repeat the rows of one cell, in both tables, or all rows."""
    table = tables[ROLLOUTS_TABLE.name]
    if not table.num_rows or any(key not in table.column_names for key in KEYS):
        return
    cell = tuple(table[key].to_pylist()[rng.randrange(table.num_rows)] for key in KEYS)
    times = rng.choice((0, 2, 50, -1))
    for name, one in tables.items():
        if all(key in one.column_names for key in KEYS):
            keys = list(zip(*(one[key].to_pylist() for key in KEYS), strict=True))
            places = [
                i
                for i, key in enumerate(keys)
                for _ in range(0 if times < 0 else times if key == cell else 1)
            ]
            tables[name] = one.take(pa.array(places, pa.int64()))


CHANGES: tuple[Callable[[Tables, dict[str, Any], random.Random], None], ...] = (
    _rename,
    _rename_metric,
    _extreme,
    _extreme,
    _other_type,
    _drop_column,
    _rows,
)


def _columns(tables: Tables) -> list[Column]:
    """Return the columns that the schema states and a table has."""
    names = {name for table in tables.values() for name in table.column_names}
    own = [column for one in SCHEMAS for column in one.columns]
    stated = [*own, *columns_of(metrics_in(tables[ROLLOUTS_TABLE.name].column_names))]
    return [column for column in stated if column.name in names] or [Column("renderer", "text")]


def _with(table: pa.Table, column: str, values: list[Any], kind: pa.DataType) -> pa.Table:
    try:
        return _set(table, column, pa.array(values, kind))
    except (pa.ArrowInvalid, pa.ArrowTypeError):  # an earlier change gave it another type
        return table


def _set(table: pa.Table, column: str, array: pa.Array) -> pa.Table:
    return table.set_column(table.column_names.index(column), column, array)


def _replace(documents: Texts, old: str, new: str) -> None:
    """Replace a text in documents, as value and as key: no other place of JSON has it between bare
    quotes.
    """
    for name, text in documents.items():
        documents[name] = text.replace(json.dumps(old), json.dumps(new))


@cache
def _table(data: bytes) -> pa.Table:
    return pq.read_table(io.BytesIO(data))
