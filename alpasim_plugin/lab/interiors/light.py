"""Light on surfels: ambient light, lamps or a sun with shadows of blocks, and the darkness of
corners.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.types import F64
from alpasim_plugin.lab.interiors.shadow_kernels import nearest, reached
from alpasim_plugin.lab.interiors.surfaces import Block, Surfels

FAINT = 0.003  # light below this is not traced
LIFT_M = 0.015  # shadow rays start this far above their surface
CONTACT_M, CONTACT = 0.12, 0.45  # reach and depth of the darkness where things touch
CORNER_M, CORNER = 0.30, 0.30  # the same in the corners of a room


@dataclass(frozen=True)
class Lamp:
    """A light that shines on things: the points ``(K, 3)`` of its area, its colour ``(3,)``, and
    the distance at which it gives half.

    A sun is a lamp far away, ``reach_m`` infinite.
    """

    points: F64
    rgb: npt.ArrayLike
    reach_m: float = np.inf


@dataclass(frozen=True)
class Light:
    """All light of a place.

    Attributes:
        ambient: ``(3,)``.
        lamps: See `Lamp`.
        walls: Low and high corner of the room, whose corners are darker; None outdoors.
    """

    ambient: npt.ArrayLike
    lamps: tuple[Lamp, ...]
    walls: tuple[F64, F64] | None = None

    def colours(self, surfels: Surfels, blocks: Sequence[Block]) -> F64:
        """Return the lit colours ``(N, 3)`` of surfels among blocks that throw shadows, those of
        their own thing left out.
        """
        p, n = surfels.means + LIFT_M * surfels.normals, surfels.normals
        stacked = _stacked(blocks)
        total = (
            np.asarray(self.ambient) * self._open(p, stacked)[:, None] * (0.85 + 0.15 * n[:, 2:])
        )
        for lamp in self.lamps:
            for point in lamp.points:
                to = point - p
                distance = np.linalg.norm(to, axis=1)
                facing = np.clip(np.einsum("ij,ij->i", n, to) / np.maximum(distance, 1e-9), 0, 1)
                strength = facing / (1 + (distance / lamp.reach_m) ** 2) / len(lamp.points)
                strength *= reached(p, point, strength > FAINT, *stacked)
                total = total + strength[:, None] * np.asarray(lamp.rgb)
        glow = surfels.glow[:, None]
        return np.asarray(np.clip(surfels.rgb * (glow + (1 - glow) * total), 0.0, 1.0))

    def _open(self, p: F64, stacked: tuple[F64, F64, F64]) -> F64:
        """Return how much ambient light reaches points ``(N,)``."""
        out = 1 - CONTACT * np.exp(-nearest(p, *stacked, 10 * CONTACT_M) / CONTACT_M)
        if self.walls is not None:
            gap = np.sort(
                np.maximum(np.minimum(p - self.walls[0], self.walls[1] - p), 0.0), axis=1
            )[:, 1]  # the second nearest wall
            out = out * (1 - CORNER * np.exp(-gap / CORNER_M))
        return np.asarray(out)


def _stacked(blocks: Sequence[Block]) -> tuple[F64, F64, F64]:
    """Return rotations ``(B, 3, 3)``, middles ``(B, 3)`` and half sizes ``(B, 3)``."""
    rotations = np.array([b.T[:3, :3] for b in blocks]).reshape(-1, 3, 3)
    return (
        rotations,
        np.array([b.T[:3, 3] for b in blocks]).reshape(-1, 3),
        np.array([b.half for b in blocks]).reshape(-1, 3),
    )
