"""Who goes first where neither a light nor a sign says it."""

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.core.geometry import centre_line, direction_of, left_of
from alpasim_plugin.core.types import Box, Lane, Signal
from alpasim_plugin.world.idm import bodies_from
from alpasim_plugin.world.path import polyline_path
from alpasim_plugin.world.signals import give_way_gap_m, lights_on
from scenarios.unsigned_junctions import circle_lanes, priority_lines

CAR = Box(4.6, 1.85, 1.5)
SIDES = {
    "south": 90.0,
    "west": 0.0,
    "north": -90.0,
    "east": 180.0,
}  # heading of who comes from there


def lane(name, points, after=(), inside=False):
    """A lane 3.4 m wide along points ``(N, 2)``."""
    points = np.asarray(points, dtype=np.float64)
    aside = 1.7 * left_of(
        np.gradient(points, axis=0) / np.hypot(*np.gradient(points, axis=0).T)[:, None]
    )
    left, right = (np.column_stack([points + way * aside, 0 * points[:, 0]]) for way in (1, -1))
    return Lane(
        name, centre_line(left, right), left, right, successors=after, is_intersection=inside
    )


def crossing(sides=tuple(SIDES)):
    """Streets that meet at the origin: one lane towards it from each side, straight on over it, and
    away; who comes from the south may turn to the left.
    """
    lanes = []
    for side in sides:
        ahead = direction_of(np.radians(SIDES[side]))
        right = -left_of(ahead)
        along = [
            np.linspace(*span, 30)[:, None] * ahead + 1.7 * right
            for span in ((-80, -8), (-8, 8), (8, 80))
        ]
        turns = (f"{side} left",) if side == "south" else ()
        lanes += [
            lane(f"{side} in", along[0], (f"{side} over", *turns)),
            lane(f"{side} over", along[1], (f"{side} out",), inside=True),
            lane(f"{side} out", along[2]),
        ]
    if "south" in sides:
        turn = np.linspace(0.0, np.pi / 2, 20)
        arc = np.column_stack([-8 + 9.7 * np.cos(turn), -8 + 9.7 * np.sin(turn)])
        lanes.append(lane("south left", arc, (), inside=True))
    return {item.lane_id: item for item in lanes}


def rules(lanes, **more):
    return {line.lanes[0]: line for line in priority_lines(lanes, (), (), **more)}


def test_who_comes_from_the_right_goes_first():
    first = {key: set(line.yields_to) for key, line in rules(crossing()).items()}
    assert first["south over"] == {"east over"}
    assert first["east over"] == {"north over"}
    assert first["north over"] == {"west over"}
    assert first["south left"] == {"east over", "north over"}  # who comes towards it too
    assert first["west over"] == {"south over", "south left"}


def test_where_the_left_goes_first_the_order_is_the_other_one():
    first = {
        key: set(line.yields_to) for key, line in rules(crossing(), first_from_right=False).items()
    }
    assert first["south over"] == {"west over"}
    assert first["south left"] == {"west over", "north over"}


def test_lights_need_no_rule_and_a_sign_holds_its_side_alone():
    lanes = crossing()
    names = [f"{side} in" for side in SIDES]
    stop = np.array([[-5.0, -9.0, 0.0], [5.0, -9.0, 0.0]])
    all_sides = Signal(stop, 0.0, (("red", 1),), lanes=tuple(names))
    assert priority_lines(lanes, (all_sides,), ()) == ()
    sign = Signal(stop, 0.0, (), lanes=("east in",))
    lines = {line.lanes[0]: line for line in priority_lines(lanes, (), (sign,))}
    assert set(lines["east over"].yields_to) == {"north over", "south over", "south left"}
    assert "south over" not in lines


def test_in_a_ring_of_four_one_need_not_wait_for_who_waits():
    """Otherwise four who come at once stand for ever."""
    lines = rules(crossing())
    chain = ["south over"]
    while chain[-1] in lines and (waiting := lines[chain[-1]].yields_to_waiting):
        assert len(chain) < 5
        chain.append(waiting[0])
    pair = rules(crossing(("south", "east")))
    assert pair["south over"].yields_to_waiting == ("east over",)


@pytest.mark.parametrize("signed", [(), ("east in", "west in")])
def test_two_who_turn_left_towards_each_other_do_not_both_wait(signed):
    """Each stands before the lane straight on too, which goes first."""
    lanes = crossing()
    arc = -lanes["south left"].centre[:, :2]
    lanes["north left"] = lane("north left", arc, inside=True)
    after = (*lanes["north in"].successors, "north left")
    lanes["north in"] = replace(lanes["north in"], successors=after)
    stop = np.array([[-5.0, -9.0, 0.0], [5.0, -9.0, 0.0]])
    signs = [Signal(stop, 0.0, (), lanes=(key,)) for key in signed]
    lines = {line.lanes[0]: line for line in priority_lines(lanes, (), signs)}
    for_north = "north over" in lines["south left"].yields_to_waiting
    for_south = "south over" in lines["north left"].yields_to_waiting
    assert for_north != for_south


def roundabout(radius=15.0, squeeze=1.0, corners=None):
    """A circle that is driven around to the left, in four pieces, and a way into it from the south."""

    def point(angle):
        r = (
            radius
            if corners is None
            else radius * np.cos(np.pi / 4) / np.cos((angle + np.pi / 4) % (np.pi / 2) - np.pi / 4)
        )
        return np.column_stack([r * np.cos(angle), squeeze * r * np.sin(angle)])

    lanes = {}
    for n in range(4):
        angle = np.linspace(n, n + 1, 30) * np.pi / 2 - np.pi / 4
        name = f"circle {n}"
        lanes[name] = lane(name, point(angle), (f"circle {(n + 1) % 4}",), inside=True)
    south = np.array([[2.0, -60.0], [2.0, -squeeze * radius - 12.0]])
    end = lanes["circle 3"].centre[-1, :2]
    share = np.linspace(0.0, 1.0, 12)[:, None]
    bow = (
        (1 - share) ** 2 * south[1] + 2 * share * (1 - share) * (end - [7.0, 7.0]) + share**2 * end
    )
    lanes["in"] = lane("in", south, ("join",))
    lanes["join"] = lane("join", bow, ("circle 0",), inside=True)
    return lanes


@pytest.mark.parametrize(
    ("shape", "is_roundabout"),
    [({}, True), ({"squeeze": 0.65}, True), ({"radius": 60.0}, False), ({"corners": 4}, False)],
)
def test_a_roundabout_is_a_small_round_ring(shape, is_roundabout):
    inside = {f"circle {n}" for n in range(4)}
    assert circle_lanes(roundabout(**shape)) == (inside if is_roundabout else set())


def test_who_is_inside_a_roundabout_goes_first():
    lines = rules(roundabout())
    assert list(lines) == ["join"]
    assert lines["join"].yields_to == ("circle 3",)


def bodies(lanes, places):
    """Cars on lanes: name, metres from the lane's end, speed."""
    rows = []
    for name, before_m, speed_mps in places:
        path = polyline_path(lanes[name].centre)
        xyz, yaw = path.at(path.length_m - before_m)
        rows.append((xyz[:2], float(yaw), speed_mps * direction_of(float(yaw))))
    xy, yaw, velocity = (np.array(column) for column in zip(*rows, strict=True))
    return bodies_from(xy, yaw, [CAR] * len(rows), velocity)


def waits(lanes, way, places, front_m):
    """Whether a car on a way of lanes, whose front is so far along it, has to wait."""
    path = polyline_path(np.concatenate([lanes[name].centre for name in way]))
    lines = lights_on(path, priority_lines(lanes, (), ()), lanes)
    return give_way_gap_m(lines, path, front_m, bodies(lanes, places), -1) < np.inf


@pytest.mark.parametrize(
    ("place", "has_to_wait"),
    [
        (("east in", 20.0, 8.0), True),  # from the right
        (("east in", 70.0, 8.0), False),  # too far
        (("west in", 20.0, 8.0), False),  # from the left
        (("north in", 20.0, 8.0), False),  # comes towards
        (("east in", 4.0, 0.0), True),  # waits, and goes first
        (("east in", 30.0, 0.0), False),  # parked
        (("east over", 0.0, 8.0), False),  # is over
    ],
)
def test_a_driver_waits_for_those_who_go_first(place, has_to_wait):
    lanes = crossing(("south", "west", "north", "east"))
    lanes = {key: made for key, made in lanes.items() if key != "south left"}
    way = ("south in", "south over", "south out")
    if place[2] == 0.0:  # two streets alone: no ring
        lanes = {key: made for key, made in lanes.items() if key.split()[0] in ("south", "east")}
    assert waits(lanes, way, [place], 55.0) == has_to_wait
    assert not waits(lanes, way, [place], 74.0)  # is over the line


def test_a_driver_lets_those_in_a_roundabout_pass_who_come_around_it():
    """Straight on they would leave it."""
    lanes = roundabout()
    way = ("in", "join", "circle 0")
    assert waits(lanes, way, [("circle 2", 2.0, 6.0)], 30.0)
    assert waits(lanes, way, [("circle 3", 12.0, 4.0)], 30.0)
    assert not waits(lanes, way, [("circle 0", 2.0, 6.0)], 30.0)
    assert not waits(lanes, way, [("in", 25.0, 6.0)], 30.0)
