"""Clock, seeds and errors."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from alpasim_plugin.core.clock import Clock
from alpasim_plugin.core.errors import (
    EvaluatorError,
    InfrastructureError,
    InputError,
    PolicyError,
    RendererError,
)
from alpasim_plugin.core.seeding import derive_seed, stream
from alpasim_plugin.core.types import Rates


def test_clock_ticks_in_whole_periods_and_marks_the_last():
    ticks = list(Clock(7, 1_000_007, Rates(100_000, 200_000, 500_000)).ticks())
    assert [t.t_us for t in ticks] == [7 + 100_000 * i for i in range(11)]
    assert [t.step for t in ticks if t.policy_due] == [0, 5, 10]
    assert [t.is_last for t in ticks] == [False] * 10 + [True]


@pytest.mark.parametrize(
    "rates", [Rates(0), Rates(100_000, 150_000), Rates(100_000, 100_000, 50_000), Rates(-1)]
)
def test_periods_that_are_no_multiple_are_refused(rates):
    with pytest.raises(InputError, match=r"multiple of rates\.control_us"):
        Clock(0, 1_000_000, rates)


def test_streams_depend_on_their_key_alone():
    first = stream("scene", 3, "policy", 7).normal(size=4)
    stream("other", 3, "policy", 7).normal(size=100)
    np.testing.assert_array_equal(first, stream("scene", 3, "policy", 7).normal(size=4))
    for other in (
        ("scene2", 3, "policy", 7),
        ("scene", 4, "policy", 7),
        ("scene", 3, "actors", 7),
        ("scene", 3, "policy", 8),
    ):
        assert not np.array_equal(first, stream(*other).normal(size=4))


def test_streams_are_the_same_on_every_platform():
    assert derive_seed("scene", 0, "policy", 0) == 0x3CB2424955DFCEC0
    np.testing.assert_allclose(
        stream("scene", 0, "policy").random(2), [0.54300724, 0.97485974], atol=1e-8
    )


@given(st.text(max_size=8), st.text(max_size=8))
def test_fields_of_a_key_cannot_run_into_each_other(a, b):
    if "\x1f" not in a + b and b:
        assert derive_seed(a + b, 0, "c") != derive_seed(a, 0, b + "c")


def test_exit_codes_tell_the_cause():
    assert [
        e.exit_code
        for e in (InputError, InfrastructureError, RendererError, PolicyError, EvaluatorError)
    ] == [2, 4, 4, 2, 5]


def test_clock_does_not_drift_over_an_hour_at_thirty_hertz():
    clock = Clock(0, 3_600_000_000, Rates(33_333, 33_333, 33_333))
    assert clock.n_steps == 3_600_000_000 // 33_333
    assert [t.t_us for t in clock.ticks()][-1] == clock.n_steps * 33_333
