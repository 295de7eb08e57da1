"""Lanelet2 maps: lanes and links, both kinds of coordinates, traffic lights, limits, drives on them,
and what is refused.

Small maps are made here. The real one is compared with facts, and with the library lanelet2 where it
is installed.
"""

import re

import numpy as np
import pytest
import shapely

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import arc_lengths
from alpasim_plugin.core.lane_areas import lane_polygon
from scenarios.lanelet2 import read_street
from scenarios.load import load_scenario
from scenarios.recorded import SourceFiles

ROAD = {"type": "lanelet", "subtype": "road"}
SOLID = {"type": "line_thin", "subtype": "solid"}


def tags(values):
    return "".join(f'<tag k="{key}" v="{value}"/>' for key, value in values.items())


def node(key, x, y):
    return f'<node id="{key}" lat="" lon="">{tags({"local_x": str(x), "local_y": str(y)})}</node>'


def way(key, *nodes, **more):
    listed = "".join(f'<nd ref="{n}"/>' for n in nodes)
    return f'<way id="{key}">{listed}{tags(more)}</way>'


def relation(key, members, more):
    listed = "".join(f'<member type="{t}" role="{r}" ref="{i}"/>' for t, r, i in members)
    return f'<relation id="{key}">{listed}{tags(more)}</relation>'


def lanelet(key, left, right, *rules, **more):
    members = [("way", "left", left), ("way", "right", right)]
    members += [("relation", "regulatory_element", rule) for rule in rules]
    return relation(key, members, {**ROAD, **more})


def places(x0=1000.0):
    """Three rows of nodes 3.5 m apart, at 0, 150 and 300 m: 11 12 13, 21 22 23, 31 32 33."""
    return [
        node(10 * row + column, x0 + 150.0 * (column - 1), 3.5 * row)
        for row in (1, 2, 3)
        for column in (1, 2, 3)
    ]


# Bounds against the driving direction where their number ends on 9.
WAYS = (
    way(112, 11, 12, type="road_border"),
    way(139, 13, 12, type="road_border"),
    way(212, 21, 22, **{**SOLID, "color": "yellow"}),
    way(223, 22, 23, type="line_thin", subtype="dashed"),
    way(329, 33, 32, 31, type="curbstone"),
    way(312, 31, 32),
    way(90, 12, 22, type="stop_line"),
    way(95, 12, 22, type="traffic_light", height="8.0"),
    way(96, 21, 22, type="traffic_light"),
)
LIGHT = relation(
    7,
    [("way", "ref_line", 90), ("way", "refers", 95), ("way", "refers", 96)],
    {"type": "regulatory_element", "subtype": "traffic_light"},
)
STREET = (
    *places(),
    *WAYS,
    lanelet(1, 212, 112, 7, speed_limit="30 km/h"),
    lanelet(2, 223, 139, one_way="no"),
    lanelet(3, 312, 212),
    LIGHT,
)


def written(folder, parts):
    file = folder / "map.osm"
    file.write_text(f"<osm version='0.6'>{''.join(parts)}</osm>", encoding="utf-8")
    return file


def street(folder, parts=STREET):
    return read_street(SourceFiles(), written(folder, parts))


def test_lanes_run_with_the_left_bound_on_the_left_and_follow_by_shared_ends(tmp_path):
    made = street(tmp_path)
    lanes = made.lanes
    assert set(lanes) == {"1", "2", "-2", "3"}
    assert lanes["1"].successors == ("2",)
    assert not lanes["-2"].successors
    assert lanes["1"].centre[[0, -1], :2] + made.origin[:2] == pytest.approx(
        np.array([[1000.0, 5.25], [1150.0, 5.25]])
    )
    assert lanes["-2"].centre[0, :2] + made.origin[:2] == pytest.approx([1300.0, 5.25])
    assert (lanes["1"].left_neighbour, lanes["3"].right_neighbour) == ("3", "1")
    assert (lanes["1"].left_mark_type, lanes["1"].right_mark_type) == ("solid_yellow", "none")
    assert lanes["2"].left_mark_type == lanes["-2"].right_mark_type == "dashed_white"
    assert lanes["1"].speed_limit_mps == pytest.approx(30 / 3.6)
    assert lanes["2"].speed_limit_mps is None


def test_a_light_holds_back_its_lanelets_at_its_line_and_the_expert_waits(tmp_path):
    file = written(tmp_path, STREET)
    route = ("map.route.from=1:10", "map.route.to=2:80", "map.vehicles=0")
    made = load_scenario(file, None, route)
    signal, other = made.lane_map.signals
    assert (signal.name, signal.lanes) == (other.name, other.lanes) == ("7", ("1",))
    assert signal.head[1:] + made.world_origin[1:] == pytest.approx([5.25, 5.5])  # over lanes
    assert other.head[1:] + made.world_origin[1:] == pytest.approx([7.0, 5.5])
    feet = [shapely.Point(pole[0, :2]) for pole in made.lane_map.poles]
    areas = [lane_polygon(lane) for lane in made.lane_map.lanes.values()]
    assert len(feet) == 2
    assert min(foot.distance(area) for foot in feet for area in areas) > 0.5
    assert signal.stop[:, 0] + made.world_origin[0] == pytest.approx([1150.0, 1150.0])
    x = made.ego_log.xyz[:, 0] + made.world_origin[0]
    front = x + made.vehicle.rear_axle_to_centre_m + made.vehicle.box.length_m / 2
    assert signal.colour_at(int(made.ego_log.t_us[np.searchsorted(front, 1150.0)])) != "red"
    assert (np.diff(x) < 1e-6).any()
    assert x[-1] == pytest.approx(1230.0, abs=1.5)
    assert made.source == "lanelet2"


@pytest.mark.parametrize("west", [8.4, 179.996])  # the second one crosses the 180th meridian
def test_latitude_and_longitude_become_east_and_north(tmp_path, west):
    def lon(column):
        return (west + 2e-3 * column + 180.0) % 360.0 - 180.0

    nodes = [
        f'<node id="{10 * row + c}" lat="{49.0 + 4e-5 * row}" lon="{lon(c)}"/>'
        for row in (1, 2, 3)
        for c in (1, 2, 3)
    ]
    made = street(tmp_path, (*nodes, *STREET[9:]))
    length_m = float(arc_lengths(made.lanes["1"].centre)[-1])
    circle_m = 6378137.0 / np.sqrt(1 - 0.00669438 * np.sin(np.deg2rad(49.0)) ** 2)
    assert length_m == pytest.approx(np.deg2rad(2e-3) * circle_m * np.cos(np.deg2rad(49)), rel=1e-5)
    assert any("latitude 49.000" in note for note in made.notes)


BROKEN = {
    "node 12": tuple(p for p in STREET if 'node id="12"' not in p),
    "way 212": tuple(p for p in STREET if 'way id="212"' not in p),
    "relation 7": STREET[:-1],
    "lanelet 3": (*STREET[:-2], lanelet(3, 212, 212), LIGHT),
    "way 112": (*places(), way(112, 11, 11), *WAYS[1:], *STREET[-4:]),
    "node 21": (
        *(p for p in STREET if 'node id="21"' not in p),
        '<node id="21" lat="49" lon="8"/>',
    ),
    "node 31": tuple(p.replace('k="local_y" v="10.5"', 'k="local_y" v="inf"') for p in STREET),
    "one of local_x and local_y": tuple(
        p.replace('<tag k="local_y" v="10.5"/>', "") for p in STREET
    ),
    "node 11 twice": (*STREET, places()[0]),
    "relation": (places()[0],),
    "km": (*places(), node(99, 9e6, 0), way(91, 11, 99, type="stop_line"), *STREET[9:]),
}


@pytest.mark.parametrize("named", BROKEN)
def test_a_broken_map_is_refused_by_the_name_of_its_element(tmp_path, named):
    with pytest.raises(InputError) as error:
        street(tmp_path, BROKEN[named])
    assert named == "relation" or named in error.value.message


def test_a_plain_file_of_openstreetmap_is_named_as_such(tmp_path):
    file = tmp_path / "extract.osm"
    file.write_text(
        '<osm version="0.6"><node id="1" lat="49.0" lon="8.4"/><node id="2" lat="49.1" lon="8.4"/>'
        '<way id="10"><nd ref="1"/><nd ref="2"/><tag k="highway" v="residential"/></way></osm>'
    )
    with pytest.raises(InputError, match="OpenStreetMap extract with 1 ways") as error:
        load_scenario(file)
    assert "--opendrive-output" in error.value.hint


def test_entities_are_refused(tmp_path):
    file = written(tmp_path, STREET)
    bomb = '<!DOCTYPE osm [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]>'
    file.write_text(bomb + file.read_text(encoding="utf-8"), encoding="utf-8")
    with pytest.raises(InputError):
        load_scenario(file)


@pytest.fixture(scope="module")
def karlsruhe(shared_data):
    return shared_data / "lanelet2" / "mapping_example.osm"


@pytest.mark.slow
def test_a_real_map_has_what_its_source_states_and_is_driven(karlsruhe):
    made = read_street(SourceFiles(), karlsruhe)
    assert sum(not key.startswith("-") for key in made.lanes) + 8 + 2 + 2 + 17 == 371
    assert len({head.signal.name for head in made.heads}) == 6
    assert len(made.beside.crosswalks) == 8
    scene = load_scenario(karlsruhe, 7)
    driven_m = np.linalg.norm(np.diff(scene.ego_log.xyz[:, :2], axis=0), axis=1).sum()
    assert driven_m == pytest.approx(200.0, abs=2.0)


def test_lanelet2_finds_the_same_lanes_links_and_lengths(karlsruhe):
    oracle = pytest.importorskip("lanelet2")
    rules = oracle.traffic_rules
    german = rules.create(rules.Locations.Germany, rules.Participants.VehicleCar)
    projector = oracle.projection.LocalCartesianProjector(oracle.io.Origin(49.006, 8.436))
    loaded = oracle.io.load(str(karlsruhe), projector)
    graph = oracle.routing.RoutingGraph(loaded, german)
    made = read_street(SourceFiles(), karlsruhe)
    lanes = {key: lane for key, lane in made.lanes.items() if lane.kind == "vehicle"}
    found = set()
    for one in loaded.laneletLayer:
        senses = [] if not german.canPass(one) else [one]
        senses += [] if not senses or german.isOneWay(one) else [one.invert()]
        for sense in senses:
            key = f"-{sense.id}" if sense.inverted() else str(sense.id)
            found.add(key)
            after = {f"{'-' * s.inverted()}{s.id}" for s in graph.following(sense)}
            assert set(lanes[key].successors) & set(lanes) == after
            begin = sense.leftBound[0]
            assert lanes[key].left[0, :2] == pytest.approx([begin.x, begin.y], abs=1e-3)
    assert found == set(lanes)


# Participants, and the kind of the lanelet of a road that names them, as lanelet2 1.2.3 lets cars pass.
PARTICIPANTS = [
    ({"participant:vehicle": "yes"}, "vehicle"),
    ({"participant:vehicle:car": "yes", "participant:bicycle": "yes"}, "vehicle"),
    ({"participant:vehicle": "no"}, None),
    ({"participant:vehicle:bus": "yes"}, "bus"),
    ({"participant:vehicle:taxi": "yes", "participant:vehicle:car": "no"}, "bus"),
    ({"participant:bicycle": "yes"}, None),
    ({"participant:pedestrian": "yes"}, None),
    ({"participant:bicycle": "yes", "subtype": "bicycle_lane"}, "bike"),
    ({"participant:vehicle:emergency": "yes", "subtype": "emergency_lane"}, "shoulder"),
    ({"participant:vehicle": "yes", "subtype": "walkway"}, "vehicle"),
]


@pytest.mark.parametrize(("named", "kind"), PARTICIPANTS)
def test_a_lanelet_belongs_to_those_it_names(tmp_path, named, kind):
    made = street(tmp_path, (*places(), *WAYS, lanelet(1, 212, 112, **named), lanelet(3, 312, 212)))
    assert made.lanes["3"].kind == "vehicle"
    assert kind == (made.lanes["1"].kind if "1" in made.lanes else None)
    users = ", ".join(sorted(key[12:] for key in named if named[key] == "yes" and key[0] == "p"))
    if kind != "vehicle" and users:
        assert any(users in note for note in made.notes)


def test_no_car_drives_on_a_lane_for_buses(tmp_path):
    bus = {"participant:vehicle:bus": "yes"}
    file = written(tmp_path, (*places(), *WAYS, lanelet(1, 212, 112, **bus), lanelet(2, 223, 139)))
    with pytest.raises(InputError, match="no lane there on which a car fits"):
        load_scenario(file, 1, ("map.route.from=1:5", "map.route.to=2:100"))


def sign(subtype="speed_limit", refers=(), **more):
    kind = {"type": "regulatory_element", "subtype": subtype, **more}
    return relation(8, [("way", "refers", way) for way in refers], kind)


def test_ids_of_new_objects_are_negative(tmp_path):
    """Editors of maps write them so before a map has its ids."""
    parts = [re.sub(r'(id|ref)="(\d+)"', r'\1="-\2"', part) for part in STREET]
    negative, lanes = street(tmp_path, parts).lanes, street(tmp_path).lanes
    assert sorted(negative) == sorted(f"-{key}" for key in lanes)


@pytest.mark.parametrize(
    ("rule", "more", "limit_kph"),
    [
        (sign(sign_type="de274-60"), {}, 60.0),
        (sign(refers=[99]), {}, 60.0),
        (sign(sign_type="de310"), {}, 50.0),
        (sign(sign_type="30 kmh"), {}, 30.0),
        (sign(sign_type="de274.1"), {}, None),
        (sign("traffic_sign"), {"speed_limit": "50", "speed_limit:vehicle": "30"}, 30.0),
    ],
)
def test_limits_by_signs(tmp_path, rule, more, limit_kph):
    post = way(99, 11, 12, type="traffic_sign", subtype="de274-60")
    made = street(tmp_path, (*places(), *WAYS, post, rule, lanelet(1, 212, 112, 8, **more)))
    limit_mps = made.lanes["1"].speed_limit_mps
    assert limit_mps == (None if limit_kph is None else pytest.approx(limit_kph / 3.6))
    assert any("de274.1" in note for note in made.notes) == (limit_kph is None)


def test_what_is_not_read_of_a_map_is_said(tmp_path):
    made = street(tmp_path, (*places(), *WAYS, sign("all_way_stop"), lanelet(1, 212, 112, 8)))
    assert any("all_way_stop" in note for note in made.notes)
    assert any("lanes for cars without a speed limit: 1;" in note for note in made.notes)


def test_metres_in_attributes_are_refused_by_a_sentence(tmp_path):
    parts = [part.replace('lat="" lon=""', 'x="1" y="2"') for part in places()]
    parts = [re.sub(r"<tag .*/>", "", part) for part in parts]
    with pytest.raises(InputError, match="neither lat and lon nor") as error:
        street(tmp_path, (*parts, *WAYS, lanelet(1, 212, 112)))
    assert "KeyError" not in str(error.value)


def test_work_grows_with_the_lanelets_of_one_bound_and_not_with_their_pairs(tmp_path, monkeypatch):
    calls = []
    intersection = shapely.intersection
    monkeypatch.setattr(
        shapely, "intersection", lambda *areas: calls.append(1) or intersection(*areas)
    )
    for n in (20, 40):
        lines = [
            node(100 + 2 * i + k, 1000.0 + 50 * k, 0.001 * i) for i in range(n) for k in (0, 1)
        ]
        ways = [way(1000 + i, 100 + 2 * i, 101 + 2 * i) for i in range(n)]
        top = (node(1, 1000.0, 3.5), node(2, 1050.0, 3.5), way(9, 1, 2))
        fan = [lanelet(5000 + i, 9, 1000 + i) for i in range(n)]
        calls.clear()
        made = street(tmp_path, (*top, *lines, *ways, *fan))
        assert all(lane.is_intersection for lane in made.lanes.values())
        assert len(calls) <= 2 * n


CROSSING = (
    *STREET[:-4],
    *(node(key, 1150.0 + x, y) for key, x, y in ((41, -2, -60), (42, -2, 90), (43, 2, -60), (44, 2, 90))),
    way(441, 41, 42),
    way(443, 43, 44),
    way(91, 41, 43),
    *(node(key, 1150.0 + x, -10.0) for key, x in ((45, -2), (46, 2))),
    way(92, 45, 46, type="stop_line"),
    lanelet(1, 212, 112),
    lanelet(2, 223, 139),
    lanelet(4, 441, 443, 8),
)  # fmt: skip
YIELD = relation(
    8,
    [("way", "ref_line", 92), ("relation", "yield", 4), ("relation", "right_of_way", 1)],
    {"type": "regulatory_element", "subtype": "right_of_way"},
)


@pytest.mark.slow
@pytest.mark.parametrize("ruled", [True, False])
def test_vehicles_cross_the_route_where_a_rule_says_who_goes_first(tmp_path, ruled):
    rule = (
        YIELD if ruled else YIELD.replace('k="subtype"', 'k="fallback" v="yes"/><tag k="subtype"')
    )
    file = written(tmp_path, (*CROSSING, rule))
    across = set()
    for seed in range(5):
        route = ("map.route.from=1:5", "map.route.to=2:140", "map.vehicles=3")
        made = load_scenario(file, seed, route)
        assert len(made.lane_map.give_way) == ruled
        sides = [np.sign(a.track.xyz[[0, -1], 1] - made.ego_log.xyz[0, 1]) for a in made.actors]
        across |= {seed for begin, end in sides if begin < 0 < end}
    assert bool(across) == ruled


def test_fields_that_are_not_read_are_named(tmp_path):
    made = street(tmp_path, (*places(), *WAYS, lanelet(1, 212, 112, dynamic="yes")))
    assert "Lanelet2: not read are lanelet@dynamic (1)" in made.notes
