"""``summary.json`` of a run folder, and of several as one: numbers, failures and times, made from
manifests and tables.
"""

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import real
from alpasim_plugin.core.files.atomic import write_json
from alpasim_plugin.log.run_folder.manifests import read_run_json
from alpasim_plugin.log.run_folder.reader import table_path
from alpasim_plugin.log.run_folder.records import Manifest, Pool, RunInfo
from alpasim_plugin.log.run_folder.rows import rollouts_of_table
from alpasim_plugin.log.run_folder.schema import ROLLOUTS, SUMMARY, is_named
from alpasim_plugin.log.run_folder.sides import AGAIN, RolloutTable
from alpasim_plugin.log.run_folder.writer import write_tables
from alpasim_plugin.runs.execute import Threads
from alpasim_plugin.runs.provenance import fixers
from evaluators import censoring
from evaluators.metrics import MetricTable
from evaluators.results import (
    DriveCalls,
    FailedRollout,
    Failures,
    Slowing,
    Speed,
    StageSpeed,
    Summary,
    to_json,
)
from evaluators.statistics.outcomes import outcome_table, times_of
from evaluators.statistics.summary import by_policy, numbers
from evaluators.statistics.variants import base_named, variants_in


def write_summary(
    root: Path, info: RunInfo, manifests: Sequence[Manifest], tables: Path
) -> Summary:
    """Write the tables and ``summary.json`` of a run folder and return the summary.

    Args:
        root: The run folder; the manifests' rollouts are below it.
        info: ``run.json``.
        manifests: One per rollout, in the order of the tables.
        tables: Folder to write to.
    """
    rollouts = write_tables(root, manifests, tables)
    summary = summary_of(info, manifests, rollouts)
    write_json(tables / SUMMARY, to_json(summary))
    return summary


def summary_of(info: RunInfo, manifests: Sequence[Manifest], rollouts: pa.Table) -> Summary:
    """Return the results of a run.

    Args:
        info: ``run.json``.
        manifests: One per rollout, in the order of the tables.
        rollouts: The content of ``rollouts.parquet``.
    """
    metric_table = MetricTable.of_run(info.metrics)
    reasons = _invalid_reasons(manifests)
    table = RolloutTable.of_table(
        rollouts, lambda renderer, metric: reasons.get((renderer, metric), "")
    )
    means = numbers(table, info.baseline, info.bases, metric_table)
    of_policy = _of_policies(manifests)
    finished = {
        policy: [manifest for manifest in policy_manifests if manifest.ok]
        for policy, policy_manifests in of_policy.items()
    }
    return Summary(
        preset=info.preset,
        metrics=means.metrics,
        paired=means.paired,
        paired_with_base=means.paired_with_base,
        paired_policies=means.paired_policies,
        failures=failures_of(manifests),
        outcomes=outcome_table(rollouts_of_table(rollouts), times_of(manifests)),
        censoring=by_policy(
            {
                policy: censoring(policy_manifests, metric_table)
                for policy, policy_manifests in of_policy.items()
            }
        ),
        copies=sum(manifest.copied_from is not None for manifest in manifests),
        fixers=by_policy(
            {policy: fixers(policy_manifests) for policy, policy_manifests in finished.items()}
        ),
        speed=by_policy(
            {policy: _speeds(policy_manifests) for policy, policy_manifests in finished.items()}
        ),
        slowing=slowing_of(finished),
        drive_calls=drive_calls_of(finished),
        unlit_frames=unlit_frames_of(manifests),
        pool=info.pool,
        repeat=info.repeat,
        exit_code=info.exit_code,
        alpasim=info.alpasim,
        boundary=info.boundary,
    )


def _invalid_reasons(manifests: Sequence[Manifest]) -> dict[tuple[str, str], str]:
    """Return for each renderer and metric why rollouts have no valid value: the most frequent
    reason.
    """
    counts: dict[tuple[str, str], Counter[str]] = {}
    for manifest in manifests:
        for metric, entry in manifest.metrics.items() if manifest.ok else ():
            if not entry.valid and entry.reason:
                key = manifest.renderer, metric
                counts.setdefault(key, Counter())[entry.reason] += 1
    return {key: reasons.most_common(1)[0][0] for key, reasons in counts.items()}


def failures_of(manifests: Sequence[Manifest]) -> Failures:
    """Return which rollouts could not be run or scored, and how many of each class."""
    failed = [manifest for manifest in manifests if not manifest.ok]
    cells = tuple(
        FailedRollout(*manifest.cell, path=manifest.path, error=manifest.error)
        for manifest in failed
        if manifest.error is not None
    )
    by_class = Counter(cell.error.failure_class for cell in cells)
    return Failures(len(failed), len(manifests), dict(by_class), cells)


def _of_policies(manifests: Sequence[Manifest]) -> dict[str, list[Manifest]]:
    manifests_by_policy: dict[str, list[Manifest]] = {}
    for manifest in manifests:
        if is_named(manifest.cell, manifest.ok):
            manifests_by_policy.setdefault(manifest.policy, []).append(manifest)
    return manifests_by_policy


def _speeds(manifests: Sequence[Manifest]) -> dict[str, Speed]:
    timed = [manifest for manifest in manifests if manifest.stage_ms]
    renderers = dict.fromkeys(manifest.renderer for manifest in timed)
    return {
        name: speed([manifest for manifest in timed if manifest.renderer == name])
        for name in renderers
    }


def speed(manifests: Sequence[Manifest]) -> Speed:
    """Return time per camera frame, all-in and by stage, over rollouts of one renderer.

    A frame's time is the sum of all stages of the loop between two frames; the time of a block is
    divided evenly among its frames. The frames of each rollout's first call are kept apart: that
    call may compile or fill caches.
    """
    stages: dict[str, list[float]] = {}
    first = []
    per_frame = []
    for manifest in manifests:
        frames = max(manifest.frames or 0, 1)
        opening = max(manifest.first_call_frames or 0, 1)
        total = np.zeros(frames)
        for stage, durations in manifest.stage_ms.items():
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
        return Speed(None, None, None, None, None, {})
    all_ms = sum(sum(times_ms) for times_ms in stages.values())
    return Speed(
        ms_per_frame_p50=round(float(np.percentile(per_frame, 50)), 3),
        ms_per_frame_p95=round(float(np.percentile(per_frame, 95)), 3),
        ms_per_frame_mean=round(float(np.mean(per_frame)), 3),
        frames_per_s=round(1e3 / float(np.mean(per_frame)), 2),
        first_frame_ms=round(float(np.median(first)), 3),
        stages={
            name: _stage(times_ms, all_ms, len(per_frame))
            for name, times_ms in stages.items()
            if any(times_ms)
        },
    )


LEAST_QUERIES = 20  # of a rollout, for its quarters to say something
SLOWER = 2.0  # times as long in the last quarter
SLOWER_MS = 10.0  # and longer by so much: less is the machine's noise
MOST_ROLLOUTS = 0.75  # the share of rollouts in which it must be so


def slowing_of(manifests_by_policy: Mapping[str, Sequence[Manifest]]) -> dict[str, Slowing]:
    """Return how much longer the plans of a policy take at the end of its rollouts than at their
    beginning, of each policy of which that is so in nearly all rollouts.
    """
    slowing: dict[str, Slowing] = {}
    for policy, manifests in manifests_by_policy.items():
        quarters = []
        for manifest in manifests:
            durations = manifest.stage_ms.get("policy", ())[1:]  # the first call may compile
            if len(durations) >= LEAST_QUERIES:
                size = len(durations) // 4
                quarters.append((np.median(durations[:size]), np.median(durations[-size:])))
        if not quarters:
            continue
        early_ms, late_ms = np.array(quarters).T
        grows = (late_ms >= SLOWER * early_ms) & (late_ms >= early_ms + SLOWER_MS)
        if np.mean(grows) >= MOST_ROLLOUTS:
            slowing[policy] = Slowing(
                early_ms=round(float(np.median(early_ms[grows])), 3),
                late_ms=round(float(np.median(late_ms[grows])), 3),
                n_rollouts=int(np.sum(grows)),
            )
    return slowing


def drive_calls_of(manifests_by_policy: Mapping[str, Sequence[Manifest]]) -> dict[str, DriveCalls]:
    """Return the drive calls of each policy that is an AlpaSim driver."""
    calls: dict[str, DriveCalls] = {}
    for policy, manifests in manifests_by_policy.items():
        facts = [manifest.policy_facts or {} for manifest in manifests]
        timed = [fact for fact in facts if fact.get("drive_calls", 0) > 0]
        if timed:
            calls[policy] = DriveCalls(
                calls=sum(fact["drive_calls"] for fact in timed),
                seconds=round(sum(fact["drive_s"] for fact in timed), 3),
                budget_s=round(sum(f["drive_calls"] * f["drive_budget_s"] for f in timed), 3),
                late=sum(fact["drive_late"] for fact in timed),
                longest_s=max(fact["drive_longest_s"] for fact in timed),
            )
    return calls


def unlit_frames_of(manifests: Sequence[Manifest]) -> dict[str, int]:
    """Return the frames of each renderer in which traffic lights in view could not be drawn; behind
    a fixer, which speaks for itself alone, they are not counted.
    """
    counts: Counter[str] = Counter()
    for manifest in manifests:
        facts = manifest.renderer_facts or {}
        counts[manifest.renderer] += int(facts.get("unlit_frames", 0))
    return {renderer: count for renderer, count in counts.items() if count}


def _stage(durations: Sequence[float], all_ms: float, frames: int) -> StageSpeed:
    """Return percentiles of the passes that took place (a frame from a draft has none through the
    fixer), share and mean per frame.
    """
    passes = [seconds for seconds in durations if seconds > 0.0]
    total = sum(durations)
    return StageSpeed(
        p50_ms=round(float(np.percentile(passes, 50)), 3),
        p95_ms=round(float(np.percentile(passes, 95)), 3),
        share=round(total / all_ms, 4),
        per_frame_ms=round(total / frames, 3),
    )


def pool_of(
    manifests: Sequence[Manifest],
    threads: Threads,
    wall_s: float,
    before: Pool | None,
    executor: str | None = None,
) -> Pool:
    """Return the throughput of all workers together, start-up included; a run that only reused
    rollouts keeps its earlier figures.

    Args:
        manifests: One per rollout.
        threads: Workers, and threads of each.
        wall_s: Seconds.
        before: What the folder says so far.
        executor: Where rollouts ran; None: on this machine.
    """
    fresh = [manifest for manifest in manifests if not manifest.reused]
    if not fresh and before is not None:
        return replace(before, executor=before.executor or executor)
    frames = sum((manifest.frames or 0) for manifest in fresh)
    has_speed = frames > 0 and wall_s > 0
    return Pool(
        workers=threads.workers,
        threads_per_worker=threads.per_worker,
        wall_s=round(wall_s, 3),
        frames=frames,
        frames_per_s_total=round(frames / wall_s, 2) if has_speed else None,
        executor=executor,
    )


def aggregate_runs(runs: Sequence[Path], baseline: str | None = None) -> Summary:
    """Return the numbers of all rollouts of some runs, such as the parts of a night: means, paired
    differences and failures.

    A cell (renderer, policy, scene, seed) that several runs hold counts once, with the mean of its
    repeats, as in a single run.

    Args:
        runs: Finished run folders.
        baseline: RENDERER, POLICY or RENDERER/POLICY that the others are compared with; None is the
            first run's.

    Raises:
        InputError: A run is not finished or its tables are damaged; presets differ, or a scene or a
            metric is another one in another run; a folder is named twice; no run has the baseline.
    """
    for number, run in enumerate(runs):
        if real(run) in {real(other) for other in runs[:number]}:
            raise InputError(f"{run}: named twice", "Name every run once.")
    infos: dict[Path, RunInfo] = {}
    for run in runs:
        infos[run] = read_run_json(run)
        if not os.path.isfile(table_path(run, SUMMARY)):
            raise InputError(f"The run {run} is not finished.", AGAIN)
    _check_alike(infos)
    first = next(iter(infos.values()))
    table = RolloutTable.of_files([table_path(run, ROLLOUTS) for run in runs])
    if baseline is not None:
        base_named(baseline, variants_in(table), "the runs together")
    metric_table = _joined(infos, table.metrics)
    bases = {name: base for info in infos.values() for name, base in info.bases.items()}
    by_class = table.failures()
    means = numbers(table, baseline or first.baseline, bases, metric_table)
    return Summary(
        preset=first.preset,
        metrics=means.metrics,
        paired=means.paired,
        paired_with_base=means.paired_with_base,
        paired_policies=means.paired_policies,
        failures=Failures(sum(by_class.values()), table.n_rollouts, by_class),
        runs=tuple(str(run) for run in runs),
    )


def joined_metrics(runs: Sequence[Path]) -> MetricTable:
    """Return what the metrics of some runs are."""
    return _joined({run: read_run_json(run) for run in runs}, ())


def _joined(infos: Mapping[Path, RunInfo], metrics: Sequence[str]) -> MetricTable:
    first, *others = infos.items()
    joined_table = MetricTable.of_run(first[1].metrics)
    for run, info in others:
        joined_table = joined_table.joined(
            MetricTable.of_run(info.metrics), metrics, f"{first[0]} and {run}"
        )
    return joined_table


def _check_alike(infos: Mapping[Path, RunInfo]) -> None:
    """Refuse runs whose rollouts are not of one kind.

    Raises:
        InputError: Presets differ, or a scene's content does.
    """
    content_by_scene: dict[str, tuple[str, Path]] = {}
    first, kind = next((run, info.preset) for run, info in infos.items())
    for run, info in infos.items():
        if info.preset != kind:
            raise InputError(
                f"{first} and {run}: presets {kind!r} and {info.preset!r}",
                "give the command of one run again with --preset",
            )
        for scene, facts in info.scenes.items():
            content = facts.content_hash
            other, first_run = content_by_scene.setdefault(scene, (content, run))
            if other != content:
                raise InputError(
                    f"{first_run} and {run}: scene {scene} with another content",
                    "aggregate runs of the same scene files",
                )
