"""Rows of a run, stored as a baseline with what they were made with, refused where that differs,
and used as one side of a decision.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from typing_extensions import TypedDict

from alpasim_plugin.core.atomic import write_json
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.parts import digest
from alpasim_plugin.core.reading import read_json_object
from alpasim_plugin.core.reading.files import as_shape, kind_of
from alpasim_plugin.log.run_folder.reader import table_path
from alpasim_plugin.log.run_folder.schema import ROLLOUTS
from alpasim_plugin.log.run_folder.sides import RolloutTable, Row, is_ok
from evaluators.opening import Run, read_run

SCHEMA_VERSION = 1
APPROVE = "make the run again as the baseline was made, or approve a new baseline with simrun gate RUN --write-baseline FILE"
NAMED = 3  # missing rollouts in an error


def table_of_run(run: Run) -> RolloutTable:
    """Return the rollouts of a run as columns, read from its folder one metric at a time.

    Raises:
        InputError: ``rollouts.parquet`` cannot be read.
    """
    return RolloutTable.of_files(
        [table_path(run.folder, ROLLOUTS)],
        lambda renderer, metric: run.invalid_reasons.get((renderer, metric), ""),
    )


def rows_of_run(run: Run) -> list[dict[str, Any]]:
    """Return one flat row per planned rollout: key, status, and METRIC with METRIC_valid."""
    rows = []
    for rollout in run.rollouts:
        row: dict[str, Any] = {
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
            if value is None and rollout.ok:
                row[f"{name}_reason"] = run.invalid_reasons.get((rollout.renderer, name), "")
        rows.append(row)
    return rows


def of_policy(rows: Sequence[Row], policy: str) -> list[Row]:
    """Return the rows of one policy."""
    return [row for row in rows if row["policy"] == policy]


def policies_of(rows: Sequence[Row]) -> list[str]:
    """Return the policies in order of appearance."""
    return list(dict.fromkeys(str(row["policy"]) for row in rows))


class StoredBaseline(TypedDict):
    """A stored baseline of the gate."""

    preset: str
    scenes: dict[str, str]
    weights: dict[str, Any]
    rows: list[dict[str, Any]]
    made_with: dict[str, Any]
    schema_version: int


class BaselineRow(TypedDict):
    """The key and the status of a row of a stored baseline; its metrics are numbers or null, with
    flags NAME_valid.
    """

    renderer: str
    policy: str
    scene: str
    seed: int
    status: str


@dataclass(frozen=True)
class Baseline:
    """What a baseline file holds."""

    preset: str
    scenes: Mapping[str, str]  # scene id -> content hash
    weights: Mapping[str, Any]  # as in run.json
    rows: Sequence[Row]
    made_with: Mapping[str, Any]  # command, versions, hardware, start: for people, not compared
    schema_version: int = SCHEMA_VERSION


def baseline_of(run: Run) -> Baseline:
    """Return a run's results as a baseline."""
    kept = (
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
    made_with = {key: run.info[key] for key in kept if key in run.info}
    return Baseline(
        _preset(run),
        scene_hashes(run),
        dict(run.info.get("weights") or {}),
        rows_of_run(run),
        made_with,
    )


def write_baseline(run: Run, path: Path) -> None:
    """Store a run's results as a baseline file.

    Raises:
        InputError: A rollout of the run failed: a baseline with holes would hide regressions.
        InfrastructureError: The disk refused.
    """
    failed = [r for r in run.rollouts if not r.ok]
    if failed or not run.rollouts:
        problem = (
            f"{len(failed)} of {len(run.rollouts)} rollouts failed"
            if failed
            else "it holds no rollouts"
        )
        raise InputError(
            f"{run.folder}: {problem}",
            "store a run in which every rollout ran to its end",
        )
    write_json(path, asdict(baseline_of(run)))


def read_baseline(path: Path) -> Baseline:
    """Read a baseline file, or take the results of a run folder as they are.

    Raises:
        InputError: Missing, not JSON, or not a baseline of this version.
    """
    if path.is_dir():
        return baseline_of(read_run(path))
    content = read_json_object(path, do_this="write one with simrun gate RUN --write-baseline FILE")
    names = set(Baseline.__dataclass_fields__)
    if set(content) != names or content["schema_version"] != SCHEMA_VERSION:
        raise InputError(
            f"{path}: not a baseline of version {SCHEMA_VERSION}",
            "write it again with this version",
        )
    do = "restore the file or write it again"
    as_shape(StoredBaseline, content, path, do)
    for i, row in enumerate(content["rows"]):
        as_shape(BaselineRow, row, f"{path}, row {i}", do)
        odd = next(
            (
                name
                for name, value in row.items()
                if f"{name}_valid" in row and not isinstance(value, float | int | None)
            ),
            None,
        )
        if odd is not None:
            raise InputError(f"{path}, row {i}: {odd}: {kind_of(row[odd])}, wanted a number", do)
    return Baseline(**content)


def check_matches(baseline: Baseline, run: Run, path: Path) -> None:
    """Refuse a baseline that was made with something else than the run.

    Scenes that only one side has are missing cells, not a mismatch.

    Raises:
        InputError: Other preset, other weights, a scene with another content, or no scene in
            common.
    """
    check_made_alike(
        baseline, _preset(run), scene_hashes(run), dict(run.info.get("weights") or {}), path
    )


def check_made_alike(
    baseline: Baseline,
    preset: str,
    hashes: Mapping[str, str],
    weights: Mapping[str, Any],
    path: Path,
) -> None:
    """Refuse a baseline that was made with something else than a run, which need not have been
    driven yet.

    Args:
        baseline: The baseline.
        preset: Of the run.
        hashes: SCENE -> hash of its content, of the run.
        weights: FILE -> digest, of the run's parts.
        path: The baseline's file or folder, for errors.

    Raises:
        InputError: As `check_matches`.
    """
    if baseline.preset != preset:
        raise InputError(f"{path}: preset {baseline.preset!r}, the run has {preset!r}", APPROVE)
    if dict(baseline.weights) != weights:
        names = sorted(
            name
            for name in {*baseline.weights, *weights}
            if baseline.weights.get(name) != weights.get(name)
        )
        raise InputError(f"{path}: other weights: {', '.join(names)}", APPROVE)
    check_scenes(baseline.scenes, hashes, str(path), APPROVE)


def check_scenes(
    here: Mapping[str, str], there: Mapping[str, str], with_what: str, do_this: str
) -> None:
    """Refuse two sets of scenes that share none, or share a name with another content.

    Raises:
        InputError: They do.
    """
    changed = sorted(name for name in here.keys() & there.keys() if here[name] != there[name])
    if changed:
        raise InputError(f"{with_what}: scenes with another content: {', '.join(changed)}", do_this)
    if not here.keys() & there.keys():
        raise InputError(f"{with_what}: no scene in common", do_this)


def scene_hashes(run: Run) -> dict[str, str]:
    """Return scene id -> content hash of a run.

    Raises:
        InputError: run.json has no hash of a scene.
    """
    scenes = run.info.get("scenes") or {}
    hashes = {name: str(facts.get("content_hash") or "") for name, facts in scenes.items()}
    bare = sorted(
        name for name in {r.scene for r in run.rollouts} | set(hashes) if not hashes.get(name)
    )
    if bare:
        raise InputError(
            f"{run.folder / 'run.json'}: no content hash for {', '.join(bare)}",
            "make the run again with this version",
        )
    return hashes


def _preset(run: Run) -> str:
    return str(run.summary.get("preset") or run.info.get("preset") or "")


@dataclass(frozen=True)
class StoredSide:
    """Rollouts of the baseline that were driven earlier.

    Attributes:
        renderer: Its renderer.
        name: What it is, in words.
        rows: One a rollout, of one renderer and policy.
    """

    renderer: str
    name: str
    rows: tuple[Row, ...]

    @property
    def digest(self) -> str:
        """Give a digest of all values."""
        return digest([[key, row[key]] for row in self.rows for key in sorted(row)])

    def of_cells(self, driven: Collection[tuple[str, int]]) -> list[Row]:
        """Return the rows of the scenes and seeds that are driven on the other side."""
        return [row for row in self.rows if (str(row["scene"]), int(row["seed"])) in driven]


def stored_side(
    rows: Sequence[Row],
    renderer: str,
    policy: str,
    planned: Collection[tuple[str, int]],
    max_missing: float,
    path: Path,
) -> StoredSide:
    """Return the side of a renderer from the rows of a stored baseline.

    Args:
        rows: All of the baseline.
        renderer: Whose rows are wanted.
        policy: The policy that is driven.
        planned: Scenes and seeds that may be driven.
        max_missing: Share of them that it may lack.
        path: The baseline's file or folder.

    Raises:
        InputError: It lacks the renderer or the policy, or more of the planned rollouts than
            allowed.
    """
    of_driven = of_policy(rows, policy)
    if not of_driven:
        raise InputError(
            f"{path}: no rollout of policy {policy}",
            f"drive one of {', '.join(policies_of(rows))}",
        )
    known = sorted({str(row["renderer"]) for row in of_driven})
    if renderer not in known:
        raise InputError(
            f"{path}: no rollout of renderer {renderer}",
            f"name one of {', '.join(known)}: `baseline` of a gate, --baseline of decide",
        )
    side = StoredSide(
        renderer,
        f"{renderer} of {path}",
        tuple(row for row in of_driven if row["renderer"] == renderer),
    )
    stored = {(str(row["scene"]), int(row["seed"])) for row in side.rows if is_ok(row)}
    lacking = sorted(set(planned) - stored)
    if len(lacking) > max_missing * len(planned):
        named = ", ".join(f"{scene} seed {seed}" for scene, seed in lacking[:NAMED])
        raise InputError(
            f"{path}: {len(lacking)} of the {len(planned)} scenes and seeds that may be driven are not in it: {named}",
            "make the baseline on all scenes and seeds of the suite, or name a smaller suite",
        )
    return side
