"""What a page replays, as JSON: an index of the run, and one document for each cell."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from alpasim_plugin.core.errors import InputError, SimrunError
from alpasim_plugin.core.types import CameraSpec, RolloutLog
from alpasim_plugin.log import read_asl
from alpasim_plugin.run_folder.reader import read_json
from alpasim_plugin.run_folder.rows import Rollout
from alpasim_plugin.run_folder.schema import LOG_NAME, WHY_NAME
from alpasim_plugin.viewer.cells import WatchedCell
from alpasim_plugin.viewer.drive_data import Place, Tracks, drive_data, map_data, plans_part, recorded_drive
from alpasim_plugin.viewer.pictures import NO_FRAMES, Fineness, encoded, sources
from alpasim_plugin.viewer.trust_data import cells_by_time, frame_rows
from evaluators.opening import Run
from evaluators.report.flips import FLIPS_NAME, baseline_of, key_of_entry
from evaluators.report.rollouts import clock_zero_us

DOING = "reading a rollout to watch"


Logs = Mapping[str, RolloutLog | SimrunError | None]  # folder of a rollout -> its log, or why it cannot be read


def read_logs(run: Run, cell: WatchedCell) -> Logs:
    """Read the logs of a cell's finished rollouts: their own, or those that they were scored from; None where neither is there."""
    return {rollout.path: _read_log(run, rollout) for rollout in cell.rollouts if rollout.ok}


def _read_log(run: Run, rollout: Rollout) -> RolloutLog | SimrunError | None:
    path = run.file_of(rollout, LOG_NAME)
    if path is None:
        stated = run.manifest(rollout).get("log")  # as it was named to simrun score, so from the same working directory
        path = None if stated is None else Path(str(stated))
    try:
        return read_asl(path) if path is not None and path.is_file() else None
    except SimrunError as error:
        return error  # the page says so in this rollout's place; the others are still shown


def cell_data(run: Run, cell: WatchedCell, logs: Logs, fine: Fineness | None, camera: str | None = None) -> dict[str, Any]:
    """Return everything that a page shows of a cell.

    Args:
        run: The run.
        cell: One of its cells.
        logs: Its logs.
        fine: How finely camera frames are kept; None for none.
        camera: The camera whose frames are kept; None is all.

    Raises:
        InputError: A file is damaged, or the run has no map of the scene.
    """
    content = run.scene_data(cell.scene)
    if content is None:
        found = f"no file of scene {cell.scene} in {run.folder / 'scenes'}"
        raise InputError(DOING, cell.name, found, "make the run again; runs of earlier versions kept no maps")
    recorded = recorded_drive(content, cell.scene)
    place = Place(recorded[0], clock_zero_us(content, _first_us(run, cell, logs)))
    tracks = Tracks()
    drives: list[dict[str, Any]] = []
    for rollout in cell.rollouts:
        if not rollout.ok:
            drives.append({"renderer": cell.side(rollout), "failed": f"{rollout.failure_class}: {rollout.failure}"})
            continue
        log = logs[rollout.path]
        if isinstance(log, SimrunError):
            drives.append({"renderer": cell.side(rollout), "failed": f"its log cannot be read: {log.found}"})
            continue
        facts = frame_rows(run, rollout)
        drive = {"renderer": cell.side(rollout)} | drive_data(run, rollout, log, content, place, tracks, facts)
        drive |= {"why": run.href(rollout, WHY_NAME) or ""}
        if fine is not None:
            kept = [one for one in sources(run, rollout, log) if camera in (None, one.camera)]
            drive["cameras"] = [encoded(one, fine, place.zero_us) for one in kept]
            known = {} if log is None else {camera.name: camera for camera in log.info["cameras"]}
            for one in drive["cameras"]:
                cells = {place.ms([t_us])[0]: text for t_us, text in cells_by_time(facts, one["name"]).items()}
                if cells:
                    one["trust"] = [cells.get(t, "") for t in one["t"]]
                if one["name"] in known:
                    one["lens"] = lens_data(known[one["name"]], one["width"])
            drive["no_frames"] = "" if kept else no_frames(run.manifest(rollout), log is not None, camera)
        drives.append(drive)
    ends = [drive["ego"]["t"][-1] for drive in drives if "ego" in drive]
    return {
        "id": cell.id,
        "map": map_data(content, recorded, place),
        "users": tracks.all,
        "drives": drives,
        "parts": plans_part(_flip_entries(run, cell), place, cell.by_policy),
        "end": max([*ends, 1]),
        "warmup": round(int(content.get("warmup_us") or 0) / 1000),
        "origin": place.origin.tolist(),
        "zero_us": place.zero_us,
    }


def lens_data(camera: CameraSpec, width_px: int) -> dict[str, Any]:
    """Return what projects rig coordinates into a picture of at most this width: fx, fy, cx, cy, and the mounting, 3 rows of 4."""
    scale = min(1.0, width_px / camera.width)
    k = [round(float(camera.K[at]) * scale, 3) for at in ((0, 0), (1, 1), (0, 2), (1, 2))]
    return {"k": k, "T": camera.T_rig_camera[:3].round(5).ravel().tolist()}


def _first_us(run: Run, cell: WatchedCell, logs: Logs) -> int:
    """Return the time of a cell's first logged pose."""
    firsts = [int(log.ego.t_us[0]) for log in logs.values() if isinstance(log, RolloutLog)]
    tables = (run.steps_of(rollout)["t_us"] for rollout in cell.rollouts if logs.get(rollout.path, "") is None)
    return min([*firsts, *(min(t.to_pylist()) for t in tables if len(t))], default=0)


def no_frames(manifest: Mapping[str, Any], has_log: bool, camera: str | None) -> str:
    """Say why a rollout has no pictures, and how to get them."""
    if not has_log and manifest.get("log"):
        return f"The log that this rollout was scored from is not at {manifest['log']}. Run simrun view where simrun score was run."
    return NO_FRAMES if camera is None else f"This rollout has no frames of a camera {camera}."


def index_data(run: Run, cells: Sequence[WatchedCell], here: Sequence[WatchedCell], state: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a page must know before it shows a cell.

    Args:
        run: The run.
        cells: All cells that were asked for, the most telling first.
        here: Those whose documents the page has or can get.
        state: ``live``, ``notes`` (what was left out, one sentence each), ``report`` (its address, or "") and, of a run that goes on,
            ``done`` and ``planned``.
    """
    ids, by_policy = {cell.id for cell in here}, any(cell.by_policy for cell in cells)
    units = {name: facts for table in (run.summary.get("metrics") or {}).values() for name, facts in table.items()}
    metrics = {}
    for name in run.table.ordered({*run.table, *units}):
        metric, stated = run.table.shown(name), units.get(name) or {}
        metrics[name] = {"unit": metric.unit or str(stated.get("unit") or ""), "help": metric.help, "flag": metric.is_flag}
    return {
        "run": run.folder.resolve().name,
        "renderers": run.policies if by_policy else run.renderers,
        "baseline": next((cell.side(flip.base) for cell in cells for flip in cell.flips), baseline_of(run)),
        "first_curves": run.table.first_curves(),
        "metrics": metrics,
        "cells": [
            {
                "id": cell.id,
                "scene": cell.scene,
                "policy": cell.policy,
                "seed": cell.seed,
                "take": cell.take,
                "interest": cell.interest,
                "outcomes": cell.outcomes(),
                "flips": [{"renderer": cell.side(flip.other), "was": flip.was, "now": flip.now, "tone": flip.tone} for flip in cell.flips],
                "here": cell.id in ids,
            }
            for cell in cells
        ],
        **state,
    }


def _flip_entries(run: Run, cell: WatchedCell) -> list[Mapping[str, Any]]:
    path = run.folder / FLIPS_NAME
    if not cell.flips or not path.is_file():
        return []
    keys = {flip.key for flip in cell.flips}
    entries = read_json(path).get("cells") or []
    return [entry for entry in entries if key_of_entry(entry) in keys]
