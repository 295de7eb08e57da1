"""Rows of a run, stored as a baseline with what they were made with, and refused where that
differs.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import parse_json, read_bytes, read_record
from alpasim_plugin.core.files.atomic import write_json
from alpasim_plugin.core.files.limits import JSON_BYTES
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.core.metric_types import MetricInfo
from alpasim_plugin.log.run_folder.checksums import DIGEST, check_seal, sealed
from alpasim_plugin.log.run_folder.records import json_of
from alpasim_plugin.log.run_folder.sides import RolloutTable
from evaluators.metrics import MetricTable
from evaluators.statistics.opening import Run, read_run

SCHEMA_VERSION = 2
WRITE = "write one with simrun gate RUN --write-baseline FILE"
MADE_WITH = (
    "key",
    "command",
    "version",
    "started_at",
    "versions",
    "hardware",
    "renderers",
    "policies",
    "seeds",
)
APPROVE = "make the run again as the baseline was made, or approve a new baseline with simrun gate RUN --write-baseline FILE"


def table_of_run(run: Run) -> RolloutTable:
    """Return the rollouts of a run as columns, read from its tables one metric at a time.

    Raises:
        InputError: ``rollouts.parquet`` cannot be read.
    """
    return RolloutTable.of_files(
        run.tables,
        lambda renderer, metric: run.invalid_reasons.get((renderer, metric), ""),
    )


@dataclass(frozen=True)
class Baseline:
    """What a baseline file holds.

    Attributes:
        preset: Evaluator preset.
        scenes: SCENE -> content hash.
        weights: File of weights -> digest.
        rows: Of ``rollouts.parquet``.
        made_with: Members of ``run.json`` for people, which are not compared.
        metrics: METRIC -> what it is.
        repeatable: What ``run --repeat`` found; None: not tried.
        schema_version: Of these members.
    """

    preset: str
    scenes: dict[str, str]
    weights: dict[str, str]
    rows: list[JsonObject]
    made_with: JsonObject
    metrics: dict[str, MetricInfo]
    repeatable: bool | None
    schema_version: int = SCHEMA_VERSION

    @property
    def table(self) -> RolloutTable:
        """Give the rollouts in columns."""
        return RolloutTable.of_table(pa.Table.from_pylist(list(self.rows)))


def baseline_of(run: Run) -> Baseline:
    """Return a run's results as a baseline."""
    stated = json_of(run.info)
    made_with = {key: stated[key] for key in MADE_WITH if key in stated}
    rows = []
    for rollout in run.rollouts:
        row: JsonObject = {
            "renderer": rollout.renderer,
            "policy": rollout.policy,
            "scene": rollout.scene,
            "seed": rollout.seed,
            "status": rollout.status,
            "failure_class": rollout.failure_class or None,
        }
        for name in run.metric_names:
            value = rollout.metrics.get(name)
            row[name], row[f"{name}_valid"] = value, value is not None
        rows.append(row)
    return Baseline(
        _preset(run),
        scene_hashes(run),
        run.info.weights,
        rows,
        made_with,
        run.info.metrics,
        is_repeatable(run),
    )


def is_repeatable(run: Run) -> bool | None:
    """Return what ``run --repeat`` found of the run's policies; None where it was not tried."""
    return None if run.info.repeat is None else run.info.repeat.repeatable


def write_baseline(run: Run, path: Path) -> None:
    """Store a run's results as a baseline file.

    Raises:
        InputError: A rollout of the run failed: a baseline with holes would hide regressions.
        InfrastructureError: The disk refused.
    """
    n_failed = sum(not rollout.ok for rollout in run.rollouts)
    if n_failed or not run.rollouts:
        raise InputError(
            f"{run.title}: {n_failed} of {len(run.rollouts)} rollouts failed",
            "store a run with rollouts that all ran to their end",
        )
    write_json(path, sealed(json_of(baseline_of(run))))


def read_baseline(path: Path) -> Baseline:
    """Read a baseline file, or take the results of a run folder as they are.

    Raises:
        InputError: Missing, not JSON, changed since it was written, or not a baseline of this
            version.
    """
    if os.path.isdir(path):
        return baseline_of(read_run(path))
    data = read_bytes(path, JSON_BYTES, WRITE)
    content = parse_json(data, path, WRITE)
    if not isinstance(content, dict) or content.get("schema_version") != SCHEMA_VERSION:
        raise InputError(
            f"{path}: not a baseline of version {SCHEMA_VERSION}",
            "Write one with simrun gate RUN --write-baseline FILE, or name the earlier run's folder.",
        )
    check_seal({DIGEST: None} | content, path, APPROVE)
    return read_record(Baseline, data, path, "restore the file or write it again")


def check_matches(baseline: Baseline, run: Run, path: Path) -> None:
    """Refuse a baseline that was made with something else than the run.

    Scenes that only one side has are missing cells, not a mismatch.

    Raises:
        InputError: Other preset, other weights, a scene with another content, no scene in
            common, or a metric that is another quantity.
    """
    if baseline.preset != _preset(run):
        raise InputError(
            f"{path}: preset {baseline.preset!r}, the run has {_preset(run)!r}", APPROVE
        )
    weights = run.info.weights
    changed = [
        name
        for name in sorted({*baseline.weights, *weights})
        if baseline.weights.get(name) != weights.get(name)
    ]
    if changed:
        raise InputError(f"{path}: other weights: {', '.join(changed)}", APPROVE)
    check_scenes(baseline.scenes, scene_hashes(run), str(path), APPROVE)
    stored = MetricTable.of_run(baseline.metrics)
    run.table.joined(stored, baseline.metrics, str(path))


def check_scenes(
    scenes: Mapping[str, str], others: Mapping[str, str], owner: str, hint: str
) -> None:
    """Refuse two sets of scenes that share none, or share a name with another content.

    Raises:
        InputError: They do.
    """
    shared = scenes.keys() & others.keys()
    changed = sorted(name for name in shared if scenes[name] != others[name])
    if changed:
        raise InputError(f"{owner}: scenes with another content: {', '.join(changed)}", hint)
    if not shared:
        raise InputError(f"{owner}: no scene in common", hint)


def scene_hashes(run: Run) -> dict[str, str]:
    """Return scene id -> content hash of a run.

    Raises:
        InputError: run.json has no hash of a scene.
    """
    hashes = {name: facts.content_hash for name, facts in run.info.scenes.items()}
    names = {rollout.scene for rollout in run.rollouts} | hashes.keys()
    bare = sorted(name for name in names if not hashes.get(name))
    if bare:
        raise InputError(
            f"{run.folder / 'run.json'}: no content hash for {', '.join(bare)}",
            "make the run again with this version",
        )
    return hashes


def _preset(run: Run) -> str:
    return run.summary.preset
