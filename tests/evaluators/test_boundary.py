"""Boundaries of simulated policies: the search along one parameter or two, its intervals, and
ranges without a boundary.
"""

import numpy as np
import pytest

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.runs.vary_study import next_points as next_area_points
from evaluators.statistics.boundary import (
    MOST_POINTS,
    STEPS,
    Bracket,
    boundary_of,
    bracket_of,
    difference_of,
    next_points,
)
from evaluators.statistics.boundary_area import AREA_STEPS, MOST_AREA_POINTS, area_of

VALUES = {point: float(point) for point in range(STEPS + 1)}


def searched(fails, skipped=()):
    failed = {}
    while points := next_points(failed, set(skipped)):
        failed |= {point: fails(point) for point in points}
        assert len(failed) <= MOST_POINTS
    return bracket_of(failed, VALUES), failed


@pytest.mark.parametrize("truth", [0.5, 16.0, 31.7, 63.5])
@pytest.mark.parametrize("fails_below", [True, False])
def test_a_change_is_enclosed_between_neighbours(truth, fails_below):
    found, _ = searched(lambda point: (point < truth) == fails_below)
    assert found.high - found.low == 1
    assert found.low <= truth <= found.high
    assert found.fails_below == fails_below


def test_a_range_without_a_boundary_is_not_bisected():
    assert searched(lambda point: False) == ("no failure", dict.fromkeys(range(0, 65, 16), False))
    assert searched(lambda point: True)[0] == "fails everywhere"
    found, failed = searched(lambda point: point < 10 or point > 40)
    assert (found, len(failed)) == ("not monotone", 5)


@pytest.mark.parametrize(
    ("again", "ends"), [((24, 25), (21, 26)), ((17, 26), (16, 27)), ((24, 28), (21, 29))]
)
def test_changes_close_to_the_first_one_are_enclosed_together(again, ends):
    found, failed = searched(lambda point: (point < 22) != (point in again))
    assert (found.low, found.high) == ends
    assert found.changes > 1
    assert len(failed) <= 0.4 * STEPS


def test_points_that_cannot_be_built_widen_the_bracket():
    found, failed = searched(lambda point: point < 22, skipped={20, 21, 22})
    assert (found.low, found.high) == (19, 23)
    assert not {20, 21, 22} & set(failed)


def test_one_seed_gives_its_bracket_and_several_students_interval():
    one = Bracket(6.0, 6.5, True)
    assert vars(boundary_of([one])) == {"value": 6.25, "low": 6.0, "high": 6.5}
    several = boundary_of([Bracket(5.0, 5.5, True), one, Bracket(7.0, 7.5, True)])
    # by hand: middles 5.25, 6.25, 7.25; t(0.975, 2) = 4.3027; s = 1; half a bracket is 0.25
    assert several.value == pytest.approx(6.25)
    assert several.high == pytest.approx(6.25 + 0.25 + 4.30265 / 3**0.5, abs=1e-4)


def test_a_difference_is_paired_by_seed():
    base = [Bracket(5.0, 5.5, True), Bracket(7.0, 7.5, True)]
    other = [Bracket(4.0, 4.5, True), Bracket(6.0, 6.5, True)]
    assert vars(difference_of(other, base)) == {"value": -1.0, "low": -1.5, "high": -0.5}


def searched_area(fails, skipped=()):
    failed = {}
    while points := next_area_points(failed, set(skipped)):
        failed |= {point: bool(fails(*point)) for point in points}
        assert len(failed) <= MOST_AREA_POINTS
    return area_of(failed, range(AREA_STEPS + 1)), failed


@pytest.mark.parametrize(
    ("fails", "share", "sides"),
    [
        (lambda x, y: x + y < 20.5, 20.5**2 / 2 / 1024, ("below", "below")),
        (lambda x, y: x - y > 9.5, 22.5**2 / 2 / 1024, ("above", "below")),
        (lambda x, y: y > 11.5 + x / 8, (20.5 - 2) / 32, ("below", "above")),
        (lambda x, y: x < 7.5, 7.5 / 32, ("below", "below")),
    ],
)
def test_the_failing_share_of_a_rectangle_is_enclosed(fails, share, sides):
    found, failed = searched_area(fails)
    assert found.low <= share <= found.high <= found.low + 0.07
    assert (found.fails, found.contradictions) == (sides, 0)
    again = {point: failed[point] for point in sorted(failed)}
    assert area_of(again, range(AREA_STEPS + 1)) == found


def test_a_point_that_contradicts_the_others_takes_claims_back():
    plain, failed = searched_area(lambda x, y: x + y < 20.5)
    at = next(point for point, one in failed.items() if not one and sum(point) in (21, 22))
    found = area_of(failed | {(at[0] + 2, at[1] + 2): True}, range(AREA_STEPS + 1))
    assert found.contradictions >= 2
    assert found.low < plain.low < plain.high < found.high


def test_rectangles_without_a_boundary_and_points_that_cannot_be_built():
    found, failed = searched_area(lambda x, y: False)
    assert (found.low, found.high, len(failed)) == (0, 0, 9)
    assert searched_area(lambda x, y: True)[0].low == 1
    found, failed = searched_area(lambda x, y: (x > 16) == (y > 16))
    assert (found, len(failed)) == ("not monotone", 9)
    gone = {(x, y) for x in range(5) for y in range(33)}
    found, failed = searched_area(lambda x, y: x + y < 20.5, gone)
    assert not gone & set(failed)
    assert found.low <= 20.5**2 / 2 / 1024 <= found.high


def test_no_claim_contradicts_an_outcome():
    for seed in range(12):
        noise = 3 * stream("area", seed, "noise").standard_normal((AREA_STEPS + 1, AREA_STEPS + 1))
        found, failed = searched_area(lambda x, y, noise=noise: x + y + noise[x, y] < 24)
        lower = np.array(found.lower)
        upper = np.array(found.upper)
        inside = {(x, y): one for (x, y), one in failed.items() if 0 < x < AREA_STEPS}
        for (x, y), has_failed in inside.items():
            assert has_failed or y >= lower[x - 1 : x + 1].min()
            assert not has_failed or y <= upper[x - 1 : x + 1].max()
