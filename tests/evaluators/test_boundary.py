"""Boundaries of simulated policies: the search along one parameter or two, what is said of its
driven points, and ranges that fail nowhere or in windows.
"""

import math
from itertools import product

import pytest

from alpasim_plugin.runs.vary_study import next_points as next_area_points
from evaluators.pages.boundary import sentence_of
from evaluators.statistics.boundary import (
    PARTS,
    SPACINGS,
    Stretch,
    difference_of,
    median_boundary,
    middles_of_changes,
    next_points,
    stretches_of,
    widest_gap,
)
from evaluators.statistics.boundary_area import AREA_PARTS, AREA_SPACINGS, claims_of
from evaluators.statistics.intervals import least_for_median
from tests.boundary_worlds import SEED_WORLDS, over_seeds

STEPS = SPACINGS * PARTS
FIRST = range(0, STEPS + 1, PARTS)
LINES = (range(0, AREA_SPACINGS * AREA_PARTS + 1, AREA_PARTS),) * 2
END = LINES[0][-1]


def searched(fails, skipped=()):
    failed = {}
    while points := next_points(failed, FIRST, set(skipped)):
        assert not set(points) & {*failed, *skipped}
        failed |= {point: fails(point) for point in points}
    return failed


def outcomes(failed):
    return {"0": [[float(point), failed[point]] for point in sorted(failed)]}


def ends(failed):
    return [(one.low, one.high, one.most) for one in stretches_of(outcomes(failed))]


@pytest.mark.parametrize("truth", [0.5, 16.0, 31.7, 63.5])
@pytest.mark.parametrize("fails_below", [True, False])
def test_a_change_is_enclosed_between_neighbours_of_the_grid(truth, fails_below):
    failed = searched(lambda point: (point < truth) == fails_below)
    below = math.ceil(truth) - 1
    assert ends(failed) == [(0, below, fails_below), (below + 1, STEPS, not fails_below)]
    assert len(failed) == SPACINGS + 1 + 2  # a spacing is halved twice


def test_windows_are_refined_at_each_change():
    failed = searched(lambda point: 10 <= point < 22 or 41 <= point <= 49)
    assert ends(failed) == [(0, 9, 0), (10, 21, 1), (22, 40, 0), (41, 49, 1), (50, STEPS, 0)]


def test_a_range_without_a_change_is_not_refined():
    for has_failed in (False, True):
        failed = searched(lambda point, has_failed=has_failed: has_failed)
        assert ends(failed) == [(0, STEPS, has_failed)]
        assert sorted(failed) == list(FIRST)


def test_points_that_cannot_be_built_widen_the_bracket_and_the_distance():
    failed = searched(lambda point: point < 22, skipped={20, 21, 22})
    assert ends(failed) == [(0, 19, 1), (23, STEPS, 0)]
    assert widest_gap(outcomes(failed)) == 4
    assert widest_gap(outcomes(searched(lambda point: False, skipped={8}))) == 8


def test_of_two_middles_the_lower_is_driven():
    assert middles_of_changes({0: True, 3: False, 8: False, 12: True}, frozenset({10})) == [1, 9]


def test_stretches_count_the_seeds_at_points_that_all_have_driven():
    by_seed = {
        "3": [[1.0, True], [2.0, True], [3.0, False], [4.0, False]],
        "7": [[1.0, True], [2.0, False], [4.0, False]],
    }
    assert stretches_of(by_seed) == [
        Stretch(1.0, 1.0, 1, 2, 2, 2),
        Stretch(2.0, 2.0, 1, 1, 1, 2),
        Stretch(4.0, 4.0, 1, 0, 0, 2),
    ]


def test_a_median_needs_six_seeds_that_each_change_once():
    def seed(boundary):
        return [[float(value), value < boundary] for value in range(10)]

    six = {str(number): seed(number + 2) for number in range(6)}
    interval = median_boundary(six)
    assert (interval.low, interval.high) == (1.0, 7.0)  # all values: 1 - 2 / 2^6 = 0.969
    assert least_for_median() == 6
    assert median_boundary({name: six[name] for name in list(six)[:5]}) is None
    assert median_boundary(six | {"9": [[0.0, False], [1.0, True], [2.0, False]]}) is None
    assert median_boundary(six | {"9": [[0.0, False], [1.0, True]]}) is None  # another direction
    nine = median_boundary({str(number): seed(number + 1) for number in range(9)})
    assert (nine.low, nine.high) == (1.0, 8.0)  # the second of each side: 1 - 20 / 2^9 = 0.961


def test_a_window_beside_an_equal_boundary_is_a_difference():
    with_window = searched(lambda point: point < 22 or 40 <= point < 48)
    without = {point: point < 22 for point in with_window}
    difference = difference_of(outcomes(with_window), outcomes(without), [list(FIRST)])
    assert (difference.gained, difference.lost) == (
        sum(40 <= point < 48 for point in with_window),
        0,
    )
    assert difference.more == pytest.approx(8, abs=1)
    back = difference_of(outcomes(without), outcomes(with_window), [list(FIRST)])
    assert back.more == -difference.more
    assert (back.anew, difference.anew) == (0.0, difference.more)


def test_a_difference_is_paired_by_point_and_seed():
    now = {"0": [[0.0, True], [1.0, True], [4.0, False]], "1": [[0.0, True]]}
    was = {"0": [[0.0, True], [1.0, False], [3.0, True], [4.0, False]], "2": [[0.0, False]]}
    difference = difference_of(now, was, [[0.0, 4.0]])
    # points 0, 1, 4 stand for 0.5, 2 and 1.5 of the range
    assert vars(difference) == {"pairs": 3, "gained": 1, "lost": 0, "anew": 2.0, "more": 2.0}
    assert difference_of({"1": now["1"]}, {"2": was["2"]}, [[0.0, 4.0]]) is None


def searched_area(fails, skipped=()):
    failed = {}
    while points := next_area_points(failed, LINES, set(skipped)):
        assert not set(points) & {*failed, *skipped}
        failed |= {point: bool(fails(*point)) for point in points}
    return failed


def test_a_disc_is_counted_and_no_share_is_claimed():
    failed = searched_area(lambda x, y: (x - 7.3) ** 2 + (y - 9.1) ** 2 < 9)
    inside = [point for point in product(*LINES) if failed[point]]
    claims = claims_of(failed, LINES)
    assert (claims.points, claims.failed, claims.squares) == (81, len(inside), 64)
    assert 0 < claims.changing < 64
    halved = set(failed) - set(product(*LINES))
    assert halved
    for x, y in halved:
        sides = [(x - 1, y), (x + 1, y)] if x % AREA_PARTS else [(x, y - 1), (x, y + 1)]
        assert len({failed[side] for side in sides}) == 2


def test_rectangles_without_a_change_and_points_that_cannot_be_built():
    failed = searched_area(lambda x, y: False)
    assert claims_of(failed, LINES).failed == 0
    assert len(failed) == 81
    gone = {(x, y) for x in range(2) for y in range(END + 1)}
    claims = claims_of(searched_area(lambda x, y: x + y < 9, gone), LINES)
    assert (claims.points, claims.squares) == (72, 56)


def record(stretches, **facts):
    return {
        "parameter": "ego.speed_mps",
        "unit": "m/s",
        "range": [4.0, 12.0],
        "reachable": [4.0, 12.0],
        "apart": 0.5,
        "unreachable": {},
        "rollouts": 19,
        "grid_rollouts": 65,
        "stopped": "",
        "differences": {},
        "variants": {
            "clean/p": {
                "stretches": [vars(one) for one in stretches],
                "median": None,
                "seeds_for_median": 6,
            }
            | facts
        },
    }


def test_a_sentence_says_where_it_fails_and_how_fine_was_driven():
    fails = Stretch(4.0, 6.875, 8, 1, 1, 1)
    holds = Stretch(7.0, 12.0, 11, 0, 0, 1)
    sentence = sentence_of(record([fails, holds]))
    assert "clean/p fails from 4 to 6.875 m/s, no failure from 7 to 12 m/s" in sentence
    assert "driven 0.5 m/s apart or closer: a narrower change would be missed" in sentence
    some = [Stretch(4.0, 4.0, 1, 1, 2, 3), Stretch(4.5, 12.0, 18, 0, 0, 3)]
    sentence = sentence_of(record(some))
    assert "fails at 4 m/s in 1 to 2 of 3 seeds" in sentence
    assert "6 seeds can give an interval" in sentence
    sentence = sentence_of(record([fails, holds] * 4))
    assert "fails at 32 of 76 points, and changes 7 times" in sentence


def test_over_seeds_no_sentence_and_no_verdict_contradicts_what_was_driven():
    rows = list(over_seeds(policies=2, sizes=(3, 6)))
    assert [row[0] for row in rows] == [world.name for world in SEED_WORLDS]
    for _, *cells in rows:
        for cell in cells:
            false, false_verdicts, _, _ = cell.split(" / ")
            assert (false, false_verdicts) == ("0", "0")
    given = {row[0]: [cell.split(" / ")[2] for cell in row[1:]] for row in rows}
    assert given["a boundary that varies by 5 %"] == ["0", "100"]
