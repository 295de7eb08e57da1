"""Rectangles, turned bodies and leaves as surfels, and things made of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.geometry import quat_from_matrix
from alpasim_plugin.core.types import F64
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.scene.surfels import SPREAD, cloud_of, grid_cells
from alpasim_plugin.lab.interiors.materials import Paint

THICKNESS_M = 0.0015  # standard deviation across a surface


class Surfels(NamedTuple):
    """Flat pieces of surface: centres, unit normals and tangents ``(N, 3)``, sizes ``(N, 2)``
    metres, colours ``(N, 3)``, glow ``(N,)``.

    ``glow`` is the share of the colour that no light changes: 1 for a window.
    """

    means: F64
    normals: F64
    tangents: F64
    sizes: F64
    rgb: F64
    glow: F64

    def moved(self, T: F64) -> Surfels:
        """Return them in another frame; ``T`` is rigid."""
        R = T[:3, :3].T
        return self._replace(
            means=self.means @ R + T[:3, 3], normals=self.normals @ R, tangents=self.tangents @ R
        )

    def cloud(self, rgb: F64) -> GaussianCloud:
        """Return Gaussians with these colours ``(N, 3)``."""
        frames = np.stack(
            [self.tangents, np.cross(self.normals, self.tangents), self.normals], axis=-1
        )
        scales = np.column_stack([SPREAD * self.sizes, np.full(len(self.means), THICKNESS_M)])
        return cloud_of(self.means, quat_from_matrix(frames), scales, rgb)


def joined(parts: Sequence[Surfels]) -> Surfels:
    """Return all of them as one."""
    return Surfels(*(np.concatenate(column) for column in zip(*parts, strict=True)))


class Part(Protocol):
    """A piece of a thing."""

    def surfels(self, cell_m: float) -> Surfels:
        """Cover it with cells of about this size."""
        ...


@dataclass(frozen=True)
class Panel:
    """A rectangle.

    Attributes:
        corner: ``(3,)`` where both edges begin.
        edge_u, edge_v: ``(3,)`` edges; outward is the first times the second.
        paint: Of places along the edges.
        glow: See `Surfels`.
    """

    corner: npt.ArrayLike
    edge_u: npt.ArrayLike
    edge_v: npt.ArrayLike
    paint: Paint
    glow: float = 0.0

    def surfels(self, cell_m: float) -> Surfels:
        """Cover it with a grid."""
        corner, u, v = (
            np.asarray(a, dtype=np.float64) for a in (self.corner, self.edge_u, self.edge_v)
        )
        length_u, length_v = float(np.linalg.norm(u)), float(np.linalg.norm(v))
        n_u, n_v = max(round(length_u / cell_m), 1), max(round(length_v / cell_m), 1)
        _, a, b = grid_cells(np.array([n_u]), np.array([n_v]))
        n = len(a)
        normal = np.cross(u, v) / (length_u * length_v)
        return Surfels(
            corner + a[:, None] * u + b[:, None] * v,
            np.tile(normal, (n, 1)),
            np.tile(u / length_u, (n, 1)),
            np.tile([length_u / n_u, length_v / n_v], (n, 1)),
            self.paint(a * length_u, b * length_v),
            np.full(n, self.glow),
        )


@dataclass(frozen=True)
class Turned:
    """A body of revolution about a vertical axis.

    Attributes:
        foot: ``(3,)`` where the axis begins.
        profile: ``(K, 2)`` radius and height above the foot, from below to above, metres.
        paint: Of places around the body, on the largest radius, and along the profile.
        glow: See `Surfels`.
    """

    foot: npt.ArrayLike
    profile: npt.ArrayLike
    paint: Paint
    glow: float = 0.0

    def surfels(self, cell_m: float) -> Surfels:
        """Cover it with rings of cells."""
        p = np.asarray(self.profile, dtype=np.float64)
        s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(p, axis=0).T))])
        n = max(round(s[-1] / cell_m), 2)
        at = (np.arange(n) + 0.5) / n * s[-1]
        radius, height = np.interp(at, s, p[:, 0]), np.interp(at, s, p[:, 1])
        step = s[-1] / n
        dr = np.interp(at + step / 4, s, p[:, 0]) - np.interp(at - step / 4, s, p[:, 0])
        dz = np.interp(at + step / 4, s, p[:, 1]) - np.interp(at - step / 4, s, p[:, 1])
        around = np.maximum(np.round(2 * np.pi * radius / cell_m), 5).astype(np.int64)
        ring, turn, _ = grid_cells(around, np.ones(n, dtype=np.int64))
        angle = 2 * np.pi * turn
        out = np.column_stack([np.cos(angle), np.sin(angle)])
        length = np.maximum(np.hypot(dr, dz), 1e-12)
        normals = np.column_stack([out * (dz / length)[ring, None], -(dr / length)[ring]])
        tangents = np.column_stack([-out[:, 1], out[:, 0], np.zeros(len(ring))])
        means = np.asarray(self.foot) + np.column_stack([out * radius[ring, None], height[ring]])
        sizes = np.column_stack([(2 * np.pi * radius / around)[ring], np.full(len(ring), step)])
        rgb = self.paint(turn * 2 * np.pi * float(p[:, 0].max()), at[ring])
        return Surfels(
            means,
            normals,
            tangents,
            np.maximum(sizes, 0.2 * step),
            rgb,
            np.full(len(ring), self.glow),
        )


@dataclass(frozen=True)
class Leaves:
    """Leaves that hang in the air: centres and normals ``(N, 3)``, colours ``(N, 3)``, one size in
    metres.
    """

    means: F64
    normals: F64
    rgb: F64
    size_m: float

    def surfels(self, cell_m: float) -> Surfels:
        """Return one surfel a leaf; where cells are larger than leaves fewer and larger ones."""
        every = max(1, round((cell_m / self.size_m) ** 2))
        means = self.means[::every]
        normals = self.normals[::every]
        rgb = self.rgb[::every]
        steep = np.where(np.abs(normals[:, 2:]) < 0.9, [[0.0, 0.0, 1.0]], [[1.0, 0.0, 0.0]])
        tangents = np.cross(steep, normals)
        tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
        size = self.size_m * float(np.sqrt(every))
        return Surfels(
            means,
            normals,
            tangents,
            np.tile([size, 0.7 * size], (len(means), 1)),
            rgb,
            np.zeros(len(means)),
        )


@dataclass(frozen=True)
class Block:
    """A box that throws shadows: its rigid frame ``T_world_block (4, 4)`` at the middle, and half
    sizes ``(3,)``, metres.
    """

    T: F64
    half: F64


@dataclass(frozen=True)
class Thing:
    """Something that stands somewhere: parts and the blocks that throw its shadow, both in its own
    frame, feet at the origin.
    """

    parts: tuple[Part, ...]
    blocks: tuple[Block, ...] = ()

    def surfels(self, cell_m: float) -> Surfels:
        """Cover all parts."""
        return joined([part.surfels(cell_m) for part in self.parts])


def upright(x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> F64:
    """Return the frame ``(4, 4)`` of what stands at a place and is turned about the vertical."""
    T = np.eye(4)
    T[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    T[:3, 3] = x, y, z
    return T


def block(low: npt.ArrayLike, high: npt.ArrayLike) -> Block:
    """Return a block between two corners ``(3,)``."""
    a, b = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    return Block(upright(*((a + b) / 2)), (b - a) / 2)


def box(
    low: npt.ArrayLike,
    high: npt.ArrayLike,
    paint: Paint,
    top: Paint | None = None,
    front: Paint | None = None,
) -> list[Panel]:
    """Return the six sides of a box between two corners; ``top`` and ``front`` (towards -y) may
    have their own paint.
    """
    (x0, y0, z0), (x1, y1, z1) = (
        np.asarray(low, dtype=np.float64),
        np.asarray(high, dtype=np.float64),
    )
    x = np.array([x1 - x0, 0, 0])
    y = np.array([0, y1 - y0, 0])
    z = np.array([0, 0, z1 - z0])
    return [
        Panel((x0, y0, z0), x, z, front or paint),
        Panel((x1, y1, z0), -x, z, paint),
        Panel((x0, y1, z0), -y, z, paint),
        Panel((x1, y0, z0), y, z, paint),
        Panel((x0, y0, z1), x, y, top or paint),
        Panel((x0, y1, z0), x, -y, paint),
    ]


def solid(*boxes: tuple[npt.ArrayLike, npt.ArrayLike, Paint]) -> Thing:
    """Return a thing of boxes, each of which throws a shadow."""
    return Thing(
        tuple(p for low, high, paint in boxes for p in box(low, high, paint)),
        tuple(block(low, high) for low, high, _ in boxes),
    )
