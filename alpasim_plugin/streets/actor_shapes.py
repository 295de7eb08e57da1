"""Outlines of vehicles as shares of their box, and their skin of quadrilaterals."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from alpasim_plugin.core.types import F64

Top = Literal["body", "glass", "bed"]
YZ = tuple[float, float]


def _flank(stations: list[tuple[float, list[YZ]]], k: int, side: float) -> list[list[float]]:
    """Return the corners between two stations and between lines k and k + 1 of their outlines."""
    (a, before), (b, after) = stations
    ring = [(b, after[k]), (a, before[k]), (a, before[k + 1]), (b, after[k + 1])]
    if side > 0:  # outward must be first edge x second edge on both flanks
        ring = [ring[1], ring[0], ring[3], ring[2]]
    return [[x, side * y, z] for x, (y, z) in ring]


def _end(x: float, sign: float, lower: YZ, upper: YZ) -> list[list[float]]:
    """Return the corners of a face at one end of the vehicle."""
    (y, z), (upper_y, upper_z) = (sign * lower[0], lower[1]), (sign * upper[0], upper[1])
    return [[x, -y, z], [x, y, z], [x, upper_y, upper_z], [x, -upper_y, upper_z]]


@dataclass(frozen=True)
class Loft:
    """A vehicle's outline from front to rear.

    Attributes:
        x: ``(S,)`` stations, share of the length from the centre, falling from 0.5 to -0.5.
        belt: ``(S,)`` height of the belt line (top of the painted flank), share of the height.
        roof: ``(S,)`` height of the top; above the belt is the glazed part.
        top: What closes the top between station i and i + 1.
        side_glass: Whether the flank between station i and i + 1 is glass above the belt.
        axles: Wheel axles, share of the length from the centre.
        wheel_m: Wheel radius, metres.
        lamp_z: Height of the lamps, share of the height.
        tuck: Share of the half width by which the roof is narrower than the belt.
        clearance: Height of the body's lower edge, share of the height.
        rear_glass: Whether the rear end is glazed above the belt.
    """

    x: tuple[float, ...]
    belt: tuple[float, ...]
    roof: tuple[float, ...]
    top: tuple[Top, ...]
    side_glass: tuple[bool, ...]
    axles: tuple[float, ...] = (0.31, -0.29)
    wheel_m: float = 0.33
    lamp_z: float = 0.46
    tuck: float = 0.16
    clearance: float = 0.14
    rear_glass: bool = True

    def quads(self, body: F64, glass: F64) -> tuple[F64, F64, F64]:
        """Return the skin.

        Returns:
            Corners ``(M, 4, 3)`` as shares of length, width and height (z from the ground), colours
            ``(M, 3)`` and gloss ``(M,)``.
        """
        faces = []
        colours = []
        gloss = []

        def add(corners: list[list[float]], rgb: F64, shine: float) -> None:
            faces.append(corners)
            colours.append(rgb)
            gloss.append(shine)

        low = self.clearance
        last = len(self.x) - 1
        stations = []  # x, and the outline: y and z of: lower edge, sill, belt line, roof
        for i, (belt, roof) in enumerate(zip(self.belt, self.roof, strict=True)):
            half = 0.45 if i in (0, last) else 0.5
            lift = min(max((roof - belt) / 0.3, 0.0), 1.0)
            top = half * (1 - self.tuck * lift)
            outline = [(half * 0.98, 0.6 * low), (half, low), (half, belt), (top, roof)]
            stations.append((self.x[i], outline))
        for i, (cover_kind, glazed) in enumerate(zip(self.top, self.side_glass, strict=True)):
            (a, before), (b, after) = stations[i : i + 2]
            for side in (1.0, -1.0):
                add(_flank(stations[i : i + 2], 1, side), body, 0.16)
                add(_flank(stations[i : i + 2], 0, side), 0.35 * body, 0.0)
                if max(before[3][1] - before[2][1], after[3][1] - after[2][1]) > 0.02:
                    add(
                        _flank(stations[i : i + 2], 2, side),
                        *((glass, 0.30) if glazed else (body, 0.16)),
                    )
            (ra, ta), (rb, tb) = before[3], after[3]
            cover = [[b, -rb, tb], [a, -ra, ta], [a, ra, ta], [b, rb, tb]]
            covers = {"glass": (glass, 0.30), "bed": (0.30 * body, 0.20), "body": (body, 0.20)}
            add(cover, *covers[cover_kind])
        for i, sign in ((0, 1.0), (last, -1.0)):
            (w, _), (_, belt), (roof_half, roof) = stations[i][1][1:]
            belt = min(belt, roof)
            x = self.x[i]
            add(_end(x, sign, (w, low), (w, belt)), body, 0.12)
            if roof - belt > 0.05:
                glazed = sign > 0 or self.rear_glass
                add(
                    _end(x, sign, (w, belt), (roof_half, roof)),
                    *((glass, 0.25) if glazed else (body, 0.12)),
                )
            add(_end(x, sign, (0.95 * w, 0.6 * low), (w, 1.6 * low)), 0.30 * body + 0.04, 0.0)
        return np.array(faces), np.stack(colours), np.array(gloss)


STATIONS: dict[str, Loft] = {
    "sedan": Loft(
        (0.5, 0.46, 0.22, 0.02, -0.20, -0.36, -0.48, -0.5),
        (0.50, 0.56, 0.63, 0.64, 0.65, 0.65, 0.65, 0.55),
        (0.50, 0.56, 0.63, 0.98, 1.00, 0.70, 0.65, 0.55),
        ("body", "body", "glass", "body", "glass", "body", "body"),
        (False, False, True, True, True, False, False),
    ),
    "hatch": Loft(
        (0.5, 0.46, 0.24, 0.05, -0.30, -0.46, -0.5),
        (0.50, 0.57, 0.63, 0.64, 0.65, 0.66, 0.55),
        (0.50, 0.57, 0.63, 0.97, 1.00, 0.75, 0.56),
        ("body", "body", "glass", "body", "glass", "body"),
        (False, False, True, True, True, False),
    ),
    "suv": Loft(
        (0.5, 0.47, 0.24, 0.08, -0.36, -0.47, -0.5),
        (0.52, 0.60, 0.64, 0.65, 0.66, 0.66, 0.50),
        (0.52, 0.60, 0.64, 0.97, 1.00, 0.80, 0.52),
        ("body", "body", "glass", "body", "glass", "body"),
        (False, False, True, True, True, False),
        wheel_m=0.37,
        lamp_z=0.50,
    ),
    "van": Loft(
        (0.5, 0.44, 0.32, -0.46, -0.5),
        (0.42, 0.52, 0.56, 0.56, 0.55),
        (0.42, 0.60, 0.97, 1.00, 0.96),
        ("body", "glass", "body", "body"),
        (False, True, False, False),
        wheel_m=0.36,
        lamp_z=0.34,
        tuck=0.08,
    ),
    "pickup": Loft(
        (0.5, 0.47, 0.26, 0.14, -0.08, -0.12, -0.47, -0.5),
        (0.52, 0.58, 0.62, 0.63, 0.63, 0.60, 0.60, 0.55),
        (0.52, 0.58, 0.62, 0.98, 1.00, 0.61, 0.60, 0.56),
        ("body", "body", "glass", "body", "glass", "bed", "body"),
        (False, False, True, True, False, False, False),
        wheel_m=0.39,
        lamp_z=0.48,
    ),
    "truck": Loft(
        (0.5, 0.485, 0.45, 0.30, 0.29, -0.49, -0.5),
        (0.30, 0.36, 0.44, 0.44, 0.30, 0.30, 0.30),
        (0.30, 0.45, 0.74, 0.76, 1.00, 1.00, 0.99),
        ("body", "glass", "body", "body", "body", "body"),
        (False, True, True, False, False, False),
        axles=(0.36, -0.30, -0.42),
        wheel_m=0.48,
        lamp_z=0.24,
        tuck=0.02,
        clearance=0.16,
        rear_glass=False,
    ),
    "bus": Loft(
        (0.5, 0.49, 0.47, -0.47, -0.5),
        (0.40, 0.42, 0.44, 0.44, 0.50),
        (0.95, 0.98, 1.00, 1.00, 0.96),
        ("body", "body", "body", "body"),
        (True, True, True, False),
        axles=(0.30, -0.28),
        wheel_m=0.48,
        lamp_z=0.26,
        tuck=0.05,
        clearance=0.10,
    ),
}
