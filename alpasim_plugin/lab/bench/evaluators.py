"""Time and correctness of the evaluators: against a search step by step, and against an exact
reference implementation.

The search step by step is how AlpaSim does it: at every step polygons of all actors, one tree over
them and one query; for lane keeping the nearby lanes and their union. The reference implementation
(`evaluators.reference`) decides contact in rational arithmetic and uses no index at all.

Times are CPU times: nothing here runs on more than one core, and other work on the machine does not
blur them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from statistics import median
from typing import Any

import numpy as np
import shapely
from scipy.spatial import cKDTree

from alpasim_plugin.core.geometry import arc_lengths
from alpasim_plugin.core.lane_areas import lane_polygon
from alpasim_plugin.core.types import F64, RolloutLog, Scene, Trajectory
from evaluators.metrics.collision import SIDES
from evaluators.metrics.contact import Contacts, find_contacts, find_swept
from evaluators.metrics.footprint import ActorTable, ego_footprints, origin_of
from evaluators.metrics.offroad import containment
from evaluators.metrics.presets import PRESETS, Preset
from evaluators.metrics.reference import busy_road, contacts_by_step, ego_corners, road_by_step
from evaluators.metrics.road import Road
from evaluators.metrics.score import score

PAPER, STRICT = PRESETS["paper"], PRESETS["strict"]
REFERENCE_PAIRS = 8_000


@dataclass(frozen=True)
class BenchRow:
    """One part of the evaluation on one world; CPU times, the least of several runs, in
    milliseconds.
    """

    # contact: who touches the ego on which side, and the gap; road: whether lanes hold the ego
    part: str
    actors: int
    steps: int
    hits: int  # touching pairs of step and actor; steps outside the lanes
    ours_ms: float
    per_step_ms: float
    ratio: float  # per step over ours
    # the reference takes most of a millisecond per pair, so it looks at this many of the steps
    reference_steps: int
    reference_ms: float | None
    differ_per_step: int  # pairs (steps) on which ours and per step disagree, sides included
    differ_reference: int | None
    gap_error_m: float  # largest difference of the least gap between ours and either other
    again_ms: float | None  # ours for the next rollout of the same scene: its road is kept
    swept_ms: float | None  # contact between steps, on top of contact at steps
    score_ms: float  # everything that `score` gives


def bench_evaluators(
    actors: Sequence[int] = (10, 40, 200),
    steps: Sequence[int] = (200, 900),
    repeats: int = 5,
    reference: bool = True,
) -> list[BenchRow]:
    """Measure every combination of actor and step counts, then lane keeping once per step count.

    Args:
        actors: How many other road users.
        steps: How many logged steps of 0.1 s.
        repeats: Runs of ours; the reference runs once, and so does the search step by step for
            contact. For lane keeping it takes turns with ours, this many times.
        reference: Also run the exact reference, which takes most of the time.
    """
    rows = [_contact_row(busy_road(a, t), a, t, repeats, reference) for a in actors for t in steps]
    return rows + [_road_row(busy_road(1, t), t, repeats, reference) for t in steps]


# --- contact


def contacts_per_step(log: RolloutLog, preset: Preset) -> tuple[list[dict[str, str]], F64]:
    """Find touching actors with their side, and the gap, by building everything anew at every
    step.
    """
    origin = origin_of(log.ego, preset)
    table = ActorTable(log, preset, origin)
    there = table.at(log.ego.t_us)
    ego_at = ego_footprints(log, preset, origin).corners()
    sides: list[dict[str, str]] = []
    gap_m = np.full(len(log.ego), np.inf)
    for i, at in enumerate(ego_at):
        ego = shapely.Polygon(at)
        front = shapely.LineString(at[0:2])
        rear = shapely.LineString(at[2:4])
        present = np.flatnonzero(there.present[:, i])
        boxes = there.footprints(present, np.full(len(present), i)).corners()
        shapes = [shapely.Polygon(box) for box in boxes]
        hits = shapely.STRtree(shapes).query(ego, predicate="intersects")
        sides.append({table.ids[present[h]]: _side(shapes[h], front, rear) for h in hits})
        gap_m[i] = min((ego.distance(one) for one in shapes), default=np.inf)
    return sides, gap_m


def _side(shape: Any, front: Any, rear: Any) -> str:
    return "front" if shape.intersects(front) else "rear" if shape.intersects(rear) else "lateral"


def _contact_row(
    world: tuple[RolloutLog, Scene], n_actors: int, n_steps: int, repeats: int, reference: bool
) -> BenchRow:
    log, scene = world
    origin = origin_of(log.ego, PAPER)

    def ours() -> tuple[Contacts, F64, tuple[str, ...]]:
        table = ActorTable(log, PAPER, origin)
        return *find_contacts(ego_footprints(log, PAPER, origin), table, log.ego.t_us), table.ids

    def between() -> object:
        return find_swept(ego, table, log.ego.t_us, at_steps, 0)

    contacts, gap_m, ids = ours()
    mine: list[dict[str, str]] = [{} for _ in range(n_steps)]
    for step, actor, side in zip(contacts.step, contacts.actor, contacts.side, strict=True):
        mine[step][ids[actor]] = SIDES[int(side)]
    (per_sides, per_gap), per_ms = _timed(lambda: contacts_per_step(log, PAPER), 1)
    every = max(1, n_actors * n_steps // REFERENCE_PAIRS)
    exact, reference_ms = (
        _timed(lambda: contacts_by_step(_thinned(log, every), PAPER), 1)
        if reference
        else ([], None)
    )
    ego, table = ego_footprints(log, STRICT, origin), ActorTable(log, STRICT, origin)
    at_steps, _ = find_contacts(ego, table, log.ego.t_us)
    _, ours_ms = _timed(ours, repeats)
    _, swept_ms = _timed(between, repeats)
    _, score_ms = _timed(lambda: score(log, scene, PAPER), repeats)
    errors = [
        np.abs(gap_m - per_gap).max(),
        *(abs(gap_m[k * every] - one.gap_m) for k, one in enumerate(exact)),
    ]
    return BenchRow(
        "contact",
        n_actors,
        n_steps,
        len(contacts.step),
        ours_ms,
        per_ms,
        per_ms / ours_ms,
        len(exact),
        reference_ms,
        _differing(mine, per_sides),
        _differing(mine[::every], [one.sides for one in exact]) if reference else None,
        float(max(errors)),
        None,
        swept_ms,
        score_ms,
    )


def _thinned(log: RolloutLog, every: int) -> RolloutLog:
    """Return the log with every k-th pose of the ego; the others keep theirs."""
    ego = log.ego
    return replace(log, ego=Trajectory(ego.t_us[::every], ego.xyz[::every], ego.quat[::every]))


def _differing(ours: list[dict[str, str]], other: list[dict[str, str]]) -> int:
    return sum(len(set(a.items()) ^ set(b.items())) for a, b in zip(ours, other, strict=True))


# --- road


def on_road_per_step(log: RolloutLog, scene: Scene, preset: Preset) -> tuple[list[bool], F64]:
    """Ask at every step whether the lanes around the ego hold it, alone or joined anew, and for the
    gap to their border.
    """
    origin = origin_of(scene.ego_log, preset)
    lanes = list(scene.lane_map.lanes.values())
    areas = [
        shapely.transform(lane_polygon(lane, preset.lane_half_width_m), lambda xy: xy - origin[:2])
        for lane in lanes
    ]
    vertices = np.concatenate([_dense(lane.centre) - origin for lane in lanes])
    owner = np.repeat(np.arange(len(lanes)), [len(_dense(lane.centre)) for lane in lanes])
    tree = cKDTree(vertices)
    held, gap_m = [], np.zeros(len(log.ego))
    for i in range(len(log.ego)):
        body = shapely.Polygon(ego_corners(log, preset, i, origin))
        near = np.unique(
            owner[tree.query_ball_point(log.ego.xyz[i] - origin, preset.lane_radius_m)]
        )
        union = shapely.union_all([areas[k] for k in near]).buffer(
            preset.seam_m / 2, join_style="mitre"
        )
        inside = bool(union.contains(body))
        held.append(inside or any(areas[k].contains(body) for k in near))
        gap_m[i] = union.boundary.distance(body) if inside else 0.0
    return held, gap_m


def _dense(line: F64) -> F64:
    """Return points every 5 cm, so that a vertex query finds the lanes that the line query does."""
    s = arc_lengths(line)
    at = np.linspace(0.0, s[-1], int(s[-1] / 0.05) + 2)
    return np.stack([np.interp(at, s, line[:, d]) for d in range(3)], axis=1)


def _road_row(
    world: tuple[RolloutLog, Scene], n_steps: int, repeats: int, reference: bool
) -> BenchRow:
    log, scene = world
    origin = origin_of(scene.ego_log, PAPER)
    xyz = log.ego.xyz - origin

    def ours() -> Any:  # a fresh road each time: nothing is kept from the last run
        return containment(
            Road(scene.lane_map, origin, PAPER), ego_footprints(log, PAPER, origin), xyz
        )

    def per_step() -> tuple[list[bool], F64]:
        return on_road_per_step(log, scene, PAPER)

    (held, ours_ms), ((per_held, per_gap), per_ms) = _in_turn(ours, per_step, repeats)
    road = Road(scene.lane_map, origin, PAPER)
    _, again_ms = _timed(
        lambda: containment(road, ego_footprints(log, PAPER, origin), xyz), repeats + 1
    )
    exact, reference_ms = (
        _timed(lambda: road_by_step(log, scene, PAPER), 1) if reference else ([], None)
    )
    _, score_ms = _timed(lambda: score(log, scene, PAPER), repeats)
    mine = held.in_one | held.in_union
    gaps = [
        np.abs(held.boundary_gap_m - per_gap).max(),
        *(abs(g - e.boundary_gap_m) for g, e in zip(held.boundary_gap_m, exact, strict=False)),
    ]
    return BenchRow(
        "road",
        0,
        n_steps,
        int(np.sum(~mine)),
        ours_ms,
        per_ms,
        per_ms / ours_ms,
        len(exact),
        reference_ms,
        int(np.sum(mine != np.array(per_held))),
        int(np.sum(mine != np.array([one.on_road for one in exact]))) if reference else None,
        float(max(gaps)),
        again_ms,
        None,
        score_ms,
    )


def _in_turn(
    ours: Callable[[], Any], other: Callable[[], Any], repeats: int
) -> tuple[tuple[Any, float], tuple[Any, float]]:
    """Return the results and median times in milliseconds of two calls that take turns, as often
    one as the other.
    """
    times: tuple[list[float], list[float]] = ([], [])
    results: list[Any] = [None, None]
    for _ in range(repeats):
        for which, call in enumerate((ours, other)):
            results[which], took = _timed(call, 1)
            times[which].append(took)
    return (results[0], median(times[0])), (results[1], median(times[1]))


def _timed(call: Callable[[], Any], repeats: int) -> tuple[Any, float]:
    """Return the result and the least time in milliseconds."""
    times, result = [], None
    for _ in range(repeats):
        began = time.process_time()
        result = call()
        times.append(time.process_time() - began)
    return result, min(times) * 1e3
