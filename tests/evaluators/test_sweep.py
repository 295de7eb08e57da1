"""First contact of two moving rectangles against closed forms and the 40-digit twin."""

import math
from decimal import Decimal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from evaluators.metrics.sweep import TOUCH_M, Motions, first_contact, slope
from tests.evaluators.reference_strict import Motion, first_touch, separation
from tests.examples import examples

EGO = (4.855, 1.88)
CAR = (4.5, 1.8)


def pair(a, b):
    row = lambda *v: np.array([v], dtype=float)  # noqa: E731
    start = np.subtract(b.xy, a.xy)[None]
    return Motions(
        start,
        np.subtract(b.shift, a.shift)[None],
        row(a.yaw, b.yaw),
        row(a.turn, b.turn),
        np.array([[a.size, b.size]]) / 2,
    )


def contact(a, b):
    tau = float(first_contact(pair(a, b))[0])
    return tau if math.isfinite(tau) else None


def assert_twins_agree(a, b):
    fast = contact(a, b)
    slow = first_touch(a, b)
    if fast is None:
        assert slow is None  # no contact is ever passed over
        return
    # Where the fast search says contact, the bodies are within the tolerance of each other ...
    assert separation(a, b, Decimal(fast)) <= TOUCH_M
    steep = float(slope(pair(a, b))[0])
    if slow is not None:
        # ... and it is never late; it is early by no more than it takes to come from the tolerance to touch.
        assert fast <= slow + TOUCH_M / max(steep, 1e-9)
        before = max(fast - TOUCH_M / max(steep, 1e-9), 0.0)
        assert before == 0.0 or separation(a, b, Decimal(before)) > 0


def still(x, y, yaw=0.0, size=CAR):
    return Motion((x, y), (0.0, 0.0), yaw, 0.0, size)


def moving(x, y, dx, dy, yaw=0.0, turn=0.0, size=CAR):
    return Motion((x, y), (dx, dy), yaw, turn, size)


def test_driving_into_a_standing_car_touches_where_the_gap_is_used_up():
    gap = 10.0 - (4.855 + 4.5) / 2
    assert contact(moving(0, 0, 8.0, 0, size=EGO), still(10.0, 0.0)) == pytest.approx(
        gap / 8.0, abs=1e-9
    )


def test_a_thin_post_that_crosses_between_the_ends_is_seen():
    post = moving(2.0, 20.0, 0.0, -40.0, size=(0.1, 0.1))
    assert contact(still(0, 0, size=EGO), post) == pytest.approx((20.0 - 0.99) / 40.0, abs=1e-9)


def test_a_turning_ego_sweeps_its_corner_into_a_wall():
    # Half diagonal h, corner at angle a: the corner's height is h sin(a + turn).
    h = math.hypot(*EGO) / 2
    angle = math.atan2(EGO[1], EGO[0])
    wall = 1.5
    ego = moving(0, 0, 0, 0, turn=0.5, size=EGO)
    box = still(0.0, wall + 0.5, size=(20.0, 1.0))
    assert contact(ego, box) == pytest.approx((math.asin(wall / h) - angle) / 0.5, abs=1e-8)


def test_a_full_half_turn_in_place_touches_at_the_first_of_two_passes():
    ego = moving(0, 0, 0, 0, turn=3.0, size=(4.0, 0.2))
    assert contact(ego, still(0.0, 1.5, size=(0.2, 0.2))) == pytest.approx(
        first_touch(ego, still(0.0, 1.5, size=(0.2, 0.2)), 400), abs=1e-8
    )


@pytest.mark.parametrize("off", [-2e-9, 0.0, 0.9e-9])
def test_bodies_within_a_nanometre_touch(off):
    assert contact(still(0, 0, size=EGO), still((4.855 + 4.5) / 2 + off, 0.0)) == 0.0


@pytest.mark.parametrize("motion", [(0.0, 0.0), (0.0, 5.0), (30.0, 0.0)])
def test_bodies_more_than_a_nanometre_apart_that_keep_their_distance_do_not_touch(motion):
    a = moving(0, 0, *motion, size=EGO)
    b = moving((4.855 + 4.5) / 2 + 3e-9, 0.0, *motion)
    assert contact(a, b) is None


def test_sliding_along_a_wall_a_nanometre_away_ends_quickly():
    a = moving(0, 0, 30.0, 0.0, turn=1e-9, size=EGO)
    assert contact(a, still(10.0, 0.94 + 0.5 + 2e-9 + 1e-8, size=(60.0, 1.0))) is None


def test_corner_that_grazes_corner_touches_within_the_band():
    # Relative motion along the diagonal that just brings corner on corner half way.
    x = (4.855 + 4.5) / 2
    y = (1.88 + 1.8) / 2
    for out, touches in ((0.0, True), (5e-9, False)):
        a = still(0, 0, size=EGO)
        b = moving(x + out + 1.0, y + out - 1.0, -2.0, 2.0)
        assert (contact(a, b) is not None) == touches
        assert_twins_agree(a, b)


def test_contact_at_the_start_and_at_the_very_end():
    assert contact(still(0, 0, size=EGO), still(0.0, 0.0)) == 0.0
    gap = 10.0 - (4.855 + 4.5) / 2
    assert contact(moving(0, 0, gap, 0, size=EGO), still(10.0, 0.0)) == pytest.approx(1.0, abs=1e-9)


NEAR = st.floats(-9.0, 9.0)
HEADING = st.one_of(
    st.floats(-3.2, 3.2),
    st.sampled_from([0.0, math.pi, -math.pi, math.pi / 2, math.nextafter(math.pi, 0)]),
)
TURN = st.one_of(st.just(0.0), st.floats(-0.8, 0.8))
SIZE = st.sampled_from([CAR, EGO, (12.0, 2.5), (0.1, 0.1), (0.5, 0.5), (30.0, 0.02), (1e-3, 1e-3)])
BODIES = st.builds(
    lambda x, y, dx, dy, *rest: Motion((x, y), (dx, dy), *rest),
    NEAR,
    NEAR,
    NEAR,
    NEAR,
    HEADING,
    TURN,
    SIZE,
)


@settings(max_examples=examples(25), deadline=None, derandomize=True)
@given(BODIES, BODIES)
def test_random_motions_agree_with_the_decimal_twin(a, b):
    assert_twins_agree(a, b)


GRAZE = st.sampled_from([0.0, 1e-12, -1e-12, 9e-10, 1.1e-9, 1e-8, -1e-8, 1e-6])


@settings(max_examples=examples(20), deadline=None, derandomize=True)
@given(HEADING, st.floats(1.0, 20.0), GRAZE, st.booleans())
def test_grazing_passes_flip_only_inside_the_band_and_to_either_side(heading, speed, out, left):
    """A car passes a parked one at a given gap; turned as a whole, as the rounding of corners
    differs with the heading.
    """
    side = 1.0 if left else -1.0
    gap = side * ((1.88 + 1.8) / 2 + out)
    c, s = math.cos(heading), math.sin(heading)
    at = lambda x, y: (c * x - s * y, s * x + c * y)  # noqa: E731
    a = Motion(at(-speed, 0.0), at(2 * speed, 0.0), heading, 0.0, EGO)
    b = Motion(at(0.0, gap), (0.0, 0.0), heading, 0.0, CAR)
    assert_twins_agree(a, b)
    # Corners are rounded at 1e-15 of 20 m, the tolerance is 1e-9: outside of twice that the answer
    # is fixed.
    if abs(out) > 2 * TOUCH_M:
        assert (contact(a, b) is not None) == (out < 0)
