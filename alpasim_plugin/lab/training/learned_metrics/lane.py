"""Train the lane judge on clean frames and the map's painted lines."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F32, F64
from alpasim_plugin.lab.learned_metrics.nets.ground_view import CELL_M, HALF_WIDTH_M, GroundView
from alpasim_plugin.lab.learned_metrics.nets.lane_net import CELLS, LaneNet
from alpasim_plugin.lab.learned_metrics.nets.layers import initialise
from alpasim_plugin.lab.learned_metrics.types import FORWARD_M
from alpasim_plugin.lab.training.learned_metrics.frames import LabelledFrames, jitter_colours
from alpasim_plugin.lab.training.trainer import Loss

STEEPEST = 2.0  # metres to the side per row; what runs across the road is no lane line


@dataclass(frozen=True)
class LaneRecipe:
    """Batch, augmentation, loss weights.

    Args:
        batch: Frames.
        shift_m: The ground is seen from so far to the side at most.
        rare: Weight of a cell with a line.
        offset, slope: Loss weights beside the existence's 1.
        seed: Of weights and draws.
    """

    batch: int = 12
    shift_m: float = 1.5
    rare: float = 3.0
    offset: float = 2.0
    slope: float = 0.5
    seed: int = 0


@dataclass(frozen=True)
class LaneBatch:
    """B frames on the ground ``(B, 4, 58, 216)``, and ``(B, 4, 29, 54)``: line (0 or 1), offset,
    slope, counted (0: outside the image).
    """

    ground: Tensor
    cells: Tensor


class LaneTask:
    """Batches and loss of the lane judge, for `Trainer`."""

    def __init__(self, data: LabelledFrames, recipe: LaneRecipe) -> None:
        self.data, self.recipe = data, recipe
        self.module = LaneNet()
        initialise(self.module, recipe.seed)
        self.module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # a quarter faster

    @property
    def facts(self) -> dict[str, Any]:
        """Identify data and recipe."""
        return {**self.data.facts, "recipe": asdict(self.recipe)}

    def batch(self, index: int) -> LaneBatch:
        """Make batch ``index``."""
        rows = [self._example(index * self.recipe.batch + i) for i in range(self.recipe.batch)]
        ground, cells = (torch.from_numpy(np.stack([row[k] for row in rows])) for k in (0, 1))
        return LaneBatch(ground, cells)

    def loss(self, batch: LaneBatch, index: int) -> Loss:
        """Return the loss of a batch and its parts."""
        del index
        r, made = (
            self.recipe,
            self.module(batch.ground.contiguous(memory_format=torch.channels_last)),
        )
        line, offset, slope, counted = batch.cells.unbind(1)
        exists = F.binary_cross_entropy_with_logits(
            made[:, 0], line, pos_weight=torch.tensor(r.rare), reduction="none"
        )
        lines = (line * counted).sum().clamp(min=1)
        parts = {
            "exists": (exists * counted).sum() / counted.sum().clamp(min=1) * 10,
            "offset": r.offset
            * (
                F.smooth_l1_loss(made[:, 1], offset, beta=0.1, reduction="none") * line * counted
            ).sum()
            / lines,
            "slope": r.slope
            * (
                F.smooth_l1_loss(made[:, 2], slope, beta=0.1, reduction="none") * line * counted
            ).sum()
            / lines,
        }
        numbers = {name: float(value.detach()) for name, value in parts.items()}
        found = (made[:, 0] > 0).float() * counted
        numbers["precision"] = float((found * line).sum() / found.sum().clamp(min=1))
        numbers["recall"] = float((found * line).sum() / lines)
        return torch.stack(list(parts.values())).sum(), numbers

    def _example(self, number: int) -> tuple[F32, F32]:
        rng = stream("training", self.recipe.seed, "judge.lane", number)
        image, labels, row = self.data.draw(rng)
        shift_m = float(rng.uniform(-self.recipe.shift_m, self.recipe.shift_m))
        view = GroundView(labels.camera, shift_m)
        ground = view(jitter_colours(rng, image))
        lanes = (
            np.array([lane.lateral_m for lane in labels.lanes_of(row)]).reshape(-1, len(FORWARD_M))
            - shift_m
        )
        if rng.random() < 0.5:
            ground, lanes = np.ascontiguousarray(ground[:, :, ::-1]), -lanes
        return ground, lane_cells(lanes, ground[3])


def lane_cells(lanes: F64, inside: F32) -> F32:
    """Return ``(4, 29, 54)``: where lines pass, offset to the right of the cell's middle in cells,
    slope in metres per row, counted.

    Args:
        lanes: ``(L, 29)`` lateral positions, metres; NaN where not visible.
        inside: ``(58, 216)`` 1 where the ground is in the image.
    """
    out = np.zeros((4, len(FORWARD_M), CELLS), dtype=np.float32)
    out[3] = inside.reshape(len(FORWARD_M), 2, CELLS, -1).mean(axis=(1, 3)) > 0.5
    for lane in lanes:
        slope = _slopes(lane)
        at = (HALF_WIDTH_M - lane) / CELL_M  # cells from the left border
        for row in np.flatnonzero(
            np.isfinite(lane) & (np.abs(slope) <= STEEPEST) & (at >= 0) & (at < CELLS)
        ):
            cell = int(at[row])
            out[:3, row, cell] = 1, at[row] - cell - 0.5, slope[row]
    return out


def _slopes(lane: F64) -> F64:
    """Return the change of a lane to the next row (else from the last one), 0 for a single
    point.
    """
    ahead = np.append(lane[1:] - lane[:-1], np.nan)
    behind = np.insert(lane[1:] - lane[:-1], 0, np.nan)
    return np.asarray(
        np.where(np.isfinite(ahead), ahead, np.where(np.isfinite(behind), behind, 0.0))
    )
