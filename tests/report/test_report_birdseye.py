from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from alpasim_plugin.log.run_folder.rows import Rollout
from evaluators.report.birdseye import path_data, scene_view
from evaluators.report.rollouts import events_of

VARIANTS = {("a", "p"): (0, 0)}


def decode(d):
    """Read back relative path data, the slow way."""
    numbers = [int(n) for n in re.findall(r"-?\d+", d)]
    points = np.array(numbers).reshape(-1, 2)
    return np.cumsum(points, axis=0)


def scene(x, y, **more: Any):
    t_us = [k * 100_000 for k in range(len(x))]
    vehicle = {"length_m": 4.8, "width_m": 1.9, "rear_axle_to_centre_m": 1.4}
    return {
        "scene_id": "s",
        "ego_log": {"t_us": t_us, "x_m": x, "y_m": y},
        "vehicle": vehicle,
        "lanes": [],
    } | more


def series_of(x, y, **more: list[float]):
    t_us = np.arange(len(x)) * 100_000
    names = {"ego_x_m": x, "ego_y_m": y, "ego_yaw_rad": [0.0] * len(x)} | more
    return {name: (t_us, np.array(values, float)) for name, values in names.items()}


coordinates = st.lists(
    st.tuples(st.floats(-3000, 3000), st.floats(-3000, 3000)), min_size=2, max_size=30
)


@given(coordinates)
@settings(deadline=None)
def test_path_data_stays_near_the_line(points):
    line = np.array(points)
    d = path_data(line, tolerance=1.5)
    if d:
        back = shapely.linestrings(decode(d))
        assert all(
            back.distance(shapely.Point(p)) <= 1.5 + 1.5 for p in line
        )  # tolerance and rounding of two coordinates
    else:
        assert float(np.ptp(line, axis=0).max()) <= 3.0  # all in one pixel


@pytest.mark.parametrize("yaw", [0.0, 0.5, np.pi / 2, 3.0, -2.2])
def test_log_runs_from_left_to_right_and_left_of_it_is_up(yaw):
    s = np.linspace(0, 100, 50)
    x, y = np.cos(yaw) * s, np.sin(yaw) * s
    left = (x - 2.0 * np.sin(yaw), y + 2.0 * np.cos(yaw))
    rollout = Rollout("a", "p", "s", 0, "ok")
    view = scene_view(
        "s",
        scene(x.tolist(), y.tolist()),
        [rollout],
        {rollout.cell: series_of(*(v.tolist() for v in left))},
        VARIANTS,
    )
    log, track = decode(view.log), decode(view.tracks[0].d)
    assert log[-1, 0] > log[0, 0]
    assert abs(log[-1, 1] - log[0, 1]) <= 2
    assert np.all(track[:, 1] < log[0, 1])
    unit_per_m = (log[-1, 0] - log[0, 0]) / 100.0
    assert (log[0, 1] - track[0, 1]) == pytest.approx(2.0 * unit_per_m, abs=2)
    assert (log >= 0).all()
    assert (log[:, 0] <= view.width).all()
    assert (log[:, 1] <= view.height).all()


def test_rollout_that_drives_away_does_not_shrink_the_scene():
    x = np.linspace(0, 100, 50).tolist()
    rollout = Rollout("a", "p", "s", 0, "ok")
    stray = series_of(x, np.linspace(0, 5000, 50).tolist())
    view = scene_view("s", scene(x, [0.0] * 50), [rollout], {rollout.cell: stray}, VARIANTS)
    unit_per_m = np.ptp(decode(view.log)[:, 0]) / 100.0
    assert view.height / unit_per_m < 70.0


def test_overlapping_lanes_of_both_directions_do_not_cut_holes():
    there = {"left": [[0, 2], [100, 2]], "right": [[0, -2], [100, -2]]}
    back = {"left": [[100, -3], [0, -3]], "right": [[100, 1], [0, 1]]}
    view = scene_view("s", scene([0.0, 100.0], [0.0, 0.0], lanes=[there, back]), [], {}, VARIANTS)
    areas = [
        np.sign(shapely.LinearRing(decode(part)).is_ccw - 0.5)
        for part in view.lanes.split("z")
        if part
    ]
    assert len(areas) == 2
    assert areas[0] == areas[1]


def test_event_is_marked_where_and_when_it_happened():
    x = np.linspace(0, 50, 51).tolist()
    rollout = Rollout(
        "a",
        "p",
        "s",
        3,
        "ok",
        metrics={"collision_any": 1.0, "collision_front": 1.0, "offroad": 0.0},
    )
    hit = [0.0] * 20 + [1.0] * 31
    series = {
        rollout.cell: series_of(
            x, [0.0] * 51, collision_any=hit, collision_front=hit, offroad=[1.0] * 51
        )
    }
    view = scene_view("s", scene(x, [0.0] * 51), [rollout], series, VARIANTS)
    (mark,) = view.marks  # off-road steps that the rollout's metric does not count are not marked
    assert (
        mark.text == "a \u00b7 seed 3: collision (front) at 2.0\u00a0s, x 21.4, y 0.0\u00a0m"
    )  # the box's centre
    log = decode(view.log)
    assert mark.x == pytest.approx(log[0, 0] + 21.4 * np.ptp(log[:, 0]) / 50.0, abs=2)
    assert mark.footprint.endswith("z")


def test_event_that_no_step_shows_is_listed_without_a_place():
    rollout = Rollout("a", "p", "s", 0, "ok", metrics={"offroad": 1.0})
    view = scene_view("s", scene([0.0, 50.0], [0.0, 0.0]), [rollout], {}, VARIANTS)
    assert view.marks[0].x is None
    assert view.marks[0].text == "a \u00b7 seed 0: off-road at a time that no step shows"


def test_far_from_the_origin_costs_no_precision():
    s = np.linspace(0, 60, 30)
    rollout = Rollout("a", "p", "s", 0, "ok")
    views = []
    for offset in (0.0, 5_412_345.25):
        x, y = (s + offset).tolist(), (0.05 * s + offset).tolist()
        views.append(
            scene_view("s", scene(x, y), [rollout], {rollout.cell: series_of(x, y)}, VARIANTS)
        )
    assert views[0] == views[1]


def test_event_during_warm_up_does_not_give_the_time():
    rollout = Rollout("a", "p", "s", 0, "ok", metrics={"offroad": 1.0})
    off = [1.0] * 5 + [0.0] * 10 + [1.0] * 5
    relevant = [0.0] * 8 + [1.0] * 12
    series = {rollout.cell: series_of([0.0] * 20, [0.0] * 20, offroad=off, eval_relevant=relevant)}
    (event,) = events_of(rollout, series)
    assert event.t_s == pytest.approx(1.5)


def test_lane_without_an_edge_gives_its_line_and_no_area():
    view = scene_view(
        "s",
        scene([0.0, 100.0], [0.0, 0.0], lanes=[{"left": [[0, 2], [100, 2]], "right": None}]),
        [],
        {},
        VARIANTS,
    )
    assert view is not None
    assert view.lanes == ""
    assert view.lines.count("M") == 1
