"""Rollouts as columns: a table of any length, read one column at a time, gives the same sides as
rows in memory.

The key columns are read once and kept as codes (25 bytes a rollout). A metric is streamed in
batches when a statistic asks for it; as many metrics are kept as `KEPT_BYTES` hold. So a million
rollouts with fifty metrics fit in a few hundred megabytes, and more are only slower.
`alpasim_plugin.log.run_folder.sides.RendererRows` is the readable reference.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, overload

import numpy as np
import pyarrow as pa
import pyarrow.dataset as pads
import pyarrow.parquet as pq

from alpasim_plugin.core.reading import parsing
from alpasim_plugin.core.types import F64, I64, Bool
from alpasim_plugin.log.run_folder.schema import ROLLOUTS_TABLE, VALID, metrics_in
from alpasim_plugin.log.run_folder.sides import Cell, Side

DOING = "aggregating rollouts"
AGAIN = "write the tables of this run again with its own command"
TEXTS = ("renderer", "policy", "scene", "status", "failure_class")
KEPT_BYTES = 512 << 20  # metrics held in memory
BATCH_ROWS = 1 << 17

Reasons = Callable[[str, str], str]  # (renderer, metric)


def _unknown(renderer: str, metric: str) -> str:
    """Know no reason: a table of rollouts alone does not have it."""
    return ""


class RolloutTable:
    """The rollouts of one or several runs.

    Args:
        data: Rows with the columns of ``rollouts.parquet``, in memory or in files.
        where: What is read, for messages.
        reasons: Gives for a renderer and metric why values are not valid; empty where nobody knows.

    Attributes:
        metrics: Names, in the order of the columns.
        renderers, policies: Names, in order of appearance.
        n_rollouts: Rows.
    """

    def __init__(
        self, data: pa.Table | pads.Dataset, where: str, reasons: Reasons = _unknown
    ) -> None:
        self._data, self._where, self.reasons = data, where, reasons
        self.metrics = list(metrics_in(data.schema.names))
        self._kept: dict[str, F64] = {}
        codes: dict[str, list[I64]] = {name: [] for name in ("renderer", "policy", "scene")}
        self._names: dict[str, dict[str, int]] = {name: {} for name in TEXTS}
        seeds = []
        ok = []
        failures = []
        has_class = "failure_class" in data.schema.names
        for batch in self._batches(
            [*ROLLOUTS_TABLE.required, *(["failure_class"] if has_class else [])]
        ):
            for name, parts in codes.items():
                parts.append(_codes(batch.column(name), self._names[name]))
            seeds.append(
                batch.column("seed").to_numpy(zero_copy_only=False).astype(np.int64, copy=False)
            )
            ran = _codes(batch.column("status"), self._names["status"]) == self._names[
                "status"
            ].get("ok", -1)
            ok.append(ran)
            if has_class:
                failures.append(
                    _codes(batch.column("failure_class"), self._names["failure_class"])[~ran]
                )
        self._renderer, self._policy, self._scene = (
            _joined(codes[name]) for name in ("renderer", "policy", "scene")
        )
        self._seed, self._ok = _joined(seeds), np.concatenate(ok) if ok else np.zeros(0, dtype=bool)
        self._failed, self._failure = np.flatnonzero(~self._ok), _joined(failures)
        self.n_rollouts = len(self._ok)
        self.renderers, self.policies = (
            _in_order(codes, self._names[name])
            for name, codes in (("renderer", self._renderer), ("policy", self._policy))
        )

    @classmethod
    def of_files(cls, paths: Sequence[Path], reasons: Reasons = _unknown) -> RolloutTable:
        """Open ``rollouts.parquet`` of one or several runs; a metric that a run lacks is missing in
        all its rollouts.

        Raises:
            InputError: A file is no such table.
        """
        for path in paths:
            ROLLOUTS_TABLE.check(path, AGAIN)
        where = ", ".join(map(str, paths[:3])) + (
            f" and {len(paths) - 3} more" if len(paths) > 3 else ""
        )
        with parsing(where, AGAIN, "no tables that fit together"):
            schema = pa.unify_schemas(
                [pq.read_schema(path) for path in paths], promote_options="permissive"
            )
            coded = [
                pa.field(f.name, pa.dictionary(pa.int32(), pa.string())) if f.name in TEXTS else f
                for f in schema
            ]
            reader = pads.ParquetFileFormat(dictionary_columns=set(TEXTS) & set(schema.names))
            return cls(
                pads.dataset([str(path) for path in paths], schema=pa.schema(coded), format=reader),
                where,
                reasons,
            )

    @classmethod
    def of_table(cls, table: pa.Table) -> RolloutTable:
        """Take a table in memory."""
        return cls(table, "a table of rollouts")

    def sides(self, policy: str, named: str | None = None) -> dict[str, RendererColumns]:
        """Return RENDERER -> its rollouts with a policy, in order of appearance.

        Args:
            policy: Its name in the table.
            named: What cells call it; None: the same.
        """
        mine = self._policy == self._names["policy"][policy]
        names = _in_order(self._renderer[mine], self._names["renderer"])
        codes = self._names["renderer"]
        return {
            name: self._side(
                name, named or policy, np.flatnonzero(mine & (self._renderer == codes[name]))
            )
            for name in names
        }

    def failures(self) -> dict[str, int]:
        """Return how many rollouts did not run to their end, by failure class."""
        return dict(Counter(self.failure(row) for row in self._failed.tolist()))

    def failure(self, row: int) -> str:
        """Return the failure class of a rollout."""
        at = int(np.searchsorted(self._failed, row))
        code = int(self._failure[at]) if len(self._failure) else -1
        return (
            next((name for name, own in self._names["failure_class"].items() if own == code), "")
            or "unknown"
        )

    def column(self, metric: str) -> F64:
        """Return a metric of every rollout ``(N,)``, NaN where the rollout failed or the value is
        not valid or not finite.
        """
        if metric not in self._kept:
            values = np.full(self.n_rollouts, np.nan)
            at = 0
            for batch in self._batches([metric, metric + VALID] if metric in self.metrics else []):
                value = batch.column(metric).cast(pa.float64()).to_numpy(zero_copy_only=False)
                valid = (
                    batch.column(metric + VALID)
                    .cast(pa.bool_())
                    .fill_null(False)
                    .to_numpy(zero_copy_only=False)
                )
                values[at : at + len(batch)] = np.where(valid & np.isfinite(value), value, np.nan)
                at += len(batch)
            values[~self._ok] = np.nan
            while self._kept and (len(self._kept) + 1) * values.nbytes > KEPT_BYTES:
                del self._kept[next(iter(self._kept))]
            self._kept[metric] = values
        return self._kept[metric]

    def _batches(self, columns: Sequence[str]) -> Iterator[pa.RecordBatch]:
        if columns and isinstance(self._data, pa.Table):
            yield from self._data.select(columns).to_batches(BATCH_ROWS)
        elif columns:
            with parsing(self._where, AGAIN, "no readable parquet"):
                yield from self._data.scanner(
                    columns=list(columns), batch_size=BATCH_ROWS
                ).to_batches()

    def _side(self, renderer: str, policy: str, rows: I64) -> RendererColumns:
        scene_names = np.array(list(self._names["scene"]), dtype=object)
        present, number = np.unique(self._scene[rows], return_inverse=True)
        order = np.argsort(scene_names[present])
        rank = np.empty(len(present), dtype=np.int64)
        rank[order] = np.arange(len(present))
        seeds, seed = np.unique(self._seed[rows], return_inverse=True)
        keys, cell = np.unique(
            rank[number.reshape(-1)] * len(seeds) + seed.reshape(-1), return_inverse=True
        )
        cells = Cells(policy, tuple(scene_names[present][order].tolist()), seeds, keys)
        return RendererColumns(
            self, renderer, rows, self._ok[rows], cells, cell.reshape(-1), cells.scene
        )


@dataclass(frozen=True)
class Cells(Sequence[Cell]):
    """Sorted cells of one policy, kept as numbers.

    Attributes:
        policy: Its name.
        scenes: ``(G,)`` names, sorted.
        seeds: ``(K,)`` distinct, sorted.
        keys: ``(C,)`` number of the scene times K plus number of the seed, sorted.
    """

    policy: str
    scenes: tuple[str, ...]
    seeds: I64
    keys: I64

    @classmethod
    def of(cls, cells: Sequence[Cell]) -> Cells:
        """Return sorted cells of one policy."""
        policies, scenes, seeds = zip(*cells, strict=True) if cells else ((), (), ())
        names, own = tuple(sorted(set(scenes))), np.unique(np.array(seeds, dtype=np.int64))
        place = {name: i for i, name in enumerate(names)}
        keys = np.array([place[name] for name in scenes], dtype=np.int64) * max(len(own), 1)
        return cls(
            policies[0] if policies else "",
            names,
            own,
            keys + np.searchsorted(own, np.array(seeds, dtype=np.int64)),
        )

    @property
    def scene(self) -> I64:
        """Give the number of each cell's scene ``(C,)``."""
        return self.keys // max(len(self.seeds), 1)

    def __len__(self) -> int:
        return len(self.keys)

    @overload
    def __getitem__(self, index: int) -> Cell: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Cell, ...]: ...
    def __getitem__(self, index: int | slice) -> Cell | tuple[Cell, ...]:
        if isinstance(index, slice):
            return tuple(self[i] for i in range(*index.indices(len(self))))
        scene, seed = divmod(int(self.keys[index]), len(self.seeds))
        return self.policy, self.scenes[scene], int(self.seeds[seed])

    def find(self, cell: Cell) -> int | None:
        """Return the index of a cell; None where it is not there."""
        policy, scene, seed = cell
        number, own = bisect_left(self.scenes, scene), int(np.searchsorted(self.seeds, seed))
        at = int(np.searchsorted(self.keys, number * len(self.seeds) + own))
        return at if policy == self.policy and at < len(self) and self[at] == cell else None

    def place_in(self, other: Cells) -> I64:
        """Return the index ``(C,)`` of each cell among others, -1 where it is not there."""
        nowhere = np.full(len(self), -1, dtype=np.int64)
        if self.policy != other.policy or not len(self) or not len(other):
            return nowhere
        number = {name: i for i, name in enumerate(other.scenes)}
        scene = np.array([number.get(name, -1) for name in self.scenes], dtype=np.int64)[self.scene]
        own = np.minimum(np.searchsorted(other.seeds, self.seeds), len(other.seeds) - 1)
        seed = np.where(other.seeds[own] == self.seeds, own, -1)[self.keys % len(self.seeds)]
        wanted = scene * len(other.seeds) + seed
        at = np.minimum(np.searchsorted(other.keys, wanted), len(other) - 1)
        return np.where((scene >= 0) & (seed >= 0) & (other.keys[at] == wanted), at, nowhere)


@dataclass(frozen=True)
class RendererColumns(Side):
    """A side made of columns.

    Attributes:
        table: Where they are.
        renderer: Whose they are.
        rows: ``(R,)`` which rollouts of the table.
    """

    table: RolloutTable
    renderer: str
    rows: I64
    ok: Bool
    cells: Cells
    cell: I64
    scene: I64

    def raw(self, metric: str) -> F64:
        """Return the metric of every rollout; see `Side.raw`."""
        return self.table.column(metric)[self.rows]

    def _placed(self, other: Side) -> I64:
        return self.cells.place_in(
            other.cells if isinstance(other.cells, Cells) else Cells.of(other.cells)
        )

    def first_row(self, cell: Cell) -> int | None:
        """Return the first rollout of a cell."""
        at = self.cells.find(cell)
        return None if at is None else int(self._first_rows[at])

    def reason(self, row: int, metric: str) -> str:
        """Return why a metric of the renderer is not valid; see `RolloutTable.reasons`."""
        return self.table.reasons(self.renderer, metric) or "not given"

    def failure(self, row: int) -> str:
        """Return the failure class of a rollout."""
        return self.table.failure(int(self.rows[row]))

    @cached_property
    def _first_rows(self) -> I64:
        """Give the first rollout of each cell ``(C,)``."""
        return np.asarray(np.unique(self.cell, return_index=True)[1])


def _codes(column: Any, names: dict[str, int]) -> I64:
    """Return the code ``(n,)`` of each text, -1 for null; new texts are added to ``names``."""
    if not pa.types.is_dictionary(column.type):
        column = column.dictionary_encode()
    code_of = np.array(
        [names.setdefault(name, len(names)) for name in column.dictionary.to_pylist()] + [-1],
        dtype=np.int64,
    )
    return np.asarray(
        code_of[column.indices.fill_null(len(code_of) - 1).to_numpy(zero_copy_only=False)]
    )


def _in_order(codes: I64, names: Mapping[str, int]) -> list[str]:
    """Return the names that occur, in order of first appearance."""
    present, first = np.unique(codes, return_index=True)
    known = list(names)
    return [known[code] for code in present[np.argsort(first)].tolist()]


def _joined(parts: Sequence[I64]) -> I64:
    return np.concatenate(parts) if parts else np.zeros(0, dtype=np.int64)
