"""One row per scene, renderer and policy: how each seed ended, and where its files are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.run_folder.reader import Run
from alpasim_plugin.run_folder.rows import Rollout
from evaluators.report.events import COLLISION
from evaluators.report.metric_info import in_percent
from evaluators.report.numbers import Cell, duration, fixed, missing, short

MAX_SCENE_ROWS = 600  # more are a page that loads and scrolls slowly
TELLING_ROWS = 200  # shown of a larger run
SCENE_METRICS = ("lateral_distance_m", "progress")


@dataclass(frozen=True)
class Chip:
    """One rollout in the scene table: its seed and how it ended."""

    text: str
    state: str  # ok | collision | offroad | failed
    title: str
    folder: str | None
    clip: str | None


@dataclass(frozen=True)
class SceneRow:
    """One scene under one renderer and policy."""

    scene: str
    renderer: str
    policy: str
    variant: int
    chips: tuple[Chip, ...]
    collisions: Cell
    offroad: Cell
    values: tuple[Cell, ...]


def scene_rows(run: Run, interesting: Sequence[str] = ()) -> tuple[list[SceneRow], int]:
    """Lay out scenes x variants, in the order of the run; where there is no room for all, the most telling scenes first.

    Args:
        run: The run.
        interesting: Its scenes, the most telling first.

    Returns:
        The rows, and how many more there are than are shown.
    """
    groups: dict[tuple[str, str, str], list[Rollout]] = {}
    for rollout in run.rollouts:
        groups.setdefault((rollout.scene, rollout.renderer, rollout.policy), []).append(rollout)
    renderer_index = {name: i for i, name in enumerate(run.renderers)}
    is_large = len(groups) > MAX_SCENE_ROWS
    rank = {name: i for i, name in enumerate(interesting if interesting and is_large else run.scenes)}
    keys = sorted(groups, key=lambda k: (rank[k[0]], renderer_index[k[1]], k[2]))
    rows = [_scene_row(run, key, groups[key], renderer_index[key[1]]) for key in keys[: TELLING_ROWS if is_large else MAX_SCENE_ROWS]]
    return rows, len(keys) - len(rows)


def _scene_row(run: Run, key: tuple[str, str, str], rollouts: list[Rollout], variant: int) -> SceneRow:
    done = [r for r in rollouts if r.ok]
    chips = tuple(_chip(run, r) for r in sorted(rollouts, key=lambda r: r.seed))
    return SceneRow(
        *key,
        variant=variant,
        chips=chips,
        collisions=_count(done, COLLISION),
        offroad=_count(done, ("offroad",)),
        values=tuple(_mean(run, done, name) for name in SCENE_METRICS),
    )


def _chip(run: Run, rollout: Rollout) -> Chip:
    if not rollout.ok:
        state, letter, said = "failed", " F", f"failed ({rollout.failure_class or 'unknown cause'})"
    elif rollout.flag(*COLLISION):
        state, letter, said = "collision", " C", "collision" + (" and off-road" if rollout.flag("offroad") else "")
    elif rollout.flag("offroad"):
        state, letter, said = "offroad", " O", "off-road"
    else:
        state, letter, said = "ok", "", "no collision, not off-road"
    facts = [f"seed {rollout.seed}: {said}"]
    facts += [f"{rollout.frames} frames"] if rollout.frames is not None else []
    facts += [duration(rollout.wall_s)] if rollout.wall_s is not None else []
    return Chip(f"{rollout.seed}{letter}", state, ", ".join(facts), run.href(rollout), run.href(rollout, "front.mp4"))


def _count(done: list[Rollout], names: tuple[str, ...]) -> Cell:
    known = [r for r in done if any(r.metrics.get(name) is not None for name in names)]
    if not known:
        return missing("no rollout finished" if not done else "the metric is valid in no rollout")
    k = sum(r.flag(*names) for r in known)
    return Cell(f"{k} of {len(known)}", sort=k / len(known), tone="worse" if k else "")


def _mean(run: Run, done: list[Rollout], name: str) -> Cell:
    values = [v for r in done if (v := r.metrics.get(name)) is not None]
    if not values:
        return missing("no rollout finished" if not done else "the metric is valid in no rollout")
    mean = float(np.mean(values))
    note = "" if len(values) == len(done) else f"valid in {len(values)} of {len(done)}"
    return Cell(f"{fixed(100 * mean, 1)}\u00a0%" if in_percent(name, "") else short(mean, "m"), note, sort=mean)
