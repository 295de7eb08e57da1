"""Check the vector operations of the kernels against numpy."""

from __future__ import annotations

import numpy as np
from numba import njit

from alpasim_plugin.gaussians.raster import simd as v


@njit
def _floats(x, out):
    a, b = v.load(x, 0), v.load(x, 16)
    v.store(out, 0, a + b)
    v.store(out, 16, a - b)
    v.store(out, 32, a * b)
    v.store(out, 48, a / b)
    v.store(out, 64, v.fma(a, b, a))
    v.store(out, 80, v.fnma(a, b, a))
    v.store(out, 96, v.sqrt(v.absolute(a)))
    v.store(out, 112, v.negative(a))
    v.store(out, 128, v.minimum(a, b))
    v.store(out, 144, v.maximum(a, b))
    v.store(out, 160, v.select((a < b) & (a > -0.5), a, b))
    v.store(out, 176, v.lane_pattern(np.float32(1), np.float32(10)))
    v.store(out, 192, v.fma(2, a, 1.0) - 3 * v.maximum(a, 0.25))
    v.store(out, 208, v.select(a > 0.5, a, 0) / 4)


@njit
def _masks(x):
    a, b = v.load(x, 0), v.load(x, 16)
    return (
        v.bits(a < b),
        v.bits(a <= b),
        v.bits(a > b),
        v.bits(a >= b),
        v.bits((a <= b) & (a >= b)),
        v.lowest_bit(np.int64(40)),
    )


@njit
def _doubles(x, out):
    v.store(out, 0, v.to_f32(v.load(x, 0) * v.load(x, 0) - 0.25))


@njit
def _lanes_with_bit(x, position):
    return v.bits(v.has_bit(v.load(x, 0), position))


def test_float_operations_equal_numpy_lane_by_lane():
    x = np.random.default_rng(0).normal(size=32).astype(np.float32)
    a, b = x[:16], x[16:]
    out = np.zeros(224, np.float32)
    _floats(x, out)
    exact = [
        a + b,
        a - b,
        a * b,
        a / b,
        None,
        None,
        np.sqrt(np.abs(a)),
        -a,
        np.minimum(a, b),
        np.maximum(a, b),
    ]
    for i, want in enumerate(exact):
        if want is not None:
            assert np.array_equal(out[i * 16 : i * 16 + 16], want), i
    assert np.allclose(out[64:80], a * b + a, rtol=1e-5, atol=1e-6)
    assert np.allclose(out[80:96], a - a * b, rtol=1e-5, atol=1e-6)
    assert np.array_equal(out[160:176], np.where((a < b) & (a > -0.5), a, b))
    assert np.array_equal(
        out[176:192], (np.arange(16) % 4 + 10 * (np.arange(16) // 4)).astype(np.float32)
    )
    assert np.allclose(out[192:208], 2 * a + 1 - 3 * np.maximum(a, 0.25), rtol=1e-5, atol=1e-5)
    assert np.array_equal(out[208:], np.where(a > 0.5, a, 0) / 4)


def test_comparisons_with_nan_are_false_and_bits_follow_the_lanes():
    x = np.arange(32, dtype=np.float32)
    x[16:] = 7.0
    x[3] = np.nan
    a = x[:16]
    less, less_equal, greater, greater_equal, equal, lowest = _masks(x)
    weights = 1 << np.arange(16)
    assert less == weights[a < 7].sum()
    assert less_equal == weights[a <= 7].sum()
    assert greater == weights[a > 7].sum()
    assert greater_equal == weights[a >= 7].sum()
    assert equal == weights[a == 7].sum()
    assert lowest == 3


def test_doubles_round_once_on_the_way_to_single_precision():
    x = np.random.default_rng(1).normal(size=16) * 1e3
    out = np.zeros(16, np.float32)
    _doubles(x, out)
    assert np.array_equal(out, (x * x - 0.25).astype(np.float32))


def test_bits_of_integers_are_found_lane_by_lane():
    x = np.random.default_rng(2).integers(-(2**31), 2**31, 16).astype(np.int32)
    for position in (0, 5, 31):
        assert (
            _lanes_with_bit(x, position) == ((1 << np.arange(16))[(x >> position) & 1 == 1]).sum()
        )
