import numpy as np
import pytest
import shapely
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import yaw_from_quat
from alpasim_plugin.core.lane_areas import lane_polygon
from alpasim_plugin.core.types import HeightField
from alpasim_plugin.world.route import LaneIndex, route_from_log
from scenarios.commonroad import read_commonroad, read_obstacles
from scenarios.commonroad_map import read_lanelets
from scenarios.recorded import SourceFiles
from tests.scenarios.make_commonroad import (
    LANES,
    TRAFFIC,
    bound,
    document,
    drive,
    lanelet,
    obstacle,
    points,
    state,
    write_commonroad,
)

NEW_TRAFFIC = obstacle(11, drive(20, 0), version="2020a")


@pytest.fixture
def log(tmp_path):
    return read_commonroad(write_commonroad(tmp_path / "a.xml"))


def read(tmp_path, ego=None, **parts):
    return read_commonroad(write_commonroad(tmp_path / "a.xml", **parts), ego)


def refused(tmp_path, ego=None, text=None, **parts):
    path = tmp_path / "bad.xml"
    path.write_bytes(document(**parts).encode() if text is None else text)
    with pytest.raises(InputError) as caught:
        read_commonroad(path, ego)
    error = caught.value
    assert error.exit_code == 2
    assert error.message.startswith(str(path))
    return error


# --- what becomes of a file


def test_longest_drive_is_the_ego_and_no_actor(log):
    assert [a.actor_id for a in log.actors] == ["12", "13"]
    assert log.notes[0].startswith("ego is the recorded car 11: the longest drive (20.0 m)")


def test_rear_axle_lies_behind_the_recorded_centre(log):
    back = log.vehicle.rear_axle_to_centre_m
    assert back == pytest.approx(1.4 * 4.4 / 4.855)
    assert_allclose(
        log.ego_log.xyz[:, 0], np.linspace(0, 20, 21) - back
    )  # origin: the first obstacle's place, whole metres
    assert_array_equal(log.ego_log.xyz[:, 2], 0.0)
    assert log.world_origin == (20.0, 0.0, 0.0)
    assert (log.vehicle.box.length_m, log.vehicle.box.width_m) == (4.4, 1.8)


def test_time_is_whole_microseconds_of_the_file_s_step(tmp_path):
    log = read(tmp_path, dt="0.04")
    assert log.ego_log.t_us.tolist() == list(range(0, 21 * 40_000, 40_000))


def test_actor_keeps_the_time_it_was_seen_and_stands_on_the_ground(log):
    actor = log.actors[1]
    assert (actor.track.t_us[0], actor.track.t_us[-1]) == (0, 1_000_000)
    assert_allclose(actor.track.xyz[:, 2], actor.box.height_m / 2)
    assert_allclose(actor.track.xyz[0, :2], [40.0, 0.0])


def test_car_that_is_not_present_all_the_time_is_passed_over(tmp_path):
    late = obstacle(20, drive(100, 4, speed=30.0, steps=range(3, 21)))
    assert "car 11" in read(tmp_path, traffic=late + obstacle(11, drive(20, 0))).notes[0]


def test_static_obstacle_is_there_for_the_whole_recording(tmp_path):
    parked = obstacle(30, [state(0, 150, 0, speed=0.0)], static=True, kind="parkedVehicle")
    actor = read(tmp_path, traffic=TRAFFIC + parked).actors[-1]
    assert (actor.label, actor.is_static) == ("car", True)
    assert actor.track.t_us.tolist() == [0, 2_000_000]


def test_shapes_become_boxes_round_them(tmp_path):
    circle = "<circle><radius>0.5</radius></circle>"
    polygon = f"<polygon>{points((0, 0), (4, 0), (4, 2), (0, 2))}</polygon>"
    turned = (
        "<rectangle><length>4</length><width>2</width><orientation>1.5707963267948966</orientation>"
        "<center><x>1.0</x><y>0.0</y></center></rectangle>"
    )
    pair = "<circle><radius>1.0</radius></circle><circle><radius>1.0</radius><center><x>3</x><y>0</y></center></circle>"
    shapes = (circle, polygon, turned, pair)
    more = "".join(
        obstacle(40 + i, [state(k, 100.0, 0.0, yaw=np.pi / 2) for k in range(21)], shape)
        for i, shape in enumerate(shapes)
    )
    boxes = {a.actor_id: a for a in read(tmp_path, traffic=TRAFFIC + more).actors}
    sizes = {k: (boxes[k].box.length_m, boxes[k].box.width_m) for k in ("40", "41", "42", "43")}
    assert sizes == {"40": (1.0, 1.0), "41": (4.0, 2.0), "42": (4.0, 2.0), "43": (5.0, 2.0)}
    assert_allclose(
        boxes["41"].track.xyz[0, :2], [80 - 1.0, 2.0], atol=1e-12
    )  # the polygon's middle, turned by 90 degrees
    assert_allclose(boxes["42"].track.xyz[0, :2], [80.0, 1.0], atol=1e-12)
    assert abs(yaw_from_quat(boxes["42"].track.quat[0])) == pytest.approx(np.pi)


def test_a_wall_across_its_frame_is_a_turned_box_and_a_shape_with_a_hollow_is_said(tmp_path):
    wall = f"<polygon>{points((0, 0), (30, 20), (29, 21.5), (-1, 1.5))}</polygon>"
    angle = f"<polygon>{points((0, 0), (4, 0), (4, 1), (1, 1), (1, 4), (0, 4))}</polygon>"
    still = obstacle(40, [state(0, 100.0, 30.0)], wall, "roadBoundary", static=True)
    made = read(tmp_path, traffic=TRAFFIC + still)
    (box,) = [one for one in made.actors if one.actor_id == "40"]
    assert (box.box.length_m, box.box.width_m) == pytest.approx(
        (np.hypot(30, 20), np.hypot(1, 1.5))
    )
    assert yaw_from_quat(box.track.quat[0]) == pytest.approx(np.arctan2(20, 30))
    assert_allclose(box.track.xyz[0, :2], [80 + 14.5, 30 + 10.75])
    assert "box around their shape" not in str(made.notes)
    hollow = obstacle(41, [state(0, 100.0, 30.0)], angle, "building", static=True)
    (note,) = [n for n in read(tmp_path, traffic=TRAFFIC + hollow).notes if "around their" in n]
    assert note == (
        "1 obstacles are taken as the box around their shape, which is up to 129% larger"
    )


SHIFTED = "<rectangle><length>4.4</length><width>1.8</width><originXShift>-1.35</originXShift></rectangle>"


def test_a_rectangle_lies_ahead_of_the_origin_that_is_shifted_to_the_rear(tmp_path):
    states = [state(k, 100.0, 0.0, yaw=np.pi / 2) for k in range(21)]
    for number, shape in ((40, SHIFTED), (41, SHIFTED + "<circle><radius>0.1</radius></circle>")):
        actors = read(tmp_path, traffic=TRAFFIC + obstacle(number, states, shape)).actors
        centre = {one.actor_id: one.track.xyz[0, :2] for one in actors}[str(number)]
        assert_allclose(centre, [80.0, 1.35], atol=1e-12)
    far = SHIFTED.replace("-1.35", "-2.3")
    assert "originXShift" in refused(tmp_path, traffic=obstacle(40, states, far)).message


def test_lanelet_attributes_arrive(log):
    lanes = log.lane_map.lanes
    assert lanes["1"].successors == ("2",)
    assert (lanes["1"].left_neighbour, lanes["1"].right_neighbour, lanes["3"].right_neighbour) == (
        "3",
        None,
        "1",
    )
    assert (lanes["1"].speed_limit_mps, lanes["2"].speed_limit_mps) == (13.5, None)
    assert {k.left_mark_type for k in lanes.values()} == {"unknown"}
    assert any("no line markings" in note for note in log.notes)


def test_version_2020a(tmp_path):
    urban = "<laneletType>urban</laneletType>"
    lanes = (
        lanelet(
            1,
            0,
            200,
            0,
            f"{urban}<laneletType>busLane</laneletType><trafficSignRef ref='201'/>",
            "dashed",
            "solid",
        )
        + lanelet(
            3,
            0,
            200,
            4,
            "<stopLine><lineMarking>solid</lineMarking></stopLine>",
            "broad_solid",
            "curb",
        )
        + lanelet(4, 0, 200, 8, "<laneletType>bicycleLane</laneletType>", "weird", "no_marking")
        + lanelet(5, 0, 200, 12, "<laneletType>sidewalk</laneletType>")
        + lanelet(6, 90, 93, 6, "<laneletType>crosswalk</laneletType>")
    )
    sign = (
        '<trafficSign id="201"><trafficSignElement><trafficSignID>274</trafficSignID><additionalValue>10</additionalValue>'
        "</trafficSignElement></trafficSign>"
    )
    cars = obstacle(11, drive(20, 0), version="2020a") + obstacle(
        12, [state(0, 150, 4)], version="2020a", static=True, kind="pillar"
    )
    extra = '<environmentObstacle id="9"><type>building</type></environmentObstacle>'
    log = read(tmp_path, version="2020a", lanes=lanes, traffic=sign + cars + extra)
    lanes_ = log.lane_map.lanes
    assert list(lanes_) == ["1", "3", "4"]
    assert [k.kind for k in lanes_.values()] == ["bus", "vehicle", "bike"]
    mark_types = [(k.left_mark_type, k.right_mark_type) for k in lanes_.values()]
    assert mark_types == [
        ("dashed_white", "solid_white"),
        ("solid_white", "none"),
        ("unknown", "none"),
    ]
    assert lanes_["1"].speed_limit_mps == 10.0
    assert_allclose(log.lane_map.stop_lines[0][:, :2], [[180, 6], [180, 2]])
    assert len(log.lane_map.crosswalks) == 1
    assert [(a.label, a.is_static) for a in log.actors] == [("other", True)]
    assert "1 environmentObstacle elements were left out" in log.notes
    assert "1 lanelets of type sidewalk carry no vehicles and are no lanes" in log.notes


def test_points_with_heights_give_a_ground_with_heights(tmp_path):
    text = document().replace("<x>", "<z>7.0</z><x>")
    path = tmp_path / "high.xml"
    path.write_text(text)
    log = read_commonroad(path)
    assert isinstance(log.ground, HeightField)
    assert_allclose(log.ground.z, 7.0)
    assert_allclose(log.ego_log.xyz[:, 2], 7.0)


def test_seam_between_lanelets_is_no_road_edge_and_a_traffic_island_is(tmp_path):
    rows = ((0, 200, 0), (0, 200, 4.05), (0, 100, 8.05), (110, 200, 8.05), (0, 200, 12.05))
    lanes = "".join(lanelet(i, *row) for i, row in enumerate(rows))
    edges = read(tmp_path, lanes=lanes).lane_map.road_edges
    assert len(edges) == 2
    assert shapely.Polygon(edges[1][:, :2]).area == pytest.approx(40.0, rel=0.03)
    inside = [(e[:, 0] > 0) & (e[:, 0] < 170) & (np.abs(e[:, 1] - 2.0) < 0.5) for e in edges]
    assert not any(mask.any() for mask in inside)


def test_exchanged_bounds_are_put_right(tmp_path):
    swapped = (
        '<lanelet id="1">'
        + bound("leftBound", (0, -2), (200, -2))
        + bound("rightBound", (0, 2), (200, 2))
        + "</lanelet>"
    )
    log = read(tmp_path, lanes=swapped, traffic=obstacle(11, drive(20, 0)))
    assert log.lane_map.lanes["1"].left[0, 1] == 2.0
    assert "1 lanelets had left and right bound exchanged and were put right" in log.notes


def test_a_lanelet_shorter_than_wide_keeps_the_sides_by_which_it_meets_the_next(tmp_path):
    """The outline of its bounds, which run back, is that of exchanged ones."""
    short = (
        '<lanelet id="1">'
        + bound("leftBound", (0.4, 2), (0.3, 2.1), (0, 2))
        + bound("rightBound", (0.3, -2), (0.2, -2), (0, -2))
        + '<successor ref="2"/></lanelet>'
    )
    log = read(tmp_path, lanes=short + lanelet(2, 0, 200, 0), traffic=obstacle(11, drive(20, 0)))
    assert log.lane_map.lanes["1"].left[-1, 1] == 2.0
    assert "exchanged" not in str(log.notes)
    alone = read(tmp_path, lanes=short + lanelet(2, 9, 200, 0), traffic=obstacle(11, drive(20, 0)))
    assert alone.lane_map.lanes["1"].left[-1, 1] == -2.0


def test_crossing_lanelets_are_an_intersection_and_linked_ones_are_not(tmp_path):
    across = (
        '<lanelet id="9">'
        + bound("leftBound", (98, -30), (98, 30))
        + bound("rightBound", (102, -30), (102, 30))
        + "</lanelet>"
    )
    lanes = read(tmp_path, lanes=LANES + across).lane_map.lanes
    assert [k for k, lane in lanes.items() if lane.is_intersection] == [
        "9"
    ]  # the long lanes are crossed by 3 % of their area


# --- bad input


BOMB = b'<!DOCTYPE commonRoad [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;">]>'
HEAD, REST = document().encode().split(b"\n", 1)
WITH_BOMB = HEAD + BOMB + REST.replace(b"ZAM_Test", b"&b;")


@pytest.mark.parametrize(
    "text",
    [
        document().encode()[:-3],
        WITH_BOMB,
        WITH_BOMB.decode().encode("utf-16"),
        b"<osm/>",
        document(version="1999a").encode(),
        document(dt="soon").encode(),
        document(lanes="").encode(),
        document(traffic="").encode(),
        document(lanes='<lanelet id="1"/>').encode(),
        document(lanes=lanelet(1, "west", 5, 0)).encode(),
        document(lanes=lanelet(1, "1e999", 5, 0)).encode(),
        document(lanes=lanelet(1, 0, 5, 0, "<laneletType>sidewalk</laneletType>")).encode(),
        document(traffic=obstacle(1, drive(0, 0)) * 2).encode(),
        document(traffic=obstacle(1, drive(0, 0), shape="<star/>")).encode(),
        document().replace("<length>4.4", "<length>0").encode(),
        document(traffic=obstacle(1, drive(0, 0, steps=[3]))).encode(),
        document(traffic=obstacle(1, drive(0, 0), kind="bus")).encode(),
    ],
)
def test_documents_that_are_no_scenario(tmp_path, text):
    refused(tmp_path, text=text)


def test_times_that_do_not_increase(tmp_path):
    states = [state(k, 20 + k, 0) for k in (0, 1, 1, 2)]
    assert "obstacle 11" in refused(tmp_path, ego="11", traffic=obstacle(11, states)).message


# --- the facts of two recorded files

FACTS = {
    "USA_US101-3_3_T-1": {
        "lanelets": 12,
        "links": 6,
        "cars": 12,
        "states": 384,
        "last_step": 31,
        "ego": "400",
        "lane_ids": ("37", "25"),
    },
    "USA_Lanker-1_1_T-1": {
        "lanelets": 91,
        "links": 84,
        "cars": 24,
        "states": 938,
        "last_step": 40,
        "ego": "1216",
        "lane_ids": None,
    },
}


def check_file(path, facts):
    """Compare one recorded file with what was measured on it with other software."""
    root = SourceFiles().read_xml(path)
    assert (root.get("commonRoadVersion"), root.get("timeStepSize")) == ("2018b", "0.1")
    assert len(root.findall("planningProblem")) == 1
    obstacles, _ = read_obstacles(path, root)
    assert len(obstacles) == facts["cars"]
    assert {o.label for o in obstacles} == {"car"}
    assert sum(len(o.steps) for o in obstacles) == facts["states"]
    assert (min(o.steps[0] for o in obstacles), max(o.steps[-1] for o in obstacles)) == (
        0,
        facts["last_step"],
    )
    lane_map, _ = read_lanelets(path, root, np.zeros(3))
    assert len(lane_map.lanes) == facts["lanelets"]
    links = [s for lane in lane_map.lanes.values() for s in lane.successors]
    assert (len(links), sum(s in lane_map.lanes for s in links)) == (facts["links"], facts["links"])
    assert all(
        lane_polygon(k).is_valid and lane_polygon(k).geom_type == "Polygon"
        for k in lane_map.lanes.values()
    )
    centres = np.concatenate([o.centre for o in obstacles])
    assert min(len(k) for k in LaneIndex(lane_map).containing_many(centres)) >= 1


@pytest.mark.parametrize("name", FACTS)
def test_real_file(shared_data, name):
    path = shared_data / "commonroad" / f"{name}.xml"
    check_file(path, FACTS[name])
    log = read_commonroad(path, FACTS[name]["ego"])
    assert len(log.actors) == FACTS[name]["cars"] - 1
    route = route_from_log(log.lane_map, log.ego_log)
    assert FACTS[name]["lane_ids"] in (None, route.lane_ids)


# --- traffic lights


def light(number, *phases, offset="", more=""):
    parts = "".join(
        f"<cycleElement><duration>{lasts}</duration><color>{colour}</color></cycleElement>"
        for colour, lasts in phases
    )
    return f'<trafficLight id="{number}"><cycle>{parts}{offset and f"<timeOffset>{offset}</timeOffset>"}</cycle>{more}</trafficLight>'


LIT = lanelet(
    1, 0, 60, 0, '<successor ref="2"/><trafficLightRef ref="7"/><trafficLightRef ref="8"/>'
) + lanelet(2, 60, 200, 0)


def test_a_light_holds_back_the_lanelet_that_names_it_at_its_end_in_microseconds_of_the_file_s_steps(
    tmp_path,
):
    lights = light(7, ("red", 30), ("redYellow", 5), ("green", 40), offset="10")
    log = read(
        tmp_path, lanes=LIT, traffic=obstacle(11, drive(20, 0)), version="2020a", more=lights
    )
    (one,) = log.lane_map.signals
    assert one.stop[:, :2].tolist() == [
        [40.0, 2.0],
        [40.0, -2.0],
    ]  # the origin is the first car's place, 20 m
    assert (one.heading_rad, one.offset_us) == (0.0, 1_000_000)
    assert one.phases == (("red", 3_000_000), ("red_yellow", 500_000), ("green", 4_000_000))
    assert [one.colour_at(t) for t in (0, 1_000_000, 4_200_000, 4_500_000, 8_500_000)] == [
        "green",
        "red",
        "red_yellow",
        "green",
        "red",
    ]


def test_lights_that_are_off_or_for_one_direction_are_noted_and_without_any_nothing_is_known(
    tmp_path, log
):
    assert log.lane_map.signals is None
    off = light(7, ("red", 30), more="<active>false</active>") + light(
        8, ("red", 30), more="<direction>left</direction>"
    )
    found = read(tmp_path, lanes=LIT, traffic=obstacle(11, drive(20, 0)), version="2020a", more=off)
    assert found.lane_map.signals is None
    assert any(note.startswith("2 traffic lights are off") for note in found.notes)


@pytest.mark.parametrize("phases", [(("blue", 3),), (("red", 0),), (("red", "soon"),)])
def test_a_light_with_a_broken_cycle_is_refused(tmp_path, phases):
    refused(tmp_path, lanes=LIT, version="2020a", more=light(7, *phases))


def test_predicted_and_uncertain_obstacles_are_left_out_with_a_note(tmp_path):
    area = '<dynamicObstacle id="50"><type>car</type><shape><rectangle><length>4</length><width>2</width></rectangle></shape>'
    area += state(0, 100, 4, tag="initialState") + "<occupancySet/></dynamicObstacle>"
    vague = obstacle(51, drive(100, 4)).replace(
        "<orientation><exact>0.0</exact>", "<orientation><intervalStart>0</intervalStart>"
    )
    log = read(tmp_path, traffic=TRAFFIC + area + vague)
    assert [a.actor_id for a in log.actors] == ["12", "13"]
    assert (
        "1 obstacles are predicted as occupied areas, not as states and were left out" in log.notes
    )
    assert (
        "1 obstacles have states without an exact position and orientation and were left out"
        in log.notes
    )


def test_unknown_ego(tmp_path):
    error = refused(tmp_path, ego="99")
    assert "no moving obstacle '99'" in error.message
    assert "choose the ego among 11, 12, 13" in error.hint


def test_another_ego_can_be_asked_for(tmp_path):
    log = read(tmp_path, ego="12")
    assert [a.actor_id for a in log.actors] == ["11", "13"]
    assert log.notes[0] == "ego is the recorded vehicle 12, as asked"


@pytest.mark.parametrize(
    ("users", "kind"),
    [
        (("OneWay", "car", "bicycle"), "vehicle"),
        (("OneWay", "vehicle"), "vehicle"),
        (("OneWay", "bus", "taxi"), "vehicle"),
        (("OneWay", "bus"), "bus"),
        (("Bidirectional", "priorityVehicle"), "bus"),
        (("OneWay", "bicycle"), "bike"),
        (("Bidirectional", "pedestrian"), None),
    ],
)
def test_a_lanelet_is_for_the_users_that_it_names(tmp_path, users, kind):
    direction, *names = users
    named = "".join(f"<user{direction}>{name}</user{direction}>" for name in names)
    lanes = LANES + lanelet(7, 0, 200, 8, f"<laneletType>urban</laneletType>{named}")
    made = read(tmp_path, lanes=lanes, version="2020a", traffic=NEW_TRAFFIC)
    lane = made.lane_map.lanes.get("7")
    assert (None if lane is None else lane.kind) == kind
    note = "1 lanelets name users without cars: no lanes for cars"
    assert (note in made.notes) == (kind != "vehicle")


def test_a_lanelet_for_cars_in_both_directions_is_said(tmp_path):
    named = "<userBidirectional>vehicle</userBidirectional>"
    lanes = LANES + lanelet(7, 0, 200, 8, named)
    made = read(tmp_path, lanes=lanes, version="2020a", traffic=NEW_TRAFFIC)
    assert "1 lanelets are for cars in both directions" in str(made.notes)


@pytest.mark.parametrize(
    ("sign", "value", "limit_mps", "note"),
    [
        ("274", "13.9", 13.9, ""),
        ("274", "50kmh", 50 / 3.6, ""),
        ("R2-1", "25 mph", 25 * 0.44704, ""),
        ("C43", "20.0", 20.0, ""),
        ("274", "30 zone", None, "traffic signs that are not read: 274 '30 zone' (1)"),
        ("274.1", "8.3", None, "traffic signs that are not read: 274.1 '8.3' (1)"),
        ("206", None, None, "traffic signs that are not read: 206 (1)"),
    ],
)
def test_limits_of_signs_are_applied_and_all_other_signs_are_named(
    tmp_path, sign, value, limit_mps, note
):
    stated = "" if value is None else f"<additionalValue>{value}</additionalValue>"
    element = (
        f"<trafficSignElement><trafficSignID>{sign}</trafficSignID>{stated}</trafficSignElement>"
    )
    lanes = LANES + lanelet(7, 0, 200, 8, '<trafficSignRef ref="90"/>')
    more = f'<trafficSign id="90">{element}</trafficSign>'
    made = read(tmp_path, lanes=lanes, version="2020a", traffic=NEW_TRAFFIC, more=more)
    assert made.lane_map.lanes["7"].speed_limit_mps == pytest.approx(limit_mps)
    assert [n for n in made.notes if "traffic signs" in n] == ([note] if note else [])


def test_fields_that_are_not_read_are_named(tmp_path):
    lights = "<signalSeries><signalState/></signalSeries></obstacle>"
    made = read(tmp_path, traffic=TRAFFIC.replace("</obstacle>", lights))
    assert "CommonRoad: not read are obstacle/signalSeries (3)" in made.notes
    assert not [note for note in read(tmp_path).notes if "not read are" in note]
