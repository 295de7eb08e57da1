"""A policy that obeys lights and limits, gives way and keeps distance."""

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.core.errors import PolicyError
from alpasim_plugin.core.geometry import quat_from_yaw, se2
from alpasim_plugin.core.types import Actor, Box, Lane, LaneMap, Signal, Trajectory
from alpasim_plugin.runs.rollout import run_rollout
from evaluators import rollout_values, score
from policies.base import make_policy
from policies.conformance import check_policy
from policies.road_forecast import RoadForecast, RoadUser
from policies.simple import PurePursuit
from scenarios.load import load_scenario
from tests.files.opendrive_text import lane, road, section
from tests.runs.grey_renderer import Grey

CAR = Box(4.6, 1.85, 1.5)
BOTH = (lane(1, 1, 1), lane(-1, -1, -1))
SIGNALS = (
    '<signals><signal id="7" s="98" t="-5" type="1000001" dynamic="yes" orientation="+" '
    'zOffset="0" height="3" width="0.4"/>'
    '<signal id="stop" s="90" t="0" type="294" dynamic="no" orientation="+" zOffset="0"/></signals>'
)
LIMIT = '<type s="0" type="town"><speed max="18" unit="km/h"/></type>'


def street(folder, signals="", limit="", goal_m=150):
    """100 m of road and 300 m behind it; the route leads from 20 m on the first along the second."""
    first = road("1", section(0, *BOTH), length=100, after="road:2:start")
    second = road("2", section(0, *BOTH), x=100, length=300, before="road:1:end")
    parts = (
        first.replace("</road>", f"{signals}</road>"),
        second.replace("<planView>", f"{limit}<planView>"),
    )
    file = folder / "map.xodr"
    file.write_text(f"<OpenDRIVE>{''.join(parts)}</OpenDRIVE>", encoding="utf-8")
    route = ("map.route.from=1:20", f"map.route.to=2:{goal_m}")
    return load_scenario(file, None, ("map.vehicles=0", *route))


def driven(made, name="rule-based"):
    """Drive without cameras; return the log, and time in seconds and x on the map of its front."""
    log = run_rollout(made, Grey(), make_policy(name, made)).log()
    x = log.ego.xyz[:, 0] + made.vehicle.box.length_m / 2 + made.world_origin[0]
    return log, log.ego.t_us * 1e-6, x


def values(made, log):
    return {name: value.value for name, value in rollout_values(score(log, made.scene)).items()}


def test_it_waits_at_a_red_light_drives_on_and_keeps_the_limit(tmp_path):
    made = street(tmp_path, SIGNALS, LIMIT, goal_m=50)
    (signal,) = made.lane_map.signals
    log, t_s, front = driven(made)
    passes_us = int(log.ego.t_us[np.searchsorted(front, 90.0)])
    assert "red" not in signal.colour_at(passes_us)
    stands = np.flatnonzero(np.diff(front) < 1e-4)
    assert 83.0 < front[stands[0]] < 90.0
    speed_mps = np.gradient(front, t_s)
    assert speed_mps[front > 110.0].max() < 5.3
    assert front.max() > 145.0  # the goal
    assert values(made, log)["red_light"] == 0.0
    assert values(made, driven(made, "pure-pursuit")[0])["red_light"] == 1.0


def standing(x, y=-1.75, seconds=60, speed_mps=0.0, yaw=0.0, wait_s=0.0):
    t_us = np.arange(0, seconds * 1_000_000, 100_000, dtype=np.int64)
    gone = speed_mps * np.maximum(t_us * 1e-6 - wait_s, 0.0)
    xyz = np.column_stack([x + gone * np.cos(yaw), y + gone * np.sin(yaw), 0 * t_us + 0.75])
    return Actor("other", "car", CAR, Trajectory(t_us, xyz, quat_from_yaw(np.full(len(t_us), yaw))))


@pytest.mark.parametrize("speed_mps", [0.0, 4.0])
def test_it_keeps_distance_from_who_stands_or_drives_slowly_ahead(tmp_path, speed_mps):
    made = street(tmp_path, goal_m=280)
    lane_y = float(made.ego_log.xyz[0, 1])
    ahead = standing(120.0 - made.world_origin[0], lane_y, speed_mps=speed_mps)
    crowded = replace(made, actors=(ahead,), end_us=20_000_000)
    log, t_s, front = driven(crowded)
    rear = 120.0 - CAR.length_m / 2 + speed_mps * t_s
    gap_m = rear - front
    assert gap_m.min() > 1.5
    assert gap_m[-1] < 12.0  # it follows
    assert values(crowded, log)["collision_any"] == 0.0


def test_it_lets_who_crosses_pass_at_a_line_to_give_way(tmp_path):
    made = street(tmp_path, goal_m=60)
    x0 = made.world_origin[0]
    lane_y = float(made.ego_log.xyz[0, 1])
    stop = np.array([[95.0 - x0, lane_y - 1.75, 0.0], [95.0 - x0, lane_y + 1.75, 0.0]])
    line = Signal(stop, 0.0, ())
    ruled = replace(made.lane_map, give_way=(line,))
    # It comes from the right, and would be met 110 m along the road.
    crossing = standing(105.0 - x0, lane_y - 45.0, speed_mps=8.0, yaw=np.pi / 2, wait_s=1.0)
    crossed = replace(made, lane_map=ruled, actors=(crossing,), end_us=20_000_000)
    log, t_s, front = driven(crossed)
    passes_s = 1.0 + 45.0 / 8.0
    assert front[np.searchsorted(t_s, passes_s)] < 95.0
    assert front.max() > 150.0
    without = replace(crossed, actors=(), lane_map=made.lane_map)
    _, t_s, front = driven(without)
    assert front[np.searchsorted(t_s, passes_s)] > 105.0  # it would have been met
    assert values(crossed, log)["collision_any"] == 0.0


def test_who_does_not_ask_is_not_told_where_road_users_are(tmp_path):
    made = street(tmp_path)
    made = replace(made, end_us=1_000_000)
    told = []

    class Notes(PurePursuit):
        def act(self, observation):
            told.append(observation.road_users)
            return super().act(observation)

    class Asks(Notes):
        sees_road_users = True

    for policy in (Notes, Asks):
        run_rollout(made, Grey(), policy(made))
    assert told[0] is None
    assert told[-1] == {}


def test_without_road_users_it_refuses_to_drive(tmp_path):
    made = street(tmp_path)
    policy = make_policy("rule-based", made)
    policy.sees_road_users = False
    with pytest.raises(PolicyError):
        run_rollout(made, Grey(), policy)


def bend():
    """A lane of 40 m radius to the left, its light after a quarter of the circle."""
    angle = np.linspace(0.0, np.pi, 80)

    def line(radius_m):
        return np.column_stack(
            [radius_m * np.sin(angle), 40.0 - radius_m * np.cos(angle), 0.0 * angle]
        )

    own = Lane("a", line(40.0), line(38.25), line(41.75))
    stop = np.array([[38.0, 40.0, 0.0], [42.0, 40.0, 0.0]])
    red = Signal(stop, np.pi / 2, (("red", 60_000_000),), lanes=("a",))
    return LaneMap({"a": own}, signals=(red,))


def test_a_vehicle_is_expected_along_its_lane_and_before_its_red_light():
    forecast = RoadForecast(bend())
    user = RoadUser(se2(0.0, 0.0, 0.0), CAR, np.array([12.0, 0.0]), "car")
    ahead = forecast.predicted([user], 0)
    radius_m = np.hypot(ahead.xy[:, 0, 0], ahead.xy[:, 0, 1] - 40.0)
    np.testing.assert_allclose(radius_m, 40.0, atol=0.1)
    assert ahead.xy[-1, 0, 1] > 20.0
    near = RoadUser(se2(38.6, 30.0, 1.3), CAR, np.array([3.0, 11.5]), "car")
    assert forecast.predicted([near], 0).xy[:, 0, 1].max() < 40.0
    walker = RoadUser(se2(38.6, 30.0, 1.3), CAR, np.array([0.0, 2.0]), "pedestrian")
    assert forecast.predicted([walker], 0).xy[-1, 0, 1] == pytest.approx(38.0)


def test_it_conforms():
    report = check_policy("rule-based", load_scenario("smoke/straight"))
    assert report.ok, str(report)


@pytest.mark.parametrize("x_m", [20.0, 140.0, 160.0, 280.0])
def test_a_car_is_expected_ahead_of_where_it_is_however_long_its_lane(x_m):
    centre = np.column_stack([np.linspace(0.0, 400.0, 201), np.zeros(201), np.zeros(201)])
    edges = (centre + np.array([0.0, 1.75, 0.0]), centre - np.array([0.0, 1.75, 0.0]))
    forecast = RoadForecast(LaneMap({"long": Lane("long", centre, *edges)}))
    user = RoadUser(se2(x_m, 0.0, 0.0, 0.75), CAR, np.array([10.0, 0.0]), "car")
    ahead = forecast.predicted([user], 0)
    assert ahead.xy[:, 0, 0] == pytest.approx(x_m + 10.0 * np.arange(0.0, 4.01, 0.5))
