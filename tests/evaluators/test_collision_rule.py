"""Contact: hand-made situations, and the array search against the exact step-by-step reference on
hard ones.
"""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alpasim_plugin.core.types import Box
from evaluators import PRESETS
from evaluators.metrics.contact import FRONT, LATERAL, REAR, find_contacts
from evaluators.metrics.footprint import ActorTable, ego_footprints, origin_of
from tests.evaluators.eval_build import CAR, car, rollout, scored, track
from tests.evaluators.reference_rules import contacts_by_step
from tests.examples import examples

PAPER = PRESETS["paper"]
HALF_L = 4.855 / 2
HALF_W = 1.88 / 2
SIDES = {FRONT: "front", REAR: "rear", LATERAL: "lateral"}


def sides_by_step(log, preset=PAPER):
    origin = origin_of(log.ego, preset)
    table = ActorTable(log, preset, origin)
    contacts, gap_m = find_contacts(ego_footprints(log, preset, origin), table, log.ego.t_us)
    out = [{} for _ in range(len(log.ego))]
    for step, actor, side in zip(contacts.step, contacts.actor, contacts.side, strict=True):
        out[step][table.ids[actor]] = SIDES[int(side)]
    return out, gap_m


def assert_twins_agree(log, preset=PAPER, gap_tol_m=1e-9):
    fast, gap_m = sides_by_step(log, preset)
    slow = contacts_by_step(log, preset)
    assert fast == [one.sides for one in slow]
    np.testing.assert_allclose(gap_m, [one.gap_m for one in slow], atol=gap_tol_m)


def flags(log):
    """Return the steps of the flags that are raised at any."""
    found = scored(log, preset="paper")
    steps = {
        name: np.flatnonzero(found[f"collision_{name}"].value).tolist()
        for name in ("any", "front", "rear", "lateral", "at_fault")
    }
    return {name: some for name, some in steps.items() if some}


def test_car_driven_into_is_a_front_contact_at_fault():
    log = rollout(track([0.0, 1.0, 2.0], 0.0), [car("a", track(7.0, 0.0, n=3))])
    # Gap 7 - 2.4275 - 2.25 = 2.32 m at the first step.
    assert flags(log) == {}
    log = rollout(track([0.0, 2.0, 3.0], 0.0), [car("a", track(7.0, 0.0, n=3))])
    assert flags(log) == {"any": [2], "front": [2], "at_fault": [2]}


def test_hit_from_behind_is_a_rear_contact_and_not_at_fault():
    log = rollout(track(0.0, 0.0, n=2), [car("a", track([-6.0, -4.0], 0.0))])
    assert flags(log) == {"any": [1], "rear": [1]}


def test_hit_in_the_side_is_lateral_and_at_fault():
    log = rollout(track(0.0, 0.0), [car("a", track(0.0, 1.5))])
    # The other car is as long as the ego less 0.355 m, so it reaches neither bumper.
    assert flags(log) == {"any": [0], "lateral": [0], "at_fault": [0]}


def test_an_actor_on_both_bumpers_counts_as_front():
    log = rollout(track(0.0, 0.0), [car("bus", track(0.0, 1.5), Box(12.0, 2.5, 3.0))])
    assert sides_by_step(log)[0] == [{"bus": "front"}]


def test_every_touching_actor_is_classified():
    log = rollout(
        track(0.0, 0.0),
        [
            car("ahead", track(4.0, 0.0)),
            car("behind", track(-4.0, 0.0)),
            car("beside", track(0.0, -1.5)),
        ],
    )
    assert sides_by_step(log)[0] == [{"ahead": "front", "behind": "rear", "beside": "lateral"}]
    assert flags(log) == {"any": [0], "front": [0], "rear": [0], "lateral": [0], "at_fault": [0]}


def test_identical_boxes_touch_at_the_front():
    log = rollout(track(0.0, 0.0), [car("same", track(0.0, 0.0), Box(4.855, 1.88, 1.6))])
    assert sides_by_step(log)[0] == [{"same": "front"}]


@pytest.mark.parametrize(
    ("x", "y", "side"),
    [
        (HALF_L + 2.25, 0.0, "front"),  # edges on one line
        (-HALF_L - 2.25, 0.0, "rear"),
        (0.0, HALF_W + 0.9, "lateral"),
        (HALF_L + 2.25, HALF_W + 0.9, "front"),  # corner on corner
        (-HALF_L - 2.25, -HALF_W - 0.9, "rear"),
    ],
)
def test_touching_is_contact_and_a_micrometre_away_is_not(x, y, side):
    at = rollout(track(0.0, 0.0), [car("a", track(x, y))])
    nudge = 1e-6 * np.sign([x, y])
    away = rollout(track(0.0, 0.0), [car("a", track(x + nudge[0], y + nudge[1]))])
    assert_twins_agree(at)
    assert_twins_agree(away)
    # The corners are rounded, so at the touching position itself either answer is right, but within
    # one rounding of it.
    near = rollout(track(0.0, 0.0), [car("a", track(x - nudge[0] * 1e-3, y - nudge[1] * 1e-3))])
    assert sides_by_step(near)[0] == [{"a": side}]
    assert sides_by_step(away)[0] == [{}]


def test_the_gap_is_zero_exactly_where_there_is_contact():
    log = rollout(track(0.0, 0.0, n=3), [car("a", track([8.0, 4.0, 4.6775], 0.0))])
    sides, gap_m = sides_by_step(log)
    assert [bool(s) for s in sides] == [False, True, bool(gap_m[2] == 0.0)]
    assert gap_m[0] == pytest.approx(8.0 - 2.4275 - 2.25)
    assert gap_m[1] == 0.0


def test_without_actors_the_gap_is_invalid_with_a_reason_and_no_flag_is_set():
    log = rollout(track([0.0, 1.0], 0.0))
    found = scored(log, preset="paper")
    gap = found["min_distance_to_obstacle_m"]
    assert not gap.valid.any()
    assert np.isnan(gap.value).all()
    assert gap.reason == "no other actor is present"
    assert found["collision_any"].value.tolist() == [0.0, 0.0]
    assert found["collision_any"].valid.all()


def test_an_actor_counts_only_between_its_first_and_last_logged_time():
    t = np.array([200_000, 300_000])
    log = rollout(track(0.0, 0.0, n=6), [car("ghost", track(0.0, 0.0, t_us=t))])
    assert flags(log)["any"] == [2, 3]
    gap = scored(log, preset="paper")["min_distance_to_obstacle_m"]
    assert gap.valid.tolist() == [False, False, True, True, False, False]


def test_between_logged_times_an_actor_is_interpolated():
    sparse = track([20.0, 0.0, 20.0], 0.0, t_us=[0, 500_000, 1_000_000])
    log = rollout(track(0.0, 0.0, n=11), [car("a", sparse)])
    x = np.interp(np.arange(11), [0, 5, 10], [20.0, 0.0, 20.0])
    assert flags(log)["any"] == np.flatnonzero(abs(x) <= HALF_L + 2.25).tolist()
    assert_twins_agree(log)


def test_interpolated_headings_take_the_shorter_turn_across_180_degrees():
    turning = track(0.0, 3.0, yaw=[math.radians(175), math.radians(-175)], t_us=[0, 200_000])
    log = rollout(track(0.0, 0.0, n=3), [car("a", turning, Box(8.0, 1.0, 1.0))])
    # On the longer way round the box would stand across the road at the middle step and hit the
    # ego.
    assert flags(log) == {}
    assert_twins_agree(log)


def test_footprint_size_is_the_papers_and_not_the_logged_one():
    big = rollout(track(0.0, 0.0), [car("a", track(4.9, 0.0))], box=Box(6.0, 2.5, 2.0))
    assert flags(big) == {}


angles = st.sampled_from(
    [0.0, np.pi, -np.pi, np.pi / 2, -np.pi / 2, np.pi / 4, 3.0, -3.0]
) | st.floats(-np.pi, np.pi)
# Quarter metres make touching edges and shared corners likely.
coarse = st.integers(-32, 32).map(lambda k: k / 4)
offsets = st.sampled_from([(0.0, 0.0), (691_000.0, 5_334_000.0), (-3e5, 1e-3)])


@st.composite
def situations(draw):
    n = draw(st.integers(1, 4))
    ox, oy = draw(offsets)
    standstill = draw(st.booleans())
    xs = [0.0] * n if standstill else [draw(coarse) for _ in range(n)]
    ego = track(np.array(xs) + ox, oy, yaw=[draw(angles)] * n)
    actors = []
    for k in range(draw(st.integers(0, 4))):
        first = draw(st.integers(0, n - 1))
        last = draw(st.integers(first, n - 1))
        m = last - first + 1
        poses = track(
            np.array([draw(coarse) for _ in range(m)]) + ox,
            np.array([draw(coarse) for _ in range(m)]) + oy,
            yaw=[draw(angles) for _ in range(m)],
            t_us=np.arange(first, last + 1) * 100_000,
        )
        size = draw(
            st.sampled_from(
                [
                    CAR,
                    Box(0.5, 0.5, 1.8),
                    Box(12.0, 2.5, 3.0),
                    Box(4.0, 2.0, 1.5),
                    Box(1e-3, 1e-3, 1.0),
                ]
            )
        )
        actors.append(car(f"a{k}", poses, size))
    size = draw(st.sampled_from([(4.855, 1.88), (4.0, 2.0)]))
    return rollout(ego, actors), size


@settings(max_examples=examples(150), deadline=None)
@given(situations())
def test_array_search_and_exact_twin_agree_on_hard_situations(case):
    log, size = case
    from dataclasses import replace

    assert_twins_agree(log, replace(PAPER, ego_size_m=size))


@settings(max_examples=examples(60), deadline=None)
@given(st.floats(-1e-9, 1e-9), st.floats(-np.pi, np.pi), st.sampled_from([0.0, 5e6]))
def test_flips_stay_within_a_nanometre_of_touching(nudge, yaw, offset):
    """Whole scene turned and moved: rounding of the corners may flip a contact only next to the
    touching position.
    """
    c = np.cos(yaw)
    s = np.sin(yaw)
    distance = HALF_L + 2.25 + nudge
    log = rollout(
        track(offset, -offset, yaw=yaw),
        [car("a", track(offset + c * distance, -offset + s * distance, yaw=yaw))],
    )
    sides, gap_m = sides_by_step(log)
    band_m = 1e-9 if offset else 1e-14 * 10
    rounding_m = np.spacing(2 * abs(offset) + 10.0) * 2
    if nudge < -max(rounding_m, band_m):
        assert sides == [{"a": "front"}]
    elif nudge > max(rounding_m, band_m):
        assert sides == [{}]
    assert gap_m[0] <= max(nudge, 0.0) + rounding_m + 1e-12
