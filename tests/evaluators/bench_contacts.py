"""Time the contact search against one spatial tree per step and count disagreements: ``python -m tests.evaluators.bench_contacts``."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import shapely

from alpasim_plugin.geometry import yaw_from_quat
from alpasim_plugin.types import RolloutLog
from evaluators import PRESETS, score
from evaluators.footprint import ActorTable, corners, ego_footprints, origin_of
from evaluators.step_contact import find_contacts
from tests.evaluators.eval_build import TWO_LANES, car, rollout, scene, track

PAPER = PRESETS["paper"]


def per_step(log: RolloutLog) -> list[tuple[bool, float]]:
    """Contact and gap per step: polygons of everybody, a tree, a query."""
    origin = origin_of(log.ego, PAPER)[:2]

    def polygon(xyz, quat, size):
        return shapely.Polygon(corners((xyz[:2] - origin)[None], np.array([yaw_from_quat(quat)]), np.array([size]))[0])

    out = []
    for i, t in enumerate(log.ego.t_us):
        ego = polygon(log.ego.xyz[i], log.ego.quat[i], PAPER.ego_size_m)
        others = []
        for actor in log.actors.values():
            if actor.track.t_us[0] <= t <= actor.track.t_us[-1]:
                k = np.searchsorted(actor.track.t_us, t)
                others.append(polygon(actor.track.xyz[k], actor.track.quat[k], (actor.box.length_m, actor.box.width_m)))
        hits = shapely.STRtree(others).query(ego, predicate="intersects")
        out.append((len(hits) > 0, min((ego.distance(one) for one in others), default=np.inf)))
    return out


def busy_road(n_actors: int, n_steps: int) -> RolloutLog:
    rng = np.random.Generator(np.random.Philox(1))
    x = np.cumsum(rng.uniform(0.5, 1.5, n_steps))
    actors = []
    for k in range(n_actors):
        along = rng.uniform(0, x[-1]) + np.cumsum(rng.uniform(-1, 2, n_steps))
        actors.append(car(f"a{k}", track(along, rng.uniform(-40, 40), yaw=rng.uniform(-3, 3, n_steps))))
    return rollout(track(x, 0.0, yaw=rng.uniform(-0.05, 0.05, n_steps)), actors)


def best_ms(call: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        began = time.perf_counter()
        call()
        times.append(time.perf_counter() - began)
    return min(times) * 1e3


def main() -> None:
    print("| actors | steps | this | per step | ratio | everything (`score`) | disagreements | largest gap difference |")
    print("|---|---|---|---|---|---|---|---|")
    for n_actors in (10, 40, 200):
        for n_steps in (200, 900):
            log = busy_road(n_actors, n_steps)
            origin = origin_of(log.ego, PAPER)

            def search(log=log, origin=origin):
                return find_contacts(ego_footprints(log, PAPER, origin), ActorTable(log, PAPER, origin), log.ego.t_us)

            _, gap_m = search()
            slow = per_step(log)
            fast_ms, slow_ms = best_ms(search, 5), best_ms(lambda log=log: per_step(log), 1)
            all_ms = best_ms(lambda log=log: score(log, scene(TWO_LANES, log)), 3)
            differ = sum((gap == 0) != hit for gap, (hit, _) in zip(gap_m, slow, strict=True))
            worst = max(abs(gap - want) for gap, (_, want) in zip(gap_m, slow, strict=True))
            times = f"{fast_ms:.1f} ms | {slow_ms:.0f} ms | {slow_ms / fast_ms:.0f} | {all_ms:.0f} ms"
            print(f"| {n_actors} | {n_steps} | {times} | {differ} | {worst:.0e} |")


if __name__ == "__main__":
    main()
