"""Small objects for a table: each stands on the origin and draws its own sizes and colours."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from alpasim_plugin.lab.interiors.furniture import BRIGHT, WOODS, chosen, plant
from alpasim_plugin.lab.interiors.materials import Paint, Rng, plain, printed, stripes, wood
from alpasim_plugin.lab.interiors.surfaces import Part, Thing, Turned, block, box


def glaze(rng: Rng) -> Paint:
    """Return the glaze of a vessel: plain, or with rings of a second colour around it."""
    if rng.random() < 0.45:
        return plain(rng, chosen(rng, BRIGHT), 0.05)
    rings = stripes(rng, (1, 1, 1), (0, 0, 0), float(rng.uniform(0.03, 0.07)))
    a = chosen(rng, BRIGHT)
    b = chosen(rng, BRIGHT)
    return lambda x, y: b + (rings(y, x)[:, :1] > 0.5) * (a - b)


def mug(rng: Rng) -> Thing:
    """Return a mug with a handle of short rods."""
    r = float(rng.uniform(0.036, 0.046))
    h = float(rng.uniform(0.085, 0.11))
    paint = glaze(rng)
    inside = plain(rng, (0.85, 0.83, 0.78), 0.02)
    turn = np.linspace(-1.3, 1.3, 9)
    centres = np.column_stack([r + 0.024 * np.cos(turn), np.zeros(9), h / 2 + 0.03 * np.sin(turn)])
    handle = [p for c in centres for p in box(c - 0.006, c + 0.006, paint)]
    parts: list[Part] = [
        Turned((0, 0, 0), [[0.0, 0.001], [r * 0.9, 0], [r, 0.01], [r, h]], paint),
        Turned((0, 0, 0), [[r * 0.93, h], [r * 0.9, 0.6 * h], [0.0, 0.6 * h]], inside),
        *handle,
    ]
    return Thing(tuple(parts), (block((-0.8 * r, -0.8 * r, 0), (0.8 * r, 0.8 * r, 0.95 * h)),))


def vase(rng: Rng) -> Thing:
    """Return a vase of a drawn outline."""
    h = float(rng.uniform(0.16, 0.30))
    widths = h * np.array(
        [
            0.22,
            rng.uniform(0.25, 0.42),
            rng.uniform(0.25, 0.40),
            rng.uniform(0.08, 0.16),
            rng.uniform(0.10, 0.18),
        ]
    )
    z = np.linspace(0, 1, 25)
    radius = np.interp(z, [0, 0.28, 0.55, 0.85, 1.0], widths)
    radius = np.convolve(np.pad(radius, 2, mode="edge"), np.ones(5) / 5, mode="valid")
    low = float(widths[:3].min())
    return Thing(
        (Turned((0, 0, 0), np.column_stack([radius, z * h]), glaze(rng)),),
        (block((-0.7 * low, -0.7 * low, 0), (0.7 * low, 0.7 * low, h)),),
    )


def bottle(rng: Rng) -> Thing:
    """Return a bottle with a label."""
    h = float(rng.uniform(0.24, 0.31))
    r = float(rng.uniform(0.033, 0.042))
    glass = chosen(rng, np.array([[0.13, 0.28, 0.16], [0.30, 0.17, 0.08], [0.5, 0.6, 0.62]]))
    label, base = printed(rng, (0.88, 0.85, 0.76), (2 * np.pi * r, 0.09)), plain(rng, glass)

    def paint(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        on = (y > 0.05 + r) & (y < 0.14 + r)
        return np.where(on[:, None], label(x, y - 0.05 - r), base(x, y))

    profile = [
        [0, 0.001],
        [r, 0.0],
        [r, 0.62 * h],
        [0.4 * r, 0.78 * h],
        [0.36 * r, 0.98 * h],
        [0.0, h],
    ]
    return Thing(
        (Turned((0, 0, 0), profile, paint),),
        (block((-0.8 * r, -0.8 * r, 0), (0.8 * r, 0.8 * r, 0.6 * h)),),
    )


def fruit(rng: Rng) -> Thing:
    """Return an apple, an orange or a lemon."""
    colour = [(0.72, 0.14, 0.10), (0.90, 0.50, 0.10), (0.90, 0.80, 0.20), (0.50, 0.66, 0.20)][
        int(rng.integers(4))
    ]
    r = float(rng.uniform(0.034, 0.046))
    angle = np.linspace(-np.pi / 2, np.pi / 2, 17)
    profile = np.column_stack([r * np.cos(angle), 0.92 * r * (1 + np.sin(angle))])
    return Thing(
        (Turned((0, 0, 0), profile, plain(rng, colour, 0.12)),),
        (block((-0.6 * r, -0.6 * r, 0), (0.6 * r, 0.6 * r, 1.5 * r)),),
    )


def bowl(rng: Rng) -> Thing:
    """Return a bowl with fruit in it."""
    r, paint = float(rng.uniform(0.11, 0.15)), glaze(rng)
    outer = [[0.4 * r, 0], [0.8 * r, 0.2 * r], [r, 0.55 * r]]
    inner = [[0.97 * r, 0.55 * r], [0.75 * r, 0.25 * r], [0.0, 0.12 * r]]
    parts: list[Part] = [
        Turned((0, 0, 0), outer, paint),
        Turned((0, 0, 0), inner, plain(rng, (0.8, 0.78, 0.72), 0.03)),
    ]
    for k in range(4):
        piece = fruit(rng).parts[0]
        assert isinstance(piece, Turned)
        turn = k * np.pi / 2 + float(rng.uniform(-0.3, 0.3))
        parts.append(
            Turned(
                (0.45 * r * np.cos(turn), 0.45 * r * np.sin(turn), 0.22 * r),
                piece.profile,
                piece.paint,
            )
        )
    return Thing(tuple(parts), (block((-0.7 * r, -0.7 * r, 0), (0.7 * r, 0.7 * r, 0.5 * r)),))


def packet(rng: Rng) -> Thing:
    """Return a printed packet."""
    w, d, h = (float(v) for v in rng.uniform((0.10, 0.05, 0.14), (0.20, 0.09, 0.28)))
    colour = chosen(rng, BRIGHT)
    low, high = (-w / 2, -d / 2, 0), (w / 2, d / 2, h)
    return Thing(
        tuple(box(low, high, printed(rng, colour, (w, h)), top=plain(rng, colour))),
        (block(low, high),),
    )


def book_stack(rng: Rng) -> Thing:
    """Return two to four books on each other, turned a little."""
    parts: list[Part] = []
    z, pages = 0.0, plain(rng, (0.88, 0.86, 0.78), 0.06)
    for _ in range(int(rng.integers(2, 5))):
        w, d, h = (float(v) for v in rng.uniform((0.20, 0.14, 0.022), (0.27, 0.19, 0.045)))
        dx, dy = rng.uniform(-0.015, 0.015, 2)
        cover = printed(rng, chosen(rng, BRIGHT), (w, d))
        parts += box(
            (dx - w / 2, dy - d / 2, z),
            (dx + w / 2, dy + d / 2, z + h),
            pages,
            top=cover,
            front=printed(rng, chosen(rng, BRIGHT), (w, h)),
        )
        z += h
    return Thing(tuple(parts), (block((-0.1, -0.07, 0), (0.1, 0.07, z)),))


def toy_blocks(rng: Rng) -> Thing:
    """Return a small tower of painted wooden blocks."""
    s, parts = float(rng.uniform(0.04, 0.055)), []
    for x, z in ((-1, 0), (0, 0), (1, 0), (-0.5, 1), (0.5, 1), (0, 2)):
        low = np.array([(x - 0.48) * s, -0.48 * s, z * s])
        parts += box(
            low,
            low + 0.96 * s,
            plain(rng, chosen(rng, BRIGHT), 0.04)
            if rng.random() < 0.7
            else wood(rng, chosen(rng, WOODS)),
        )
    return Thing(
        tuple(parts),
        (
            block((-1.4 * s, -0.4 * s, 0), (1.4 * s, 0.4 * s, s)),
            block((-0.9 * s, -0.4 * s, s), (0.9 * s, 0.4 * s, 2 * s)),
        ),
    )


def small_plant(rng: Rng) -> Thing:
    """Return a plant for a table."""
    return plant(rng, float(rng.uniform(0.22, 0.36)))


OBJECTS: tuple[Callable[[Rng], Thing], ...] = (
    mug,
    vase,
    bottle,
    bowl,
    packet,
    book_stack,
    toy_blocks,
    small_plant,
    fruit,
)
