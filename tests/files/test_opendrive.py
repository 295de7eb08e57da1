"""OpenDRIVE maps as other tools write them: sections of one side, junctions without lanes, records
out of order.

Every map is made here.
"""

from xml.etree import ElementTree

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from scenarios.load import load_scenario
from scenarios.map_lines import link_notes
from scenarios.opendrive import lane_map_of, read_lanes
from scenarios.opendrive_road import parse_map
from scenarios.opendrive_signals import traffic_lights
from tests.files.opendrive_text import lane, road, section


def read(*parts):
    root = ElementTree.fromstring(f"<OpenDRIVE>{''.join(parts)}</OpenDRIVE>")
    return lane_map_of("map.xodr", parse_map("map.xodr", root), np.eye(4))


def span(lanes, key):
    x = lanes.lanes[key].centre[:, 0]
    return round(float(x[0]), 6), round(float(x[-1]), 6)


def test_a_section_of_one_side_is_refused():
    with pytest.raises(InputError, match="single side"):
        read(road("1", section(0, lane(1), more='singleSide="true"')))


def test_lanes_that_cannot_be_placed_are_said():
    _, notes = read(road("1", section(0, lane(-1)), section(50, lane(-1), lane(-2))))
    assert any("without length" in note and "2" in note for note in notes)


def test_a_direct_junction_links_both_ways():
    junction = (
        '<junction id="9" type="direct">'
        '<connection id="0" incomingRoad="1" linkedRoad="2" contactPoint="start">'
        '<laneLink from="-1" to="-1"/><laneLink from="1" to="1"/></connection>'
        '<connection id="1" incomingRoad="1" linkedRoad="3" contactPoint="start">'
        '<laneLink from="-2" to="-1"/></connection></junction>'
    )
    lanes, notes = read(
        road("1", section(0, lane(1), lane(-1), lane(-2)), after="junction:9"),
        road("2", section(0, lane(1), lane(-1)), x=50, before="junction:9"),
        road("3", section(0, lane(-1)), x=50, before="junction:9"),
        junction,
    )
    assert lanes.lanes["1.0.-1"].successors == ("2.0.-1",)
    assert lanes.lanes["1.0.-2"].successors == ("3.0.-1",)
    assert lanes.lanes["2.0.1"].successors == ("1.0.1",)
    assert not lanes.lanes["2.0.-1"].successors
    assert not notes


@pytest.mark.parametrize("contact", ["start", "end"])
def test_a_connection_without_lanes_links_those_of_one_direction(contact):
    ends = {"before": "road:1:end", "after": "road:3:start"}
    if contact == "end":
        ends = {"before": "road:3:start", "after": "road:1:end"}
        turn = road("2", section(0, lane(1, 1, 1)), x=50, junction="9", **ends)
    else:
        turn = road("2", section(0, lane(-1, -1, -1)), x=50, junction="9", **ends)
    connection = f'<connection incomingRoad="1" connectingRoad="2" contactPoint="{contact}"/>'
    lanes, notes = read(
        road("1", section(0, lane(-1)), after="junction:9"),
        turn,
        road("3", section(0, lane(-1)), x=100, before="junction:9"),
        f'<junction id="9">{connection}</junction>',
    )
    assert lanes.lanes["1.0.-1"].successors == ("2.0.1" if contact == "end" else "2.0.-1",)
    assert "name no lanes" in str(notes)


def test_a_link_that_stands_in_the_next_road_alone_counts():
    lanes, _ = read(
        road("1", section(0, lane(1), lane(-1)), after="road:2:start"),
        road("2", section(0, lane(1), lane(-1, -1)), x=50, before="road:1:end"),
    )
    assert lanes.lanes["1.0.-1"].successors == ("2.0.-1",)


def test_a_lane_that_ends_inside_the_map_is_said():
    _, notes = read(
        road("1", section(0, lane(-1, None, -1), lane(-2)), after="road:2:start"),
        road("2", section(0, lane(-1)), x=50, before="road:1:end"),
    )
    assert "1.0.-2" in str(notes)


def test_links_of_a_road_between_two_junctions_stay_apart():
    def junction(i, incoming, connecting, a, b):
        link = f'<laneLink from="{a}" to="{b}"/>'
        ends = f'incomingRoad="{incoming}" connectingRoad="{connecting}" contactPoint="start"'
        return f'<junction id="{i}"><connection {ends}>{link}</connection></junction>'

    lanes, _ = read(
        road("1", section(0, lane(-1)), before="junction:8", after="junction:9"),
        road("2", section(0, lane(-1)), x=50, junction="9"),
        road("3", section(0, lane(-1)), x=-50, junction="8"),
        junction(8, "1", "3", -1, -1),
        junction(9, "1", "2", -1, -1),
    )
    assert lanes.lanes["1.0.-1"].successors == ("2.0.-1",)


def test_records_out_of_order_are_put_in_order():
    line = '<geometry s="0" x="0" y="0" hdg="0" length="50"><line/></geometry>'
    arc = '<geometry s="50" x="50" y="0" hdg="0" length="50"><arc curvature="0.02"/></geometry>'
    lanes, notes = read(road("1", section(0, lane(-1)), length=100, view=arc + line))
    end = lanes.lanes["1.0.-1"].left[-1]
    assert end[:2] == pytest.approx([50 + 50 * np.sin(1.0), 50 * (1 - np.cos(1.0))], abs=1e-6)
    assert not notes
    _, notes = read(
        road("7", section(0, lane(-1)), length=100, view=arc.replace('x="50"', 'x="51"') + line)
    )
    assert "7 (1.00 m)" in str(notes)


def test_a_reversed_lane_runs_and_sees_the_other_way():
    lanes, _ = read(road("1", section(0, lane(-1), lane(-2, more='direction="reversed"'))))
    assert span(lanes, "1.0.-1") == (0.0, 50.0)
    assert span(lanes, "1.0.-2") == (50.0, 0.0)
    assert lanes.lanes["1.0.-2"].left[0, 1] == pytest.approx(-7.0)
    assert lanes.lanes["1.0.-1"].right_neighbour is None


def test_what_is_not_read_of_a_map_is_said():
    _, notes = read(
        '<header><offset x="1" y="2" z="0" hdg="0"/></header>',
        road("1", section(0, lane(-1))),
        '<include file="more.xodr"/><junction id="4" type="virtual"/>',
    )
    for word in ("include", "virtual", "offset"):
        assert any(word in note for note in notes)


def banked(*lanes):
    """Return the map of a road that is banked by 0.1 rad, with its lanes on the right."""
    made = road("1", section(0, *lanes))
    bank = '<lateralProfile><superelevation s="0" a="0.1" b="0" c="0" d="0"/></lateralProfile>'
    return read(made.replace("<lanes>", f"{bank}<lanes>"))[0].lanes


def test_a_level_lane_and_those_outside_of_it_are_not_banked():
    slope = np.tan(0.1)
    lanes = banked(lane(-1), lane(-2, more='level="true"'), lane(-3))
    assert lanes["1.0.-1"].right[:, 2] == pytest.approx(-3.5 * slope)
    for key in ("1.0.-2", "1.0.-3"):
        assert lanes[key].left[:, 2] == pytest.approx(-3.5 * slope)
        assert lanes[key].right[:, 2] == pytest.approx(-3.5 * slope)
    assert banked(lane(-1))["1.0.-1"].right[:, 2] == pytest.approx(-3.5 * slope)
    assert banked(lane(-1, more='level="true"'))["1.0.-1"].right[:, 2] == pytest.approx(0.0)


def test_a_limit_of_a_lane_goes_before_that_of_its_road():
    slow = lane(-1).replace("</lane>", '<speed sOffset="0" max="30" unit="km/h"/></lane>')
    late = lane(-2).replace("</lane>", '<speed sOffset="20" max="20" unit="km/h"/></lane>')
    made = road("1", section(0, slow, late, lane(-3)))
    made = made.replace("<planView>", '<type s="0" type="town"><speed max="10"/></type><planView>')
    lane_map, notes = read(made)
    limits = {key: one.speed_limit_mps for key, one in lane_map.lanes.items()}
    assert limits == pytest.approx({"1.0.-1": 30 / 3.6, "1.0.-2": 20 / 3.6, "1.0.-3": 10.0})
    assert [note for note in notes if "change their speed limit" in note and "1.0.-2" in note]


def test_linked_lanes_that_do_not_meet_are_named():
    def pair(x):
        first = road("1", section(0, lane(-1, None, -1)), after="road:2:start")
        return read(first, road("2", section(0, lane(-1, -1)), x=x, before="road:1:end"))[0].lanes

    (note,) = link_notes(pair(53.0))
    assert "1.0.-1 to 2.0.-1 (3.00 m)" in note
    assert link_notes(pair(50.05)) == ()


@pytest.mark.parametrize(("junction", "held"), [("9", ["1.0.-1"]), ("-1", [])])
def test_a_light_on_a_one_way_road_of_a_junction_is_for_its_lane(junction, held):
    text = road("1", section(0, lane(-1)), junction=junction)
    light = (POST % "-").replace('<validity fromLane="0" toLane="0"/>', "")
    text = text.replace("</road>", f"{light}</road>")
    odr = parse_map("map.xodr", ElementTree.fromstring(f"<OpenDRIVE>{text}</OpenDRIVE>"))
    lanes, _ = read_lanes("map.xodr", odr, np.eye(4))
    heads, notes = traffic_lights(odr, lanes, np.eye(4))
    assert [list(head.signal.lanes) for head in heads] == ([held] if held else [])
    assert bool(notes) != bool(held)


def test_a_light_for_people_names_lane_0_and_stands_for_those_who_cross():
    text = road("1", section(0, lane(1), lane(-1)))
    walk = (POST % "-").replace("1000001", "1000002")
    odr = parse_map(
        "map.xodr",
        ElementTree.fromstring(
            f"<OpenDRIVE>{text.replace('</road>', walk + '</road>')}</OpenDRIVE>"
        ),
    )
    lanes, _ = read_lanes("map.xodr", odr, np.eye(4))
    (head,), notes = traffic_lights(odr, lanes, np.eye(4))
    assert (head.signal.pedestrians, notes) == (True, ())


def test_links_between_lanes_that_end_at_each_other_are_said_and_not_followed():
    """As shoulders around a corner: the number on the one side, its negative on the other."""
    first = road("1", section(0, lane(1), lane(-1, None, 1)), after="road:2:start")
    second = road("2", section(0, lane(1, -1), lane(-1)), x=50, before="road:1:end")
    lane_map, notes = read(first, second)
    assert [lane.successors for lane in lane_map.lanes.values()] == [(), (), (), ()]
    assert "2 links join lanes that are driven against each other" in str(notes)
    assert "1.0.-1 to 2.0.1" in str(notes)
    assert link_notes(lane_map.lanes) == ()


def test_a_lane_without_a_link_ends_where_others_of_its_section_have_one():
    before = section(0, lane(-1, None, -1), lane(-2), lane(-3, None, -2))
    after = section(25, lane(-1, -1), lane(-2, -3))
    lanes, _ = read(road("1", before, after))
    assert [lanes.lanes[f"1.0.{i}"].successors for i in (-1, -2, -3)] == [
        ("1.1.-1",),
        (),
        ("1.1.-2",),
    ]
    bare, _ = read(road("1", section(0, lane(-1)), section(25, lane(-1))))
    assert bare.lanes["1.0.-1"].successors == ("1.1.-1",)
    named_after, _ = read(road("1", section(0, lane(-1)), section(25, lane(-1), lane(-2, -1))))
    assert named_after.lanes["1.0.-1"].successors == ("1.1.-2",)


TRAVEL = '<userData><vectorLane sOffset="0" travelDir="%s"/></userData></lane>'


@pytest.mark.parametrize(
    ("more", "direction", "is_turned"),
    [
        ("", "forward", False),
        ("", "backward", True),
        ("", "undirected", False),
        ('direction="standard"', "backward", False),
    ],
)
def test_a_lane_is_driven_as_roadrunner_says(more, direction, is_turned):
    made = lane(-1, more=more).replace("</lane>", TRAVEL % direction)
    lanes, notes = read(road("1", section(0, made)))
    assert span(lanes, "1.0.-1") == ((50.0, 0.0) if is_turned else (0.0, 50.0))
    assert ("1 lanes are driven as travelDir" in str(notes)) == is_turned


def test_edges_of_a_tight_bend_follow_their_circles():
    """A corner on half a metre: chords of 0.5 m of the reference line would cut it by 0.8 m."""
    arc = '<geometry s="0" x="0" y="0" hdg="0" length="1"><arc curvature="2"/></geometry>'
    lanes, _ = read(road("1", section(0, lane(-1), lane(-2)), length=1.0, view=arc))
    for key, radius_m in (("1.0.-1", 4.0), ("1.0.-2", 7.5)):
        edge = lanes.lanes[key].right[:, :2]
        middles = (edge[1:] + edge[:-1]) / 2
        away = np.hypot(*(middles - [0.0, 0.5]).T)
        assert away == pytest.approx(radius_m, abs=0.05)


def test_a_limit_of_zero_is_none():
    made = lane(-1).replace("</lane>", '<speed sOffset="0" max="0.0e+00" unit="mph"/></lane>')
    text = road("1", section(0, made))
    lanes, notes = read(text)
    assert lanes.lanes["1.0.-1"].speed_limit_mps is None
    assert "speed limits of 0 are taken as none: 1" in notes
    limited = '<type s="0" type="town"><speed max="10"/></type><planView>'
    lanes, _ = read(text.replace("<planView>", limited))
    assert lanes.lanes["1.0.-1"].speed_limit_mps == 10.0


POST = """<signals><signal id="7" s="1" t="-4" dynamic="yes" type="1000001" orientation="%s"
    height="1" width="0.5" zOffset="5"><validity fromLane="0" toLane="0"/></signal></signals>"""
REFERENCE = """<signals><signalReference id="7" s="49" t="0" orientation="+">
    <validity fromLane="%d" toLane="%d"/></signalReference></signals>"""


@pytest.mark.parametrize(
    ("named", "held"),
    [((1, 1), ["1.0.1"]), ((-1, -1), ["1.0.-1"]), ((-1, 1), ["1.0.-1"]), ((0, 0), [])],
)
def test_a_light_holds_back_the_lanes_that_its_reference_names(named, held):
    """As RoadRunner writes it: the post on a road of the junction names lane 0, the reference a lane,
    whatever its orientation is.
    """
    texts = (
        road("1", section(0, lane(1), lane(-1)), junction="9"),
        road("2", section(0, lane(1), lane(-1)), x=90, junction="9"),
    )
    signals = (REFERENCE % named, POST % "-")
    parts = [
        text.replace("</road>", f"{more}</road>") for text, more in zip(texts, signals, strict=True)
    ]
    odr = parse_map("map.xodr", ElementTree.fromstring(f"<OpenDRIVE>{''.join(parts)}</OpenDRIVE>"))
    lanes, _ = read_lanes("map.xodr", odr, np.eye(4))
    heads, notes = traffic_lights(odr, lanes, np.eye(4))
    assert [list(head.signal.lanes) for head in heads] == ([held] if held else [])
    assert ("1 traffic lights hold back no lane: 7" in str(notes)) == (not held)


def test_ways_do_not_lead_over_gaps_and_the_run_names_them(tmp_path):
    first = road("1", section(0, lane(-1, None, -1)), after="road:2:start")
    second = road("2", section(0, lane(-1, -1)), x=53, before="road:1:end")
    path = tmp_path / "map.xodr"
    path.write_text(f"<OpenDRIVE>{first}{second}</OpenDRIVE>")
    scenario = load_scenario(path, 1)
    assert len(scenario.route.lane_ids) == 1
    notes = " ".join(scenario.notes)
    assert "1.0.-1 to 2.0.-1 (3.00 m)" in notes
    assert "are not driven" in notes


def test_lanes_under_the_side_that_is_not_of_their_number_are_named():
    made = road("1", section(0, lane(-1)))
    swapped = made.replace("right>", "left>")
    lanes, notes = read(swapped)
    assert lanes.lanes["1.0.-1"].right[0, 1] == pytest.approx(-3.5)
    assert any("-1 of road 1" in note for note in notes)
    assert not read(made)[1]


def test_fields_that_are_not_read_are_named():
    height = '<height sOffset="0" inner="0.1" outer="0.1"/></lane>'
    _, notes = read(road("1", section(0, lane(-1).replace("</lane>", height))))
    assert "OpenDRIVE: not read are lane/height (1)" in notes


NESTED = '<access sOffset="0" rule="deny"><restriction type="passengerCar"/></access>'


@pytest.mark.parametrize(
    ("access", "kind"),
    [
        ('<access sOffset="0" rule="allow" restriction="trucks"/>', "bus"),
        ('<access sOffset="0" rule="allow" restriction="emergency"/>', "bus"),
        (
            '<access sOffset="0" rule="allow" restriction="bus"/>'
            '<access sOffset="5" rule="allow" restriction="passengerCar"/>',
            "bus",
        ),
        ('<access sOffset="10" rule="deny" restriction="passengerCar"/>', "bus"),
        (NESTED, "bus"),
        ('<access sOffset="0" rule="allow" restriction="passengerCar"/>', "vehicle"),
        ('<access sOffset="0" rule="allow" restriction="autonomousTraffic"/>', "vehicle"),
        ('<access sOffset="0" rule="deny" restriction="bicycle"/>', "vehicle"),
    ],
)
def test_lanes_that_access_rules_close_to_cars_are_not_lanes_of_cars(access, kind):
    text = lane(-2).replace("</lane>", f"{access}</lane>")
    lanes, notes = read(road("1", section(0, lane(-1), text)))
    assert (lanes.lanes["1.0.-1"].kind, lanes.lanes["1.0.-2"].kind) == ("vehicle", kind)
    assert any("access rules close to cars" in note for note in notes) == (kind == "bus")
    assert "not read" not in str(notes)
