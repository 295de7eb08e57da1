"""Scene-graph nodes: named clouds at several levels of detail."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from alpasim_plugin.core.types import F64, I64
from alpasim_plugin.gaussians.cloud import GaussianCloud


@dataclass(frozen=True, eq=False)
class Level:
    """One level of detail: Gaussians that stand for cells of about ``cell_m``."""

    cell_m: float
    cloud: GaussianCloud


@dataclass(frozen=True, eq=False)
class SceneNode:
    """A part of a scene that is culled and drawn as a whole.

    Attributes:
        name: Unique within the scene; an actor's node bears the actor's id.
        kind: ``background`` (world coordinates) or ``actor`` (box frame: origin at the box centre, x length, y width, z height).
        levels: Finest first.
        far_m: Beyond this distance the node is not drawn.
    """

    name: str
    kind: str
    levels: tuple[Level, ...]
    far_m: float = 1.0e9

    @cached_property
    def sphere(self) -> tuple[F64, float]:
        """Return a centre ``(3,)`` and radius around the three-sigma extent of all levels."""
        clouds = [level.cloud for level in self.levels if len(level.cloud)]
        if not clouds:
            return np.zeros(3), 0.0
        reach = [3 * c.scales.max(axis=1, keepdims=True) for c in clouds]
        low = np.min([(c.means - r).min(axis=0) for c, r in zip(clouds, reach, strict=True)], axis=0)
        high = np.max([(c.means + r).max(axis=0) for c, r in zip(clouds, reach, strict=True)], axis=0)
        return (low + high) / 2, float(np.linalg.norm(high - low) / 2)


def split_by_tile(cloud: GaussianCloud, tile: I64) -> dict[int, GaussianCloud]:
    """Return the Gaussians of each tile; ``tile (N,)`` names the tile of each Gaussian."""
    order = np.argsort(tile, kind="stable")
    ids, first = np.unique(tile[order], return_index=True)
    return {int(i): cloud.take(part) for i, part in zip(ids, np.split(order, first[1:]), strict=True)}


def nodes_by_tile(prefix: str, levels: list[tuple[float, GaussianCloud, I64]], far_m: float = 1.0e9) -> list[SceneNode]:
    """Group clouds of several levels into one node per tile.

    Args:
        prefix: Start of the nodes' names.
        levels: (cell size, cloud, tile of each Gaussian), finest first. A tile may lack its finest levels, not its coarser ones.
        far_m: See `SceneNode`.
    """
    by_tile: dict[int, list[Level]] = {}
    for cell_m, cloud, tile in levels:
        for i, part in split_by_tile(cloud, tile).items():
            by_tile.setdefault(i, []).append(Level(cell_m, part))
    return [SceneNode(f"{prefix}/{i}", "background", tuple(by_tile[i]), far_m) for i in sorted(by_tile)]
