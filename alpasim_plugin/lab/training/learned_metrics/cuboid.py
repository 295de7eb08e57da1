"""Train the cuboid judge on clean frames and the boxes of the vehicles in them."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F32, F64
from alpasim_plugin.lab.learned_metrics.nets.cuboid_net import CLASSES, STRIDE, CuboidNet, encode
from alpasim_plugin.lab.learned_metrics.nets.layers import initialise
from alpasim_plugin.lab.learned_metrics.types import Cuboid, hull_pixels
from alpasim_plugin.lab.training.learned_metrics.frames import LabelledFrames, jitter_colours
from alpasim_plugin.lab.training.trainer import Loss

NUMBERS = 8  # offset (2), depth, sizes (3), sine and cosine


@dataclass(frozen=True)
class CuboidRecipe:
    """Batch, augmentation, loss weights.

    Args:
        batch: Frames.
        zoom: Largest magnification of a frame; its focal length grows with it.
        heat, numbers, kind: Loss weights.
        seed: Of weights and draws.
    """

    batch: int = 10
    zoom: float = 1.3
    heat: float = 1.0
    numbers: float = 1.0
    kind: float = 0.2
    seed: int = 0


@dataclass(frozen=True)
class CuboidBatch:
    """B frames ``(B, 3, H, W)`` in [-1, 1]; heat, middles (0 or 1) and class ``(B, h, w)``,
    regressed numbers ``(B, 8, h, w)``.
    """

    image: Tensor
    heat: Tensor
    middle: Tensor
    numbers: Tensor
    kind: Tensor


class CuboidTask:
    """Batches and loss of the cuboid judge, for `Trainer`."""

    def __init__(self, data: LabelledFrames, recipe: CuboidRecipe) -> None:
        self.data, self.recipe = data, recipe
        self.module = CuboidNet()
        initialise(self.module, recipe.seed)
        self.module.rest()
        self.module.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    @property
    def facts(self) -> dict[str, Any]:
        """Identify data and recipe."""
        return {**self.data.facts, "recipe": asdict(self.recipe)}

    def batch(self, index: int) -> CuboidBatch:
        """Make batch ``index``."""
        rows = [self._example(index * self.recipe.batch + i) for i in range(self.recipe.batch)]
        return CuboidBatch(
            *(torch.from_numpy(np.stack([row[k] for row in rows])) for k in range(5))
        )

    def loss(self, batch: CuboidBatch, index: int) -> Loss:
        """Return the loss of a batch and its parts: CenterNet's focal loss for middles, absolute
        errors, cross entropy of classes.
        """
        del index
        r, made = (
            self.recipe,
            self.module(batch.image.contiguous(memory_format=torch.channels_last)),
        )
        count = batch.middle.sum().clamp(min=1)
        log_p, log_q = F.logsigmoid(made[:, 0]), F.logsigmoid(-made[:, 0])
        p = torch.sigmoid(made[:, 0])
        focal = (
            batch.middle * (1 - p) ** 2 * log_p
            + (1 - batch.middle) * (1 - batch.heat) ** 4 * p**2 * log_q
        )
        error = (
            F.smooth_l1_loss(made[:, 1 : 1 + NUMBERS], batch.numbers, beta=0.05, reduction="none")
        ).sum(1)
        kind = F.cross_entropy(made[:, 1 + NUMBERS :], batch.kind, reduction="none")
        parts = {
            "heat": -r.heat * focal.sum() / count,
            "numbers": r.numbers * (error * batch.middle).sum() / count,
            "kind": r.kind * (kind * batch.middle).sum() / count,
        }
        numbers = {name: float(value.detach()) for name, value in parts.items()}
        off = ((made[:, 3] - batch.numbers[:, 2]).abs() * batch.middle).sum() / count
        numbers["depth_share"] = float(off.detach())
        return torch.stack(list(parts.values())).sum(), numbers

    def _example(self, number: int) -> tuple[Any, ...]:
        rng = stream("training", self.recipe.seed, "judge.cuboid", number)
        image, labels, row = self.data.draw(rng)
        cuboids, K = labels.cuboids_of(row), labels.camera.K
        height, width = image.shape[:2]
        if rng.random() < 0.5:
            image = np.ascontiguousarray(image[:, ::-1])
            cuboids = [replace(c, x_m=-c.x_m, yaw_rad=np.pi - c.yaw_rad) for c in cuboids]
            K = np.array([[K[0, 0], 0, width - K[0, 2]], K[1], K[2]])
        zoom = float(rng.uniform(1.0, self.recipe.zoom))
        left, top = (float(rng.uniform(0, side * (zoom - 1))) for side in (width, height))
        A = np.array([[zoom, 0, -left], [0, zoom, -top], [0, 0, 1]])
        # Pixel centres lie at halves for K, at integers for cv2.
        moved = A + np.array([[0, 0, 0.5 * zoom - 0.5], [0, 0, 0.5 * zoom - 0.5], [0, 0, 0]])
        image = cv2.warpAffine(
            jitter_colours(rng, image),
            moved[:2],
            (width, height),
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        picture = np.moveaxis(image, -1, 0).astype(np.float32) / np.float32(127.5) - 1
        return (picture, *cuboid_cells(cuboids, A @ K, width, height))


def cuboid_cells(
    cuboids: list[Cuboid], K: F64, width: int, height: int
) -> tuple[F32, F32, F32, Any]:
    """Return heat ``(h, w)``, middles ``(h, w)``, numbers ``(8, h, w)`` and classes ``(h, w)`` of a
    frame's vehicles.

    Vehicles whose middle is outside the image are left out: their cell does not exist.
    """
    h, w = height // STRIDE, width // STRIDE
    heat, middle = np.zeros((h, w), dtype=np.float32), np.zeros((h, w), dtype=np.float32)
    numbers, kind = np.zeros((NUMBERS, h, w), dtype=np.float32), np.zeros((h, w), dtype=np.int64)
    rows, columns = np.mgrid[:h, :w]
    for cuboid in sorted(cuboids, key=lambda c: -c.z_m):  # the nearest is written last
        coded, hull = encode(cuboid, K, width), hull_pixels(cuboid, K)
        if coded is None or hull is None:
            continue
        u, v, values = coded
        column, row = int(u), int(v)
        if not (0 <= u < w and 0 <= v < h):
            continue
        spread = np.maximum(np.ptp(hull, axis=0) / STRIDE / 8, 0.4)
        bump = np.exp(
            -0.5 * (((columns - column) / spread[0]) ** 2 + ((rows - row) / spread[1]) ** 2)
        )
        heat = np.maximum(heat, bump).astype(np.float32)
        middle[row, column] = 1
        numbers[:, row, column] = u - column, v - row, *values[1:]
        kind[row, column] = CLASSES.index(cuboid.label)
    return heat, middle, numbers, kind
