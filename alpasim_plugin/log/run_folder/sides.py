"""Rollouts laid out by cell, for statistics: from rows in memory, or from ``rollouts.parquet``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from numbers import Real
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from alpasim_plugin.core.files import parsing
from alpasim_plugin.core.types import F64, I64, Bool
from alpasim_plugin.log.run_folder.records import Manifest
from alpasim_plugin.log.run_folder.schema import KEYS, ROLLOUTS_TABLE, VALID, is_named, metrics_in

if TYPE_CHECKING:
    import pyarrow.dataset as pads

AGAIN = "Write the tables of this run again with its own command."

Row = Mapping[str, Any]  # of rollouts.parquet
Cell = tuple[str, str, int]  # policy, scene, seed: what two renderers share


@dataclass(frozen=True)
class RolloutValues:
    """One rollout as statistics read it.

    Attributes:
        cell: Policy, scene, seed.
        ok: It ran to its end.
        failure_class: Whose fault it is that it did not.
        values: METRIC -> value; None where it is not valid or not finite.
        reasons: METRIC -> why it is not valid, as far as it is known.
    """

    cell: Cell
    ok: bool
    failure_class: str
    values: Mapping[str, float | None]
    reasons: Mapping[str, str]

    @classmethod
    def of_manifest(cls, manifest: Manifest) -> RolloutValues:
        """Take the values of a manifest."""
        metrics = manifest.metrics
        return cls(
            cell=(manifest.policy, manifest.scene, manifest.seed),
            ok=manifest.ok,
            failure_class=manifest.failure_class,
            values={
                name: _finite(entry.value) if entry.valid else None
                for name, entry in metrics.items()
            },
            reasons={name: entry.reason for name, entry in metrics.items() if entry.reason},
        )

    @classmethod
    def of_row(cls, row: Row) -> RolloutValues:
        """Take the values of a row as ``rollouts.parquet`` has them.

        A caller's row may leave out METRIC_valid, where the value is valid, and may say why it is
        not in METRIC_reason.
        """
        names = [
            name
            for name, value in row.items()
            if value is None or isinstance(value, (Real, np.bool_))
        ]
        reasons = {name: row.get(f"{name}_reason") for name in names}
        return cls(
            cell=(str(row["policy"]), str(row["scene"]), int(row["seed"])),
            ok=row.get("status", "ok") == "ok",
            failure_class=row.get("failure_class") or "unknown",
            values={name: value_of(row, name) for name in names},
            reasons={name: str(reason) for name, reason in reasons.items() if reason},
        )


def value_of(row: Row, metric: str) -> float | None:
    """Return a metric of a row of ``rollouts.parquet``; None where absent, not valid, or not
    finite.
    """
    return _finite(row.get(metric)) if row.get(metric + VALID, True) else None


def _finite(value: float | None) -> float | None:
    """Return a number; None where it is missing or not finite."""
    return None if value is None or not np.isfinite(float(value)) else float(value)


def metric_names(rows: Iterable[Row]) -> list[str]:
    """Return the metrics that any row carries, in order of appearance."""
    names: dict[str, None] = {}
    for row in rows:
        names |= dict.fromkeys(metrics_in(row))
    return list(names)


@dataclass(frozen=True, eq=False)
class Side:
    """The rollouts of one renderer, laid out by cell: what every statistic over rollouts reads.

    Attributes:
        ok: ``(R,)`` the rollout ran to its end.
        cells: ``(C,)`` of all rollouts, sorted.
        cell: ``(R,)`` index into ``cells``.
        scene: ``(C,)`` number of the cell's scene, in the order of names.
        raw: Metric -> its value in every rollout ``(R,)``, NaN where the rollout failed or the
            value is not valid or not finite.
        reason: (rollout, metric) -> why the metric is not valid, as far as it is known.
        failure: Rollout -> failure class of one that did not run to its end.
    """

    ok: Bool
    cells: tuple[Cell, ...]
    cell: I64
    scene: I64
    raw: Callable[[str], F64]
    reason: Callable[[int, str], str]
    failure: Callable[[int], str]
    _places: dict[Side, I64] = field(default_factory=dict, init=False)

    @classmethod
    def laid_out(
        cls,
        keys: Sequence[Cell],
        ok: Bool,
        raw: Callable[[str], F64],
        reason: Callable[[int, str], str],
        failure: Callable[[int], str],
    ) -> Side:
        """Lay out rollouts by their cells; ``keys`` ``(R,)`` may repeat."""
        cells = tuple(sorted(set(keys)))
        number = {cell: i for i, cell in enumerate(cells)}
        _, scene = np.unique([scene for _, scene, _ in cells], return_inverse=True)
        cell = np.array([number[key] for key in keys], dtype=np.int64)
        return cls(ok, cells, cell, scene, raw, reason, failure)

    @classmethod
    def of(cls, rollouts: Sequence[RolloutValues]) -> Side:
        """Lay out rollouts of one renderer."""
        ok = np.array([rollout.ok for rollout in rollouts], dtype=bool)

        def raw(metric: str) -> F64:
            values = [rollout.values.get(metric) for rollout in rollouts]
            return np.where(ok, np.array(values, dtype=np.float64), np.nan)

        return cls.laid_out(
            [rollout.cell for rollout in rollouts],
            ok,
            raw,
            lambda number, metric: rollouts[number].reasons.get(metric, "not given"),
            lambda number: rollouts[number].failure_class,
        )

    def place_in(self, other: Side) -> I64:
        """Return the index ``(C,)`` of each cell among another side's cells, -1 where it has no
        such cell.
        """
        if other not in self._places:
            number = {cell: i for i, cell in enumerate(other.cells)}
            places = [number.get(cell, -1) for cell in self.cells]
            self._places[other] = np.array(places, dtype=np.int64)
        return self._places[other]

    @cached_property
    def first_row(self) -> Mapping[Cell, int]:
        """Give the first rollout of each cell."""
        numbers, rows = np.unique(self.cell, return_index=True)
        return {self.cells[i]: row for i, row in zip(numbers.tolist(), rows.tolist(), strict=True)}

    def values(self, metric: str) -> F64:
        """Return the metric of every cell ``(C,)``, NaN where missing; repeats of a cell are
        averaged first, as the paper does.
        """
        values = self.raw(metric)
        finite = np.isfinite(values)
        count = np.bincount(self.cell[finite], minlength=len(self.cells))
        total = np.bincount(self.cell[finite], weights=values[finite], minlength=len(self.cells))
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    def why_missing(self, cell: Cell, metric: str, values: F64) -> str:
        """Return why there is no value for a cell, or "" where there is one; ``values`` as
        `Side.values` gives them.
        """
        row = self.first_row.get(cell)
        if row is None:
            return "not planned"
        if np.isfinite(values[self.cell[row]]):
            return ""
        if not self.ok[row]:
            return f"failed ({self.failure(row)})"
        return f"not valid ({self.reason(row, metric)})"


def flat_row(row: Row) -> Row:
    """Return a row as ``rollouts.parquet`` has it, of one whose values lie under ``metrics``."""
    nested = row.get("metrics")
    if not isinstance(nested, Mapping):
        return row
    flat = {key: value for key, value in row.items() if key != "metrics"}
    for name, entry in nested.items():
        flat[name] = entry["value"]
        flat[name + VALID] = entry.get("valid", True)
        flat[f"{name}_reason"] = entry.get("reason", "")
    return flat


def by_renderer(rows: Sequence[Row]) -> dict[str, Side]:
    """Return each renderer's rollouts, of rows of ``rollouts.parquet``, in order of appearance."""
    rollouts: dict[str, list[RolloutValues]] = {}
    for row in rows:
        rollouts.setdefault(str(row["renderer"]), []).append(RolloutValues.of_row(row))
    return {name: Side.of(of_renderer) for name, of_renderer in rollouts.items()}


class RolloutTable:
    """The rollouts of one or several runs; a metric is read when a statistic asks for it.

    Args:
        data: Rows with the columns of ``rollouts.parquet``, in memory or in files.
        location: What is read, for messages.
        reasons: (renderer, metric) -> why values are not valid; empty where that is unknown.

    Attributes:
        metrics: Names, in the order of the columns.
        renderers, policies: Names, in order of appearance; a log that cannot be read has none.
        n_rollouts: Rows.
    """

    def __init__(
        self,
        data: pa.Table | pads.Dataset,
        location: str,
        reasons: Callable[[str, str], str] = lambda renderer, metric: "",
    ) -> None:
        self._data = data
        self._location = location
        self.reasons = reasons
        self._columns: dict[str, F64] = {}
        columns = self._data.schema.names
        self.metrics = list(metrics_in(columns))
        keys = self._read([*KEYS, "status"]).to_pydict()
        self._keys = list(zip(*(keys[name] for name in KEYS), strict=True))
        self.n_rollouts = len(self._keys)
        self._ok = np.array(keys["status"], dtype=object) == "ok"
        keys_by_row = zip(self._keys, self._ok, strict=True)
        named = [key for key, is_ok in keys_by_row if is_named(key, bool(is_ok))] or self._keys
        self.renderers = list(dict.fromkeys(key[0] for key in named))
        self.policies = list(dict.fromkeys(key[1] for key in named))
        self._failure_class = [None] * self.n_rollouts
        if "failure_class" in columns:
            self._failure_class = self._read(["failure_class"])[0].to_pylist()

    @classmethod
    def of_files(
        cls,
        paths: Sequence[Path],
        reasons: Callable[[str, str], str] = lambda renderer, metric: "",
    ) -> RolloutTable:
        """Open ``rollouts.parquet`` of one or several runs; a metric that a run lacks is missing in
        all its rollouts.

        Raises:
            InputError: A file is no such table.
        """
        import pyarrow.dataset as pads  # with it comes pandas, where that is installed

        for path in paths:
            ROLLOUTS_TABLE.check(path, AGAIN)
        location = ", ".join(map(str, paths))
        with parsing(location, AGAIN, "no tables that fit together"):
            schema = pa.unify_schemas(
                [pq.read_schema(path) for path in paths], promote_options="permissive"
            )
            data = pads.dataset([str(path) for path in paths], schema=schema, format="parquet")
        return cls(data, location, reasons)

    @classmethod
    def of_table(
        cls,
        table: pa.Table,
        reasons: Callable[[str, str], str] = lambda renderer, metric: "",
    ) -> RolloutTable:
        """Take a table in memory."""
        return cls(table, "a table of rollouts", reasons)

    def sides(self, policy: str, named: str | None = None) -> dict[str, Side]:
        """Return RENDERER -> its rollouts with a policy, in order of appearance.

        Args:
            policy: Its name in the table.
            named: What cells call it; None: the same.
        """
        rows: dict[str, list[int]] = {}
        for row, (renderer, row_policy, _, _) in enumerate(self._keys):
            if row_policy == policy:
                rows.setdefault(renderer, []).append(row)
        return {
            name: self._side(name, named or policy, np.array(indices))
            for name, indices in rows.items()
        }

    def failures(self) -> dict[str, int]:
        """Return how many rollouts did not run to their end, by failure class."""
        return dict(Counter(self._failure(row) for row in np.flatnonzero(~self._ok).tolist()))

    def column(self, metric: str) -> F64:
        """Return a metric of every rollout ``(N,)``, NaN where the rollout failed or the value is
        not valid or not finite.
        """
        if metric not in self._columns:
            values = np.full(self.n_rollouts, np.nan)
            if metric in self.metrics:
                number, flag = self._read([metric, metric + VALID]).columns
                value = number.cast(pa.float64()).to_numpy()
                is_valid = flag.cast(pa.bool_()).fill_null(False).to_numpy() & self._ok
                is_valid &= np.isfinite(value)
                values[is_valid] = value[is_valid]
            self._columns[metric] = values
        return self._columns[metric]

    def _failure(self, row: int) -> str:
        return self._failure_class[row] or "unknown"

    def _read(self, names: Sequence[str]) -> pa.Table:
        with parsing(self._location, AGAIN, "no readable parquet"):
            if isinstance(self._data, pa.Table):
                return self._data.select(list(names))
            return self._data.to_table(columns=list(names))

    def _side(self, renderer: str, policy: str, rows: I64) -> Side:
        keys = [(policy, *self._keys[row][2:]) for row in rows.tolist()]
        return Side.laid_out(
            keys,
            self._ok[rows],
            lambda metric: self.column(metric)[rows],
            lambda row, metric: self.reasons(renderer, metric) or "not given",
            lambda row: self._failure(int(rows[row])),
        )
