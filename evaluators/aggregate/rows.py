"""Rollout rows: reading metric values out of them, flat (rollouts.parquet) or nested (manifests), and laying them out by cell."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from alpasim_plugin.types import F64, I64, Bool

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


def reason_of(row: Row, metric: str) -> str:
    """Return why a metric of a rollout is not valid, as far as the row knows."""
    nested = row.get("metrics")
    entry = nested.get(metric) if isinstance(nested, Mapping) else None
    if entry is None:
        return str(row.get(f"{metric}_reason") or "not given")
    return str(entry["reason"] if isinstance(entry, Mapping) else entry.reason)


def failure_of(row: Row) -> str:
    """Return the failure class of a rollout that did not run to its end."""
    error = row.get("error") or {}
    return str(row.get("failure_class") or error.get("failure_class") or "unknown")


def metric_names(rows: Iterable[Row]) -> list[str]:
    """Return the metrics that any row carries, in order of appearance."""
    names: dict[str, None] = {}
    seen: set[tuple[str, ...]] = set()
    for row in rows:
        nested = row.get("metrics")
        keys = tuple(nested if isinstance(nested, Mapping) else row)
        if keys in seen:
            continue
        seen.add(keys)
        flat = not isinstance(nested, Mapping)
        names.update(dict.fromkeys(key[: -len("_valid")] if flat else key for key in keys if not flat or key.endswith("_valid")))
    return list(names)


def is_ok(row: Row) -> bool:
    """Return whether a rollout ran to its end."""
    return bool(row.get("status", "ok") == "ok")


def renderers(rows: Iterable[Row]) -> list[str]:
    """Return the renderers in order of appearance."""
    return list(dict.fromkeys(str(row["renderer"]) for row in rows))


def cell_of(row: Row) -> Cell:
    """Return what identifies a rollout apart from its renderer."""
    return str(row["policy"]), str(row["scene"]), int(row["seed"])


@dataclass(frozen=True)
class RendererRows:
    """The rollouts of one renderer, sorted into cells."""

    rows: tuple[Row, ...]
    ok: Bool  # (R,) the rollout ran to its end
    cells: tuple[Cell, ...]  # (C,) sorted, of all rows
    cell: I64  # (R,) index into cells
    scene: I64  # (C,) number of the cell's scene, in the order of names

    @classmethod
    def of(cls, rows: Sequence[Row]) -> RendererRows:
        """Sort rows of one renderer."""
        keys = [cell_of(row) for row in rows]
        cells = tuple(sorted(set(keys)))
        place = {cell: i for i, cell in enumerate(cells)}
        scenes = {name: i for i, name in enumerate(sorted({c[1] for c in cells}))}
        return cls(
            tuple(rows),
            np.array([is_ok(row) for row in rows], dtype=bool),
            cells,
            np.array([place[key] for key in keys], dtype=np.int64),
            np.array([scenes[c[1]] for c in cells], dtype=np.int64),
        )

    def raw(self, metric: str) -> F64:
        """Return the metric of every row ``(R,)``, NaN where the rollout failed or the value is not valid."""
        if self._flat:
            key = f"{metric}_valid"
            found = np.array([row.get(metric) if row.get(key, True) else None for row in self.rows], dtype=np.float64)
        else:
            found = np.array([value_of(row, metric) for row in self.rows], dtype=np.float64)
        return np.where(self.ok & np.isfinite(found), found, np.nan)

    def values(self, metric: str) -> F64:
        """Return the metric of every cell ``(C,)``, NaN where missing; repeats of a cell are averaged first, as the paper does."""
        found = self.raw(metric)
        known = np.isfinite(found)
        count = np.bincount(self.cell[known], minlength=len(self.cells))
        total = np.bincount(self.cell[known], weights=found[known], minlength=len(self.cells))
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    def place_in(self, other: RendererRows) -> I64:
        """Return the index ``(C,)`` of each cell among another side's cells, -1 where it has no such cell."""
        if id(other) not in self._places:
            place = {cell: i for i, cell in enumerate(other.cells)}
            self._places[id(other)] = np.array([place.get(cell, -1) for cell in self.cells], dtype=np.int64)
        return self._places[id(other)]

    @cached_property
    def _places(self) -> dict[int, I64]:
        return {}

    @cached_property
    def rows_of(self) -> Mapping[Cell, Sequence[int]]:
        """Which rows belong to each cell."""
        found: dict[Cell, list[int]] = {}
        for i, c in enumerate(self.cell.tolist()):
            found.setdefault(self.cells[c], []).append(i)
        return found

    @cached_property
    def _flat(self) -> bool:
        return not any(isinstance(row.get("metrics"), Mapping) for row in self.rows)


def by_renderer(rows: Sequence[Row]) -> dict[str, RendererRows]:
    """Return each renderer's rollouts, in order of appearance."""
    split: dict[str, list[Row]] = {}
    for row in rows:
        split.setdefault(str(row["renderer"]), []).append(row)
    return {name: RendererRows.of(mine) for name, mine in split.items()}
