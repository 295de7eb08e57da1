"""``summary.json`` of a run folder, and of several as one: numbers, failures and times, made from
manifests and tables.
"""

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import real
from alpasim_plugin.core.files.atomic import write_json
from alpasim_plugin.core.json_types import JsonObject, JsonView
from alpasim_plugin.log.run_folder.manifests import read_run_json
from alpasim_plugin.log.run_folder.reader import table_path
from alpasim_plugin.log.run_folder.rows import rollouts_of_table
from alpasim_plugin.log.run_folder.schema import KEYS, ROLLOUTS, SUMMARY
from alpasim_plugin.log.run_folder.sides import AGAIN, RolloutTable
from alpasim_plugin.log.run_folder.writer import write_tables
from alpasim_plugin.runs.execute import Threads
from alpasim_plugin.runs.provenance import fixers
from evaluators import censoring
from evaluators.metrics import MetricTable
from evaluators.statistics.outcomes import outcome_table, times_of
from evaluators.statistics.summary import by_policy, numbers
from evaluators.statistics.variants import base_named, variants_in

SPEEDS = (
    "ms_per_frame_p50",
    "ms_per_frame_p95",
    "ms_per_frame_mean",
    "frames_per_s",
    "first_frame_ms",
)
# Members of run.json that are in the summary too.
IN_SUMMARY = ("pool", "repeat", "exit_code", "alpasim", "boundary")


def write_summary(
    root: Path, info: JsonView, manifests: Sequence[JsonObject], tables: Path
) -> JsonObject:
    """Write the tables and ``summary.json`` of a run folder and return the summary.

    Args:
        root: The run folder; the manifests' rollouts are below it.
        info: ``run.json``.
        manifests: One per rollout, in the order of the tables.
        tables: Folder to write to.
    """
    known = MetricTable.of_run(info)
    rollouts = write_tables(root, manifests, tables)
    done = [m for m in manifests if m["status"] == "ok"]
    failed = [m for m in manifests if m["status"] != "ok"]
    by_class = dict(Counter(m["error"]["failure_class"] for m in failed))
    cells = [{k: m[k] for k in (*KEYS, "path", "error")} for m in failed]
    summary = {
        "preset": info["preset"],
        "outcomes": outcome_table(rollouts_of_table(rollouts), times_of(manifests)),
        **numbers(
            RolloutTable.of_table(rollouts),
            info["config"].get("baseline"),
            info.get("bases") or {},
            known,
        ),
        "censoring": by_policy(_of_policies(manifests), lambda some: censoring(some, known)),
        "failures": {
            "n_failed": len(failed),
            "n_rollouts": len(manifests),
            "by_class": by_class,
            "cells": cells,
        },
        "copies": sum("copied_from" in m for m in manifests),
        "fixers": by_policy(_of_policies(done), fixers),
        "speed": by_policy(_of_policies([m for m in done if m.get("stage_ms")]), _speeds),
        **{name: info[name] for name in IN_SUMMARY if name in info},
    }
    write_json(tables / SUMMARY, summary)
    return summary


def _of_policies(manifests: Sequence[JsonObject]) -> dict[str, list[JsonObject]]:
    found: dict[str, list[JsonObject]] = {}
    for manifest in manifests:
        found.setdefault(manifest["policy"], []).append(manifest)
    return found


def _speeds(manifests: Sequence[JsonObject]) -> JsonObject:
    renderers = list(dict.fromkeys(m["renderer"] for m in manifests))
    return {name: speed([m for m in manifests if m["renderer"] == name]) for name in renderers}


def speed(manifests: Sequence[JsonObject]) -> JsonObject:
    """Return time per camera frame, all-in and by stage, over rollouts of one renderer.

    A frame's time is the sum of all stages of the loop between two frames; the time of a block is
    divided evenly among its frames. The frames of each rollout's first call are kept apart: that
    call may compile or fill caches.
    """
    stages: dict[str, list[float]] = {}
    first = []
    per_frame = []
    for manifest in manifests:
        frames = max(int(manifest["frames"]), 1)
        opening = max(int(manifest.get("first_call_frames", 1)), 1)
        total = np.zeros(frames)
        for stage, durations in manifest["stage_ms"].items():
            done = np.concatenate([[0.0], np.cumsum(durations)])
            total += np.diff(
                np.interp(np.linspace(0, len(durations), frames + 1), np.arange(len(done)), done)
            )
            stages.setdefault(stage, []).extend(
                durations[opening if len(durations) == frames else 1 :]
            )
        first.append(float(total[:opening].sum()))
        per_frame.extend(total[opening:].tolist())
    if not per_frame:
        return dict.fromkeys(SPEEDS) | {"stages": {}}
    all_ms = sum(sum(d) for d in stages.values())
    return {
        "ms_per_frame_p50": round(float(np.percentile(per_frame, 50)), 3),
        "ms_per_frame_p95": round(float(np.percentile(per_frame, 95)), 3),
        "ms_per_frame_mean": round(float(np.mean(per_frame)), 3),
        "frames_per_s": round(1e3 / float(np.mean(per_frame)), 2),
        "first_frame_ms": round(float(np.median(first)), 3),
        "stages": {name: _stage(d, all_ms, len(per_frame)) for name, d in stages.items() if any(d)},
    }


def _stage(durations: Sequence[float], all_ms: float, frames: int) -> dict[str, float]:
    """Return percentiles of the passes that took place (a frame from a draft has none through the
    fixer), share and mean per frame.
    """
    passes = [d for d in durations if d > 0.0]
    total = sum(durations)
    return {
        "p50_ms": round(float(np.percentile(passes, 50)), 3),
        "p95_ms": round(float(np.percentile(passes, 95)), 3),
        "share": round(total / all_ms, 4),
        "per_frame_ms": round(total / frames, 3),
    }


def pool_of(
    manifests: Sequence[JsonObject],
    threads: Threads,
    wall_s: float,
    before: JsonView | None,
) -> JsonView:
    """Return the throughput of all workers together, start-up included; a run that only reused
    rollouts keeps its earlier figures.
    """
    fresh = [m for m in manifests if not m.get("reused")]
    if not fresh and before:
        return before
    frames = sum(int(m.get("frames") or 0) for m in fresh)
    return {
        "workers": threads.workers,
        "threads_per_worker": threads.per_worker,
        "wall_s": round(wall_s, 3),
        "frames": frames,
        "frames_per_s_total": round(frames / wall_s, 2) if frames and wall_s > 0 else None,
    }


def aggregate_runs(runs: Sequence[Path], baseline: str | None = None) -> JsonObject:
    """Return the numbers of all rollouts of some runs, such as the parts of a night, in the form of
    ``summary.json``.

    A cell (renderer, policy, scene, seed) that several runs hold counts once, with the mean of its
    repeats, as in a single run.

    Args:
        runs: Finished run folders.
        baseline: RENDERER, POLICY or RENDERER/POLICY that the others are compared with; None is the
            first run's.

    Returns:
        ``runs``, ``preset``, ``metrics``, ``paired``, ``paired_with_base``, ``paired_policies``,
        ``failures`` (docs/statistics.md).

    Raises:
        InputError: A run is not finished or its tables are damaged; presets differ, or a scene or a
            metric is another one in another run; a folder is named twice; no run has the baseline.
    """
    for number, run in enumerate(runs):
        if real(run) in {real(other) for other in runs[:number]}:
            raise InputError(f"{run}: named twice", "Name every run once.")
    infos: dict[Path, JsonObject] = {}
    for run in runs:
        infos[run] = read_run_json(run)
        if not os.path.isfile(table_path(run, SUMMARY)):
            raise InputError(f"The run {run} is not finished.", AGAIN)
    _check_alike(infos)
    first = next(iter(infos.values()))
    table = RolloutTable.of_files([table_path(run, ROLLOUTS) for run in runs])
    if baseline is not None:
        base_named(baseline, variants_in(table), "the runs together")
    known = _joined(infos, table.metrics)
    bases = {
        name: base for info in infos.values() for name, base in (info.get("bases") or {}).items()
    }
    by_class = table.failures()
    return {
        "runs": [str(run) for run in runs],
        "preset": first["preset"],
        **numbers(table, baseline or first["config"].get("baseline"), bases, known),
        "failures": {
            "n_failed": sum(by_class.values()),
            "n_rollouts": table.n_rollouts,
            "by_class": by_class,
        },
    }


def joined_metrics(runs: Sequence[Path]) -> MetricTable:
    """Return what the metrics of some runs are."""
    return _joined({run: read_run_json(run) for run in runs}, ())


def _joined(infos: Mapping[Path, JsonView], metrics: Sequence[str]) -> MetricTable:
    first, *others = infos.items()
    known = MetricTable.of_run(first[1])
    for run, info in others:
        known = known.joined(MetricTable.of_run(info), metrics, f"{first[0]} and {run}")
    return known


def _check_alike(infos: Mapping[Path, JsonView]) -> None:
    """Refuse runs whose rollouts are not of one kind.

    Raises:
        InputError: Presets differ, or a scene's content does.
    """
    seen: dict[str, tuple[str, Path]] = {}
    first, kind = next((run, info["preset"]) for run, info in infos.items())
    for run, info in infos.items():
        if info["preset"] != kind:
            raise InputError(
                f"{first} and {run}: presets {kind!r} and {info['preset']!r}",
                "give the command of one run again with --preset",
            )
        for scene, facts in info["scenes"].items():
            content = str(facts.get("content_hash") or "")
            other, where = seen.setdefault(scene, (content, run))
            if other != content:
                raise InputError(
                    f"{where} and {run}: scene {scene} with another content",
                    "aggregate runs of the same scene files",
                )
