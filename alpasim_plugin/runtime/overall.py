"""Several runs as one: their tables are streamed into the numbers that a single run of all their rollouts would have."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.run_folder.columns import AGAIN, DOING, RolloutTable
from alpasim_plugin.run_folder.manifests import damaged_files, find_contents, read_run_json
from alpasim_plugin.run_folder.schema import ROLLOUTS
from evaluators.metrics import MetricTable
from evaluators.statistics.summary import numbers


def aggregate_runs(runs: Sequence[Path], baseline: str | None = None) -> dict[str, Any]:
    """Return the numbers of all rollouts of some runs, such as the parts of a night, in the form of ``summary.json``.

    A cell (renderer, policy, scene, seed) that several runs hold counts once, with the mean of its repeats, as in a single run.

    Args:
        runs: Finished run folders.
        baseline: Renderer that the others are compared with; None is the first run's.

    Returns:
        ``runs``, ``preset``, ``metrics``, ``paired``, ``paired_with_base``, ``failures`` (docs/statistics.md).

    Raises:
        InputError: A run is not finished or its tables are damaged; presets differ, or a scene or a metric is another one in another run; a
            folder
            is named twice; no run has the baseline.
    """
    twice = [run for i, run in enumerate(runs) if run.resolve() in {other.resolve() for other in runs[:i]}]
    if twice:
        raise InputError(DOING, str(twice[0]), "named twice", "name every run once")
    infos = {run: _info_of(run) for run in runs}
    _check_alike(infos)
    first = next(iter(infos.values()))
    table = RolloutTable.of_files([run / ROLLOUTS for run in runs])
    sides = list(dict.fromkeys(name for policy in table.policies for name in table.sides(policy)))
    if baseline is not None and baseline not in sides:
        raise InputError(DOING, f"--baseline {baseline}", "no rollout has it", f"choose one of {', '.join(sides) or 'none'}")
    known = _joined(infos, table.metrics)
    bases = {name: base for info in infos.values() for name, base in (info.get("bases") or {}).items()}
    by_class = table.failures()
    return {
        "runs": [str(run) for run in runs],
        "preset": first["preset"],
        **numbers(table, baseline or first["config"].get("baseline"), bases, known),
        "failures": {"n_failed": sum(by_class.values()), "n_rollouts": table.n_rollouts, "by_class": by_class},
    }


def joined_metrics(runs: Sequence[Path]) -> MetricTable:
    """Return what the metrics of some runs are."""
    return _joined({run: read_run_json(run) for run in runs}, ())


def _joined(infos: Mapping[Path, Mapping[str, Any]], metrics: Sequence[str]) -> MetricTable:
    first, *others = infos.items()
    known = MetricTable.of_run(first[1])
    for run, info in others:
        known = known.joined(MetricTable.of_run(info), metrics, DOING, f"{first[0]} and {run}")
    return known


def _info_of(run: Path) -> dict[str, Any]:
    """Return a run's description.

    Raises:
        InputError: The run is not finished, or damaged.
    """
    info = read_run_json(run)
    contents = find_contents(run)
    damaged = None if contents is None else next((one for one in damaged_files(run, contents) if one.file == ROLLOUTS), None)
    if contents is None or damaged is not None:
        raise InputError(DOING, str(run), "the run is not finished" if damaged is None else str(damaged), AGAIN)
    return info


def _check_alike(infos: Mapping[Path, Mapping[str, Any]]) -> None:
    """Refuse runs whose rollouts are not of one kind.

    Raises:
        InputError: Presets differ, or a scene's content does.
    """
    seen: dict[str, tuple[str, Path]] = {}
    first, kind = next((run, info["preset"]) for run, info in infos.items())
    for run, info in infos.items():
        if info["preset"] != kind:
            found = f"presets {kind!r} and {info['preset']!r}"
            raise InputError(DOING, f"{first} and {run}", found, "give the command of one run again with --preset")
        for scene, facts in info["scenes"].items():
            content = str(facts.get("content_hash") or "")
            other, where = seen.setdefault(scene, (content, run))
            if other != content:
                raise InputError(
                    DOING, f"{where} and {run}", f"scene {scene} with another content", "aggregate runs of the same scene files"
                )
