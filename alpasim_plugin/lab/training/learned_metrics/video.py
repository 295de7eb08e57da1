"""Train the video judge's features on clean windows: what is driven where, how fast, and in which
order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F32
from alpasim_plugin.lab.learned_metrics.nets.layers import initialise
from alpasim_plugin.lab.learned_metrics.nets.video_net import (
    FEATURES,
    FRAMES,
    VideoNet,
    window_input,
)
from alpasim_plugin.lab.training.learned_metrics.frames import jitter_colours
from alpasim_plugin.lab.training.learned_metrics.labels import for_training
from alpasim_plugin.lab.training.pair_store import PairSequence, pairs_digest
from alpasim_plugin.lab.training.semantics import CLASSES, class_masks
from alpasim_plugin.lab.training.trainer import Loss

ORDERS = ("forward", "reversed", "shuffled")
SPEED_MPS, YAW_RADPS = 10.0, 0.1  # units of the regressed motion
MAP_CELL = 16
OCCUPANCY_GRID = (
    3,
    4,
)  # rows, columns: each cell of the image has one label a map class, whether it occurs there


@dataclass(frozen=True)
class VideoRecipe:
    """Batch and loss weights.

    Args:
        batch: Windows.
        family, order, motion, occupancy: Loss weights.
        seed: Of weights and draws.
    """

    batch: int = 12
    family: float = 0.5
    order: float = 1.0
    motion: float = 1.0
    occupancy: float = 2.0
    seed: int = 0


@dataclass(frozen=True)
class VideoBatch:
    """B windows ``(B, 3, 16, 64, 112)``; family and order ``(B,)``, speed and yaw rate ``(B, 2)``,
    map classes ``(B, K)``.
    """

    video: Tensor
    family: Tensor
    order: Tensor
    motion: Tensor
    occupancy: Tensor


class VideoTraining(nn.Module):
    """The features with the heads of their training."""

    def __init__(self, families: int) -> None:
        super().__init__()
        self.net = VideoNet()
        self.family = nn.Linear(FEATURES, families)
        self.order = nn.Linear(FEATURES, len(ORDERS))
        self.motion = nn.Linear(FEATURES, 2)
        self.occupancy = nn.Linear(FEATURES, len(CLASSES) * OCCUPANCY_GRID[0] * OCCUPANCY_GRID[1])


class VideoTask:
    """Batches and loss of the video judge, for `Trainer`."""

    def __init__(self, sequences: Sequence[PairSequence], recipe: VideoRecipe) -> None:
        self.sequences, self.recipe = for_training(sequences), recipe
        self.families = sorted({str(s.info["family"]) for s in self.sequences})
        self.module = VideoTraining(len(self.families))
        initialise(self.module, recipe.seed)

    @property
    def facts(self) -> dict[str, Any]:
        """Identify data and recipe."""
        return {
            "sequences": len(self.sequences),
            "pairs": pairs_digest(self.sequences),
            "families": self.families,
            "recipe": asdict(self.recipe),
        }

    def batch(self, index: int) -> VideoBatch:
        """Make batch ``index``."""
        rows = [self._example(index * self.recipe.batch + i) for i in range(self.recipe.batch)]
        return VideoBatch(
            *(torch.from_numpy(np.stack([np.asarray(row[k]) for row in rows])) for k in range(5))
        )

    def loss(self, batch: VideoBatch, index: int) -> Loss:
        """Return the loss of a batch and its parts; a shuffled window has no motion."""
        del index
        r, module = self.recipe, self.module
        x = module.net(batch.video)
        moves = (batch.order < ORDERS.index("shuffled")).float()
        motion = F.smooth_l1_loss(module.motion(x), batch.motion, beta=0.1, reduction="none").sum(1)
        order = module.order(x)
        parts = {
            "family": r.family * F.cross_entropy(module.family(x), batch.family),
            "order": r.order * F.cross_entropy(order, batch.order),
            "motion": r.motion * (motion * moves).sum() / moves.sum().clamp(min=1),
            "occupancy": r.occupancy
            * F.binary_cross_entropy_with_logits(module.occupancy(x), batch.occupancy),
        }
        numbers = {name: float(value.detach()) for name, value in parts.items()}
        numbers["order_right"] = float((order.argmax(1) == batch.order).float().mean())
        numbers["family_right"] = float((module.family(x).argmax(1) == batch.family).float().mean())
        return torch.stack(list(parts.values())).sum(), numbers

    def _example(self, number: int) -> tuple[Any, ...]:
        rng = stream("training", self.recipe.seed, "judge.video", number)
        sequence = self.sequences[int(rng.integers(len(self.sequences)))]
        clip = sequence.clip
        start = int(rng.integers(len(clip) - FRAMES + 1))
        cut = clip.cut(start, FRAMES)
        order = int(rng.integers(len(ORDERS)))
        at = (
            np.arange(FRAMES)
            if order == 0
            else np.arange(FRAMES)[::-1]
            if order == 1
            else rng.permutation(FRAMES)
        )
        frames = jitter_colours(
            rng, np.array(cut.rgb_gt[at]).reshape(-1, cut.rgb_gt.shape[2], 3)
        ).reshape(cut.rgb_gt.shape)
        poses, seconds = cut.T_world_camera, float(cut.t_us[-1] - cut.t_us[0]) * 1e-6
        step = np.diff(poses[:, :3, 3], axis=0)
        speed = float(np.linalg.norm(step, axis=1).sum()) / seconds
        turn = np.arctan2(poses[-1, 1, 2], poses[-1, 0, 2]) - np.arctan2(
            poses[0, 1, 2], poses[0, 0, 2]
        )
        yaw_rate = float((turn + np.pi) % (2 * np.pi) - np.pi) / seconds
        video, occupancy = window_input(frames), _occupancy(np.array(cut.sdmap[FRAMES // 2]))
        if rng.random() < 0.5:
            video = np.ascontiguousarray(video[..., ::-1])
            occupancy = np.ascontiguousarray(occupancy[..., ::-1])
            yaw_rate = -yaw_rate
        sign = -1.0 if ORDERS[order] == "reversed" else 1.0
        motion = np.array([sign * speed / SPEED_MPS, sign * yaw_rate / YAW_RADPS], dtype=np.float32)
        return (
            video,
            self.families.index(str(sequence.info["family"])),
            order,
            motion,
            occupancy.ravel(),
        )


def _occupancy(sdmap: Any) -> F32:
    """Return ``(classes, 3, 4)``: whether a class of the map is in a part of the image."""
    h, w = (side // MAP_CELL * MAP_CELL for side in sdmap.shape[:2])
    masks = class_masks(sdmap[:h, :w], MAP_CELL)
    rows, columns = (
        np.array_split(np.arange(n), parts)
        for n, parts in zip(masks.shape[1:], OCCUPANCY_GRID, strict=True)
    )
    cells = [[masks[:, r][:, :, c].max(axis=(1, 2)) for c in columns] for r in rows]
    return np.ascontiguousarray(np.moveaxis(np.array(cells, dtype=np.float32), -1, 0))
