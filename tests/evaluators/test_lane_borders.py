"""The border of the lanes around the ego against the reference that builds the union at every
step.
"""

import numpy as np
import pytest

from alpasim_plugin.core.types import Lane
from evaluators import PRESETS
from evaluators.metrics.footprint import ego_footprints, origin_of
from evaluators.metrics.offroad import containment
from evaluators.metrics.road import Road
from tests.evaluators.eval_build import lane, road_map, rollout, scene, scored, track
from tests.evaluators.reference_rules import road_by_step
from tests.examples import examples

PAPER = PRESETS["paper"]
LENGTH_M = 4.855
HALF_W = 0.94


def checked(lane_map, log):
    """Return what the road holds, having compared every step with the reference."""
    where = scene(lane_map, log)
    origin = origin_of(where.ego_log, PAPER)
    road = Road(lane_map, origin, PAPER)
    centres = log.ego.xyz - origin
    below_m = log.ego_box.height_m / 2
    held = containment(road, ego_footprints(log, PAPER, origin), centres, below_m)
    slow = road_by_step(log, where, PAPER)
    assert (held.in_one | held.in_union).tolist() == [one.on_road for one in slow]
    np.testing.assert_allclose(
        held.boundary_gap_m, [one.boundary_gap_m for one in slow], rtol=0, atol=2e-9
    )
    return held


def strip(name, y0, y1, x0=-30.0, x1=30.0, vertices=2, turn=0.0, about=(0.0, 0.0)):
    """A straight lane between two heights, with this many vertices an edge, turned about a
    point.
    """
    x = np.linspace(x0, x1, vertices)
    c, s = np.cos(turn), np.sin(turn)

    def line(y):
        dx = x - about[0]
        dy = np.full(vertices, y) - about[1]
        return np.stack(
            [about[0] + c * dx - s * dy, about[1] + s * dx + c * dy, np.zeros(vertices)], axis=1
        )

    return Lane(name, line((y0 + y1) / 2), line(y1), line(y0))


@pytest.mark.parametrize("turn", [0.0, 0.3])
@pytest.mark.parametrize(
    "gap_m",
    [
        0.0,
        1e-12,
        1e-9,
        0.4e-6,
        0.999e-6,
        1e-6,
        1.001e-6,
        1.6e-6,
        1e-5,
        1e-3,
        0.3,
        -1e-9,
        -1e-3,
        -0.5,
    ],
)
def test_a_seam_of_any_width_between_two_lanes(gap_m, turn):
    lanes = [
        strip("right", -2.0, 0.0, vertices=4, turn=turn),
        strip("left", gap_m, gap_m + 2.0, vertices=7, turn=turn),
    ]
    y = np.array([0.0, 0.3, -0.8, 1.0 + gap_m, 1.06, 1.2, -1.06, -1.07])
    c = np.cos(turn)
    s = np.sin(turn)
    checked(road_map(*lanes), rollout(track(-s * y, c * y, yaw=turn)))


def test_a_wedge_that_opens_between_two_lanes():
    upper = Lane(
        "upper",
        np.array([[-30, 1.0, 0], [30, 1.2, 0]]),
        np.array([[-30, 2.0, 0], [30, 2.0, 0]]),
        np.array([[-30, 0, 0], [30, 0.4, 0]]),
    )
    lanes = road_map(strip("lower", -2.0, 0.0), upper)
    checked(lanes, rollout(track(np.linspace(-29, 29, 12), 0.1)))
    checked(lanes, rollout(track(np.linspace(-29, 29, 12), -1.0)))


@pytest.mark.parametrize(
    "nudge_m", [0.0, 1e-12, -1e-12, 4e-7, -4e-7, 6e-7, -6e-7, 1e-5, -1e-5, 1e-3, -1e-3]
)
def test_corners_and_sides_exactly_on_the_border(nudge_m):
    lanes = road_map(strip("right", -1.0, 0.0, vertices=3), strip("left", 0.0, 1.0, vertices=5))
    checked(
        lanes,
        rollout(
            track(
                [0.0, 30.0 - LENGTH_M / 2 + nudge_m, -30.0 + LENGTH_M / 2],
                [1.0 - HALF_W + nudge_m, 0.0, HALF_W - 1.0 + nudge_m],
            )
        ),
    )
    # A corner on the outer border, the body turned.
    yaw = 0.4
    up = LENGTH_M / 2 * np.sin(yaw) + HALF_W * np.cos(yaw)
    wide = road_map(strip("right", -6.0, 0.0), strip("left", 0.0, 6.0))
    checked(wide, rollout(track(0.0, 6.0 - up + nudge_m, yaw=yaw)))


def test_crossing_lanes_slivers_needles_and_bow_ties_at_once():
    bow = lane(
        "bow",
        1.5,
        left=np.array([[-20.0, 2.0, 0], [20.0, 2.5, 0]]),
        right=np.array([[20.0, 1.0, 0], [-20.0, 0.5, 0]]),
    )
    needle = lane(
        "needle",
        0.0,
        left=np.array([[-20.0, 0.0, 0], [20, 0, 0]]),
        right=np.array([[-20.0, 0.0, 0], [20, 0, 0]]),
    )
    sliver = strip("sliver", 1.75, 1.75 + 2e-6, vertices=3)
    bare = Lane("bare", np.array([[-10.0, -4.0, 0], [0, -1, 0], [12.0, -1.0, 0]]), None, None)
    across = [
        strip(f"x{k}", -1.75, 1.75, vertices=k + 2, turn=0.7 * k, about=(1.0, 0.5))
        for k in range(4)
    ]
    steps = np.linspace(-9, 9, 40)
    for lanes in (
        (*across, bow, needle, sliver, bare),
        (bow, bare),
        (across[1], sliver, needle),
        (needle, sliver),
    ):
        checked(road_map(*lanes), rollout(track(steps, 1.2 * np.sin(steps), yaw=steps / 4)))


def test_pieces_of_a_lane_chain_that_bends_and_whose_ends_differ_by_rounding():
    s = np.linspace(0, 60, 31)
    bend = np.stack([s, 6 * np.sin(s / 12), np.zeros(31)], axis=1)
    normal = np.stack([-np.gradient(bend[:, 1], s), np.ones(31), np.zeros(31)], axis=1)
    rows = []
    for k in (-1, 0, 1):
        for i, (a, b) in enumerate([(0, 11), (10, 21), (20, 31)]):
            at = bend[a:b] + normal[a:b] * 3.5 * k * (1 + i * 2e-16)
            rows.append(Lane(f"{k}.{i}", at, at + 1.75 * normal[a:b], at - 1.75 * normal[a:b]))
    x = np.linspace(4, 56, 60)
    on = np.interp(x, s, bend[:, 1])
    held = checked(
        road_map(*rows), rollout(track(x, on + 3.0 * np.sin(x / 5), yaw=np.cos(x / 12) / 2))
    )
    assert held.in_union.any()


def test_random_arrangements_far_from_neat():
    rng = np.random.Generator(np.random.Philox(18))
    for _ in range(examples(40)):
        lanes = [
            strip(
                f"l{k}",
                *np.sort(
                    np.round(rng.uniform(-4, 4, 2), int(rng.integers(0, 3)))
                    + np.array([0.0, 1e-9 * rng.integers(0, 2)])
                ),
                *(-float(rng.integers(5, 20)), float(rng.integers(5, 20))),
                int(rng.integers(2, 6)),
                float(rng.choice([0.0, 0.0, 1e-7, 0.02, 1.0, np.pi / 2, np.pi])),
            )
            for k in range(int(rng.integers(2, 6)))
        ]
        n = 6
        at = np.round(rng.uniform(-6, 6, (2, n)) * 2) / 2
        checked(
            road_map(*lanes), rollout(track(*at, yaw=rng.choice([0.0, np.pi / 2, 0.3, np.pi], n)))
        )


@pytest.mark.parametrize("clockwise", [False, True])
def test_a_closed_ring_is_one_lane_without_a_border_where_it_begins(clockwise):
    """Driven once round as one lane and as two halves."""
    turn = np.linspace(0.0, 2 * np.pi, 201)
    turn = -turn if clockwise else turn

    def arc(radius, part=slice(None)):
        angle = turn[part]
        return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle])

    def ring(name, part=slice(None)):
        left, right = (31.75, 28.25) if clockwise else (28.25, 31.75)
        return Lane(name, arc(30.0, part), arc(left, part), arc(right, part))

    way = arc(30.0)
    log = rollout(track(way[:, 0], way[:, 1], turn + np.sign(turn[-1]) * np.pi / 2))
    one, two = (
        scored(log, road_map(*lanes))["offroad_margin_m"].value
        for lanes in ([ring("a")], [ring("a", slice(0, 101)), ring("b", slice(100, 201))])
    )
    assert one.min() > 0.7
    assert one == pytest.approx(two, abs=1e-3)
