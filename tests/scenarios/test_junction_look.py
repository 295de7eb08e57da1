"""What stands and is painted at a junction: markings that nobody drives over, posts beside the road."""

from xml.etree import ElementTree

import numpy as np
import pytest
import shapely

from alpasim_plugin.core.lane_areas import lane_polygon
from alpasim_plugin.core.types import Lane
from scenarios.light_posts import BESIDE_M, LOWEST_M, LOWEST_OVER_LANES_M, Carriageway
from scenarios.opendrive import read_lanes
from scenarios.opendrive_road import parse_map
from scenarios.opendrive_signals import light_posts, roadside, traffic_lights

SOLID = '<roadMark sOffset="0" type="solid" color="yellow"/>'
GUIDE = '<roadMark sOffset="0" type="broken" color="white"><explicit/></roadMark>'
WIDTH = '<width sOffset="0" a="3.5" b="0" c="0" d="0"/>'


def one_lane(name, x, y, heading_rad, mark=SOLID, junction="9", signals="", length=40.0):
    """A road of one lane with a mark on both of its edges."""
    line = (
        f'<geometry s="0" x="{x}" y="{y}" hdg="{heading_rad}" length="{length}"><line/></geometry>'
    )
    centre = f'<center><lane id="0" type="none">{mark}</lane></center>'
    right = f'<right><lane id="-1" type="driving">{WIDTH}{mark}</lane></right>'
    return (
        f'<road id="{name}" length="{length}" junction="{junction}"><planView>{line}</planView>'
        f'<lanes><laneSection s="0">{centre}{right}</laneSection></lanes>'
        f"<signals>{signals}</signals></road>"
    )


EAST = one_lane("east", -20, 0, 0.0)
NORTH = one_lane("north", 0, -20, np.pi / 2)
BESIDE = one_lane("beside", -20, -30, 0.0)  # nobody crosses it


def parsed(*roads):
    root = ElementTree.fromstring(f"<OpenDRIVE>{''.join(roads)}</OpenDRIVE>")
    odr = parse_map("map.xodr", root)
    return odr, read_lanes("map.xodr", odr, np.eye(4))[0]


def marks(lane):
    return lane.left_mark_type, lane.right_mark_type


def test_lines_over_which_others_of_the_junction_drive_are_not_painted():
    _, lanes = parsed(EAST, NORTH, BESIDE)
    assert marks(lanes["east.0.-1"]) == marks(lanes["north.0.-1"]) == ("none", "none")
    assert marks(lanes["beside.0.-1"]) == ("solid_yellow", "solid_yellow")


def test_a_guide_line_that_the_map_gives_piece_by_piece_stays():
    _, lanes = parsed(EAST, one_lane("north", 0, -20, np.pi / 2, GUIDE))
    assert marks(lanes["east.0.-1"]) == ("none", "none")
    assert marks(lanes["north.0.-1"]) == ("dashed_white", "dashed_white")


def test_roads_that_cross_outside_of_junctions_keep_their_lines():
    _, lanes = parsed(*(road.replace('junction="9"', 'junction="-1"') for road in (EAST, NORTH)))
    assert marks(lanes["east.0.-1"]) == ("solid_yellow", "solid_yellow")


def test_roads_above_one_another_in_a_junction_keep_their_lines():
    height = '<elevationProfile><elevation s="0" a="6" b="0" c="0" d="0"/></elevationProfile>'
    _, lanes = parsed(EAST, NORTH.replace("<lanes>", f"{height}<lanes>"))
    assert marks(lanes["east.0.-1"]) == marks(lanes["north.0.-1"]) == ("solid_yellow",) * 2


def signal(name, t_m, s_m=10.0, above_m=0.0):
    return (
        f'<signal id="{name}" s="{s_m}" t="{t_m}" type="1000001" dynamic="yes" orientation="+" '
        f'zOffset="{above_m}" height="1"/>'
    )


def test_a_light_over_lanes_hangs_from_a_mast_whose_post_stands_beside_them():
    odr, lanes = parsed(one_lane("wide", 0, 0, 0.0, signals=signal("over", -1.6)))
    post = light_posts(odr, lanes, np.eye(4)).by_id["over"]
    road = lane_polygon(lanes["wide.0.-1"])
    assert shapely.distance(road, shapely.Point(post.line[0, :2])) == pytest.approx(BESIDE_M)
    assert post.line[0, 2] == pytest.approx(0.0)
    assert post.lamps == pytest.approx([10.0, -1.6, LOWEST_OVER_LANES_M])
    assert post.line[-1] == pytest.approx(post.lamps)
    assert post.line[1:3, 2].min() > post.lamps[2]


def test_a_light_beside_the_road_stands_where_the_map_has_it():
    odr, lanes = parsed(one_lane("a", 0, 0, 0.0, signals=signal("near", -6.0, above_m=-0.5)))
    post = light_posts(odr, lanes, np.eye(4)).by_id["near"]
    assert post.line == pytest.approx(np.array([[10.0, -6.0, 0.0], [10.0, -6.0, LOWEST_M]]))


def test_a_light_at_the_edge_moves_beside_the_road_with_its_lamps():
    odr, lanes = parsed(one_lane("a", 0, 0, 0.0, signals=signal("edge", -3.3)))
    post = light_posts(odr, lanes, np.eye(4)).by_id["edge"]
    assert len(post.line) == 2
    assert post.line[:, 1] == pytest.approx([-3.5 - BESIDE_M] * 2)


def test_a_light_that_other_roads_refer_to_has_one_post():
    reference = '<signalReference id="once" s="5" t="-1" orientation="+"/>'
    odr, lanes = parsed(
        one_lane("a", -20, 0, 0.0, signals=signal("once", -6.0)),
        one_lane("b", -20, -30, 0.0, signals=reference),
    )
    (pole,) = roadside(odr, lanes, np.eye(4)).poles
    assert pole[0] == pytest.approx([-10.0, -6.0, 0.0])
    heads, _ = traffic_lights(odr, lanes, np.eye(4))
    assert {head.road_id for head in heads} == {"a", "b"}
    assert all(head.signal.head == pytest.approx(pole[-1]) for head in heads)


def test_a_road_on_a_bridge_does_not_move_a_post_below_it():
    _, lanes = parsed(EAST)
    raised = {
        key: lane.__class__(key, lane.centre + np.array([0.0, 0.0, 7.0]), lane.left, lane.right)
        for key, lane in lanes.items()
    }
    foot = np.array([0.0, -1.75, 0.0])
    assert len(Carriageway(lanes).post(foot, 5.0).line) == 4
    assert len(Carriageway(raised).post(foot, 5.0).line) == 2


def test_lights_of_one_id_have_a_post_each():
    both = signal("same", -6.0) + signal("same", -6.0, s_m=30.0)
    odr, lanes = parsed(one_lane("a", 0, 0, 0.0, signals=both))
    assert sorted(pole[0, 0] for pole in roadside(odr, lanes, np.eye(4)).poles) == pytest.approx(
        [10.0, 30.0]
    )
    heads, _ = traffic_lights(odr, lanes, np.eye(4))
    assert sorted(head.signal.head[0] for head in heads) == pytest.approx([10.0, 30.0])


def test_a_lane_that_climbs_over_a_post_does_not_move_it():
    x = np.linspace(0.0, 100.0, 51)
    centre = np.column_stack([x, np.zeros(51), 0.06 * x])
    beside = np.array([0.0, 1.75, 0.0])
    climbing = Lane("up", centre, centre + beside, centre - beside)
    post = Carriageway({"up": climbing}).post(np.array([95.0, 0.0, 0.0]), 5.0)
    assert post.line[:, :2] == pytest.approx(np.array([[95.0, 0.0]] * 2))
