"""Train the feature network of `perceptual-syn` with three losses on one backbone.

Semantics: predict the classes of the map in each cell from the clean frame. Reconstruction: pixels
    are a linear function of the features of
the first two stages, so that features keep all pixel changes. Distance: the distance to a distorted
image matches the target (training/perceptual_targets.py) and increases with the strength of the
distortion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F32, U8
from alpasim_plugin.lab.training.distortions import Distortion, draw_distortion
from alpasim_plugin.lab.training.pair_store import PairSequence, pairs_digest
from alpasim_plugin.lab.training.perceptual_targets import target_distance
from alpasim_plugin.lab.training.semantics import CLASSES, class_masks
from alpasim_plugin.lab.training.trainer import Loss
from alpasim_plugin.lab.video_metrics.perceptual_net import FeatureNet, PerceptualDistance

CELL = 4  # side of a labelled cell, pixels: the resolution of the second stage
LOG_FLOOR = 0.01  # distances far below this count as equal
RENDER = "render"  # kind of distortion: the degraded render of the pair


@dataclass(frozen=True)
class PerceptualRecipe:
    """Batch and loss weights.

    Args:
        images: Clean images in a batch; each has three distorted versions.
        side: Of an image, pixels; a multiple of 16.
        zoom: Range of the crop size relative to ``side``.
        shapes_share: Share of synthetic images of overlapping textured shapes instead of crops.
        render_share: Share of distortions that blend in the pair's degraded render.
        semantics, readout, order: Loss weights; the distance loss has weight 1.
        seed: Of weights and sampling.
    """

    images: int = 12
    side: int = 80
    zoom: tuple[float, float] = (0.8, 1.8)
    shapes_share: float = 0.25
    render_share: float = 0.15
    semantics: float = 0.5
    readout: float = 0.5
    order: float = 1.0
    seed: int = 0


@dataclass(frozen=True)
class PerceptualBatch:
    """Images in [-1, 1] and targets.

    Args:
        clean: ``(N, 3, S, S)``.
        damaged: ``(3, N, 3, S, S)``: a weak distortion, the same stronger, another one.
        targets: ``(3, N)`` distances to the clean image.
        classes: ``(N, len(CLASSES), S / 4, S / 4)`` of 0 and 1.
        labelled: ``(N,)`` 1 where classes are known.
    """

    clean: Tensor
    damaged: Tensor
    targets: Tensor
    classes: Tensor
    labelled: Tensor


class PerceptualTraining(nn.Module):
    """The distance with the auxiliary heads of its training."""

    def __init__(self, net: PerceptualDistance) -> None:
        super().__init__()
        self.net = net
        one, two, three, four = net.trunk.widths
        self.semantic_heads = nn.ModuleList(
            [nn.Conv2d(c, len(CLASSES), 1) for c in (two, three, four)]
        )
        self.reconstruct_half = nn.Conv2d(one, 3 * 2 * 2, 1)
        self.reconstruct_quarter = nn.Conv2d(two, 3 * CELL * CELL, 1)

    def semantics(self, features: list[Tensor]) -> Tensor:
        """Return logits ``(N, classes, H / 4, W / 4)``."""
        size = features[1].shape[2:]
        parts = [
            F.interpolate(head(x), size=size, mode="bilinear")
            for head, x in zip(self.semantic_heads, features[1:], strict=True)
        ]
        return torch.stack(parts).sum(0)

    def readout_error(self, features: list[Tensor], image: Tensor) -> Tensor:
        """Return the mean absolute error of the linear reconstruction of ``image`` from the first
        two stages.
        """
        half = F.pixel_shuffle(self.reconstruct_half(features[0]), 2)
        quarter = F.pixel_shuffle(self.reconstruct_quarter(features[1]), CELL)
        return (half - image).abs().mean() + (quarter - image).abs().mean()


class PerceptualTask:
    """Batches and loss, for `Trainer`."""

    def __init__(self, sequences: Sequence[PairSequence], recipe: PerceptualRecipe) -> None:
        self.sequences, self.recipe = sequences, recipe
        self.module = PerceptualTraining(PerceptualDistance())
        _init_weights(self.module, torch.Generator().manual_seed(recipe.seed))
        _he_init(self.module.net.trunk)

    @property
    def facts(self) -> dict[str, Any]:
        """Identify the training data and recipe."""
        return {
            "sequences": [s.name for s in self.sequences],
            "pairs": pairs_digest(self.sequences),
            "recipe": asdict(self.recipe),
        }

    def batch(self, index: int) -> PerceptualBatch:
        """Make batch ``index``."""
        r = self.recipe
        rows = [make_example(self.sequences, r, index * r.images + i) for i in range(r.images)]
        clean = torch.stack([to_image_tensor(row.clean) for row in rows])
        damaged = torch.stack(
            [torch.stack([to_image_tensor(row.damaged[k]) for row in rows]) for k in range(3)]
        )
        targets = torch.tensor([[row.targets[k] for row in rows] for k in range(3)])
        classes = torch.stack([torch.from_numpy(row.classes) for row in rows])
        return PerceptualBatch(
            clean, damaged, targets, classes, torch.tensor([float(row.labelled) for row in rows])
        )

    def loss(self, batch: PerceptualBatch, index: int) -> Loss:
        """Return the loss of a batch and its parts."""
        del index
        r, module = self.recipe, self.module
        n = len(batch.clean)
        everything = torch.cat([batch.clean, batch.damaged.flatten(0, 1)])
        features = module.net.trunk(everything)
        clean = [x[:n] for x in features]
        made = torch.stack(
            [
                module.net.feature_distance([x[n * k : n * (k + 1)] for x in features], clean)
                for k in (1, 2, 3)
            ]
        )  # (3, N)
        target = (batch.targets + LOG_FLOOR).log()
        log_distance = (made + LOG_FLOOR).log()
        step = (target[1] - target[0]).clamp(min=0)  # target difference between the two strengths
        parts = {
            "distance": F.smooth_l1_loss(log_distance, target, beta=0.3),
            "order": r.order * F.relu(0.7 * step - (log_distance[1] - log_distance[0])).mean(),
            "semantics": r.semantics * self._semantics(clean, batch),
            "readout": r.readout * module.readout_error(features, everything),
        }
        numbers = {name: float(value.detach()) for name, value in parts.items()}
        numbers["wrong_order"] = float(
            ((made[1] <= made[0]) & (step > 0.1)).float().sum()
            / (step > 0.1).float().sum().clamp(min=1)
        )
        return torch.stack(list(parts.values())).sum(), numbers

    def _semantics(self, features: list[Tensor], batch: PerceptualBatch) -> Tensor:
        logits = self.module.semantics(features)
        rare = torch.full((len(CLASSES), 1, 1), 4.0)
        error = F.binary_cross_entropy_with_logits(
            logits, batch.classes, pos_weight=rare, reduction="none"
        )
        return (error.mean((1, 2, 3)) * batch.labelled).sum() / batch.labelled.sum().clamp(min=1)


@dataclass(frozen=True)
class Example:
    """One clean image ``(S, S, 3)`` in 0 to 1, three distorted ones, their targets, and labels."""

    clean: F32
    damaged: tuple[F32, F32, F32]
    targets: tuple[float, float, float]
    classes: F32
    labelled: bool


def make_example(
    sequences: Sequence[PairSequence], recipe: PerceptualRecipe, index: int
) -> Example:
    """Make example ``index``: a function of the data, the recipe and the index only."""
    rng = stream("training", recipe.seed, "perceptual.example", index)
    render: F32 | None = None
    if rng.random() < recipe.shapes_share:
        clean, classes = (
            draw_shapes(rng, recipe.side),
            np.zeros((len(CLASSES), recipe.side // CELL, recipe.side // CELL), dtype=np.float32),
        )
        labelled = False
    else:
        clean, render, classes = _cut(rng, sequences[int(rng.integers(len(sequences)))], recipe)
        labelled = True
    first, second = (_Degradation.draw(rng, clean, render, recipe) for _ in range(2))
    weak, strong = np.sort(rng.uniform(0.02, 1.0, 2) ** 1.5)
    damaged = first(clean, weak), first(clean, strong), second(clean, float(rng.uniform(0.02, 1.0)))
    return Example(
        clean,
        tuple(d[0] for d in damaged),
        tuple(d[1] for d in damaged),
        classes,
        labelled,  # type: ignore[arg-type]
    )


@dataclass(frozen=True)
class _Degradation:
    """A synthetic distortion, or blending with the pair's degraded render."""

    made: Distortion | None
    render: F32 | None

    @classmethod
    def draw(
        cls, rng: np.random.Generator, clean: F32, render: F32 | None, recipe: PerceptualRecipe
    ) -> _Degradation:
        if render is not None and rng.random() < recipe.render_share:
            return cls(None, render)
        return cls(draw_distortion(rng, clean.shape), None)

    def __call__(self, clean: F32, strength: float) -> tuple[F32, float]:
        """Return the distorted image and its target."""
        if self.made is None:
            assert self.render is not None
            out = clean + np.float32(strength) * (self.render - clean)
            return out, target_distance(clean, out, RENDER)
        out = self.made(clean, strength)
        return out, target_distance(clean, out, self.made.kind, self.made.displacement_px(strength))


def _cut(
    rng: np.random.Generator, sequence: PairSequence, recipe: PerceptualRecipe
) -> tuple[F32, F32, F32]:
    """Return a random crop of a random frame, its degraded render and its classes, with random
    flip, gain and gamma.
    """
    clip = sequence.clip
    h, w = clip.rgb_gt.shape[1:3]
    t = int(rng.integers(len(clip)))
    side = min(round(recipe.side * float(rng.uniform(*recipe.zoom))), h, w)
    top, left = int(rng.integers(h - side + 1)), int(rng.integers(w - side + 1))
    flip = bool(rng.random() < 0.5)
    gain = float(rng.uniform(0.6, 1.4))
    gamma = float(rng.uniform(0.6, 1.5))

    def cut(frames: U8, how: int) -> U8:
        piece = np.array(frames[t, top : top + side, left : left + side])
        return np.asarray(
            cv2.resize(
                piece[:, ::-1] if flip else piece, (recipe.side, recipe.side), interpolation=how
            )
        )

    how = cv2.INTER_AREA if side >= recipe.side else cv2.INTER_LINEAR
    clean, render = (
        np.clip((cut(x, how).astype(np.float32) / 255) ** gamma * gain, 0, 1)
        for x in (clip.rgb_gt, clip.rgb_input)
    )
    return (
        clean.astype(np.float32),
        render.astype(np.float32),
        class_masks(cut(clip.sdmap, cv2.INTER_NEAREST), CELL),
    )


def draw_shapes(rng: np.random.Generator, side: int) -> F32:
    """Draw an image ``(side, side, 3)`` of overlapping textured ellipses and boxes: edges of all
    contrasts and sizes.
    """
    image = np.full((side, side, 3), rng.random(3), dtype=np.float32)
    for _ in range(int(rng.integers(5, 80))):
        size = side * 0.5 * float(rng.random()) ** 3 + 1
        centre = tuple(int(v) for v in rng.integers(0, side, 2))
        axes = (max(1, round(size)), max(1, round(size * rng.uniform(0.1, 1))))
        colour = tuple(float(v) for v in rng.random(3))
        angle = float(rng.uniform(0, 180))
        if rng.random() < 0.5:
            cv2.ellipse(image, centre, axes, angle, 0, 360, colour, -1, cv2.LINE_8)
        else:
            corners = cv2.boxPoints((centre, (2.0 * axes[0], 2.0 * axes[1]), angle)).astype(
                np.int32
            )
            cv2.fillPoly(image, [corners], colour)
    texture = cv2.GaussianBlur(
        rng.standard_normal((side, side, 1), dtype=np.float32), (0, 0), float(rng.uniform(0.4, 2))
    )[..., None]
    image = image + np.float32(rng.uniform(0, 0.15)) * texture / (texture.std() + 1e-6)
    return np.asarray(np.clip(cv2.GaussianBlur(image, (0, 0), 0.5), 0, 1), dtype=np.float32)


def to_image_tensor(image: F32) -> Tensor:
    """Map ``(H, W, 3)`` in 0 to 1 to ``(3, H, W)`` in [-1, 1]."""
    return torch.from_numpy(np.ascontiguousarray(image)).permute(2, 0, 1) * 2 - 1


def _init_weights(module: nn.Module, generator: torch.Generator) -> None:
    """Initialise convolutions as torch does by default, from the given generator."""
    for conv in module.modules():
        if isinstance(conv, nn.Conv2d):
            bound = conv.weight[0].numel() ** -0.5
            nn.init.uniform_(conv.weight, -bound, bound, generator=generator)
            nn.init.uniform_(conv.bias, -bound, bound, generator=generator)  # type: ignore[arg-type]


def _he_init(trunk: FeatureNet) -> None:
    """Rescale the weights for leaky ReLU units (He et al., 2015)."""
    for module in trunk.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.zeros_(module.bias)  # type: ignore[arg-type]
            with torch.no_grad():
                fan_in = module.weight[0].numel()
                module.weight.mul_((2 / fan_in) ** 0.5 / module.weight.std())
