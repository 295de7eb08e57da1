"""From a run's files to data frames of pandas or polars."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import pyarrow as pa
import pyarrow.compute as pc

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.lazy import require_library

Library = Literal["pandas", "polars"]
LIBRARIES: tuple[Library, ...] = ("pandas", "polars")
DOING = "making a data frame"


def require(library: str) -> Any:
    """Import a library of data frames.

    Raises:
        InputError: It is none of the known ones, or not installed.
    """
    if library not in LIBRARIES:
        raise InputError(DOING, f"frames={library!r}", "no such library", f"the libraries are {' and '.join(LIBRARIES)}")
    other = next(name for name in LIBRARIES if name != library)
    do_this = f"install the extra [notebook], or pip install {library}; frames={other!r} gives frames of {other}"
    return require_library(library, DOING, f"frames={library!r}", do_this)


def frame_of(table: pa.Table, library: Library) -> Any:
    """Return a table as a frame of a library; text columns of few values become categories.

    Raises:
        InputError: The library is not installed.
    """
    found = require(library)
    return table.to_pandas() if library == "pandas" else found.from_arrow(table)


def valid_only(table: pa.Table) -> pa.Table:
    """Return a table of rollouts in which a metric that is not valid has no value.

    The column ``NAME_valid`` of each metric ``NAME`` stays.
    """
    for name in [column.removesuffix("_valid") for column in table.column_names if column.endswith("_valid")]:
        empty = pa.scalar(None, table[name].type)
        kept = pc.if_else(pc.fill_null(table[f"{name}_valid"], False), table[name], empty)
        table = table.set_column(table.column_names.index(name), name, kept)
    return table


def summary_table(summary: Mapping[str, Any]) -> pa.Table:
    """Return ``metrics`` of a summary, one row a renderer and metric."""
    rows = []
    for renderer, metrics in (summary.get("metrics") or {}).items():
        for metric, entry in metrics.items():
            low, high = _ends(entry.get("ci95_clustered"))
            facts = {key: entry.get(key) for key in ("mean", "ci95", "n_rollouts", "n_scenes", "unit", "direction")}
            rows.append({"renderer": renderer, "metric": metric, **facts, "ci95_low": low, "ci95_high": high})
    return pa.Table.from_pylist(rows, SUMMARY)


def paired_table(summary: Mapping[str, Any]) -> pa.Table:
    """Return the paired differences of a summary, against the baseline and against a fixer's base, one row each."""
    rows = []
    for kind in ("paired", "paired_with_base"):
        for renderer, metrics in (summary.get(kind) or {}).items():
            for metric, entry in metrics.items():
                low, high = _ends(entry.get("ci95"))
                facts = {key: entry.get(key) for key in ("baseline", "diff", "p_value", "verdict")}
                rows.append({"renderer": renderer, "metric": metric, **facts, "ci95_low": low, "ci95_high": high})
    return pa.Table.from_pylist(rows, PAIRED)


SUMMARY = pa.schema(
    [
        ("renderer", pa.string()),
        ("metric", pa.string()),
        ("mean", pa.float64()),
        ("ci95", pa.float64()),
        ("ci95_low", pa.float64()),
        ("ci95_high", pa.float64()),
        ("n_rollouts", pa.int64()),
        ("n_scenes", pa.int64()),
        ("unit", pa.string()),
        ("direction", pa.string()),
    ]
)
PAIRED = pa.schema(
    [
        ("renderer", pa.string()),
        ("baseline", pa.string()),
        ("metric", pa.string()),
        ("diff", pa.float64()),
        ("ci95_low", pa.float64()),
        ("ci95_high", pa.float64()),
        ("p_value", pa.float64()),
        ("verdict", pa.string()),
    ]
)


def _ends(interval: Sequence[float | None] | None) -> tuple[float | None, float | None]:
    return (interval[0], interval[1]) if interval is not None else (None, None)
