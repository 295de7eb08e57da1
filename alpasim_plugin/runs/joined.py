"""Several runs read as one: the shards of a suite that many machines have driven."""

import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.log.run_folder.records import Repeat, RunInfo
from alpasim_plugin.log.run_folder.rows import Rollout
from alpasim_plugin.log.run_folder.schema import cell_name
from alpasim_plugin.runs.summary import aggregate_runs
from evaluators.results import Censoring, Summary
from evaluators.statistics.opening import Run
from evaluators.statistics.outcomes import LISTED, outcome_table
from evaluators.statistics.summary import joined_censoring

SHARD = re.compile(r"([0-9]+)/([0-9]+)")


def join_runs(runs: Sequence[Run], baseline: str | None = None) -> Run:
    """Return the run that some runs make together, with the rollouts of all of them.

    Args:
        runs: Finished runs.
        baseline: RENDERER, POLICY or RENDERER/POLICY that the others are compared with; None is the
            first run's.

    Raises:
        InputError: Presets differ, or a scene, a metric or a part is another one in another run; a
            folder is named twice; no run has the baseline.
    """
    _check_parts(runs)
    rollouts = [rollout for run in runs for rollout in run.rollouts]
    names = dict.fromkeys(name for run in runs for name in run.info.asked or ())
    scenes = {name: scene for run in runs for name, scene in run.info.scenes.items()}
    weights = {file: sha for run in runs for file, sha in run.info.weights.items()}
    summary = aggregate_runs([run.folder for run in runs], baseline)
    info = replace(
        runs[0].info,
        asked=tuple(names),
        shard=None,
        scenes=scenes,
        weights=weights,
        renderers=tuple(dict.fromkeys(chain(*(run.info.renderers for run in runs)))),
        policies=tuple(dict.fromkeys(chain(*(run.info.policies for run in runs)))),
        seeds=tuple(dict.fromkeys(chain(*(run.info.seeds for run in runs)))),
        repeat=_joined_repeat([run.info for run in runs]),
    )
    return replace(
        runs[0],
        summary=_with_endings(summary, runs, rollouts),
        rollouts=rollouts,
        metric_names=tuple(dict.fromkeys(chain(*(run.metric_names for run in runs)))),
        info=info,
        folders=tuple(run.folder for run in runs),
    )


def missing_shards(infos: Sequence[RunInfo]) -> str | None:
    """Return a sentence that names the shards which some runs lack; None where they lack none.

    A run that was driven without ``--shard`` lacks nothing.

    Raises:
        InputError: They are parts of runs that were divided into different numbers of shards, or one
            shard is there twice.

    Example:
        A run of ``--shard 2/3`` alone gives "shards 1/3 and 3/3 are missing: the verdict is about the
        scenes of all three, so name their runs as well".
    """
    shards = _shards_of_one_run(infos)
    if not shards:
        return None
    count = shards[0][1]
    present = {number for number, _ in shards}
    absent = [f"{number}/{count}" for number in range(1, count + 1) if number not in present]
    if not absent:
        return None
    subject = f"shard {absent[0]} is" if len(absent) == 1 else f"shards {_listed(absent)} are"
    return (
        f"{subject} missing: the verdict is about the scenes of all {count} shards,"
        " so name their runs as well"
    )


def _shards_of_one_run(infos: Sequence[RunInfo]) -> list[tuple[int, int]]:
    """Return which shard of how many each run is; nothing where none is a shard.

    Raises:
        InputError: Runs are divided into different numbers of shards, or one shard is there twice.
    """
    matches = [SHARD.fullmatch(info.shard) for info in infos if info.shard is not None]
    shards = [(int(match[1]), int(match[2])) for match in matches if match is not None]
    if not shards:
        return []
    counts = {count for _, count in shards}
    if len(counts) > 1 or len(shards) < len(infos):
        stated = ", ".join(info.shard or "not divided" for info in infos)
        raise InputError(
            f"shards of different runs: {stated}",
            "Name runs that were driven with one N of --shard I/N.",
        )
    for number, count in sorted(shards):
        if shards.count((number, count)) > 1:
            raise InputError(
                f"shard {number}/{count} is there twice", "Name one run of each shard."
            )
    return shards


def check_apart(runs: Sequence[Run]) -> None:
    """Refuse runs that hold one rollout twice.

    Raises:
        InputError: Two runs have a rollout of the same renderer, policy, scene and seed.
    """
    owners: dict[tuple[str, str, str, int], Run] = {}
    for run in runs:
        for rollout in run.rollouts:
            other = owners.setdefault(rollout.cell, run)
            if other is not run:
                raise InputError(
                    f"{other.folder} and {run.folder}: both have {cell_name(*rollout.cell)}",
                    "Name the shards of one run, or the earlier run with --baseline-file.",
                )


def _listed(names: Sequence[str]) -> str:
    return f"{', '.join(names[:-1])} and {names[-1]}"


def _check_parts(runs: Sequence[Run]) -> None:
    """Refuse runs in which one name stands for parts of different code, settings or files.

    Raises:
        InputError: A renderer, fixer, policy, controller or evaluator, or a file of weights, is
            another one in another run.
    """
    digests: dict[str, tuple[str, Run]] = {}
    for run in runs:
        stated = {name: facts.digest for name, facts in run.info.parts.items()}
        stated |= {f"weights {name}": digest for name, digest in run.info.weights.items()}
        for name, digest in stated.items():
            if digest is None:  # a remote service
                continue
            first, owner = digests.setdefault(name, (digest, run))
            if first != digest:
                raise InputError(
                    f"{owner.folder} and {run.folder}: {name} has other code, settings or files",
                    "drive both with the same version of it",
                )


def _joined_repeat(infos: Sequence[RunInfo]) -> Repeat | None:
    """Return what ``--repeat`` found in all runs together: what one of them found not repeatable is
    not, and where one of them knows nothing, nothing is known.
    """
    repeats = [info.repeat for info in infos]
    for repeat in repeats:
        if repeat is not None and repeat.repeatable is False:
            return repeat
    for repeat in repeats:
        if repeat is None or repeat.repeatable is None:
            return repeat
    return repeats[0]


def _with_endings(joined: Summary, runs: Sequence[Run], rollouts: Sequence[Rollout]) -> Summary:
    """Return the joined summary of some runs with how their rollouts ended, the times of their
    events, and what their own summaries say was removed.
    """
    outcomes = outcome_table(rollouts)
    for variant, endings in outcomes.items():
        tables = [run.summary.outcomes for run in runs if variant in run.summary.outcomes]
        counts = {}
        for name, events in endings.outcomes.items():
            cells = [
                table[variant].outcomes[name].cells
                for table in tables
                if name in table[variant].outcomes
            ]
            counts[name] = replace(events, cells=tuple(chain(*cells))[:LISTED])
        outcomes[variant] = replace(endings, outcomes=counts)
    ledgers: dict[str, list[Censoring]] = {}
    for run in runs:
        for renderer, ledger in run.summary.censoring.items():
            is_key = renderer in joined.metrics
            key = renderer if is_key else cell_name(renderer, run.policies[0])
            ledgers.setdefault(key, []).append(ledger)
    censoring = {key: joined_censoring(parts) for key, parts in ledgers.items()}
    return replace(joined, outcomes=outcomes, censoring=censoring)
