"""Rollout rows: reading metric values out of them, flat (rollouts.parquet) or nested (manifests), and averaging repeats of a cell."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from alpasim_plugin.types import F64

Row = Mapping[str, Any]
Cell = tuple[str, str, int]  # policy, scene, seed: what two renderers share


def value_of(row: Row, metric: str) -> float | None:
    """Return a metric of a row, None where absent, not valid, or not finite."""
    nested = row.get("metrics")
    if isinstance(nested, Mapping):
        entry = nested.get(metric)
        if entry is None:
            return None
        value, valid = (entry["value"], entry["valid"]) if isinstance(entry, Mapping) else (entry.value, entry.valid)
    else:
        value, valid = row.get(metric), row.get(f"{metric}_valid", True)
    if not valid or value is None:
        return None
    number = float(value)
    return number if np.isfinite(number) else None


def metric_names(rows: Iterable[Row]) -> list[str]:
    """Return the metrics that any row carries, in order of appearance."""
    names: dict[str, None] = {}
    for row in rows:
        nested = row.get("metrics")
        if isinstance(nested, Mapping):
            names.update(dict.fromkeys(nested))
        else:
            names.update(dict.fromkeys(key[: -len("_valid")] for key in row if key.endswith("_valid")))
    return list(names)


def is_ok(row: Row) -> bool:
    """Tell whether a rollout ran to its end."""
    return bool(row.get("status", "ok") == "ok")


def renderers(rows: Iterable[Row]) -> list[str]:
    """Return the renderers in order of appearance."""
    return list(dict.fromkeys(str(row["renderer"]) for row in rows))


def cell_of(row: Row) -> Cell:
    """Return what identifies a rollout apart from its renderer."""
    return str(row["policy"]), str(row["scene"]), int(row["seed"])


@dataclass(frozen=True)
class Column:
    """One metric of one renderer: one value per cell, repeats averaged."""

    cells: tuple[Cell, ...]
    values: F64  # (N,)

    @property
    def scenes(self) -> list[str]:
        """Scene of each value."""
        return [scene for _, scene, _ in self.cells]


def column(rows: Sequence[Row], metric: str) -> Column:
    """Collect the valid values of rows of one renderer; repeats of a scene-seed cell are averaged first, as the paper does."""
    values: dict[Cell, list[float]] = {}
    for row in rows:
        value = value_of(row, metric) if is_ok(row) else None
        if value is not None:
            values.setdefault(cell_of(row), []).append(value)
    cells = tuple(sorted(values))
    return Column(cells, np.array([sum(values[c]) / len(values[c]) for c in cells], dtype=np.float64))
