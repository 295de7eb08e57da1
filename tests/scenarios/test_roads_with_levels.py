"""Below and over a bridge: who drives on the other level, crosses there or has lights there does not
matter to a drive.
"""

import numpy as np
import pytest

from alpasim_plugin.core.geometry import se2
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import Box, LaneMap
from alpasim_plugin.world.route import LaneIndex
from policies.road_forecast import RoadForecast, RoadUser
from scenarios.load import load_scenario
from scenarios.map_route import LaneGraph, Way
from scenarios.map_traffic import Rides, place_followers
from scenarios.map_walkers import place_walkers
from tests.data_sets import shared_folder
from tests.files.opendrive_text import lane, road, section
from tests.world.stacked_roads import STACKED, lanes_of, straight

WAY = Way(("along",), 20.0, 0.0)


def crossing(z_m, crosswalks=()):
    """A lane of 400 m along x, and one across its middle at a height."""
    lanes = lanes_of(
        straight("along", (0, 0, 0), (400, 0, 0), 201),
        straight("across", (200, -200, z_m), (200, 200, z_m), 201),
    )
    return LaneMap(lanes, crosswalks=tuple(crosswalks))


def followers(z_m, seed):
    lane_map = crossing(z_m)
    line = LaneGraph(lane_map.lanes).line(WAY)
    placed = place_followers(Rides(lane_map, WAY, line), 4, stream("levels", seed, "vehicles"))
    return [follower.path.xyz for follower in placed]


@pytest.mark.parametrize("z_m", [-7.0, 4.0])
def test_vehicles_drive_on_both_levels(z_m):
    paths = [path for seed in range(6) for path in followers(z_m, seed)]
    over = [path for path in paths if abs(path[0, 2] - z_m) < 0.1]
    assert len(over) < len(paths)
    assert any(path[0, 1] < -5.0 and path[-1, 1] > 5.0 for path in over)  # over the drive
    for path in (path for seed in range(6) for path in followers(0.0, seed)):
        assert path[0, 1] > -5.0 or path[-1, 1] < 5.0  # at its height, without a rule, never


def test_people_on_a_bridge_do_not_cross_the_road_below():
    corners = np.array([[-4.0, -2.0], [4.0, -2.0], [4.0, 2.0], [-4.0, 2.0], [-4.0, -2.0]])
    t_us = np.arange(0, 60_000_001, 1_000_000)
    for z_m, count in ((7.0, 0), (0.0, 1), (4.0, 0)):
        ring = np.column_stack([corners[:, 0] + 200.0, corners[:, 1], np.full(5, z_m)])
        lane_map = crossing(z_m, [ring])
        line = LaneGraph(lane_map.lanes).line(WAY)
        rng = stream("levels", 0, "pedestrians")
        assert len(place_walkers(lane_map, line, 4.0, 10.0, 2, t_us, rng)) == count


def test_the_edges_below_a_bridge_and_on_it_are_at_their_heights(tmp_path):
    view = '<geometry s="0" x="60" y="-60" hdg="1.5707963267948966" length="120"><line/></geometry>'
    profile = '<elevationProfile><elevation s="0" a="7" b="0" c="0" d="0"/></elevationProfile>'
    both = (lane(1), lane(-1))
    along = road("1", section(0, *both), length=120)
    across = road("2", section(0, *both), length=120, view=view)
    across = across.replace("<lanes>", f"{profile}<lanes>")
    file = tmp_path / "map.xodr"
    file.write_text(f"<OpenDRIVE>{along}{across}</OpenDRIVE>", encoding="utf-8")
    options = ("map.route.from=1:20", "map.route.to=1:50", "map.vehicles=0")
    made = load_scenario(file, 0, options)
    assert sorted(float(np.ptp(edge[:, 2])) for edge in made.lane_map.road_edges) == [0.0, 0.0]
    heights = [float(edge[0, 2]) for edge in made.lane_map.road_edges]
    assert max(heights) - min(heights) == pytest.approx(7.0)
    assert np.abs(made.ego_log.xyz[:, 2]).max() < 1e-6


@pytest.mark.parametrize(("z_m", "goes_straight"), [(0.0, True), (3.0, False)])
@pytest.mark.parametrize("box", [Box(4.6, 1.85, 1.5), Box(12.0, 2.55, 3.8)])
def test_a_vehicle_is_forecast_along_the_road_that_it_is_on(z_m, goes_straight, box):
    pose = se2(95.0, 0.0, 0.0, z_m + box.height_m / 2)
    user = RoadUser(pose, box, np.array([10.0, 0.0]), "car")
    forecast = RoadForecast(STACKED).predicted([user], 0)
    assert (abs(forecast.xy[-1, 0, 1]) < 1.0) == goes_straight
    assert forecast.z[:, 0] == pytest.approx(z_m + box.height_m / 2)


LOGS = sorted(shared_folder().glob("av2/*/"))


@pytest.mark.slow
@pytest.mark.skipif(not LOGS, reason="no logs of Argoverse 2")
def test_recorded_drives_lie_at_the_height_of_their_lanes():
    for folder in LOGS[:1]:
        made = load_scenario(folder)
        index = LaneIndex(made.lane_map)
        places = made.ego_log.xyz[::10]
        in_plan = index.containing_many(places[:, :2])
        assert sum(map(len, in_plan)) > 0
        assert index.containing_many(places) == in_plan
        raised = places + np.array([0.0, 0.0, 4.0])
        assert not any(index.containing_many(raised))
