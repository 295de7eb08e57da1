"""Rollouts laid out by cell, for statistics; here from rows in memory, flat (rollouts.parquet) or
nested (manifests).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from alpasim_plugin.core.types import F64, I64, Bool
from alpasim_plugin.log.run_folder.schema import VALID, metrics_in

Row = Mapping[str, Any]
Cell = tuple[str, str, int]  # policy, scene, seed: what two renderers share


def value_of(row: Row, metric: str) -> float | None:
    """Return a metric of a row, None where absent, not valid, or not finite."""
    nested = row.get("metrics")
    if not isinstance(nested, Mapping):
        value, valid = row.get(metric), row.get(metric + VALID, True)
    else:
        value, valid, _ = _entry_of(nested, metric)
    return float(value) if valid and value is not None and np.isfinite(float(value)) else None


def reason_of(row: Row, metric: str) -> str:
    """Return why a metric of a rollout is not valid, as far as the row knows."""
    nested = row.get("metrics")
    if isinstance(nested, Mapping) and nested.get(metric) is not None:
        return str(_entry_of(nested, metric)[2])
    return str(row.get(f"{metric}_reason") or "not given")


def _entry_of(metrics: Mapping[str, Any], metric: str) -> tuple[Any, Any, Any]:
    """Return value, valid and reason of a metric of a manifest, or of a reduction that was not
    written yet.
    """
    entry = metrics.get(metric)
    if entry is None:
        return None, False, ""
    facts = entry if isinstance(entry, Mapping) else vars(entry)
    return facts["value"], facts["valid"], facts.get("reason", "")


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
        if keys not in seen:
            seen.add(keys)
            names.update(dict.fromkeys(keys if isinstance(nested, Mapping) else metrics_in(keys)))
    return list(names)


def is_ok(row: Row) -> bool:
    """Return whether a rollout ran to its end."""
    return bool(row.get("status", "ok") == "ok")


class Side(ABC):
    """The rollouts of one renderer, laid out by cell: what every statistic over rollouts reads.

    Attributes:
        ok: ``(R,)`` the rollout ran to its end.
        cells: ``(C,)`` of all rollouts, sorted.
        cell: ``(R,)`` index into ``cells``.
        scene: ``(C,)`` number of the cell's scene, in the order of names.
    """

    ok: Bool
    cells: Sequence[Cell]
    cell: I64
    scene: I64

    @abstractmethod
    def raw(self, metric: str) -> F64:
        """Return the metric of every rollout ``(R,)``, NaN where it failed or the value is not
        valid or not finite.
        """

    def place_in(self, other: Side) -> I64:
        """Return the index ``(C,)`` of each cell among another side's cells, -1 where it has no
        such cell.
        """
        if id(other) not in self._places:
            self._places[id(other)] = self._placed(other)
        return self._places[id(other)]

    @cached_property
    def _places(self) -> dict[int, I64]:
        return {}

    @abstractmethod
    def _placed(self, other: Side) -> I64: ...

    @abstractmethod
    def first_row(self, cell: Cell) -> int | None:
        """Return the first rollout of a cell; None where none was planned."""

    @abstractmethod
    def reason(self, row: int, metric: str) -> str:
        """Return why a metric of a rollout is not valid, as far as it is known."""

    @abstractmethod
    def failure(self, row: int) -> str:
        """Return the failure class of a rollout that did not run to its end."""

    def values(self, metric: str) -> F64:
        """Return the metric of every cell ``(C,)``, NaN where missing; repeats of a cell are
        averaged first, as the paper does.
        """
        found = self.raw(metric)
        known = np.isfinite(found)
        count = np.bincount(self.cell[known], minlength=len(self.cells))
        total = np.bincount(self.cell[known], weights=found[known], minlength=len(self.cells))
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    def why_missing(self, cell: Cell, metric: str, values: F64) -> str:
        """Return why there is no value for a cell, or "" where there is one; ``values`` as
        `Side.values` gives them.
        """
        row = self.first_row(cell)
        if row is None:
            return "not planned"
        if np.isfinite(values[self.cell[row]]):
            return ""
        return (
            f"not valid ({self.reason(row, metric)})"
            if self.ok[row]
            else f"failed ({self.failure(row)})"
        )


@dataclass(frozen=True)
class RendererRows(Side):
    """A side made of rows in memory: for small tables, and the reference of
    `alpasim_plugin.log.run_folder.columns`.
    """

    rows: tuple[Row, ...]
    ok: Bool
    cells: tuple[Cell, ...]
    cell: I64
    scene: I64

    @classmethod
    def of(cls, rows: Sequence[Row]) -> RendererRows:
        """Sort rows of one renderer."""
        keys = [(str(row["policy"]), str(row["scene"]), int(row["seed"])) for row in rows]
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
        """Return the metric of every row; see `Side.raw`."""
        found = np.array([value_of(row, metric) for row in self.rows], dtype=np.float64)
        return np.where(self.ok & np.isfinite(found), found, np.nan)

    def _placed(self, other: Side) -> I64:
        place = {cell: i for i, cell in enumerate(other.cells)}
        return np.array([place.get(cell, -1) for cell in self.cells], dtype=np.int64)

    def first_row(self, cell: Cell) -> int | None:
        """Return the first row of a cell."""
        return self._first_rows.get(cell)

    def reason(self, row: int, metric: str) -> str:
        """Return why a metric of a row is not valid."""
        return reason_of(self.rows[row], metric)

    def failure(self, row: int) -> str:
        """Return the failure class of a row."""
        return failure_of(self.rows[row])

    @cached_property
    def _first_rows(self) -> Mapping[Cell, int]:
        found: dict[Cell, int] = {}
        for i, c in enumerate(self.cell.tolist()):
            found.setdefault(self.cells[c], i)
        return found


def by_renderer(rows: Sequence[Row]) -> dict[str, RendererRows]:
    """Return each renderer's rollouts, in order of appearance."""
    split: dict[str, list[Row]] = {}
    for row in rows:
        split.setdefault(str(row["renderer"]), []).append(row)
    return {name: RendererRows.of(mine) for name, mine in split.items()}
