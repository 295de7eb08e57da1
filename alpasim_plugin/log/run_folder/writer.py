"""Write a run folder: be its only writer, remove what killed writers left, write scenes, and tables
from the rollouts' manifests.
"""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.atomic import (
    atomic_file,
    is_left_over,
    remove,
    write_bytes,
    write_json,
)
from alpasim_plugin.core.files.lock import one_writer
from alpasim_plugin.core.files.tables import read_parquet
from alpasim_plugin.core.geometry import yaw_from_quat
from alpasim_plugin.core.json_types import JsonObject, JsonView
from alpasim_plugin.core.types import F64, Actor, Scenario, Scene
from alpasim_plugin.log.run_folder.records import Manifest
from alpasim_plugin.log.run_folder.schema import (
    FILES,
    LOCK,
    ROLLOUTS,
    ROLLOUTS_TABLE,
    SCENES,
    STEPS,
    STEPS_NAME,
    STEPS_TABLE,
    SUMMARY,
    VALID,
    slug,
)

ACTOR_STEP_US = 250_000
GROUP_ROWS = 1 << 20  # rows of a row group: what is held in memory
CHUNK_ROWS = 4096  # rows that are held as dictionaries, which take ten times the memory


@contextmanager
def writing(root: Path) -> Iterator[None]:
    """Be the only writer of a run folder during the block; left-overs of killed writers are removed
    first.

    Args:
        root: The run folder; made if it does not exist.

    Raises:
        InputError: A folder in it is a link, through which others would be written.
        InfrastructureError: Another process writes the folder, or it is read-only.
    """
    with one_writer(root / LOCK, f"folder {root}") as held:
        for path in root.iterdir():
            if os.path.islink(path) and os.path.isdir(path):
                raise InputError(
                    f"{path}: a link to a folder", "move that folder to the place of the link"
                )
        remove_left_overs(root, held.since_ns)
        yield


def unfinish(root: Path) -> None:
    """Remove what makes a run folder a finished one, before anything in it changes."""
    for name in (SUMMARY, FILES):
        (root / name).unlink(missing_ok=True)


def remove_left_overs(root: Path, before_ns: int | None = None) -> list[Path]:
    """Remove temporary files and folders of processes that are gone; return them.

    Only names that simrun gives are touched, only those older than the lock, and only if no process
    of this machine has the number in the name. Run folders inside this one (forks) have writers of
    their own and are left alone.

    Args:
        root: A run folder whose lock is held, or a folder that only this machine's processes write.
        before_ns: When the lock was taken, by the clock of the file system; None: of any time.
    """
    removed = []
    for parent_name, folders, files in os.walk(root):
        parent = Path(parent_name)
        if parent != root and LOCK in files:
            folders.clear()
            continue
        for name in [*files, *folders]:
            if not is_left_over(name, of_any_machine=True):
                continue
            path = parent / name
            if before_ns is not None and path.lstat().st_mtime_ns >= before_ns:
                continue
            if os.path.isdir(path) and not os.path.islink(path):
                folders.remove(name)
            remove(path)
            removed.append(path)
    return removed


def rollout_rows(manifests: Sequence[Manifest]) -> list[JsonObject]:
    """Return one flat row per rollout: its key, its status, and every metric with its validity."""
    rows = []
    for manifest in manifests:
        error = manifest.error
        row: JsonObject = {
            "renderer": manifest.renderer,
            "policy": manifest.policy,
            "scene": manifest.scene,
            "seed": manifest.seed,
            "rollout": manifest.rollout,
            "status": manifest.status,
            "failure_class": None if error is None else error.failure_class,
            "failure": None if error is None else error.message,
            "path": manifest.path,
            "copied_from": manifest.copied_from,
            "wall_s": manifest.wall_s,
            "frames": manifest.frames,
            "steps": manifest.steps,
        }
        for name, entry in manifest.metrics.items():
            row[name] = entry.value
            row[name + VALID] = entry.valid
        rows.append(row)
    return rows


def rollout_table(manifests: Sequence[Manifest]) -> pa.Table:
    """Return the content of ``rollouts.parquet``, a row per manifest."""
    metrics = dict.fromkeys(name for manifest in manifests for name in manifest.metrics)
    of_logs = any(manifest.rollout is not None for manifest in manifests)
    schema = ROLLOUTS_TABLE.arrow(metrics, of_logs)
    starts = range(0, len(manifests), CHUNK_ROWS)
    batches = [
        pa.RecordBatch.from_pylist(rollout_rows(manifests[start : start + CHUNK_ROWS]), schema)
        for start in starts
    ]
    return pa.Table.from_batches(batches, schema)


def write_tables(root: Path, manifests: Sequence[Manifest], tables: Path) -> pa.Table:
    """Write ``rollouts.parquet`` and ``steps.parquet`` of a run folder and return the first.

    Args:
        root: The run folder; the manifests' rollouts are below it.
        manifests: One per rollout, in the order of the tables.
        tables: Folder to write to.

    Raises:
        InfrastructureError: The disk refuses.
    """
    rollouts = rollout_table(manifests)
    write_parquet(tables / ROLLOUTS, rollouts)
    parts = (root / manifest.path / STEPS_NAME for manifest in manifests if manifest.ok)
    path = tables / STEPS
    schema = STEPS_TABLE.arrow(of_logs="rollout" in rollouts.column_names)
    path.parent.mkdir(parents=True, exist_ok=True)
    with (
        atomic_file(path) as partial,
        pq.ParquetWriter(partial, schema, compression="zstd", write_page_checksum=True) as writer,
    ):
        held = []
        rows = 0
        for part in parts:
            held.append(read_parquet(part, {}))  # a few kilobytes each
            rows += len(held[-1])
            if rows >= GROUP_ROWS:
                writer.write_table(pa.concat_tables(held))
                held = []
                rows = 0
        writer.write_table(pa.concat_tables(held) if held else schema.empty_table())
    return rollouts


def write_steps(folder: Path, rows: Sequence[JsonView], of_logs: bool = False) -> None:
    """Write ``steps.parquet`` of a rollout's folder; ``of_logs`` as for `TableSchema.arrow`."""
    write_table(folder / STEPS_NAME, rows, STEPS_TABLE.arrow(of_logs=of_logs))


def copy_steps(source: Path, folder: Path, renderer: str) -> None:
    """Write ``steps.parquet`` of a rollout's folder ``source`` for the same rollout behind another
    renderer.
    """
    table = read_parquet(source / STEPS_NAME, {})
    index = table.schema.get_field_index("renderer")
    names = pa.repeat(renderer, len(table))
    write_parquet(folder / STEPS_NAME, table.set_column(index, "renderer", names))


def write_table(path: Path, rows: Sequence[JsonView], schema: pa.Schema) -> None:
    """Write rows as parquet atomically, in the order given."""
    write_parquet(path, pa.Table.from_pylist(rows, schema))


def write_parquet(path: Path, table: pa.Table) -> None:
    """Write a table as parquet atomically, compressed with zstd."""
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd", write_page_checksum=True)
    write_bytes(path, sink.getvalue().to_pybytes())


@dataclass(frozen=True)
class LoggedScene:
    """A scene that logs are scored against, with the facts that a report shows."""

    scene: Scene
    source: str
    content_hash: str
    notes: tuple[str, ...]
    actors: Sequence[Actor]
    world_origin: tuple[float, float, float]
    start_us: int = 0
    end_us: int = 0
    warmup_us: int = 0


def write_scene(root: Path, scenario: Scenario | LoggedScene) -> None:
    """Write the file of a scene into a run folder."""
    write_json(root / SCENES / f"{slug(scenario.scene.scene_id)}.json", scene_as_json(scenario))


def scene_as_json(scenario: Scenario | LoggedScene) -> JsonObject:
    """Return lanes, edges, crosswalks and the logged path in world metres, rounded to a
    centimetre.
    """
    scene = scenario.scene
    log = scenario.scene.ego_log
    lanes = [
        {
            "id": lane.lane_id,
            "kind": lane.kind,
            "centre": _xy(lane.centre),
            "left": _xy(lane.left) if lane.left is not None else None,
            "right": _xy(lane.right) if lane.right is not None else None,
            "markings": [lane.left_mark_type, lane.right_mark_type],
            "limit_mps": lane.speed_limit_mps,
        }
        for lane in scene.lane_map.lanes.values()
    ]
    keep = np.unique(np.linspace(0, len(log) - 1, min(len(log), 400)).astype(int))
    return {
        "scene_id": scene.scene_id,
        "source": scenario.source,
        "content_hash": scenario.content_hash,
        "notes": list(scenario.notes),
        "world_origin": list(scenario.world_origin),
        "start_us": scenario.start_us,
        "end_us": scenario.end_us,
        "warmup_us": scenario.warmup_us,
        "lanes": lanes,
        "road_edges": [_xy(edge) for edge in scene.lane_map.road_edges],
        "crosswalks": [_xy(ring) for ring in scene.lane_map.crosswalks],
        "ego_log": {"t_us": log.t_us[keep].tolist()}
        | {f"{axis}_m": np.round(log.xyz[keep, i], 3).tolist() for i, axis in enumerate("xy")},
        "measured": None if scene.measured is None else vars(scene.measured),
        "plan_ranges": [vars(entry) for entry in scene.plan_ranges],
        "vehicle": {
            "length_m": scene.vehicle.box.length_m,
            "width_m": scene.vehicle.box.width_m,
            "rear_axle_to_centre_m": scene.vehicle.rear_axle_to_centre_m,
        },
        "actors": [_actor(scenario, actor) for actor in scenario.actors],
    }


def _actor(scenario: Scenario | LoggedScene, actor: Actor) -> JsonObject:
    """Return what a drawing needs of a road user: its size, and its track every `ACTOR_STEP_US`
    while the scene runs.
    """
    track = actor.track
    inside = np.arange(len(track))
    if scenario.end_us > scenario.start_us:  # a scene that logs are scored against may not say
        is_inside = (track.t_us >= scenario.start_us) & (track.t_us <= scenario.end_us)
        inside = np.flatnonzero(is_inside)
    if actor.is_static:
        inside = inside[:1] if len(inside) else np.array([0])
    step = 1
    if len(track) > 1:
        period_us = max(1.0, float(np.median(np.diff(track.t_us))))
        step = max(1, round(ACTOR_STEP_US / period_us))
    keep = np.unique(np.concatenate([inside[::step], inside[-1:]]))
    yaw = yaw_from_quat(track.quat[keep])
    return {
        "id": actor.actor_id,
        "label": actor.label,
        "static": actor.is_static,
        "reacts": actor.behaviour.kind != "replay",
        "length_m": actor.box.length_m,
        "width_m": actor.box.width_m,
        "t_us": track.t_us[keep].tolist(),
        "x_m": np.round(track.xyz[keep, 0], 2).tolist(),
        "y_m": np.round(track.xyz[keep, 1], 2).tolist(),
        "yaw_rad": np.round(yaw, 3).tolist(),
    }


def _xy(line: F64) -> list[list[float]]:
    return np.round(line[:, :2], 2).tolist()
