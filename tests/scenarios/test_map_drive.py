"""Drives on maps that have none: routes, traffic lights, traffic, and what is refused.

Every map is made here.
"""

from xml.etree import ElementTree

import numpy as np
import pytest
import shapely

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import interpolate, yaw_from_quat
from alpasim_plugin.core.lane_areas import lane_polygon
from alpasim_plugin.world.ground import ground_poses
from scenarios.load import load_scenario
from scenarios.opendrive import read_lanes
from scenarios.opendrive_road import parse_map
from scenarios.opendrive_signals import traffic_lights
from scenarios.street_map import with_cycles
from tests.examples import first_of
from tests.files.opendrive_text import lane, road, section


def light(i, s, more="", kind="1000001", t=-5.0):
    return (
        f'<signal id="{i}" s="{s}" t="{t}" type="{kind}" dynamic="yes" orientation="+" '
        f'zOffset="0" height="3" width="0.4">{more}</signal>'
    )


def with_signals(text, *signals):
    return text.replace("</road>", f"<signals>{''.join(signals)}</signals></road>")


STOP = '<signal id="stop" s="90" t="0" type="294" dynamic="no" orientation="+" zOffset="0"/>'
BOTH = (lane(1, 1, 1), lane(-1, -1, -1))


def two_roads(*signals):
    """Two straights of 100 m and 300 m, one behind the other."""
    first = road("1", section(0, *BOTH), length=100, after="road:2:start")
    return (
        with_signals(first, *signals),
        road("2", section(0, *BOTH, lane(-2)), x=100, length=300, before="road:1:end"),
    )


def scenario(folder, parts, *overrides, seed=None):
    file = folder / "map.xodr"
    file.write_text(f"<OpenDRIVE>{''.join(parts)}</OpenDRIVE>", encoding="utf-8")
    return load_scenario(file, seed, ("map.vehicles=0", *overrides))


def named(start, goal):
    return f"map.route.from={start}", f"map.route.to={goal}"


def test_the_command_names_the_ends_of_a_route(tmp_path, capsys):
    scenario(tmp_path, two_roads())
    command = ["--renderer", "clean", "--dry-run", str(tmp_path / "map.xodr")]
    assert run_command([*command, "--from", "1:20", "--to", "2:150"]) == 0
    assert run_command([*command, "--from", "1:20", "--to", "9:150"]) == 2
    assert "9" in capsys.readouterr().err


def test_a_named_route_is_driven_from_place_to_place(tmp_path):
    made = scenario(tmp_path, two_roads(), *named("1:20", "2:150"))
    assert made.source == "opendrive"
    assert made.route.lane_ids[:2] == ("1.0.-1", "2.0.-1")
    x = made.ego_log.xyz[:, 0] + made.world_origin[0]
    assert x[0] == pytest.approx(20.0, abs=0.2)
    assert x[-1] == pytest.approx(250.0, abs=1.0)
    assert np.allclose(made.ego_log.xyz[:, 1], -1.75, atol=0.05)
    assert made.route.xyz[-1, 0] > made.ego_log.xyz[-1, 0] + 80.0


def test_a_route_against_the_other_one_takes_the_other_side(tmp_path):
    made = scenario(tmp_path, two_roads(), *named("2:150", "1:20"))
    assert made.route.lane_ids[:2] == ("2.0.1", "1.0.1")
    assert np.allclose(made.ego_log.xyz[:, 1], 1.75, atol=0.05)


def test_a_route_changes_lanes_where_it_has_to(tmp_path):
    aside = '<geometry s="0" x="-100" y="-3.5" hdg="0" length="100"><line/></geometry>'
    parts = (
        road("0", section(0, lane(-1, None, -2)), length=100, after="road:1:start", view=aside),
        road("1", section(0, lane(-1, None, -1), lane(-2)), length=200, after="road:2:start"),
        road("2", section(0, lane(-1, -1)), x=200, length=200, before="road:1:end"),
    )
    made = scenario(tmp_path, parts, *named("0:50", "2:100"))
    assert made.route.lane_ids[:4] == ("0.0.-1", "1.0.-2", "1.0.-1", "2.0.-1")
    y = made.ego_log.xyz[:, 1] + made.world_origin[1]
    assert y[[0, -1]] == pytest.approx([-5.25, -1.75], abs=0.01)


def test_the_seed_draws_the_route(tmp_path):
    once, again, other = (scenario(tmp_path, two_roads(), seed=seed) for seed in (0, 0, 1))
    assert once.content_hash == again.content_hash
    assert not np.array_equal(once.ego_log.xyz[0], other.ego_log.xyz[0])


@pytest.mark.parametrize(
    ("route", "value"),
    [
        (named("7:20", "2:150"), "7"),
        (named("1:20", "2:400"), "2:400"),
        (named("1:90", "1:20"), "1:20"),
        (("map.route.from=here",), "here"),
        (("map.route=shortest",), "shortest"),
        ((*named("1:20", "2:150"), "ego.lane=1"), "ego.lane"),
    ],
)
def test_a_route_that_the_map_does_not_have_is_refused(tmp_path, route, value):
    lonely = road("1", section(0, lane(-1, -1, -1)), length=100, after="road:2:start")
    parts = (lonely, road("2", section(0, lane(-1, -1)), x=100, length=300, before="road:1:end"))
    with pytest.raises(InputError) as error:
        scenario(tmp_path, parts, *route)
    assert value in error.value.message


def test_the_expert_waits_at_the_stop_line_and_who_drives_on_is_caught(tmp_path):
    made = scenario(tmp_path, two_roads(light("7", 98), STOP), *named("1:20", "2:150"))
    (signal,) = made.lane_map.signals
    assert signal.name == "7"
    assert signal.lanes == ("1.0.-1",)
    assert signal.stop[:, 0] + made.world_origin[0] == pytest.approx([90.0, 90.0])
    x = made.ego_log.xyz[:, 0] + made.world_origin[0]
    front = x + made.vehicle.rear_axle_to_centre_m + made.vehicle.box.length_m / 2
    stands = np.flatnonzero(np.diff(x) < 1e-6)
    assert 84.0 < front[stands[0]] < 90.0
    assert signal.colour_at(int(made.ego_log.t_us[np.searchsorted(front, 90.0)])) != "red"
    on_free_road_us = round((90.0 - front[0]) / 10.0 * 1e6)
    assert signal.colour_at(on_free_road_us) == "red"


def test_a_light_that_is_too_near_to_stop_at_is_green_when_the_ego_passes_it(tmp_path):
    for start_m in (60, 70, 80, 85):
        made = scenario(tmp_path, two_roads(light("7", 98), STOP), *named(f"1:{start_m}", "2:150"))
        (signal,) = made.lane_map.signals
        x = made.ego_log.xyz[:, 0] + made.world_origin[0]
        front = x + made.vehicle.rear_axle_to_centre_m + made.vehicle.box.length_m / 2
        passed = int(np.searchsorted(front, 90.0))
        assert signal.colour_at(int(made.ego_log.t_us[passed])) in ("green", "yellow")


@pytest.mark.parametrize(("number", "height_m"), [("1", 0.0), ("2", 7.0)])
def test_a_drive_under_a_bridge_is_level_and_so_is_one_on_it(tmp_path, number, height_m):
    over = '<geometry s="0" x="100" y="-100" hdg="1.5707963" length="200"><line/></geometry>'
    raised = (
        '</planView><elevationProfile><elevation s="0" a="7" b="0" c="0" d="0"/></elevationProfile>'
    )
    parts = (
        road("1", section(0, *BOTH), length=200),
        road("2", section(0, *BOTH), length=200, view=over).replace("</planView>", raised),
    )
    made = scenario(tmp_path, parts, *named(f"{number}:20", f"{number}:180"))
    z = made.ego_log.xyz[:, 2] + made.world_origin[2]
    assert z == pytest.approx(np.full(len(z), height_m), abs=1e-6)
    poses = ground_poses(made.ground, made.ego_log.xyz[:, :2], yaw_from_quat(made.ego_log.quat))
    assert poses[:, 2, 3] + made.world_origin[2] == pytest.approx(z, abs=1e-6)
    assert np.degrees(np.arccos(np.clip(poses[:, 2, 2], -1.0, 1.0))).max() < 1.5


def junction_of(*parts):
    links = '<laneLink from="-1" to="-1"/>'
    connection = (
        f'<connection incomingRoad="1" connectingRoad="2" contactPoint="start">{links}</connection>'
    )
    return f'<junction id="9">{connection}</junction>{"".join(parts)}'


def test_lights_of_a_junction_take_turns_and_people_walk_while_their_road_has_red(tmp_path):
    validity = '<validity fromLane="-1" toLane="-1"/>'
    incoming = road("1", section(0, lane(-1), lane(-2)), length=100, after="junction:9")
    inside = road("2", section(0, lane(-1)), x=100, length=20, junction="9", before="road:1:end")
    crossing = (
        '<signal id="z" s="95" t="-3.5" type="1000003" dynamic="no" orientation="+" width="8"/>'
    )
    northward = '<geometry s="0" x="110" y="-110" hdg="1.5708" length="100"><line/></geometry>'
    parts = (
        with_signals(incoming, light("a", 98, validity), light("p", 95, kind="1000002"), crossing),
        with_signals(inside, '<signalReference id="a" s="12" t="-5" orientation="+"/>'),
        with_signals(
            road("3", section(0, lane(-1)), length=100, after="junction:9", view=northward),
            light("b", 98),
        ),
        junction_of('<controller id="n"><control signalId="b"/></controller>'),
    )
    root = ElementTree.fromstring(f"<OpenDRIVE>{''.join(parts)}</OpenDRIVE>")
    odr = parse_map("map.xodr", root)
    lanes, _ = read_lanes("map.xodr", odr, np.eye(4))
    heads, notes = traffic_lights(odr, lanes, np.eye(4))
    assert not notes
    signals = with_cycles(heads, {"9": 1_000_000})
    by = {(one.name, one.lanes): one for one in signals}
    assert set(by) == {
        ("a", ("1.0.-1",)),
        ("a", ("2.0.-1",)),
        ("p", ("1.0.-1", "1.0.-2")),
        ("b", ("3.0.-1",)),
    }
    assert by["a", ("2.0.-1",)].stop[:, 0] == pytest.approx([100.0, 100.0])
    walk, go, other = by["p", ("1.0.-1", "1.0.-2")], by["a", ("1.0.-1",)], by["b", ("3.0.-1",)]
    assert walk.stop[:, 0] == pytest.approx([93.0, 97.0])
    assert walk.pedestrians
    for t_us in range(0, 60_000_000, 500_000):
        colours = go.colour_at(t_us), other.colour_at(t_us), walk.colour_at(t_us)
        assert "red" in colours[:2]
        assert colours[0] == "red" or colours[2] == "red"
    assert {one.colour_at(1_000_000) for one in signals} == {"green", "red"}
    assert go.head is not None
    assert go.head[0] == pytest.approx(98.0)
    assert go.head[2] >= 3.0


def test_what_stands_beside_a_road_is_part_of_the_map_and_what_does_not_fit_is_said(tmp_path):
    outline = "".join(f'<cornerLocal u="{u}" v="{v}"/>' for u, v in ((-2, -4), (2, -4), (2, 4)))
    objects = (
        f'<objects><object type="crosswalk" s="50" t="0" hdg="0"><outline>{outline}</outline></object>'
        '<object type="tree" s="10" t="9"/></objects>'
    )
    sign = '<signal id="s" s="30" t="-5" type="205" dynamic="no" orientation="+" zOffset="2" height="0.9" width="0.8"/>'
    lost = '<signalReference id="nobody" s="1" t="0" orientation="+"/>'
    first, second = two_roads(sign, lost, light("in the field", 150, t=40))
    parts = (first.replace("</road>", f"{objects}</road>"), second)
    made = scenario(tmp_path, parts, *named("1:0", "2:150"))
    x = made.world_origin[0]
    (ring,) = made.lane_map.crosswalks
    assert ring[:3, :2] + [x, made.world_origin[1]] == pytest.approx(
        np.array([[48, -4], [52, -4], [52, 4]])
    )
    ((pose, box),) = made.lane_map.signs
    assert pose[:3, 3] == pytest.approx([30.0 - x, -5.0 - made.world_origin[1], 2.45])
    assert box.width_m == 0.8
    for word in ("tree", "references", "205 (1)"):
        assert any(word in note for note in made.notes)


def test_vehicles_start_apart_keep_apart_and_wait_for_red(tmp_path):
    parts = two_roads(light("7", 98), STOP)
    made = scenario(tmp_path, parts, *named("1:0", "2:200"), "map.vehicles=4", seed=3)
    assert 0 < len(made.actors) <= 4
    assert {actor.behaviour.kind for actor in made.actors} == {"idm"}
    starts = [made.ego_log.xyz[0, :2], *(actor.track.xyz[0, :2] for actor in made.actors)]
    for n, one in enumerate(starts):
        assert all(np.hypot(*(one - other)) >= 20.0 for other in starts[:n])


@pytest.mark.parametrize("lane_changes", [False, True])
def test_vehicles_change_lanes_where_the_file_says_so(tmp_path, lane_changes):
    route = (*named("1:0", "2:200"), "map.vehicles=1", f"map.lane_changes={lane_changes}".lower())
    made = scenario(tmp_path, two_roads(light("7", 98), STOP), *route, seed=3)
    (vehicle,) = made.actors
    assert ("change_gain_mps2" in vehicle.behaviour.params) == lane_changes


@pytest.mark.parametrize(
    "parts",
    [
        (road("1", section(0, lane(-1)), length=10),),  # too short for a route
        (road("1", length=100),),  # without lanes
        (road("1", section(0, lane(-1).replace('a="3.5"', 'a="1.5"')), length=100),),  # too narrow
        (road("1", section(0, lane(-1).replace('"driving"', '"sidewalk"')), length=100),),
        (road("1", section(0, lane(-1)), length=0, view="<geometry/>"),),  # broken numbers
        (with_signals(road("1", section(0, lane(-1)), length=90), light("7", 98, "<validity/>")),),
    ],
)
def test_a_map_that_cannot_be_driven_is_refused(tmp_path, parts):
    with pytest.raises(InputError):
        scenario(tmp_path, parts)


def test_dangling_links_and_roads_without_length_are_noted(tmp_path):
    parts = (
        road("1", section(0, lane(-1, None, -1)), length=100, after="road:8:start"),
        road("5", section(0, lane(-1)), length=0, view="<!-- none -->"),
    )
    made = scenario(tmp_path, parts)
    assert any("1.0.-1" in note for note in made.notes)
    assert any("without length" in note for note in made.notes)


def test_the_whole_car_starts_on_the_map(tmp_path):
    made = scenario(tmp_path, two_roads(), *named("1:0", "2:150"))
    rear = made.vehicle.box.length_m / 2 - made.vehicle.rear_axle_to_centre_m
    assert made.ego_log.xyz[0, 0] + made.world_origin[0] > rear


@pytest.mark.parametrize("seed", first_of(range(3)))
def test_a_short_road_gives_a_short_route(tmp_path, seed):
    made = scenario(tmp_path, (road("1", section(0, lane(-1)), length=90),), seed=seed)
    assert 20.0 < np.ptp(made.ego_log.xyz[:, 0]) < 90.0


def test_a_lane_that_closes_is_not_driven(tmp_path):
    closing = lane(-2).replace('b="0"', 'b="-0.035"')
    made = road("1", section(0, lane(-1), closing), length=100)
    for seed in range(2):
        assert scenario(tmp_path, (made,), seed=seed).route.lane_ids == ("1.0.-1",)


def test_the_front_of_the_car_stays_on_the_road_in_a_tight_bend(tmp_path):
    view = (
        '<geometry s="0" x="0" y="0" hdg="0" length="60"><line/></geometry>'
        '<geometry s="60" x="60" y="0" hdg="0" length="7"><arc curvature="-0.16"/></geometry>'
        '<geometry s="67" x="65.6257" y="-3.5269" hdg="-1.12" length="60"><line/></geometry>'
    )
    bend = road("1", section(0, lane(-1)), length=127, view=view)
    made = scenario(tmp_path, (bend,), *named("1:5", "1:110"))
    surface = shapely.union_all([lane_polygon(lane) for lane in made.lane_map.lanes.values()])
    T_world_rig = interpolate(made.ego_log, made.ego_log.t_us)
    front_m = made.vehicle.rear_axle_to_centre_m + made.vehicle.box.length_m / 2
    for left_m in (-made.vehicle.box.width_m / 2, made.vehicle.box.width_m / 2):
        corners = T_world_rig @ [front_m, left_m, 0.0, 1.0]
        assert shapely.distance(surface, shapely.points(corners[:, :2])).max() < 0.01


@pytest.mark.slow
def test_people_cross_where_the_route_passes_and_the_expert_lets_them(tmp_path):
    outline = "".join(
        f'<cornerLocal u="{u}" v="{v}"/>' for u, v in ((-2, -4), (2, -4), (2, 4), (-2, 4))
    )
    crosswalk = f'<objects><object type="crosswalk" s="50" t="0" hdg="0"><outline>{outline}</outline></object></objects>'
    first, second = two_roads()
    parts = (first, second.replace("</road>", f"{crosswalk}</road>"))
    sides = set()
    for seed in range(4):
        made = scenario(tmp_path, parts, *named("1:20", "2:150"), seed=seed)
        (walker,) = made.actors
        assert walker.label == "pedestrian"
        xy = walker.track.xyz[:, :2] + made.world_origin[:2]
        assert np.abs(xy[:, 0] - 150.0).max() < 1e-6
        assert np.ptp(xy[:, 1]) == pytest.approx(10.0)
        sides.add(float(np.sign(xy[0, 1])))
        front = made.ego_log.xyz[:, 0] + made.world_origin[0] + 1.4 + 4.855 / 2
        at = made.ego_log.t_us[np.searchsorted(front, 149.5)]
        y = np.interp(at, walker.track.t_us, xy[:, 1])
        assert abs(y + 1.75) > 1.2
    assert len(sides) == 2
    assert not scenario(tmp_path, parts, *named("1:20", "2:150"), "map.pedestrians=0").actors


@pytest.mark.slow
def test_the_expert_and_vehicles_keep_the_posted_speed(tmp_path):
    first, second = two_roads()
    posted = '<type s="0" type="town"><speed max="18" unit="km/h"/></type>'
    parts = (first, second.replace("<planView>", f"{posted}<planView>"))
    made = scenario(tmp_path, parts, *named("1:0", "2:200"), "map.vehicles=3", seed=3)
    assert made.lane_map.lanes["2.0.-1"].speed_limit_mps == pytest.approx(5.0)
    assert made.lane_map.lanes["1.0.-1"].speed_limit_mps is None
    for track in (made.ego_log, *(actor.track for actor in made.actors)):
        x = track.xyz[:, 0] + made.world_origin[0]
        speed = np.abs(np.diff(x)) / np.diff(track.t_us) * 1e6
        assert speed[(x[1:] > 105.0) & (x[1:] < 390.0)].max(initial=0.0) < 5.3


@pytest.mark.parametrize("limit", first_of(['max="-3"', 'max="fast"', 'max="50" unit="knots"']))
def test_a_speed_limit_that_is_no_speed_is_refused(tmp_path, limit):
    text = two_roads()[0].replace("<planView>", f"<type s='0'><speed {limit}/></type><planView>")
    with pytest.raises(InputError):
        scenario(tmp_path, (text,))
