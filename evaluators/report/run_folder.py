"""Read a run folder into plain records; nothing here renders, scores or writes.

The report is a pure reader: it works on a folder that was copied from another machine, without scenario files or weights.
"""

from __future__ import annotations

import operator
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import cached_property, reduce
from pathlib import Path
from typing import Any, overload
from urllib.parse import quote

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as pads

from alpasim_plugin.io.reading import parsing, read_json_as, read_json_object
from alpasim_plugin.io.reading.tables import Kind, check_parquet, read_parquet
from evaluators.metrics import declare_from
from evaluators.report.shapes import RunInfo, SceneFile, Summary

DOING = "reading a run folder"
ROLLOUTS = "rollouts.parquet"
AGAIN = "give a folder written by simrun run or simrun score, or write it again with the same command and --resume"
ROLLOUT_COLUMNS: dict[str, Kind] = {"renderer": "text", "policy": "text", "scene": "text", "seed": "integer", "status": "text"}
STEP_COLUMNS: dict[str, Kind] = {**ROLLOUT_COLUMNS, "t_us": "integer", "metric": "text", "value": "number", "valid": "flag"}
del STEP_COLUMNS["status"]
KEY_COLUMNS = ("renderer", "policy", "scene", "seed")
ROW_COLUMNS = (*KEY_COLUMNS, "status", "failure_class", "failure", "path", "wall_s", "frames", "steps")
TEXT_AS_CODES = pads.ParquetFileFormat(dictionary_columns={"renderer", "policy", "scene", "metric"})
SEPARATORS = ("/", "|", " ", ":", "+")  # how a summary may join renderer and policy into one key


@dataclass(frozen=True)
class Rollout:
    """One row of ``rollouts.parquet``.

    Attributes:
        metrics: Rollout values; None where the metric is invalid or was not computed.
        path: Folder of the rollout relative to the run folder, POSIX separators.
    """

    renderer: str
    policy: str
    scene: str
    seed: int
    status: str
    failure_class: str = ""
    failure: str = ""
    path: str = ""
    wall_s: float | None = None
    frames: int | None = None
    steps: int | None = None
    metrics: Mapping[str, float | None] = field(default_factory=dict)

    @property
    def ok(self) -> bool:
        """Return whether the rollout ran to its end."""
        return self.status == "ok"

    @property
    def cell(self) -> tuple[str, str, str, int]:
        """Give the key renderer, policy, scene, seed."""
        return (self.renderer, self.policy, self.scene, self.seed)

    def flag(self, *names: str) -> bool:
        """Return whether any of the named 0/1 metrics is 1."""
        return any((self.metrics.get(name) or 0.0) >= 0.5 for name in names)


class StoredRollouts(Sequence[Rollout]):
    """The rows of ``rollouts.parquet``, read when the first one is asked for: what only needs columns never makes them.

    Args:
        path: The file.
    """

    def __init__(self, path: Path) -> None:
        self._path = path

    @cached_property
    def _rows(self) -> tuple[Rollout, ...]:
        table = read_parquet(self._path, DOING, ROLLOUT_COLUMNS, AGAIN)
        with parsing(DOING, self._path, AGAIN, "rows that are none of a run"):
            return rollouts_of_table(table)[0]

    def __len__(self) -> int:
        return len(self._rows)

    @overload
    def __getitem__(self, index: int) -> Rollout: ...
    @overload
    def __getitem__(self, index: slice) -> tuple[Rollout, ...]: ...
    def __getitem__(self, index: int | slice) -> Rollout | tuple[Rollout, ...]:
        return self._rows[index]

    def __iter__(self) -> Iterator[Rollout]:
        return iter(self._rows)


@dataclass(frozen=True)
class Run:
    """A run folder; rollouts, steps and scenes are read on demand.

    Attributes:
        info: ``run.json``.
        summary: ``summary.json``.
        rollouts: Rows of ``rollouts.parquet``.
        metric_names: Rollout metrics in the column order of ``rollouts.parquet``.
    """

    folder: Path
    info: Mapping[str, Any]
    summary: Mapping[str, Any]
    rollouts: Sequence[Rollout]
    metric_names: tuple[str, ...]

    @property
    def renderers(self) -> list[str]:
        """List renderers in the order of the command."""
        return _ordered(self.info.get("renderers"), (r.renderer for r in self.rollouts))

    @property
    def policies(self) -> list[str]:
        """List policies in the order of the command."""
        return _ordered(self.info.get("policies"), (r.policy for r in self.rollouts))

    @property
    def scenes(self) -> list[str]:
        """List scene ids in the order of ``run.json``."""
        return _ordered(self.info.get("scenes"), (r.scene for r in self.rollouts))

    @property
    def scenes_asked(self) -> list[str]:
        """List what the command named as scenarios: paths that a command may name again."""
        scenes = (self.info.get("scenes") or {}).values()
        return list(dict.fromkeys(str((scene.get("ref") or {}).get("path")) for scene in scenes if (scene.get("ref") or {}).get("path")))

    @property
    def variants(self) -> list[str]:
        """List the columns of the result tables: the keys under which ``summary.json`` holds metrics."""
        return list(self.summary.get("metrics") or {}) or self.renderers

    def rollouts_of(self, variant: str) -> list[Rollout]:
        """List the rollouts of a summary key.

        Args:
            variant: A renderer's name, or renderer and policy joined by one of `SEPARATORS`.
        """
        exact = [r for r in self.rollouts if any(variant == f"{r.renderer}{s}{r.policy}" for s in SEPARATORS)]
        return exact or [r for r in self.rollouts if r.renderer == variant]

    @cached_property
    def by_scene(self) -> Mapping[str, Sequence[Rollout]]:
        """Give the rollouts of each scene."""
        found: dict[str, list[Rollout]] = {}
        for rollout in self.rollouts:
            found.setdefault(rollout.scene, []).append(rollout)
        return found

    @cached_property
    def _scene_files(self) -> dict[str, Path]:
        found: dict[str, Path] = {}
        for path in sorted((self.folder / "scenes").rglob("*.json")):
            scene_id = read_json(path).get("scene_id")
            if isinstance(scene_id, str):
                found[scene_id] = path
        return found

    def scene_path(self, scene: str) -> Path | None:
        """Find the file of a scene's map, independent of how slashes in its name were encoded; None where there is none."""
        return self._scene_files.get(scene)

    def scene_data(self, scene: str) -> Mapping[str, Any] | None:
        """Read a scene's map and logged drive; None where the run has no such file."""
        path = self.scene_path(scene)
        return None if path is None else read_json_as(SceneFile, path, DOING, do_this=AGAIN)

    def manifest(self, rollout: Rollout) -> Mapping[str, Any]:
        """Read a rollout's manifest; empty where the rollout did not get so far."""
        path = self.file_of(rollout, "manifest.json")
        return {} if path is None else read_json(path)

    def file_of(self, rollout: Rollout, name: str) -> Path | None:
        """Find a file in a rollout's folder; None where absent or where the path leaves the run folder."""
        if not rollout.path:
            return None
        path = self.folder / rollout.path / name
        return path if path.is_file() and path.resolve().is_relative_to(self.folder.resolve()) else None

    def href(self, rollout: Rollout, name: str = "") -> str | None:
        """Give a relative link to a rollout's folder or to a file in it; None where it does not exist."""
        if not rollout.path:
            return None
        target = self.folder / rollout.path / name
        if not target.exists() or not target.resolve().is_relative_to(self.folder.resolve()):
            return None
        return quote(target.relative_to(self.folder).as_posix()) + ("" if name else "/")

    def steps(self, metrics: Sequence[str], scenes: Sequence[str] | None = None, columns: Sequence[str] = ()) -> pa.Table:
        """Read the named series from ``steps.parquet``.

        Returns:
            A table with renderer, policy, scene, seed, t_us, metric, value, valid and ``columns``; empty without the file.
        """
        wanted = [*KEY_COLUMNS, "t_us", "metric", "value", "valid", *columns]
        path = self.folder / "steps.parquet"
        if not path.is_file():
            return pa.table({name: pa.array([], pa.string()) for name in wanted})
        keep = pc.field("metric").isin(list(metrics))
        if scenes is not None:
            keep = keep & pc.field("scene").isin(list(scenes))
        self._check_steps(path)
        with parsing(DOING, path, AGAIN, "no readable parquet"):
            return pads.dataset(path, format=TEXT_AS_CODES).to_table(columns=wanted, filter=keep)

    def steps_of(self, rollout: Rollout) -> pa.Table:
        """Read all series of one rollout, from the table in its own folder or else from the run's.

        Returns:
            A table with renderer, policy, scene, seed, t_us, metric, value, valid and reason; empty where neither exists.
        """
        own = self.file_of(rollout, "steps.parquet")
        path = own or self.folder / "steps.parquet"
        if not path.is_file():
            return pa.table({name: pa.array([], pa.string()) for name in (*STEP_COLUMNS, "reason")})
        self._check_steps(path)
        keys = zip(KEY_COLUMNS, rollout.cell, strict=True)
        keep = reduce(operator.and_, (pc.field(name) == value for name, value in keys)) if own is None else None
        with parsing(DOING, path, AGAIN, "no readable parquet"):
            return pads.dataset(path, format=TEXT_AS_CODES).to_table(columns=[*STEP_COLUMNS, "reason"], filter=keep)

    @cached_property
    def _steps_checked(self) -> set[Path]:
        return set()

    def _check_steps(self, path: Path) -> None:
        """Compare the table of steps with its columns, once."""
        if path not in self._steps_checked:
            check_parquet(path, DOING, STEP_COLUMNS, AGAIN)
            self._steps_checked.add(path)

    @cached_property
    def invalid_reasons(self) -> dict[tuple[str, str], str]:
        """Give per (renderer, metric) why rollouts have no valid value: the most frequent reason, from the ledger or else the steps."""
        found = self._step_reasons()
        for renderer, ledger in (self.summary.get("censoring") or {}).items():
            for metric, entry in (ledger.get("invalid") or {}).items():
                reasons = entry.get("reasons") or {}
                if reasons:
                    found[renderer, metric] = max(reasons, key=lambda reason: reasons[reason])
        return found

    def _step_reasons(self) -> dict[tuple[str, str], str]:
        path = self.folder / "steps.parquet"
        if not path.is_file():
            return {}
        self._check_steps(path)
        with parsing(DOING, path, AGAIN, "no readable parquet"):
            table = pads.dataset(path).to_table(columns=["renderer", "metric", "reason"], filter=~pc.field("valid"))
        if not table.num_rows:
            return {}
        counts = table.group_by(["renderer", "metric", "reason"]).aggregate([([], "count_all")]).sort_by("count_all")
        rows = counts.to_pylist()  # ascending: the most frequent reason is written last
        return {(row["renderer"], row["metric"]): row["reason"] for row in rows if row["reason"]}


Own = dict[str, tuple[npt.NDArray[np.int64], npt.NDArray[np.float64]]]  # metric -> (t_us (T,), value (T,)) of one rollout
Series = dict[tuple[str, str, str, int], Own]


def series_by_cell(table: pa.Table) -> Series:
    """Split a step table into valid, time-sorted series.

    Works on integer codes of the text columns: a run has millions of steps and few names.

    Returns:
        cell -> metric -> (``t_us (T,)``, ``value (T,)``).
    """
    table = table.filter(table["valid"]) if table.num_rows else table
    if not table.num_rows:
        return {}
    codes, names = zip(*(_coded(table[name]) for name in (*KEY_COLUMNS, "metric")), strict=True)
    t_us = table["t_us"].to_numpy().astype(np.int64, copy=False)
    value = table["value"].to_numpy().astype(np.float64, copy=False)
    group = np.zeros(len(t_us), np.int64)
    for code, values in zip(codes, names, strict=True):
        group = group * len(values) + code
    order = np.lexsort((t_us, group))
    group, t_us, value = group[order], t_us[order], value[order]
    starts = np.flatnonzero(np.diff(group, prepend=-1))
    stops = np.append(starts[1:], len(group))
    found: Series = {}
    for start, stop in zip(starts, stops, strict=True):
        row = order[start]
        renderer, policy, scene, seed, metric = (values[code[row]] for code, values in zip(codes, names, strict=True))
        found.setdefault((renderer, policy, scene, int(seed)), {})[metric] = (t_us[start:stop], value[start:stop])
    return found


def _coded(column: pa.ChunkedArray) -> tuple[npt.NDArray[np.int64], list[Any]]:
    """Return per row the index into the list of distinct values, and that list."""
    coded = column.combine_chunks()
    if isinstance(coded, pa.ChunkedArray):  # several chunks too large for one
        coded = pa.concat_arrays(coded.chunks)
    if not pa.types.is_dictionary(coded.type):
        coded = coded.dictionary_encode()
    return coded.indices.to_numpy(zero_copy_only=False).astype(np.int64, copy=False), coded.dictionary.to_pylist()


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object of a run folder.

    Raises:
        InputError: Absent, not JSON, or not an object.
    """
    return read_json_object(path, DOING, do_this=AGAIN)


def reporting(run: Run) -> AbstractContextManager[None]:
    """Give what makes a report of a run that says something impossible an error of that run, and not a traceback."""
    return parsing("writing a report", run.folder, AGAIN, "a run from which no report can be made")


def read_run(run_dir: Path | str) -> Run:
    """Read a run folder.

    Args:
        run_dir: Folder with ``run.json``, ``rollouts.parquet`` and ``summary.json`` (docs/architecture.md).

    Raises:
        InputError: A file is absent or unreadable, or ``rollouts.parquet`` lacks a key column.
    """
    folder = Path(run_dir)
    info: Mapping[str, Any] = read_json_as(RunInfo, folder / "run.json", DOING, do_this=AGAIN)
    declare_from(info)
    summary: Mapping[str, Any] = read_json_as(Summary, folder / "summary.json", DOING, do_this=AGAIN)
    path = folder / ROLLOUTS
    return Run(folder, info, summary, StoredRollouts(path), metrics_in(check_parquet(path, DOING, ROLLOUT_COLUMNS, AGAIN)))


def metrics_in(columns: Sequence[str]) -> tuple[str, ...]:
    """Return the metrics among the columns of ``rollouts.parquet``: those with a column of validity."""
    return tuple(name.removesuffix("_valid") for name in columns if name.endswith("_valid"))


def rollouts_of_table(table: pa.Table) -> tuple[tuple[Rollout, ...], tuple[str, ...]]:
    """Return the rollouts of a table with the columns of ``rollouts.parquet``, and the names of their metrics."""
    names = metrics_in(table.column_names)
    rows = []
    for row in table.to_pylist():
        metrics = {m: _number(row.get(m)) if row[f"{m}_valid"] else None for m in names}
        rows.append(
            Rollout(
                renderer=str(row["renderer"]),
                policy=str(row["policy"]),
                scene=str(row["scene"]),
                seed=int(row["seed"]),
                status=str(row["status"]),
                failure_class=row.get("failure_class") or "",
                failure=row.get("failure") or "",
                path=(row.get("path") or "").strip("/"),
                wall_s=_number(row.get("wall_s")),
                frames=row.get("frames"),
                steps=row.get("steps"),
                metrics=metrics,
            )
        )
    return tuple(rows), names


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) and np.isfinite(value) else None


def _ordered(stated: Any, seen: Any) -> list[str]:
    names = [str(name) for name in stated] if stated else []
    return list(dict.fromkeys([*names, *seen]))
