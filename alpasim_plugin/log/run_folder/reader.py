"""Read a run folder into plain records; nothing here renders, scores or writes.

It works on a folder that was copied from another machine, without scenario files or weights.
"""

import os
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import cached_property, reduce
from operator import and_
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Self
from urllib.parse import quote

import pyarrow as pa
import pyarrow.compute as pc

from alpasim_plugin.core.files import (
    inside,
    parsing,
    read_bytes,
    read_json_as,
    read_json_object,
    real,
)
from alpasim_plugin.core.files.limits import SOURCE_BYTES
from alpasim_plugin.core.json_types import JsonView
from alpasim_plugin.log.run_folder.check import inspect_run
from alpasim_plugin.log.run_folder.manifests import read_manifest, read_run_json
from alpasim_plugin.log.run_folder.records import Manifest, RunInfo
from alpasim_plugin.log.run_folder.rows import Rollout, StoredRollouts, rollouts_of_table
from alpasim_plugin.log.run_folder.schema import (
    AGAIN,
    KEYS,
    LOG_COLUMN,
    MANIFEST,
    ROLLOUTS,
    ROLLOUTS_TABLE,
    SCENES,
    STEPS,
    STEPS_NAME,
    STEPS_TABLE,
    SUMMARY,
    metrics_in,
)
from alpasim_plugin.log.run_folder.shapes import SceneFile
from alpasim_plugin.log.run_folder.writer import rollout_table

TRACEBACK_LINES = 3
STEP_COLUMNS = (*KEYS, "t_us", "metric", "value", "valid", LOG_COLUMN.name)
TEXT_AS_CODES = {"renderer", "policy", "scene", "metric", LOG_COLUMN.name}

REMADE: dict[Path, TemporaryDirectory[str]] = {}  # run folder -> tables that were made again


def table_path(root: Path, name: str) -> Path:
    """Return the file of a table of a run: in its folder, or where it was made again."""
    remade = REMADE.get(real(root))
    return root / name if remade is None else Path(remade.name, name)


@dataclass(frozen=True)
class Run:
    """A run folder; rollouts, steps and scenes are read on demand.

    Attributes:
        info: ``run.json``.
        rollouts: Rows of ``rollouts.parquet``.
        metric_names: Rollout metrics in the column order of ``rollouts.parquet``.
        planned: Rollouts in all, of an unfinished run.
        damage: What cannot be read of an unfinished run, one line each.
    """

    folder: Path
    info: RunInfo
    rollouts: Sequence[Rollout]
    metric_names: tuple[str, ...]
    planned: int = 0
    damage: tuple[str, ...] = ()

    @classmethod
    def read(cls, folder: Path) -> Self:
        """Read a run folder.

        Raises:
            InputError: ``run.json`` or ``rollouts.parquet`` is absent or unreadable, or the table
                is not as `ROLLOUTS_TABLE` says.
        """
        info = read_run_json(folder)
        path = table_path(folder, ROLLOUTS)
        rows = StoredRollouts(path)
        return cls(folder, info, rows, metrics_in(ROLLOUTS_TABLE.check(path)))

    @classmethod
    def read_so_far(cls, root: Path) -> Self:
        """Read a run folder that may be unfinished: then with the finished rollouts alone.

        Raises:
            InputError: It holds no run, or its description or its tables are damaged.
        """
        if os.path.exists(table_path(root, SUMMARY)):
            return cls.read(root)
        inspection = inspect_run(root)
        damaged = {damage.cell for damage in inspection.damage}
        with parsing(root, AGAIN, "manifests from which no table can be made"):
            whole = [manifest for manifest in inspection.manifests if manifest.path not in damaged]
            table = rollout_table(whole)
        return cls(
            root,
            read_run_json(root),
            rollouts_of_table(table),
            metrics_in(table.column_names),
            len(inspection.cells),
            tuple(map(str, inspection.damage)),
        )

    @property
    def _named(self) -> list[Rollout]:
        return [rollout for rollout in self.rollouts if rollout.is_named] or [*self.rollouts]

    @property
    def renderers(self) -> list[str]:
        """List renderers in the order of the command."""
        return _in_order(self.info.renderers, (rollout.renderer for rollout in self._named))

    @property
    def policies(self) -> list[str]:
        """List policies in the order of the command."""
        return _in_order(self.info.policies, (rollout.policy for rollout in self._named))

    @property
    def scenes(self) -> list[str]:
        """List scene ids in the order of ``run.json``."""
        return _in_order(self.info.scenes, (rollout.scene for rollout in self._named))

    def rollouts_of(self, variant: str) -> list[Rollout]:
        """List the rollouts of a summary key: a renderer's name, or `Rollout.variant`."""
        return [rollout for rollout in self.rollouts if rollout.variant == variant] or [
            rollout for rollout in self.rollouts if rollout.renderer == variant
        ]

    @cached_property
    def by_scene(self) -> Mapping[str, Sequence[Rollout]]:
        """Give the rollouts of each scene."""
        rollouts: dict[str, list[Rollout]] = {}
        for rollout in self.rollouts:
            rollouts.setdefault(rollout.scene, []).append(rollout)
        return rollouts

    @cached_property
    def _scene_files(self) -> dict[str, Path]:
        files: dict[str, Path] = {}
        for path in sorted((self.folder / SCENES).rglob("*.json")):
            scene_id = read_json(path).get("scene_id")
            if isinstance(scene_id, str):
                files[scene_id] = path
        return files

    def scene_path(self, scene: str) -> Path | None:
        """Find the file of a scene's map, independent of how slashes in its name were encoded; None
        where there is none.
        """
        return self._scene_files.get(scene)

    def scene_data(self, scene: str) -> JsonView | None:
        """Read a scene's map and logged drive; None where the run has no such file."""
        path = self.scene_path(scene)
        return None if path is None else read_json_as(SceneFile, path, do_this=AGAIN)

    def manifest(self, rollout: Rollout) -> Manifest | None:
        """Read a rollout's manifest; None where the rollout did not get so far.

        Raises:
            InputError: It is damaged.
        """
        path = self.file_of(rollout, MANIFEST)
        return None if path is None else read_manifest(path.parent)

    def file_of(self, rollout: Rollout, name: str) -> Path | None:
        """Find a file in a rollout's folder; None where absent or where the path leaves the run
        folder.
        """
        path = self._inside(rollout, name)
        return path if path is not None and os.path.isfile(path) else None

    def href(self, rollout: Rollout, name: str = "") -> str | None:
        """Give a relative link to a rollout's folder or to a file in it; None where it does not
        exist.
        """
        path = self._inside(rollout, name)
        return (
            None
            if path is None
            else quote(path.relative_to(self.folder).as_posix()) + ("" if name else "/")
        )

    def _inside(self, rollout: Rollout, name: str) -> Path | None:
        return inside(self.folder, f"{rollout.path}/{name}") if rollout.path else None

    def steps(self, metrics: Sequence[str], scenes: Sequence[str] | None = None) -> pa.Table:
        """Read the named series from ``steps.parquet``.

        Returns:
            A table with renderer, policy, scene, seed, t_us, metric, value and valid, of scored
            logs rollout too; empty without the file.
        """
        keep = pc.field("metric").isin(list(metrics))
        if scenes is not None:
            keep = keep & pc.field("scene").isin(list(scenes))
        return self._read_steps(table_path(self.folder, STEPS), STEP_COLUMNS, keep)

    def steps_of(self, rollout: Rollout) -> pa.Table:
        """Read all series of one rollout, from the table in its own folder or else from the run's.

        Returns:
            A table with renderer, policy, scene, seed, t_us, metric, value, valid and reason, of a
            scored log rollout too; empty where neither exists.
        """
        rollout_file = self.file_of(rollout, STEPS_NAME)
        keep = None
        if rollout_file is None:
            wanted = dict(zip(KEYS, rollout.cell, strict=True))
            wanted |= {LOG_COLUMN.name: rollout.log} if rollout.log else {}
            keep = reduce(and_, (pc.field(name) == value for name, value in wanted.items()))
        return self._read_steps(
            rollout_file or table_path(self.folder, STEPS), (*STEP_COLUMNS, "reason"), keep
        )

    def _read_steps(
        self, path: Path, columns: Sequence[str], keep: pc.Expression | None, coded: bool = True
    ) -> pa.Table:
        if not os.path.isfile(path):
            names = [name for name in columns if name != LOG_COLUMN.name]
            return STEPS_TABLE.arrow().empty_table().select(names)
        if path not in self._steps_checked:
            STEPS_TABLE.check(path)
            self._steps_checked.add(path)
        import pyarrow.dataset as pads  # with it comes pandas, where that is installed

        codes = TEXT_AS_CODES if coded else set[str]()
        with parsing(path, AGAIN, "no readable parquet"):
            rows = pads.dataset(path, format=pads.ParquetFileFormat(dictionary_columns=codes))
            of_logs = LOG_COLUMN.name in rows.schema.names
            names = [name for name in columns if of_logs or name != LOG_COLUMN.name]
            return rows.to_table(columns=names, filter=keep)

    @cached_property
    def _steps_checked(self) -> set[Path]:
        return set()

    @cached_property
    def invalid_reasons(self) -> dict[tuple[str, str], str]:
        """Give per (renderer, metric) why rollouts have no valid value: the most frequent reason of
        the steps.
        """
        columns = ["renderer", "metric", "reason"]
        table = self._read_steps(
            table_path(self.folder, STEPS), columns, ~pc.field("valid"), coded=False
        )
        counts = table.group_by(columns).aggregate([([], "count_all")]).sort_by("count_all")
        rows = counts.to_pylist()  # ascending: the most frequent reason is written last
        return {(row["renderer"], row["metric"]): row["reason"] for row in rows if row["reason"]}


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object of a run folder.

    Raises:
        InputError: Absent, not JSON, or not an object.
    """
    return read_json_object(path, do_this=AGAIN)


def last_output(path: Path) -> list[str]:
    """Return the end of what a rollout printed, its traceback, and the name of the file; nothing
    where there is none.
    """
    if not os.path.isfile(path):
        return []
    lines = read_bytes(path, SOURCE_BYTES).decode("utf-8", "replace").rstrip().splitlines()
    lines = [line for line in lines if line.strip(" ~^")]
    return [*(line.rstrip() for line in lines[-TRACEBACK_LINES:]), f"log {path}"]


def _in_order(stated: Iterable[str], driven: Iterable[str]) -> list[str]:
    """Return names, each once: those that ``run.json`` states, then others of the rollouts."""
    return list(dict.fromkeys([*stated, *driven]))


def reporting(run: Run) -> AbstractContextManager[None]:
    """Give what makes a report of a run that says something impossible an error of that run, and
    not a traceback.
    """
    return parsing(run.folder, AGAIN, "a run from which no report can be made")
