import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from evaluators.statistics.numbers import (
    decimals,
    finite,
    fixed,
    interval,
)


@pytest.mark.parametrize(
    ("value", "places", "sign", "text"),
    [
        (0.0, 1, False, "0.0"),
        (-0.04, 1, True, "0.0"),  # neither a negative zero nor a signed one
        (-0.06, 1, True, "\u22120.1"),
        (0.25, 2, True, "+0.25"),
        (12345.6, 0, False, "12\u202f346"),
        (-1e9, 0, False, "\u22121\u202f000\u202f000\u202f000"),
    ],
)
def test_fixed_decimals(value, places, sign, text):
    assert fixed(value, places, sign) == text


@given(st.floats(-1e6, 1e6), st.integers(0, 4))
def test_printed_number_reads_back_within_half_a_unit(value, places):
    read = float(fixed(value, places).replace("\u2212", "-").replace("\u202f", ""))
    assert abs(read - value) <= 0.5 * 10.0**-places * (1 + 1e-9)


@given(st.floats(1e-3, 1e5))
def test_three_significant_digits_are_kept(value):
    places = decimals(value)
    assert 0 <= places <= 4
    if places < 4:
        assert abs(round(value, places) - value) <= 0.006 * value


@pytest.mark.parametrize("value", [None, math.nan, math.inf, -math.inf, "0.5", True, [1.0]])
def test_only_finite_numbers_are_numbers(value):
    assert finite(value) is None


def test_interval_from_bounds_from_half_width_and_from_nothing():
    assert interval([0.1, 0.3]) == (0.1, 0.3)
    assert interval([None, 0.3]) is None
    assert interval(None) is None
    assert interval([0.1, math.nan]) is None
