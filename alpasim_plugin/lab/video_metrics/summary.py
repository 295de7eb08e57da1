"""From clips to a table: means with standard deviations over scenes, and differences from a baseline
scene by scene.

Clips of one scene are no independent samples: phases of one drive show the same street, cameras of
one rig the same moment. A scene's value is the mean of its clips, and everything else counts scenes.

Nothing bounds these metrics, so that no sample bounds their mean over other scenes: the interval of
a difference is that of its median, by order statistics, which hold whatever the distribution.

A row is one clip under one variant: ``arm``, ``clip``, ``scene``, ``values`` (metric -> number),
``ms_per_frame`` (of later blocks; empty where no fixer ran), ``frames``, ``identical``, ``events``,
``features`` (vectors of the whole video, for distances between sets of clips).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.lab.video_metrics.facts import FACTS, MS
from alpasim_plugin.lab.video_metrics.sets import set_distances
from evaluators.statistics.intervals import median_interval

Row = Mapping[str, Any]
TRUTH = "truth"  # the variant of the clean frames: it has only metrics without a reference


def summarise(rows: Sequence[Row], baseline: str) -> dict[str, Any]:
    """Summarise clips.

    Args:
        rows: As above; every variant should have every clip.
        baseline: Variant that the others are compared with, scene by scene.

    Returns:
        ``baseline``; ``arms``: VARIANT -> METRIC -> ``mean``, ``spread`` (standard deviation over
        scenes; None of one), ``n``, ``unit``, ``direction``; ``paired``: VARIANT -> METRIC ->
        ``diff`` (the mean), ``spread``, ``median``, ``median_ci95`` ([low, high], or None with
        ``reason``), ``n_better``, ``n_worse``, ``n``; ``sets``: VARIANT -> METRIC -> a distance of
        all its clips from the true ones (`sets.set_distances`); ``by_scene``: VARIANT -> METRIC ->
        SCENE -> the scene's value, from which any two variants can be compared; ``identical``,
        ``events``, ``frames``, ``clips``, ``scenes`` by variant.

    Raises:
        EvaluatorError: No row of the baseline.
    """
    variants: dict[str, dict[str, Row]] = {}
    for row in rows:
        variants.setdefault(str(row["arm"]), {})[str(row["clip"])] = row
    if baseline not in variants:
        raise EvaluatorError(
            f"baseline {baseline!r}: the variants are {', '.join(variants) or 'none'}",
            "name one of the variants as the baseline",
        )
    arms: dict[str, Any] = {}
    paired: dict[str, Any] = {}
    sets: dict[str, Any] = {}
    by_scene: dict[str, Any] = {}
    names_of_facts = ("clips", "scenes", "frames", "identical", "events")
    facts: dict[str, dict[str, Any]] = {key: {} for key in names_of_facts}
    for name, by_clip in variants.items():
        clip_rows = list(by_clip.values())
        by_scene[name] = {
            metric: scene_values(clip_rows, metric) for metric in metrics_of(clip_rows)
        }
        arms[name] = {
            metric: _mean(list(values.values()), metric)
            for metric, values in by_scene[name].items()
        }
        if name not in (baseline, TRUTH):
            paired[name] = _paired(by_clip, variants[baseline])
        if name != TRUTH and TRUTH in variants:
            sets[name] = set_distances(by_clip, variants[TRUTH])
        events: Counter[str] = Counter()
        for row in clip_rows:
            events.update(row["events"])
        facts["clips"][name] = len(clip_rows)
        facts["scenes"][name] = len({str(row["scene"]) for row in clip_rows})
        facts["frames"][name] = sorted({int(row["frames"]) for row in clip_rows})
        facts["identical"][name] = sum(int(row["identical"]) for row in clip_rows)
        facts["events"][name] = dict(events)
    tables = {"arms": arms, "paired": paired, "sets": sets, "by_scene": by_scene}
    return {"baseline": baseline, **tables, **facts}


def metrics_of(rows: Sequence[Row]) -> list[str]:
    """Return the metrics that every row carries, and the optional ones that any does, in the order
    of the tables.
    """
    needed = {metric: any if fact.optional else all for metric, fact in FACTS.items()}
    return [name for name, quorum in needed.items() if quorum(_carries(row, name) for row in rows)]


def value_of(row: Row, metric: str) -> float:
    """Return a clip's value; the time is the median over blocks."""
    return float(np.median(row[MS])) if metric == MS else float(row["values"][metric])


def scene_values(rows: Sequence[Row], metric: str) -> dict[str, float]:
    """Return the mean over the clips of every scene that carry a metric, by scene, in the order of
    their first rows.
    """
    carried = [row for row in rows if _carries(row, metric)]
    return _scene_means(carried, [value_of(row, metric) for row in carried])


def _scene_means(rows: Sequence[Row], values: Sequence[float]) -> dict[str, float]:
    """Return the mean by scene of one value a row."""
    by_scene: dict[str, list[float]] = {}
    for row, value in zip(rows, values, strict=True):
        by_scene.setdefault(str(row["scene"]), []).append(value)
    return {scene: float(np.mean(of_clips)) for scene, of_clips in by_scene.items()}


def _carries(row: Row, metric: str) -> bool:
    return bool(row[MS]) if metric == MS else metric in row["values"]


def _mean(values: Sequence[float], metric: str) -> dict[str, Any]:
    fact = FACTS[metric]
    entry = {"mean": float(np.mean(values)), "spread": _spread(values), "n": len(values)}
    return entry | {"unit": fact.unit, "direction": fact.direction}


def _spread(values: Sequence[float]) -> float | None:
    return float(np.std(values, ddof=1)) if len(values) > 1 else None


def _paired(rows: Mapping[str, Row], baseline: Mapping[str, Row]) -> dict[str, Any]:
    pairs = [(rows[clip], baseline[clip]) for clip in rows if clip in baseline]
    out: dict[str, Any] = {}
    for metric in metrics_of([row for pair in pairs for row in pair]):
        carried = [(a, b) for a, b in pairs if _carries(a, metric) and _carries(b, metric)]
        if not carried:
            continue
        by_clip = [value_of(a, metric) - value_of(b, metric) for a, b in carried]
        differences = np.array([*_scene_means([a for a, _ in carried], by_clip).values()])
        gains = differences if FACTS[metric].direction == "higher" else -differences
        interval = median_interval(differences, "scenes")
        out[metric] = {
            "diff": float(np.mean(differences)),
            "spread": _spread(differences.tolist()),
            "median": interval.centre,
            "median_ci95": interval.bounds,
            **({"reason": interval.reason} if interval.reason else {}),
            "n_better": int(np.sum(gains > 0.0)),
            "n_worse": int(np.sum(gains < 0.0)),
            "n": len(differences),
        }
    return out
