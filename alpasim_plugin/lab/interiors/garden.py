"""What stands along a garden path: ground, hedges, fence, trees, pots, a bench and the wall of a
house.
"""

from __future__ import annotations

import numpy as np

from alpasim_plugin.core.types import F64
from alpasim_plugin.lab.interiors import furniture as f
from alpasim_plugin.lab.interiors.light import Lamp, Light
from alpasim_plugin.lab.interiors.materials import (
    Paint,
    Rng,
    bricks,
    gravel,
    leafy,
    plain,
    planks,
    tiles,
    wood,
)
from alpasim_plugin.lab.interiors.surfaces import (
    Leaves,
    Panel,
    Part,
    Thing,
    Turned,
    block,
    box,
    solid,
    upright,
)

NEAR_M, FAR_M = 7.0, 40.0  # width of the ground that is covered finely, and of all of it


def daylight(rng: Rng) -> Light:
    """Return the sun, somewhere above, and the sky's light."""
    turn, height = rng.uniform(0, 2 * np.pi), rng.uniform(0.6, 1.1)
    sun = 200.0 * np.array(
        [[np.cos(turn) * np.cos(height), np.sin(turn) * np.cos(height), np.sin(height)]]
    )
    return Light(
        (0.50, 0.53, 0.58), (Lamp(sun, np.array([0.86, 0.82, 0.72]) * rng.uniform(0.7, 1.0)),)
    )


def garden_things(rng: Rng, bend: float, length_m: float) -> list[tuple[str, Thing, F64]]:
    """Return name, thing and frame of everything along a path ``y = bend x^2`` from x = 0 to
    ``length_m``.
    """
    half = float(rng.uniform(0.55, 0.75))
    out = [
        ("ground", Thing((_ground(rng, bend, half, length_m),)), np.eye(4)),
        ("lawn", _lawn(rng, length_m), np.eye(4)),
    ]
    for side in (-1, 1):
        kind, x = int(rng.integers(3)), float(rng.uniform(-0.5, 0.5))
        aside = half + float(rng.uniform(0.9, 1.5))
        border = (hedge, fence, flower_bed)[kind](rng)
        while x < length_m - 2.2:
            T = upright(
                x + 1.0,
                bend * (x + 1.0) ** 2 + side * aside,
                0.0,
                float(np.arctan(2 * bend * (x + 1.0))),
            )
            out.append((f"border{side}/{len(out)}", border, T))
            x += 2.0
        for _ in range(int(rng.integers(2, 5))):
            x, y = float(rng.uniform(3.0, length_m)), float(rng.uniform(2.6, 5.0))
            out.append((f"tree{side}/{len(out)}", tree(rng), upright(x, bend * x**2 + side * y)))
        for _ in range(int(rng.integers(1, 4))):
            x = float(rng.uniform(3.0, 10.0))
            T = upright(x, bend * x**2 + side * (half + 0.35), 0.0, float(rng.uniform(0, 6)))
            out.append((f"pot{side}/{len(out)}", f.plant(rng, float(rng.uniform(0.5, 0.9))), T))
    x = float(rng.uniform(5.0, 9.0))
    out.append(("bench", bench(rng), upright(x, bend * x**2 + half + 0.4, 0.0, 0.0)))
    out.append(("house", house(rng), upright(length_m + 1.0, bend * length_m**2, 0.0, -np.pi / 2)))
    return out


def _ground(rng: Rng, bend: float, half_m: float, length_m: float) -> Panel:
    grass = leafy(rng, (0.30, 0.42, 0.17), 0.025)
    way: Paint = (
        gravel(rng, (0.62, 0.58, 0.52))
        if rng.random() < 0.5
        else tiles(rng, (0.6, 0.57, 0.54), (0.52, 0.5, 0.48), 0.3)
    )

    def paint(x: F64, y: F64) -> F64:
        off = np.abs(y - NEAR_M / 2 - bend * (x - 2.0) ** 2)
        edge = np.abs(off - half_m) < 0.05
        return np.where(
            edge[:, None],
            [0.50, 0.48, 0.45],
            np.where((off < half_m)[:, None], way(x, y), grass(x, y)),
        )

    return Panel((-2.0, -NEAR_M / 2, 0), (length_m + 4.0, 0, 0), (0, NEAR_M, 0), paint)


def _lawn(rng: Rng, length_m: float) -> Thing:
    """Return the ground on both sides and behind the house."""
    grass = leafy(rng, (0.30, 0.42, 0.17), 0.1)
    side = (FAR_M - NEAR_M) / 2
    long = length_m + 24.0
    strips = [
        Panel((-2.0, y, 0), (long, 0, 0), (0, side, 0), grass) for y in (-FAR_M / 2, NEAR_M / 2)
    ]
    return Thing(
        (*strips, Panel((length_m + 2.0, -NEAR_M / 2, 0), (20.0, 0, 0), (0, NEAR_M, 0), grass))
    )


def hedge(rng: Rng) -> Thing:
    """Return two metres of hedge: a leafy box and loose leaves before it."""
    h = float(rng.uniform(0.8, 1.3))
    d = 0.5
    green = np.array([0.20, 0.34, 0.13]) * rng.uniform(0.8, 1.2)
    low, high = np.array([-1.0, -d / 2, 0.0]), np.array([1.0, d / 2, h])
    n = 900
    means = rng.uniform(low - 0.03, high + 0.03, (n, 3))
    axis = rng.integers(0, 3, n)
    sign = rng.integers(0, 2, n)
    means[np.arange(n), axis] = np.where(
        sign > 0, high[axis], np.maximum(low[axis], 0.02)
    ) + 0.02 * rng.standard_normal(n)
    parts: list[Part] = [*box(low, high, leafy(rng, green)), _leaves(rng, means, green, 0.035)]
    return Thing(tuple(parts), (block(low, high),))


def _leaves(rng: Rng, means: F64, rgb: F64, size_m: float) -> Leaves:
    normals = rng.standard_normal(means.shape) + np.array([0, 0, 0.5])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Leaves(means, normals, rgb * rng.uniform(0.6, 1.7, (len(means), 1)), size_m)


def fence(rng: Rng) -> Thing:
    """Return two metres of wooden fence."""
    timber, h = wood(rng, f.chosen(rng, f.WOODS)), float(rng.uniform(0.8, 1.1))
    pickets = [
        ((x - 0.04, -0.012, 0.05), (x + 0.04, 0.012, h), timber)
        for x in np.arange(-0.93, 1.0, 0.14)
    ]
    rails = [((-1.0, 0.012, z), (1.0, 0.05, z + 0.07), timber) for z in (0.22, h - 0.25)]
    return solid(*pickets, *rails)


def flower_bed(rng: Rng) -> Thing:
    """Return two metres of bed: earth, green and flowers of two colours."""
    soil = plain(rng, (0.27, 0.19, 0.13), 0.2)
    low, high = np.array([-1.0, -0.3, 0.0]), np.array([1.0, 0.3, 0.12])
    green, n = np.array([0.26, 0.42, 0.16]), 700
    leaf = rng.uniform((-0.97, -0.28, 0.1), (0.97, 0.28, 0.4), (n, 3))
    bloom = rng.uniform((-0.97, -0.28, 0.22), (0.97, 0.28, 0.5), (260, 3))
    colours = f.BRIGHT[rng.integers(len(f.BRIGHT), size=2)][
        (np.sin(5 * bloom[:, 0]) > 0).astype(np.int64)
    ]
    return Thing(
        (
            *box(low, high, soil),
            _leaves(rng, leaf, green, 0.05),
            _leaves(rng, bloom, colours, 0.04),
        ),
        (block(low, high),),
    )


def tree(rng: Rng) -> Thing:
    """Return a tree: trunk, and a crown of leaves in clumps."""
    h, r = float(rng.uniform(2.6, 4.5)), float(rng.uniform(0.07, 0.14))
    crown = float(rng.uniform(0.8, 1.4))
    centre = np.array([0, 0, h])
    clumps = centre + rng.standard_normal((14, 3)) * crown * np.array([0.5, 0.5, 0.42])
    n = 2600
    means = clumps[rng.integers(14, size=n)] + rng.standard_normal((n, 3)) * 0.24 * crown
    means[:, 2] = np.maximum(means[:, 2], 1.3)
    green = np.array([0.25, 0.40, 0.15]) * rng.uniform(0.8, 1.2)
    half = 0.55 * crown
    return Thing(
        (
            Turned(
                (0, 0, 0), [[1.5 * r, 0], [r, 0.3], [0.6 * r, h]], wood(rng, (0.36, 0.27, 0.20))
            ),
            _leaves(rng, means, green, 0.09),
        ),
        (
            block((-0.7 * r, -0.7 * r, 0), (0.7 * r, 0.7 * r, h)),
            block(centre - half, centre + half),
        ),
    )


def bench(rng: Rng) -> Thing:
    """Return a garden bench."""
    timber = wood(rng, f.chosen(rng, f.WOODS))
    slats = [((-0.7, y, 0.42), (0.7, y + 0.08, 0.45), timber) for y in (-0.22, -0.12, -0.02, 0.08)]
    back = [((-0.7, 0.2, z), (0.7, 0.23, z + 0.09), timber) for z in (0.55, 0.68, 0.81)]
    legs = [((x - 0.03, -0.22, 0.0), (x + 0.03, 0.22, 0.42), timber) for x in (-0.6, 0.6)]
    return solid(*slats, *back, *legs)


def house(rng: Rng) -> Thing:
    """Return the front of a house with a door and windows, towards -y."""
    wall = bricks(
        rng, f.chosen(rng, np.array([[0.66, 0.36, 0.27], [0.76, 0.68, 0.56], [0.72, 0.42, 0.32]]))
    )
    low, high = (-5.0, 0.0, 0.0), (5.0, 0.4, 4.4)
    parts: list[Part] = list(box(low, high, planks(rng, (0.5, 0.45, 0.4), 0.2, 2.0), front=wall))
    parts += f.on_wall(rng, "door", (0.95, 2.05), 0.02).parts
    for x in (-3.2, -1.7, 1.7, 3.2):
        w, h = float(rng.uniform(0.8, 1.1)), 1.2
        pane = plain(rng, (0.22, 0.28, 0.34), 0.15)
        parts.append(Panel((x - w / 2, -0.02, 1.0), (w, 0, 0), (0, 0, h), pane, 0.3))
        frame = plain(rng, (0.86, 0.85, 0.82), 0.01)
        left, right = x - w / 2, x + w / 2
        bars = [((left - 0.06, z), (right + 0.06, z + 0.06)) for z in (0.94, 2.2)]
        bars += [((u, 1.0), (u + 0.055, 2.2)) for u in (left - 0.055, x - 0.0275, right)]
        for a, b in bars:
            parts += box((a[0], -0.06, a[1]), (b[0], 0.0, b[1]), frame)
    return Thing(tuple(parts), (block(low, high),))
