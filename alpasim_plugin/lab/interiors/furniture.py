"""Furniture: each draws its own sizes and colours; its back is towards +y, its front towards -y,
its feet at the origin.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from alpasim_plugin.core.types import F64
from alpasim_plugin.lab.interiors.materials import (
    Rng,
    books,
    painting,
    panelled,
    plaid,
    plain,
    printed,
    rug,
    stripes,
    window,
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
)

WOODS = np.array(
    [
        [0.62, 0.43, 0.26],
        [0.45, 0.29, 0.17],
        [0.74, 0.58, 0.40],
        [0.33, 0.22, 0.15],
        [0.80, 0.76, 0.70],
    ]
)
CLOTHS = np.array(
    [
        [0.28, 0.38, 0.50],
        [0.58, 0.28, 0.22],
        [0.36, 0.44, 0.30],
        [0.70, 0.63, 0.52],
        [0.40, 0.36, 0.40],
        [0.72, 0.52, 0.20],
    ]
)
BRIGHT = np.array(
    [
        [0.75, 0.18, 0.14],
        [0.15, 0.35, 0.62],
        [0.85, 0.68, 0.18],
        [0.20, 0.48, 0.28],
        [0.90, 0.88, 0.82],
        [0.50, 0.22, 0.48],
        [0.12, 0.12, 0.14],
    ]
)


def chosen(rng: Rng, palette: F64) -> F64:
    """Return a colour of a palette, a little lighter or darker."""
    return np.asarray(palette[rng.integers(len(palette))] * rng.uniform(0.88, 1.1))


def table(rng: Rng, size_m: tuple[float, float] | None = None, height_m: float = 0.74) -> Thing:
    """Return a table with four legs."""
    w, d = size_m or (float(rng.uniform(1.1, 1.7)), float(rng.uniform(0.75, 0.95)))
    top, leg = wood(rng, chosen(rng, WOODS)), wood(rng, chosen(rng, WOODS))
    x = w / 2
    y = d / 2
    h = height_m
    legs = [
        (
            (sx * (x - 0.07) - 0.03, sy * (y - 0.07) - 0.03, 0),
            (sx * (x - 0.07) + 0.03, sy * (y - 0.07) + 0.03, h - 0.04),
            leg,
        )
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    return solid(((-x, -y, h - 0.04), (x, y, h), top), *legs)


def low_table(rng: Rng) -> Thing:
    """Return a low table for a sofa."""
    return table(rng, (float(rng.uniform(0.8, 1.1)), float(rng.uniform(0.5, 0.65))), 0.42)


def chair(rng: Rng) -> Thing:
    """Return a chair with a slatted back."""
    frame = wood(rng, chosen(rng, WOODS))
    seat = plain(rng, chosen(rng, CLOTHS), 0.06)
    w = 0.21
    legs = [
        (
            (sx * w - 0.02, sy * w - 0.02, 0),
            (sx * w + 0.02, sy * w + 0.02, 0.95 if sy > 0 else 0.43),
            frame,
        )
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    slats = [((-w, w - 0.015, z), (w, w + 0.015, z + 0.09), frame) for z in (0.56, 0.71, 0.85)]
    return solid(((-w - 0.02, -w - 0.02, 0.43), (w + 0.02, w + 0.02, 0.48), seat), *legs, *slats)


def sofa(rng: Rng) -> Thing:
    """Return a sofa with seat cushions and two pillows."""
    cloth = chosen(rng, CLOTHS)
    cover = plaid(rng, cloth, 0.75 * cloth, 0.16) if rng.random() < 0.4 else plain(rng, cloth, 0.08)
    pillow, w = (
        stripes(rng, chosen(rng, BRIGHT), (0.88, 0.86, 0.80), 0.07),
        float(rng.uniform(1.6, 2.1)) / 2,
    )
    n = 2 if w < 0.9 else 3
    seats = [
        (
            (-w + 0.2 + k * (2 * w - 0.4) / n + 0.01, -0.42, 0.30),
            (-w + 0.2 + (k + 1) * (2 * w - 0.4) / n - 0.01, 0.2, 0.46),
            cover,
        )
        for k in range(n)
    ]
    pillows = [
        ((sx * (w - 0.45) - 0.2, 0.08, 0.46), (sx * (w - 0.45) + 0.2, 0.2, 0.82), pillow)
        for sx in (-1, 1)
    ]
    return solid(
        ((-w, -0.42, 0.06), (w, 0.42, 0.30), cover),
        ((-w, 0.2, 0.30), (w, 0.42, 0.84), cover),
        ((-w, -0.44, 0.06), (-w + 0.19, 0.42, 0.62), cover),
        ((w - 0.19, -0.44, 0.06), (w, 0.42, 0.62), cover),
        *seats,
        *pillows,
    )


def bed(rng: Rng) -> Thing:
    """Return a bed with a blanket and pillows."""
    frame = wood(rng, chosen(rng, WOODS))
    cloth = chosen(rng, CLOTHS)
    w = float(rng.uniform(0.9, 1.5)) / 2
    blanket = (
        plaid(rng, cloth, (0.86, 0.84, 0.78), 0.22)
        if rng.random() < 0.5
        else stripes(rng, cloth, 0.8 * cloth, 0.18)
    )
    white = plain(rng, (0.88, 0.87, 0.84), 0.02)
    pillows = [
        ((sx * w / 2 - 0.3, 0.55, 0.52), (sx * w / 2 + 0.3, 0.95, 0.64), white)
        for sx in ((-1, 1) if w > 0.6 else (0,))
    ]
    return solid(
        ((-w, -1.0, 0.1), (w, 1.0, 0.3), frame),
        ((-w, 1.0, 0.1), (w, 1.06, 1.0), frame),
        ((-w + 0.02, -0.98, 0.3), (w - 0.02, 0.98, 0.5), white),
        ((-w, -1.02, 0.34), (w, 0.42, 0.53), blanket),
        *pillows,
    )


def shelf(rng: Rng) -> Thing:
    """Return a shelf full of books, with some boxes."""
    timber = wood(rng, chosen(rng, WOODS))
    w = float(rng.uniform(0.7, 1.2)) / 2
    levels = int(rng.integers(4, 6))
    step, dark = 0.36, plain(rng, (0.12, 0.10, 0.08))
    h = levels * step + 0.05
    parts: list[Part] = [
        p
        for low, high in (
            ((-w, -0.14, 0.0), (-w + 0.025, 0.14, h)),
            ((w - 0.025, -0.14, 0.0), (w, 0.14, h)),
            *(
                ((-w, -0.14, k * step + 0.02), (w, 0.14, k * step + 0.045))
                for k in range(levels + 1)
            ),
        )
        for p in box(low, high, timber)
    ]
    parts.append(Panel((-w, 0.13, 0), (2 * w, 0, 0), (0, 0, h), dark))
    for k in range(levels):
        z, filled = k * step + 0.045, float(rng.uniform(0.55, 1.0)) * (2 * w - 0.06)
        parts.append(Panel((-w + 0.03, -0.09, z), (filled, 0, 0), (0, 0, 0.27), books(rng, BRIGHT)))
        if filled < 2 * w - 0.3:
            x = -w + 0.06 + filled
            side = min(0.22, w - x - 0.05)
            parts += box(
                (x, -0.10, z),
                (x + side, 0.1, z + side),
                printed(rng, chosen(rng, BRIGHT), (side, side)),
            )
    return Thing(tuple(parts), (block((-w, -0.14, 0), (w, 0.14, h)),))


def cupboard(rng: Rng) -> Thing:
    """Return a cupboard or a chest of drawers."""
    tall = rng.random() < 0.5
    w = float(rng.uniform(0.8, 1.3))
    h = (1.9 if tall else 0.85) * float(rng.uniform(0.95, 1.05))
    d = 0.45
    colour = chosen(rng, WOODS)
    body, front = (
        wood(rng, colour),
        panelled(rng, colour, (w, h), 2 if tall else 1, 1 if tall else 4),
    )
    low, high = (-w / 2, -d / 2, 0.0), (w / 2, d / 2, h)
    return Thing(tuple(box(low, high, body, front=front)), (block(low, high),))


def lamp(rng: Rng) -> Thing:
    """Return a standing lamp whose shade glows."""
    h = float(rng.uniform(1.4, 1.7))
    metal = plain(rng, (0.25, 0.24, 0.23))
    shade = plain(rng, (0.98, 0.90, 0.70), 0.02)
    return Thing(
        (
            Turned((0, 0, 0), [[0.15, 0], [0.15, 0.025], [0.012, 0.04], [0.012, h]], metal),
            Turned((0, 0, h - 0.12), [[0.2, 0], [0.13, 0.28]], shade, 0.85),
        ),
        (block((-0.12, -0.12, 0), (0.12, 0.12, 0.03)),),
    )


def plant(rng: Rng, height_m: float | None = None) -> Thing:
    """Return a plant in a pot."""
    h, pot = (
        height_m or float(rng.uniform(0.9, 1.5)),
        plain(
            rng, chosen(rng, np.array([[0.66, 0.36, 0.24], [0.82, 0.80, 0.76], [0.3, 0.32, 0.36]]))
        ),
    )
    r = 0.14 * h
    n, stems = round(320 * (0.5 + h)), 9
    stem, s = rng.integers(stems, size=n), rng.random(n) ** 0.7
    lean, turn = rng.uniform(0.15, 0.42, stems) * h, rng.uniform(0, 2 * np.pi, stems)
    out = lean[stem] * s**1.5
    centre = np.column_stack(
        [out * np.cos(turn[stem]), out * np.sin(turn[stem]), 0.3 * h + 0.7 * h * s]
    )
    means = centre + rng.standard_normal((n, 3)) * 0.05 * h
    normals = rng.standard_normal((n, 3)) * [0.6, 0.6, 1.0] + [0, 0, 0.6]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    rgb = np.array([0.24, 0.42, 0.18]) * rng.uniform(0.55, 1.5, (n, 1)) * np.array([1.0, 1.0, 0.9])
    profile = [
        [0.7 * r, 0],
        [r, 0.28 * h],
        [1.06 * r, 0.28 * h],
        [1.06 * r, 0.31 * h],
        [0.9 * r, 0.31 * h],
        [0.0, 0.29 * h],
    ]
    size = 0.5 * h
    return Thing(
        (Turned((0, 0, 0), profile, pot), Leaves(means, normals, rgb, 0.065 * h**0.7)),
        (
            block((-0.7 * r, -0.7 * r, 0), (0.7 * r, 0.7 * r, 0.3 * h)),
            block((-0.3 * size, -0.3 * size, 0.5 * h), (0.3 * size, 0.3 * size, 0.95 * h)),
        ),
    )


def carpet(rng: Rng, size_m: tuple[float, float]) -> Thing:
    """Return a rug that lies on the floor."""
    w, d = size_m
    colours = [chosen(rng, CLOTHS), chosen(rng, BRIGHT), np.array([0.82, 0.78, 0.68])]
    return Thing((Panel((-w / 2, -d / 2, 0.012), (w, 0, 0), (0, d, 0), rug(rng, size_m, colours)),))


def on_wall(rng: Rng, kind: str, size_m: tuple[float, float], foot_m: float) -> Thing:
    """Return what hangs on a wall behind it, at y = 0: ``picture``, ``window`` with curtains, or
    ``door``.

    Raises:
        KeyError: Another kind.
    """
    w, h = size_m
    makers: Mapping[str, Callable[[], list[Part]]] = {
        "picture": lambda: list(
            box(
                (-w / 2, -0.03, foot_m),
                (w / 2, 0.0, foot_m + h),
                wood(rng, WOODS[3]),
                front=painting(rng, size_m, BRIGHT),
            )
        ),
        "door": lambda: list(
            box(
                (-w / 2, -0.03, foot_m),
                (w / 2, 0.0, foot_m + h),
                wood(rng, WOODS[4]),
                front=panelled(rng, WOODS[4], size_m, 1, 3),
            )
        ),
        "window": lambda: _curtained(rng, size_m, foot_m),
    }
    return Thing(tuple(makers[kind]()))


def _curtained(rng: Rng, size_m: tuple[float, float], foot_m: float) -> list[Part]:
    w, h = size_m
    cloth, width = chosen(rng, CLOTHS), 0.28
    curtain = stripes(rng, cloth, 0.9 * cloth, 0.1, folds=0.22)
    sides = [
        Panel((x, -0.09, foot_m - 0.15), (width, 0, 0), (0, 0, h + 0.3), curtain)
        for x in (-w / 2 - width + 0.06, w / 2 - 0.06)
    ]
    sill = box(
        (-w / 2 - 0.04, -0.14, foot_m - 0.05),
        (w / 2 + 0.04, 0.0, foot_m - 0.01),
        plain(rng, (0.85, 0.84, 0.81), 0.01),
    )
    return [
        Panel((-w / 2, -0.02, foot_m), (w, 0, 0), (0, 0, h), window(rng, size_m), 1.0),
        *sides,
        *sill,
    ]
