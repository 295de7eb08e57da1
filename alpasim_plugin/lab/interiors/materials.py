"""What surfaces look like: a paint gives the colour of every point of a rectangle.

A paint is called with places in metres along the rectangle's two edges, both ``(N,)``, and returns
colours ``(N, 3)``, 0..1. Everything random is drawn when the paint is made, so it shows the same
picture at every level of detail.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.types import F64

Paint: TypeAlias = Callable[[F64, F64], F64]
Rng = np.random.Generator
LATTICE = 64  # side of a noise table; the noise repeats after so many units


def value_noise(rng: Rng) -> Callable[[F64, F64], F64]:
    """Return smooth noise of about unit spread on the plane, with one independent value a unit."""
    table = 1.5 * rng.standard_normal((LATTICE, LATTICE))

    def noise(x: F64, y: F64) -> F64:
        i, j = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
        u, v = x - i, y - j
        u, v = u * u * (3 - 2 * u), v * v * (3 - 2 * v)
        i0 = i % LATTICE
        i1 = (i + 1) % LATTICE
        j0 = j % LATTICE
        j1 = (j + 1) % LATTICE
        low, high = (
            table[i0, j0] * (1 - u) + table[i1, j0] * u,
            table[i0, j1] * (1 - u) + table[i1, j1] * u,
        )
        return np.asarray(low * (1 - v) + high * v)

    return noise


def plain(rng: Rng, rgb: npt.ArrayLike, mottle: float = 0.03) -> Paint:
    """Return one colour with stains of half a metre and a grain of two centimetres."""
    colour = np.asarray(rgb, dtype=np.float64)
    large = value_noise(rng)
    fine = value_noise(rng)
    return lambda x, y: (
        colour * (1 + mottle * (large(x / 0.5, y / 0.5) + 0.7 * fine(x / 0.02, y / 0.02)))[:, None]
    )


def wood(rng: Rng, rgb: npt.ArrayLike) -> Paint:
    """Return wood with its grain along the first edge."""
    colour = np.asarray(rgb, dtype=np.float64)
    grain = value_noise(rng)
    ring = value_noise(rng)
    return lambda x, y: (
        colour * (1 + 0.10 * grain(x / 0.35, y / 0.018) + 0.07 * ring(x / 0.9, y / 0.09))[:, None]
    )


def planks(rng: Rng, rgb: npt.ArrayLike, width_m: float, length_m: float) -> Paint:
    """Return boards along the first edge, staggered, each of its own tint, with dark joints."""
    tint = rng.standard_normal(4096)
    shift = rng.random(4096)
    grain = value_noise(rng)
    colour = np.asarray(rgb, dtype=np.float64)

    def paint(x: F64, y: F64) -> F64:
        row = np.floor(y / width_m).astype(np.int64)
        along = x / length_m + shift[row % 4096]
        board = np.floor(along).astype(np.int64)
        joint = (np.abs(y / width_m - np.round(y / width_m)) * width_m < 0.004) | (
            np.abs(along - np.round(along)) * length_m < 0.005
        )
        level = (
            1
            + 0.11 * tint[(row * 131 + board * 17) % 4096]
            + 0.07 * grain(x / 0.3 + 7 * row, y / 0.015)
        )
        return np.asarray(colour * np.where(joint, 0.55, level)[:, None])

    return paint


def tiles(
    rng: Rng,
    first: npt.ArrayLike,
    second: npt.ArrayLike,
    side_m: float,
    grout: npt.ArrayLike = (0.45, 0.44, 0.42),
) -> Paint:
    """Return square tiles of two colours in a checker, with grout between them; equal colours give
    plain tiles.
    """
    tint = rng.standard_normal(4096)
    stain = value_noise(rng)
    a = np.asarray(first, dtype=np.float64)
    b = np.asarray(second)

    def paint(x: F64, y: F64) -> F64:
        i, j = np.floor(x / side_m).astype(np.int64), np.floor(y / side_m).astype(np.int64)
        u, v = x / side_m - i, y / side_m - j
        line = np.minimum(np.minimum(u, 1 - u), np.minimum(v, 1 - v)) * side_m < 0.006
        level = 1 + 0.05 * tint[(i * 71 + j * 13) % 4096] + 0.03 * stain(x / 0.06, y / 0.06)
        rgb = np.where(((i + j) % 2 == 0)[:, None], a, b) * level[:, None]
        return np.asarray(np.where(line[:, None], np.asarray(grout), rgb))

    return paint


def bricks(rng: Rng, rgb: npt.ArrayLike, width_m: float = 0.24, height_m: float = 0.075) -> Paint:
    """Return a wall of bricks in running bond."""
    tint = rng.standard_normal(4096)
    grain = value_noise(rng)
    colour = np.asarray(rgb, dtype=np.float64)

    def paint(x: F64, y: F64) -> F64:
        row = np.floor(y / height_m).astype(np.int64)
        along = x / width_m + 0.5 * (row % 2)
        brick = np.floor(along).astype(np.int64)
        u, v = along - brick, y / height_m - row
        mortar = (np.minimum(u, 1 - u) * width_m < 0.006) | (
            np.minimum(v, 1 - v) * height_m < 0.006
        )
        level = 1 + 0.16 * tint[(row * 37 + brick * 11) % 4096] + 0.06 * grain(x / 0.02, y / 0.02)
        return np.asarray(np.where(mortar[:, None], [0.66, 0.64, 0.60], colour * level[:, None]))

    return paint


def stripes(
    rng: Rng, first: npt.ArrayLike, second: npt.ArrayLike, period_m: float, folds: float = 0.0
) -> Paint:
    """Return stripes across the first edge; ``folds`` shades them like a curtain's."""
    a = np.asarray(first, dtype=np.float64)
    b = np.asarray(second, dtype=np.float64)
    fine = value_noise(rng)

    def paint(x: F64, y: F64) -> F64:
        wave = folds * np.sin(2 * np.pi * (x / 0.13 + 0.04 * fine(x, y / 0.8)))
        rgb = np.where(((x / period_m) % 1 < 0.5)[:, None], a, b)
        return np.asarray(rgb * (1 + wave + 0.02 * fine(x / 0.02, y / 0.02))[:, None])

    return paint


def plaid(rng: Rng, base: npt.ArrayLike, band: npt.ArrayLike, period_m: float) -> Paint:
    """Return a woven check."""
    a = np.asarray(base, dtype=np.float64)
    b = np.asarray(band, dtype=np.float64)
    fine = value_noise(rng)

    def paint(x: F64, y: F64) -> F64:
        share = 0.5 * ((x / period_m) % 1 < 0.35) + 0.5 * ((y / period_m) % 1 < 0.35)
        return np.asarray(
            (a + share[:, None] * (b - a)) * (1 + 0.05 * fine(x / 0.012, y / 0.012))[:, None]
        )

    return paint


def rug(rng: Rng, size_m: tuple[float, float], colours: Sequence[npt.ArrayLike]) -> Paint:
    """Return a rug: borders and a field of diamonds in three colours."""
    c, fine = np.asarray(colours, dtype=np.float64), value_noise(rng)
    cell = float(rng.uniform(0.22, 0.38))

    def paint(x: F64, y: F64) -> F64:
        edge = np.minimum(np.minimum(x, size_m[0] - x), np.minimum(y, size_m[1] - y))
        diamond = np.abs((x / cell) % 1 - 0.5) + np.abs((y / cell) % 1 - 0.5)
        index = np.where(diamond < 0.22, 2, np.where(diamond < 0.36, 1, 0))
        index = np.where(edge < 0.05, 1, np.where(edge < 0.11, 2, np.where(edge < 0.15, 0, index)))
        return np.asarray(c[index] * (1 + 0.07 * fine(x / 0.012, y / 0.012))[:, None])

    return paint


def books(rng: Rng, palette: F64) -> Paint:
    """Return a row of spines along the first edge: own widths, colours, heights and title bands."""
    edges = np.cumsum(rng.uniform(0.018, 0.052, 200))
    colour, height = (
        palette[rng.integers(len(palette), size=201)] * rng.uniform(0.7, 1.1, (201, 1)),
        rng.uniform(0.17, 0.26, 201),
    )
    band = rng.uniform(0.35, 0.75, 201)

    def paint(x: F64, y: F64) -> F64:
        i = np.minimum(np.searchsorted(edges, x), 199)
        near = np.minimum(
            np.abs(edges[i] - x), np.abs(x - np.where(i > 0, edges[np.maximum(i - 1, 0)], 0.0))
        )
        rgb = colour[i] * np.where(near < 0.003, 0.5, 1.0)[:, None]
        title = np.abs(y - band[i] * height[i]) < 0.018
        rgb = np.where(title[:, None], 0.4 * rgb + 0.5, rgb)
        return np.asarray(np.where((y > height[i])[:, None], [0.10, 0.08, 0.07], rgb))

    return paint


def painting(rng: Rng, size_m: tuple[float, float], palette: F64) -> Paint:
    """Return a framed picture: a blend of two colours with some ellipses."""
    pick = palette[rng.integers(len(palette), size=9)]
    centre = rng.random((7, 2))
    radius = rng.uniform(0.08, 0.32, (7, 2))
    turn = rng.uniform(0, np.pi, 7)
    frame, brush = rng.uniform(0.06, 0.5) * np.array([1.0, 0.8, 0.6]), value_noise(rng)

    def paint(x: F64, y: F64) -> F64:
        u, v = x / size_m[0], y / size_m[1]
        rgb = pick[0] + (v + 0.15 * brush(u * 5, v * 5))[:, None] * (pick[1] - pick[0])
        for k in range(7):
            dx, dy = u - centre[k, 0], v - centre[k, 1]
            a, b = (
                dx * np.cos(turn[k]) + dy * np.sin(turn[k]),
                -dx * np.sin(turn[k]) + dy * np.cos(turn[k]),
            )
            rgb = np.where(
                ((a / radius[k, 0]) ** 2 + (b / radius[k, 1]) ** 2 < 1)[:, None], pick[k + 2], rgb
            )
        edge = np.minimum(np.minimum(x, size_m[0] - x), np.minimum(y, size_m[1] - y))
        return np.asarray(
            np.where(
                (edge < 0.03)[:, None],
                frame,
                np.where((edge < 0.07)[:, None], [0.90, 0.89, 0.86], rgb),
            )
        )

    return paint


def window(rng: Rng, size_m: tuple[float, float]) -> Paint:
    """Return a window with its frame: sky, hills and trees behind two by two panes."""
    ridge, foliage = value_noise(rng), value_noise(rng)
    horizon = float(rng.uniform(0.3, 0.5))

    def paint(x: F64, y: F64) -> F64:
        u, v = x / size_m[0], y / size_m[1]
        sky = np.array([0.97, 0.97, 0.96]) + np.clip(v - horizon, 0, 1)[:, None] * np.array(
            [-0.45, -0.28, -0.05]
        )
        hills = v < horizon + 0.05 * ridge(3 * u + 9, 0 * v)
        green = np.array([0.42, 0.52, 0.34]) * (1 + 0.22 * foliage(x / 0.06, y / 0.06))[:, None]
        rgb = np.where(hills[:, None], green, sky)
        bar = (
            np.minimum(np.minimum(u, 1 - u) * size_m[0], np.minimum(v, 1 - v) * size_m[1]) < 0.06
        ) | (np.abs(u - 0.5) * size_m[0] < 0.025)
        bar |= np.abs(v - 0.55) * size_m[1] < 0.02
        return np.asarray(np.where(bar[:, None], [0.86, 0.85, 0.82], rgb))

    return paint


def panelled(
    rng: Rng, rgb: npt.ArrayLike, size_m: tuple[float, float], across: int, up: int
) -> Paint:
    """Return a door or a cupboard's front: ``across`` by ``up`` fields with a dark line around
    each, and a knob.
    """
    base = wood(rng, rgb)

    def paint(x: F64, y: F64) -> F64:
        u, v = x / size_m[0] * across, y / size_m[1] * up
        du, dv = (
            np.abs(u - np.floor(u) - 0.5) * size_m[0] / across,
            np.abs(v - np.floor(v) - 0.5) * size_m[1] / up,
        )
        inset = np.maximum(
            du - (0.5 * size_m[0] / across - 0.035), dv - (0.5 * size_m[1] / up - 0.035)
        )
        gap = np.maximum(du - 0.5 * size_m[0] / across, dv - 0.5 * size_m[1] / up) > -0.006
        level = np.where(gap, 0.35, np.where(np.abs(inset) < 0.008, 0.7, 1.0))
        knob = np.hypot(du - (0.5 * size_m[0] / across - 0.07), dv) < 0.018
        return np.asarray(np.where(knob[:, None], [0.75, 0.70, 0.55], base(x, y) * level[:, None]))

    return paint


def printed(rng: Rng, rgb: npt.ArrayLike, size_m: tuple[float, float]) -> Paint:
    """Return a printed package: bands, a field and blocks like letters."""
    base, ink = np.asarray(rgb, dtype=np.float64), rng.random((3, 3)) * 0.9
    line, letters = rng.uniform(0.15, 0.85, 2), rng.random((6, 40)) < 0.55

    def paint(x: F64, y: F64) -> F64:
        u, v = x / size_m[0], y / size_m[1]
        out = np.where(
            (np.abs(v - line[0]) < 0.12)[:, None],
            ink[0],
            np.where((v > 0.92)[:, None], ink[1], base),
        )
        field = (np.abs(u - 0.5) < 0.3) & (np.abs(v - line[1]) < 0.1)
        row, column = (
            np.clip((v * 14).astype(np.int64) % 6, 0, 5),
            np.clip((u * 24).astype(np.int64), 0, 39),
        )
        return np.asarray(np.where((field & letters[row, column])[:, None], ink[2], out))

    return paint


def leafy(rng: Rng, rgb: npt.ArrayLike, grain_m: float = 0.03) -> Paint:
    """Return foliage or lawn: patches of light and dark green with the grain of leaves."""
    colour = np.asarray(rgb, dtype=np.float64)
    large = value_noise(rng)
    fine = value_noise(rng)
    warm = np.array([1.15, 1.0, 0.75])

    def paint(x: F64, y: F64) -> F64:
        level = 1 + 0.13 * large(x / 0.4, y / 0.4) + 0.24 * fine(x / grain_m, y / grain_m)
        dry = np.clip(0.3 * large(x / 0.9 + 5, y / 0.9), 0, 1)[:, None]
        return np.asarray(colour * level[:, None] * (1 - dry + dry * warm))

    return paint


def gravel(rng: Rng, rgb: npt.ArrayLike) -> Paint:
    """Return gravel: pebbles of three centimetres, light and dark."""
    colour = np.asarray(rgb, dtype=np.float64)
    pebble = value_noise(rng)
    large = value_noise(rng)
    return lambda x, y: (
        colour * (1 + 0.20 * pebble(x / 0.03, y / 0.03) + 0.06 * large(x / 0.5, y / 0.5))[:, None]
    )
