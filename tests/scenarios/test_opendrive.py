"""OpenDRIVE: every kind of reference line against an independent way to the same curve, lanes and
links, AlpaSim's rule, real maps.
"""

import csv
from xml.etree import ElementTree

import numpy as np
import pytest
import shapely
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import quad

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import arc_lengths
from alpasim_plugin.core.lane_areas import lane_polygon
from scenarios.opendrive import T_enu_earth, T_local_map, geographic_origin, lane_map_of
from scenarios.opendrive_road import Geometry, cubics_at, parse_map
from scenarios.recorded import SourceFiles
from scenarios.usdz import alpasim_map

FILES = SourceFiles()


def lane(
    i,
    width='<width sOffset="0" a="3.5" b="0" c="0" d="0"/>',
    kind="driving",
    more="",
):
    return f'<lane id="{i}" type="{kind}" level="false">{more}{width}</lane>'


def road(
    left="",
    right="",
    view="",
    i=1,
    length=40.0,
    sections="",
    before="",
    more="",
):
    view = view or f'<geometry s="0" x="0" y="0" hdg="0" length="{length}"><line/></geometry>'
    sides = "".join(
        f"<{side}>{content}</{side}>"
        for side, content in (("left", left), ("right", right))
        if content
    )
    sections = sections or f'<laneSection s="0">{sides}</laneSection>'
    return f'<road id="{i}" length="{length}" junction="-1" {more}>{before}<planView>{view}</planView><lanes>{sections}</lanes></road>'


def parsed(*roads, header=""):
    return parse_map(
        "map.xodr",
        ElementTree.fromstring(f"<OpenDRIVE>{header}{''.join(roads)}</OpenDRIVE>"),
    )


def lanes_of(*roads):
    return lane_map_of("map.xodr", parsed(*roads), np.eye(4))[0]


def test_a_spiral_integrates_its_heading():
    spiral = Geometry(0.0, 3.0, -2.0, 0.4, 60.0, "spiral", (-0.01, 0.04))

    def heading(s):
        return 0.4 - 0.01 * s + 0.5 * (0.05 / 60.0) * s * s

    for s in (0.0, 1.0, 33.3, 60.0):
        x, y, yaw = spiral.at(np.array([s]))[0]
        assert x == pytest.approx(
            3.0 + quad(lambda t: np.cos(heading(t)), 0, s, epsabs=1e-13)[0], abs=1e-11
        )
        assert y == pytest.approx(
            -2.0 + quad(lambda t: np.sin(heading(t)), 0, s, epsabs=1e-13)[0], abs=1e-11
        )
        assert yaw == pytest.approx(heading(s), abs=1e-12)


@pytest.mark.parametrize("curvature", [0.05, -0.2, 1.0])
def test_an_arc_lies_on_its_circle(curvature):
    arc = Geometry(0.0, 0.0, 0.0, 1.1, 2 * np.pi / abs(curvature), "arc", (curvature,))
    at = arc.at(np.linspace(0.0, arc.length_m, 50))
    centre = np.array([-np.sin(1.1), np.cos(1.1)]) / curvature
    assert_allclose(np.hypot(*(at[:, :2] - centre).T), 1 / abs(curvature), rtol=1e-12)
    assert_allclose(at[-1, :2], 0.0, atol=1e-10)  # a full turn


def test_a_cubic_is_walked_by_its_arc_length():
    cubic = Geometry(0.0, 0.0, 0.0, 0.0, 30.0, "poly3", (0.0, 0.1, 0.02, -0.0005))
    s = np.linspace(0.0, 30.0, 3001)
    at = cubic.at(s)
    assert_allclose(
        at[:, 1], 0.1 * at[:, 0] + 0.02 * at[:, 0] ** 2 - 0.0005 * at[:, 0] ** 3, atol=1e-9
    )
    assert_allclose(arc_lengths(at[:, :2]), s, atol=1e-4)  # chords of 1 cm
    assert_allclose(at[1:-1, 2], np.arctan2(*(at[2:, :2] - at[:-2, :2]).T[::-1]), atol=1e-5)


@pytest.mark.parametrize("normalised", [True, False])
def test_a_parametric_cubic_by_share_or_by_length(normalised):
    scale = 1.0 if normalised else 20.0
    numbers = (0.0, 20.0 / scale, 0.0, 0.0, 0.0, 0.0, 6.0 / scale**2, -4.0 / scale**3)
    at = Geometry(0.0, 1.0, 2.0, np.pi / 2, 20.0, "paramPoly3", numbers, normalised).at(
        np.array([0.0, 10.0, 20.0])
    )
    assert_allclose(
        at[:, :2], [[1.0, 2.0], [1.0 - (6 / 4 - 4 / 8), 12.0], [-1.0, 22.0]], atol=1e-12
    )
    assert at[0, 2] == pytest.approx(np.pi / 2)


def test_the_record_in_force_counts():
    records = np.array([[0.0, 1.0, 0.0, 0.0, 0.0], [10.0, 5.0, 0.5, 0.0, 0.0]])
    assert_allclose(
        cubics_at(records, np.array([-1.0, 0.0, 9.99, 10.0, 12.0])), [1.0, 1.0, 1.0, 5.0, 6.0]
    )
    assert cubics_at([], np.array([3.0])).tolist() == [0.0]


def test_lanes_of_both_sides_run_against_each_other():
    found = lanes_of(road(left=lane(1), right=lane(-1) + lane(-2, kind="shoulder")))
    right = found.lanes["1.0.-1"]
    left = found.lanes["1.0.1"]
    assert_allclose(right.centre[[0, -1]], [[0, -1.75, 0], [40, -1.75, 0]], atol=1e-9)
    assert_allclose(left.centre[[0, -1]], [[40, 1.75, 0], [0, 1.75, 0]], atol=1e-9)
    for one in (right, left):
        ring = lane_polygon(one)
        assert not shapely.is_ccw(
            shapely.linearrings(np.concatenate([one.left[:, :2], one.right[::-1, :2]]))
        )
        assert ring.area == pytest.approx(140.0)
    assert (right.left_neighbour, right.right_neighbour) == (None, "1.0.-2")
    assert found.lanes["1.0.-2"].kind == "shoulder"


def test_widths_offsets_heights_and_borders_follow_the_true_arc_length():
    taper = lane(
        -1,
        '<width sOffset="0" a="3" b="0" c="0" d="0"/><width sOffset="20" a="3" b="0.1" c="0" d="0"/>',
    )
    border = lane(-2, '<border sOffset="0" a="-9" b="0" c="0" d="0"/>')
    body = f'<laneOffset s="10" a="0.5" b="0" c="0" d="0"/><laneSection s="0"><right>{taper}{border}</right></laneSection>'
    rise = '<elevationProfile><elevation s="0" a="2" b="0.1" c="0" d="0"/></elevationProfile>'
    bank = '<lateralProfile><superelevation s="0" a="0.1" b="0" c="0" d="0"/></lateralProfile>'
    found = lanes_of(road(sections=body, before=rise + bank))
    one = found.lanes["1.0.-1"]
    at_30 = np.argmin(np.abs(one.right[:, 0] - 30.0))
    assert_allclose(
        one.right[at_30], [30.0, 0.5 - 4.0, 2.0 + 3.0 + (0.5 - 4.0) * np.tan(0.1)], atol=1e-9
    )
    outer = found.lanes["1.0.-2"].right
    assert outer[np.argmin(np.abs(outer[:, 0] - 30.0)), 1] == pytest.approx(0.5 - 9.0)


def test_lanes_are_linked_along_sections_roads_and_junctions():
    next_lane = '<link><successor id="-1"/></link>'
    halves = "".join(
        f'<laneSection s="{s}"><right>{lane(-1, more=next_lane)}</right></laneSection>'
        for s in (0, 20)
    )
    first = road(
        sections=halves,
        i=1,
        before='<link><successor elementType="junction" elementId="9"/></link>',
    )
    turn = (
        road(right=lane(-1), i=2)
        .replace('junction="-1"', 'junction="9"')
        .replace('x="0"', 'x="40"')
    )
    junction = (
        '<junction id="9"><connection id="0" incomingRoad="1" connectingRoad="2" contactPoint="start">'
        '<laneLink from="-1" to="-1"/></connection></junction>'
    )
    found = lanes_of(first, turn, junction)
    assert found.lanes["1.0.-1"].successors == ("1.1.-1",)
    assert found.lanes["1.1.-1"].successors == ("2.0.-1",)
    assert found.lanes["2.0.-1"].is_intersection


LINE = '<geometry s="0" x="0" y="0" hdg="0" length="100"><line/></geometry>'
NO_SHAPE = '<geometry s="0" x="0" y="0" hdg="0" length="9"/>'


@pytest.mark.parametrize(
    "content",
    [
        "<osm/>",
        "<OpenDRIVE/>",
        road(right=lane(-1), length=float("nan")),
        road(right=lane(-1), length=1e308),
        road(right=lane(-1, '<width sOffset="0" a="1e300" b="0" c="0" d="0"/>')),
        road(right=lane(-1)).replace('id="-1"', 'id="x"'),
        road(right=lane(-1), view=NO_SHAPE),
        road(right=lane(-1, kind="sidewalk")),
        road(right=lane(-1), i=7) + road(right=lane(-1), i=7),
        road(right=lane(-1), more='rule="left"'),
        road(right=lane(-1), view=LINE, length=101.5),
    ],
)
def test_what_is_no_usable_map_is_refused(content):
    text = f"<OpenDRIVE>{content}</OpenDRIVE>" if content.startswith("<road") else content
    with pytest.raises(InputError):
        lane_map_of("map.xodr", parse_map("map.xodr", ElementTree.fromstring(text)), np.eye(4))


# --- AlpaSim's rule


def test_alpasims_edges_are_the_outermost_borders_sidewalks_included():
    walk = lane(2, '<width sOffset="0" a="2" b="0" c="0" d="0"/>', "sidewalk")
    found = alpasim_map(parsed(road(left=lane(1) + walk, right=lane(-1))), np.eye(4))
    assert set(found.lanes) == {"1_1", "1_-1"}
    assert [round(float(edge[0, 1]), 6) for edge in found.road_edges] == [5.5, -3.5]
    own = lanes_of(road(left=lane(1) + walk, right=lane(-1)))
    assert (
        shapely.distance(shapely.points(20, 3.5), shapely.linestrings(own.road_edges[0][:, :2]))
        < 1e-9
    )


def test_alpasim_gives_a_one_sided_road_an_edge_beside_its_reference_line():
    found = alpasim_map(parsed(road(right=lane(-1))), np.eye(4))
    assert sorted(round(float(edge[0, 1]), 6) for edge in found.road_edges) == [-3.5, 0.01]


def test_alpasim_reads_widths_by_station_number():
    taper = lane(-1, '<width sOffset="0" a="2" b="0.1" c="0" d="0"/>')
    edge = alpasim_map(parsed(road(right=taper, length=40.2)), np.eye(4)).road_edges[0]
    # 81 stations over 40.2 m are 0.5025 m apart, but widths are read every 0.5 m.
    assert edge[-1, 1] == pytest.approx(-(2 + 0.1 * 40.0))
    assert lanes_of(road(right=taper, length=40.2)).lanes["1.0.-1"].right[-1, 1] == pytest.approx(
        -(2 + 0.1 * 40.2)
    )


def test_alpasim_passes_over_what_is_neither_line_nor_arc():
    view = (
        '<geometry s="0" x="0" y="0" hdg="0" length="10"><line/></geometry>'
        '<geometry s="10" x="10" y="0" hdg="0" length="20"><spiral curvStart="0" curvEnd="0.01"/></geometry>'
    )
    found = alpasim_map(parsed(road(right=lane(-1), view=view, length=30)), np.eye(4))
    assert found.lanes["1_-1"].centre[:, 0].max() == pytest.approx(10.0)
    assert (
        lanes_of(road(right=lane(-1), view=view, length=30)).lanes["1.0.-1"].centre[:, 0].max()
        > 29.5
    )


def test_alpasim_drops_edges_across_lanes_and_twins_of_edges():
    across = road(
        right=lane(-1),
        i=2,
        view='<geometry s="0" x="20" y="-20" hdg="1.5707963267948966" length="40"><line/></geometry>',
    )
    found = alpasim_map(parsed(road(left=lane(1), right=lane(-1)), across), np.eye(4))
    assert found.road_edges == ()  # all of them cross a lane of the other road
    beside = road(
        right=lane(-1),
        i=3,
        view='<geometry s="0" x="0" y="-3.6" hdg="0" length="40"><line/></geometry>',
    )
    assert (
        len(alpasim_map(parsed(road(left=lane(1), right=lane(-1)), beside), np.eye(4)).road_edges)
        == 3
    )


def test_a_map_is_placed_by_its_origin_on_the_earth():
    assert geographic_origin("+proj=tmerc +lat_0=49 +lon_0=8 +=alt_0=0 +h_0=110") == (
        49.0,
        8.0,
        110.0,
    )
    assert geographic_origin("+proj=utm +zone=32") is None
    assert geographic_origin("+lat_0=x +lon_0=8") is None
    T_earth_local = np.linalg.inv(T_enu_earth(49.0, 8.0, 110.0))
    shift = np.eye(4)
    shift[:3, 3] = [5.0, -7.0, 1.0]
    place = T_local_map("+lat_0=49 +lon_0=8 +h_0=110", T_earth_local @ shift)
    assert_allclose(place, np.linalg.inv(shift), atol=1e-8)
    assert_array_equal(T_local_map("", T_earth_local), np.eye(4))
    x, y, z = np.linalg.inv(T_enu_earth(90.0, 0.0, 0.0))[:3, 3]
    assert_allclose(
        [x, y, z], [0.0, 0.0, 6356752.3142], atol=1e-4
    )  # the pole: WGS 84's semi-minor axis


# --- real maps

REAL = {
    # roads, metres, records by kind: facts of the data sets' notes, counted by other software
    "opendrive-esmini/fabriksgatan.xodr": (16, 687.717, {"paramPoly3": 16, "arc": 8}),
    "opendrive-esmini/e6mini.xodr": (1, 1464.434, {"paramPoly3": 16, "line": 1}),
    "opendrive-esmini/multi_intersections.xodr": (
        63,
        3507.665,
        {"line": 95, "spiral": 56, "arc": 32},
    ),
    "opendrive-esmini/straight_500m.xodr": (1, 500.0, {"line": 1}),
    "opendrive-carla/Town01.xodr": (98, 3923.072, {"line": 240, "arc": 112}),
    "opendrive-carla/Town03.xodr": (279, 9141.991, {"line": 718, "arc": 358}),
}


def real(shared_data, name):
    path = shared_data / name
    return parse_map(path, FILES.read_xml(path))


@pytest.mark.parametrize("name", REAL)
def test_roads_and_reference_lines_of_real_maps(shared_data, name):
    odr = real(shared_data, name)
    roads, metres, kinds = REAL[name]
    records = [record for one in odr.roads for record in one.records]
    assert len(odr.roads) == roads
    assert sum(one.length_m for one in odr.roads) == pytest.approx(metres, abs=2e-3)
    assert {kind: sum(record.kind == kind for record in records) for kind in kinds} == kinds
    assert len(records) == sum(kinds.values())
    for one in odr.roads:
        for a, b in zip(one.records[:-1], one.records[1:], strict=True):
            end = a.at(np.array([a.length_m]))[0]
            assert (
                np.hypot(end[0] - b.x_m, end[1] - b.y_m) < 2e-3
            )  # one record ends where the next begins


BIG = [pytest.param("opendrive-carla/Town03.xodr", marks=pytest.mark.slow)]


@pytest.mark.parametrize("name", [n for n in REAL if "Town" not in n] + BIG)
def test_lanes_of_real_maps_are_sound(shared_data, name):
    odr = real(shared_data, name)
    found, _ = lane_map_of(name, odr, np.eye(4))
    assert found.road_edges
    assert alpasim_map(odr, np.eye(4)).lanes
    for one in found.lanes.values():
        assert np.isfinite(one.centre).all()
        for after in one.successors:
            follower = found.lanes[after]
            gap = np.hypot(*(one.centre[-1, :2] - follower.centre[0, :2]))
            # Town03 links shoulders across the tips of two head-on roads that are 8 cm and 96 cm
            # long.
            assert gap < 0.01 or one.kind == "shoulder", (one.lane_id, after, gap)


def test_cars_of_another_simulator_drive_in_the_lanes(shared_data):
    """The trace's car drives through fabriksgatan by esmini's own reading of the map."""
    found, _ = lane_map_of("f", real(shared_data, "opendrive-esmini/fabriksgatan.xodr"), np.eye(4))
    with (shared_data / "opendrive-esmini" / "osi" / "example.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    car = [row for row in rows if float(row["length"]) > 2.0]
    assert len(car) == 434
    road = shapely.union_all(
        [
            shapely.buffer(lane_polygon(one), 1e-3)
            for one in found.lanes.values()
            if one.kind == "vehicle"
        ]
    )
    inside = shapely.contains_xy(
        road, [float(row["x"]) for row in car], [float(row["y"]) for row in car]
    )
    assert inside.all()
    best = []
    for row in car[::40]:
        at = np.array([float(row["x"]), float(row["y"])])
        yaw = float(row["yaw"])
        steps = [
            np.diff(one.centre[:, :2], axis=0)[np.argmin(np.hypot(*(one.centre[:-1, :2] - at).T))]
            for one in found.lanes.values()
        ]
        near = [np.min(np.hypot(*(one.centre[:, :2] - at).T)) for one in found.lanes.values()]
        ahead = [abs((np.arctan2(s[1], s[0]) - yaw + np.pi) % (2 * np.pi) - np.pi) for s in steps]
        best.append(min(d for d, a in zip(near, ahead, strict=True) if a < 0.3))
    assert max(best) < 0.6  # some lane there runs its way, and it is in its middle


@pytest.mark.parametrize("length", [60.0, 100.5])
def test_a_road_not_as_long_as_its_reference_line_is_noted(length):
    def notes(metres):
        odr = parsed(road(right=lane(-1), view=LINE, length=metres, i="a7"))
        return lane_map_of("map.xodr", odr, np.eye(4))[1]

    assert not notes(100.0)
    assert any(f"a7 ({100 - length:+.2f} m)" in note for note in notes(length))


@pytest.mark.parametrize(
    "both", [lane(-1, kind="bidirectional"), lane(-1).replace("level", 'direction="both" level')]
)
def test_a_lane_for_both_directions_is_noted(both):
    assert any("both directions" in note for note in parsed(road(right=both)).notes)
    assert not parsed(road(right=lane(-1))).notes


@pytest.mark.parametrize("rule", ["LHT", "lht"])
def test_with_left_hand_traffic_lanes_run_the_other_way(rule):
    found = lanes_of(road(left=lane(1), right=lane(-1), more=f'rule="{rule}"'))
    assert_allclose(found.lanes["1.0.-1"].centre[[0, -1], 0], [40, 0], atol=1e-9)
    assert_allclose(
        found.lanes["1.0.-1"].left[:, 1], -3.5, atol=1e-12
    )  # its left is the road's outside
    assert_allclose(found.lanes["1.0.1"].right[:, 1], 0.0, atol=1e-12)


def test_paint_of_marks():
    mark = '<roadMark sOffset="0" type="{}" color="{}"/>'
    middle = (
        f'<center><lane id="0" type="none">{mark.format("solid solid", "yellow")}</lane></center>'
    )
    sides = f"{middle}<right>{lane(-1, more=mark.format('broken', 'white'))}</right>"
    one = lanes_of(road(sections=f'<laneSection s="0">{sides}</laneSection>')).lanes["1.0.-1"]
    assert (one.left_mark_type, one.right_mark_type) == ("double_yellow", "dashed_white")


def test_a_lane_inside_of_corners_runs_forwards():
    """The reference line turns by 10 degrees every 2 m, 11 m to the left of the lane's middle."""
    places = [np.zeros(2)]
    headings = -np.radians(10.0) * np.arange(9)
    for yaw in headings:
        places.append(places[-1] + 2.0 * np.array([np.cos(yaw), np.sin(yaw)]))
    view = "".join(
        f'<geometry s="{2 * n}" x="{x}" y="{y}" hdg="{yaw}" length="2"><line/></geometry>'
        for n, ((x, y), yaw) in enumerate(zip(places, headings, strict=False))
    )
    sides = lane(-1, '<width sOffset="0" a="7" b="0" c="0" d="0"/>') + lane(-2)
    flat = "".join(f'<elevation s="{s}" a="0" b="0" c="0" d="0"/>' for s in (0, 9))
    heights = f"<elevationProfile>{flat}</elevationProfile>"  # two records: stations every 0.5 m
    lanes = lanes_of(road(right=sides, view=view, length=18, before=heights)).lanes
    for key in ("1.0.-1", "1.0.-2"):
        centre = lanes[key].centre
        steps = np.diff(centre[:, :2], axis=0)
        yaw = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0])[np.hypot(*steps.T) > 1e-6])
        assert yaw.min() > headings[-1] - 0.4
        assert yaw.max() < 0.4
        assert len(lanes[key].left) == len(lanes[key].right)
    ends = lanes["1.0.-2"].centre[[0, -1], :2]
    left = np.array([-np.sin(headings[-1]), np.cos(headings[-1])])
    assert ends == pytest.approx(np.stack([[0.0, -8.75], places[-1] - 8.75 * left]), abs=1e-6)
