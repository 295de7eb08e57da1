"""The maps from above: what is drawn is where and when it was."""

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.log.run_folder.rows import Rollout
from alpasim_plugin.log.run_folder.writer import scene_as_json
from evaluators.pages.above import still_map
from evaluators.pages.html import marked_events
from evaluators.pages.rollouts import events_of
from scenarios.load import load_scenario

VARIANTS = {("a", "p"): (0, 0)}
X = np.linspace(0, 50, 51)


def scene(x, y, **more):
    vehicle = {"length_m": 4.8, "width_m": 1.9, "rear_axle_to_centre_m": 1.4}
    return {"ego_log": {"x_m": list(x), "y_m": list(y)}, "vehicle": vehicle} | more


def series_of(x, y, **more):
    names = {"ego_x_m": x, "ego_y_m": y, "ego_yaw_rad": 0.0 * np.asarray(x)} | more
    t_us = np.arange(len(x)) * 100_000
    return {name: (t_us, np.array(values, dtype=float)) for name, values in names.items()}


def drawn(rollout, content, own):
    return still_map("s", content, [rollout], {rollout.key: own} if own else {}, VARIANTS)


def test_an_event_is_marked_where_and_when_it_happened():
    counted = {"collision_any": 1.0, "collision_front": 1.0, "offroad": 0.0}
    hit = [0.0] * 20 + [1.0] * 31
    own = series_of(X, 0 * X, collision_any=hit, collision_front=hit, offroad=[1.0] * 51)
    found = drawn(Rollout("a", "p", "s", 3, "ok", metrics=counted), scene(X, 0 * X), own)
    (mark,) = found["marks"]  # off-road steps that the metric does not count are not marked
    assert mark["text"] == "a \u00b7 seed 3: collision (front) at 2.0\u00a0s, x 21.4, y 0.0\u00a0m"
    assert (mark["x"], mark["y"], mark["size"]) == (2140, 0, [480, 190])
    assert found["users_at"] == "at 2.0\u00a0s, when the first collision (front) happens"
    assert found["tracks"][0]["line"] == [[0, 5000], [0, 0]]


def test_an_event_that_no_step_shows_is_listed_without_a_place():
    rollout = Rollout("a", "p", "s", 0, "ok", metrics={"offroad": 1.0})
    (mark,) = drawn(rollout, scene([0.0, 50.0], [0.0, 0.0]), None)["marks"]
    assert "x" not in mark
    assert mark["text"] == "a \u00b7 seed 0: off-road at a time that no step shows"


def test_the_legend_names_the_events_that_the_maps_mark():
    stalled = drawn(
        Rollout("a", "p", "s", 0, "ok", metrics={"stalled": 1.0}), scene(X, 0 * X), None
    )
    hit = drawn(
        Rollout("a", "p", "s", 0, "ok", metrics={"collision_any": 1.0}), scene(X, 0 * X), None
    )
    assert marked_events([stalled]) == ["stalled"]
    assert marked_events([stalled, hit]) == ["collision", "stalled"]
    assert marked_events([]) == []


def test_far_from_the_origin_costs_no_precision():
    rollout = Rollout("a", "p", "s", 0, "ok")
    maps = []
    for offset in (0.0, 5_412_345.25):
        x = X + offset
        y = 0.05 * X + offset
        maps.append(drawn(rollout, scene(x, y), series_of(x, y)))
    assert maps[0] == maps[1]


def test_an_event_during_warm_up_does_not_give_the_time():
    rollout = Rollout("a", "p", "s", 0, "ok", metrics={"offroad": 1.0})
    off = [1.0] * 5 + [0.0] * 10 + [1.0] * 5
    relevant = [0.0] * 8 + [1.0] * 12
    series = {
        rollout.key: series_of(np.zeros(20), np.zeros(20), offroad=off, eval_relevant=relevant)
    }
    (event,) = events_of(rollout, series)
    assert event.t_s == pytest.approx(1.5)


def test_a_collision_has_time_and_side_of_the_contact_that_made_the_outcome():
    """Something touches the rear at 2 s; the ego drives into something at 5 s."""
    hit_rear = [0.0] * 20 + [1.0] * 10 + [0.0] * 21
    hit_front = [0.0] * 50 + [1.0]
    names = ("collision_any", "collision_at_fault", "collision_front", "collision_rear")
    rollout = Rollout("a", "p", "s", 0, "ok", metrics=dict.fromkeys(names, 1.0))
    either = np.maximum(hit_rear, hit_front)
    steps = series_of(
        X,
        0 * X,
        collision_any=either,
        collision_at_fault=hit_front,
        collision_front=hit_front,
        collision_rear=hit_rear,
    )
    (event,) = events_of(rollout, {rollout.key: steps})
    assert (event.t_s, event.what) == (pytest.approx(5.0), "collision (front)")
    innocent = replace(rollout, metrics=rollout.metrics | {"collision_at_fault": 0.0})
    (event,) = events_of(innocent, {rollout.key: steps})
    assert (event.t_s, event.what) == (pytest.approx(2.0), "collision (rear)")
    (event,) = events_of(rollout, {})
    assert event.what == "collision"


def test_a_lane_without_an_edge_gives_its_line_and_no_area():
    lane = {"left": [[0, 2], [50, 2]], "right": None, "markings": ["solid_white", "none"]}
    found = drawn(Rollout("a", "p", "s", 0, "ok"), scene(X, 0 * X, lanes=[lane]), None)["map"]
    assert (found["lanes"], len(found["markings"])) == ([], 1)


def test_a_road_user_is_where_it_is_at_the_first_event_and_leaves_its_way():
    scenario = load_scenario("smoke/lead_car")
    (lead,) = [actor for actor in scenario.actors if actor.actor_id == "lead"]
    content = scene_as_json(scenario)
    rollout = Rollout("a", "p", "s", 0, "ok", metrics={"offroad": 1.0})
    own = series_of(*scenario.ego_log.xyz[:51, :2].T, offroad=[0.0] * 40 + [1.0] * 11)
    own = {name: (t_us + scenario.start_us, values) for name, (t_us, values) in own.items()}
    users = [one for one in drawn(rollout, content, own)["users"] if "way" in one]
    place = lead.track.xyz[np.searchsorted(lead.track.t_us, scenario.start_us + 4_000_000), :2]
    origin = [content["ego_log"][axis][0] for axis in ("x_m", "y_m")]
    away_m = [np.hypot(*(np.array([one["x"], one["y"]]) / 100 + origin - place)) for one in users]
    assert min(away_m) < 3.0
    assert users[int(np.argmin(away_m))]["size"][1] == round(100 * lead.box.width_m)
