"""Cyclists on maps: where they ride, that they wait, and that nobody touches anybody."""

import numpy as np
import pytest
import shapely

from alpasim_plugin.core.geometry import rectangle_corners, yaw_from_quat
from alpasim_plugin.core.types import Actor, Trajectory
from alpasim_plugin.runs.rollout import run_rollout
from policies.base import make_policy
from scenarios.load import load_scenario
from tests.files.opendrive_text import lane, road, section
from tests.runs.grey_renderer import Grey

CYCLE_LANE = lane(-2, -2, -2).replace("driving", "biking").replace('a="3.5"', 'a="1.6"')
LIGHT = (
    '<signals><signal id="7" s="100" t="-5" type="1000001" dynamic="yes" orientation="+" '
    'zOffset="0" height="3" width="0.4"/></signals>'
)


def posted(kmh):
    return f'<type s="0" type="town"><speed max="{kmh}" unit="km/h"/></type>'


def street(kmh=50, lanes=(lane(1, 1, 1), lane(-1, -1, -1)), more=""):
    """A straight street of 500 m."""
    text = road("1", section(0, *lanes), length=500)
    return text.replace("<planView>", f"{posted(kmh)}<planView>").replace(
        "</road>", f"{more}</road>"
    )


SHORT = "timing.duration_us=2000000"  # where only the places matter


def scene(folder, text, *overrides, seed=0):
    file = folder / "map.xodr"
    file.write_text(f"<OpenDRIVE>{text}</OpenDRIVE>", encoding="utf-8")
    chosen = ("map.route.from=1:20", "map.route.to=1:150", "map.vehicles=0", *overrides)
    return load_scenario(file, seed, chosen)


def cyclists(scenario):
    return [actor for actor in scenario.actors if actor.label == "cyclist"]


def outlines(actor, rows):
    size = np.tile([actor.box.length_m, actor.box.width_m], (len(rows), 1))
    yaw = yaw_from_quat(actor.track.quat[rows])
    return shapely.polygons(rectangle_corners(actor.track.xyz[rows, :2], yaw, size))


def touching(actors):
    """Return the names of those whose boxes touch at a time of both tracks."""
    out = []
    for number, first in enumerate(actors):
        for second in actors[number + 1 :]:
            _, row, other = np.intersect1d(first.track.t_us, second.track.t_us, return_indices=True)
            if shapely.intersects(outlines(first, row), outlines(second, other)).any():
                out.append((first.actor_id, second.actor_id))
    return out


def expert_of(scenario):
    """Return the expert as an actor, at the times of the others' tracks."""
    log = scenario.ego_log
    rows = np.flatnonzero(log.t_us % 50_000 == 0)
    yaw = yaw_from_quat(log.quat[rows])
    ahead = np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], axis=1)
    centre = log.xyz[rows] + scenario.vehicle.rear_axle_to_centre_m * ahead
    track = Trajectory(log.t_us[rows], centre, log.quat[rows])
    return Actor("expert", "car", scenario.vehicle.box, track)


def test_without_the_option_there_are_none_and_the_scene_is_the_same(tmp_path):
    without = scene(tmp_path, street(), SHORT)
    none = scene(tmp_path, street(), "map.cyclists=0", SHORT)
    some = scene(tmp_path, street(), "map.cyclists=3", SHORT)
    assert cyclists(without) == []
    assert without.content_hash == none.content_hash != some.content_hash


def test_they_ride_at_the_right_of_a_lane_where_cars_stay_behind_them(tmp_path):
    riders = cyclists(scene(tmp_path, street(), "map.cyclists=4", SHORT))
    assert len(riders) > 0
    for rider in riders:
        assert rider.behaviour.kind == "idm"
        assert 3.0 <= rider.behaviour.params["desired_speed_mps"] <= 7.0
        eastbound = rider.track.xyz[-1, 0] > rider.track.xyz[0, 0]
        middle_m = -1.75 if eastbound else 1.75
        right_m = (middle_m - rider.track.xyz[:, 1]) * (1.0 if eastbound else -1.0)
        assert right_m == pytest.approx(np.full(len(right_m), 1.15), abs=0.02)


def test_in_a_wide_lane_they_ride_at_the_edge(tmp_path):
    wide = tuple(text.replace('a="3.5"', 'a="6.4"') for text in (lane(1, 1, 1), lane(-1, -1, -1)))
    riders = cyclists(scene(tmp_path, street(lanes=wide), "map.cyclists=4", SHORT))
    assert len(riders) > 0
    for rider in riders:
        edge_m = 6.4 - np.abs(rider.track.xyz[:, 1])
        assert edge_m == pytest.approx(np.full(len(edge_m), 0.6), abs=0.02)


def test_they_ride_on_a_cycle_lane_where_there_is_one(tmp_path):
    riders = cyclists(
        scene(tmp_path, street(lanes=(lane(-1, -1, -1), CYCLE_LANE)), "map.cyclists=4", SHORT)
    )
    assert len(riders) > 0
    for rider in riders:
        assert rider.track.xyz[:, 1] == pytest.approx(np.full(len(rider.track), -4.3), abs=0.02)


@pytest.mark.parametrize(("kmh", "ride"), [(50, True), (70, False)])
def test_none_ride_on_fast_roads(tmp_path, kmh, ride):
    scenario = scene(tmp_path, street(kmh), "map.cyclists=3", SHORT)
    assert bool(cyclists(scenario)) == ride
    assert any("of 3 cyclists" in note for note in scenario.notes)


def test_they_wait_at_a_red_light(tmp_path):
    minute = ("map.route.to=1:300", "timing.duration_us=60000000", "map.cyclists=6")
    one_way = street(lanes=(lane(-1, -1, -1),), more=LIGHT.replace('s="100"', 's="250"'))
    scenario = scene(tmp_path, one_way, *minute, seed=0)
    (signal,) = scenario.lane_map.signals
    line_m = float(signal.stop[0, 0])
    passed = waited = 0
    for rider in cyclists(scenario):
        x = rider.track.xyz[:, 0] + rider.box.length_m / 2
        crossing = np.flatnonzero((x[:-1] < line_m) & (x[1:] >= line_m))
        passed += len(crossing)
        stands = (np.diff(x) < 0.005) & (x[:-1] > line_m - 4.0) & (x[:-1] < line_m)
        waited += bool(stands.any() and len(crossing))
        assert all(signal.colour_at(int(rider.track.t_us[row])) != "red" for row in crossing)
    assert passed > waited > 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_cars_and_the_expert_follow_them_and_nobody_touches(tmp_path, seed):
    overrides = ("map.vehicles=5", "map.cyclists=5")
    scenario = scene(tmp_path, street(more=LIGHT), *overrides, seed=seed)
    assert len(cyclists(scenario)) > 0
    assert touching([expert_of(scenario), *scenario.actors]) == []
    policy = make_policy("rule-based", scenario)
    log = run_rollout(scenario, Grey(), policy, 0).log()
    ego = Actor("ego", "car", log.ego_box, log.ego)
    assert touching([ego, *log.actors.values()]) == []
