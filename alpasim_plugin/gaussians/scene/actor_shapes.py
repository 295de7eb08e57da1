"""Outlines of vehicles as shares of their box, and their skin of quadrilaterals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.types import F64

Top = Literal["body", "glass", "bed"]


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
        faces: list[npt.NDArray[np.float64]] = []
        colours: list[F64] = []
        gloss: list[float] = []

        def add(corners: list[list[float]], rgb: F64, shine: float) -> None:
            faces.append(np.array(corners))
            colours.append(rgb)
            gloss.append(shine)

        low, half = self.clearance, 0.5
        n = len(self.x)
        narrow = [half * (0.90 if i in (0, n - 1) else 1.0) for i in range(n)]
        for i in range(n - 1):
            a, b = self.x[i], self.x[i + 1]
            wa, wb = narrow[i], narrow[i + 1]
            ra, rb = self._roof_half(i, wa), self._roof_half(i + 1, wb)
            ba = self.belt[i]
            bb = self.belt[i + 1]
            ta = self.roof[i]
            tb = self.roof[i + 1]
            for side in (1.0, -1.0):
                lower = [
                    [b, side * wb, low],
                    [a, side * wa, low],
                    [a, side * wa, ba],
                    [b, side * wb, bb],
                ]
                upper = [
                    [b, side * wb, bb],
                    [a, side * wa, ba],
                    [a, side * ra, ta],
                    [b, side * rb, tb],
                ]
                sill = [
                    [b, side * wb * 0.98, 0.6 * low],
                    [a, side * wa * 0.98, 0.6 * low],
                    [a, side * wa, low],
                    [b, side * wb, low],
                ]
                if side > 0:  # outward must be first edge x second edge on both flanks
                    lower, upper, sill = ([q[1], q[0], q[3], q[2]] for q in (lower, upper, sill))
                add(lower, body, 0.16)
                add(sill, 0.35 * body, 0.0)
                if ta - ba > 0.02 or tb - bb > 0.02:
                    add(
                        upper,
                        glass if self.side_glass[i] else body,
                        0.30 if self.side_glass[i] else 0.16,
                    )
            cover = [[b, -rb, tb], [a, -ra, ta], [a, ra, ta], [b, rb, tb]]
            rgb = glass if self.top[i] == "glass" else 0.30 * body if self.top[i] == "bed" else body
            add(cover, rgb, 0.30 if self.top[i] == "glass" else 0.20)
        for i, sign in ((0, 1.0), (n - 1, -1.0)):
            x = self.x[i]
            w = narrow[i]
            t = self.roof[i]
            belt = min(self.belt[i], t)
            ring = [
                [x, -sign * -w, low],
                [x, -sign * w, low],
                [x, -sign * w, belt],
                [x, -sign * -w, belt],
            ]
            # Seen from outside the first edge runs to the left; reversed at the front.
            add([ring[1], ring[0], ring[3], ring[2]], body, 0.12)
            if t - belt > 0.05:
                r = self._roof_half(i, w)
                glazed = sign > 0 or self.rear_glass
                upper = [
                    [x, -sign * w, belt],
                    [x, sign * w, belt],
                    [x, sign * r, t],
                    [x, -sign * r, t],
                ]
                add(upper, glass if glazed else body, 0.25 if glazed else 0.12)
            b, high = 0.95 * w, 1.6 * low
            bumper = [
                [x, -sign * b, 0.6 * low],
                [x, sign * b, 0.6 * low],
                [x, sign * w, high],
                [x, -sign * w, high],
            ]
            add(bumper, 0.30 * body + 0.04, 0.0)
        return np.stack(faces), np.stack(colours), np.array(gloss)

    def _roof_half(self, i: int, half: float) -> float:
        lift = min(max((self.roof[i] - self.belt[i]) / 0.3, 0.0), 1.0)
        return half * (1 - self.tuck * lift)


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
