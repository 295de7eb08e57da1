"""Imitation learning of the learned policy: batches of demonstrations and the loss."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.core.devices import upload
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import U8
from alpasim_plugin.lab.training.demonstrations import Demonstrations, demonstrations_digest
from alpasim_plugin.lab.training.policy_expert import SIGHT_M
from alpasim_plugin.lab.training.trainer import Loss, Schedule, Trainer
from policies.learned_input import FRONT, level_view
from policies.learned_net import (
    GRID_M,
    KNOTS_M,
    PROXIMITY_M,
    SPEED_UNIT_MPS,
    LearnedNet,
    knot_weights,
)
from policies.learned_views import in_planes, network_input

Report = Callable[[int, Mapping[str, float]], None]
SIGMA_KNOT = KNOTS_M.index(16.0)
WIDEST = 6.0  # deviations up to which an error counts as a normal one


@dataclass(frozen=True)
class PolicyRecipe:
    """Batch, augmentation and loss weights.

    Args:
        batch: Samples in a batch.
        brightness_jitter: Largest relative change of contrast and brightness.
        speed_noise: Standard deviation of the relative noise on both speeds.
        lateral_scale_m, lateral_scale_per_m: Lateral errors are divided by ``lateral_scale_m +
            lateral_scale_per_m * distance``.
        black_share: Share of the samples in which a side view is black, for each side: without its
            camera the policy drives as on average, not as at random.
        seed: Of sampling and noise.
    """

    batch: int = 32
    brightness_jitter: float = 0.15
    speed_noise: float = 0.02
    lateral_scale_m: float = 0.08
    lateral_scale_per_m: float = 0.025
    black_share: float = 0.08
    seed: int = 0


@dataclass(frozen=True)
class PolicyBatch:
    """B samples: inputs, and the expert's targets."""

    images: tuple[Tensor, ...]  # of each view (B, 4, H, W)
    state: Tensor  # (B, 3)
    command: Tensor  # (B,)
    points: Tensor  # (B, 9, 2) metres
    headings: Tensor  # (B, 9) radians
    speed: Tensor  # (B,) metres per second
    speeds: Tensor  # (B, 8) changes of speed, metres per second
    leader: Tensor  # (B, 2) proximity of the leader and its speed, as in `Prediction`
    crossing: Tensor  # (B, V - 1, 2) who comes from a side, as in `Prediction`, after the sigmoid


def integrate_path(heading: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return points ``(B, G, 2)`` and headings ``(B, G)`` of paths with headings ``(B, 9)`` at the
    knots, in metres and radians.
    """
    yaw = heading @ weights.T
    middle = 0.5 * (yaw[:, 1:] + yaw[:, :-1])
    steps = GRID_M * torch.stack([torch.cos(middle), torch.sin(middle)], dim=-1)
    return torch.cat([torch.zeros_like(steps[:, :1]), steps.cumsum(1)], dim=1), yaw


class PolicyTask:
    """Batches and loss of the learned policy, for `Trainer`."""

    def __init__(
        self, net: LearnedNet, demonstrations: Sequence[Demonstrations], recipe: PolicyRecipe
    ) -> None:
        self.net, self.demonstrations, self.recipe = net, demonstrations, recipe
        self.ends = np.cumsum([len(demonstration) for demonstration in demonstrations])
        device = next(net.parameters()).device
        self.weights = upload(knot_weights(), device).float()
        knots_m = upload(KNOTS_M, device)
        self.rows = knots_m.long()  # knots lie on whole metres
        self.unit_m = recipe.lateral_scale_m + recipe.lateral_scale_per_m * knots_m

    @property
    def facts(self) -> dict[str, Any]:
        """Identify the training data and recipe."""
        return {
            "scenes": [demonstration.folder.name for demonstration in self.demonstrations],
            "samples": int(self.ends[-1]),
            "data": demonstrations_digest(self.demonstrations),
            "recipe": asdict(self.recipe),
        }

    def batch(self, index: int) -> PolicyBatch:
        """Make batch ``index``."""
        random = stream("training", self.recipe.seed, "policy.batch", index)
        return self.collect(random.integers(0, self.ends[-1], self.recipe.batch), random)

    def collect(
        self, which: Sequence[int] | Any, random: np.random.Generator | None = None
    ) -> PolicyBatch:
        """Return a batch of samples by number; without ``random``, no augmentation."""
        rows = [self._sample(int(number), random) for number in which]
        images = zip(*(views for views, *_ in rows), strict=True)
        return PolicyBatch(
            tuple(map(torch.stack, images)),
            *(torch.from_numpy(np.stack([row[i] for row in rows])) for i in range(1, 9)),
        )

    def loss(self, batch: PolicyBatch, index: int) -> Loss:
        """Return the loss of a batch and its parts."""
        # As the network: a third faster
        images = [image.contiguous(memory_format=torch.channels_last) for image in batch.images]
        prediction = self.net(images, batch.state, batch.command)
        lateral, heading_error, speed_error = self.errors(
            prediction.heading, prediction.speed, batch
        )
        path = F.smooth_l1_loss(lateral / self.unit_m, torch.zeros_like(lateral), beta=1.0)
        heading = F.smooth_l1_loss(heading_error / 0.03, torch.zeros_like(heading_error), beta=1.0)
        speed = F.smooth_l1_loss(speed_error, torch.zeros_like(speed_error), beta=0.5)
        # Gaussian negative log-likelihood for sigma alone: the errors are detached.
        mean_speed = batch.speed + batch.speeds.mean(1)
        off = torch.stack(
            [lateral[:, SIGMA_KNOT], speed_error.mean(1) / mean_speed.clamp_min(3.0)], dim=1
        ).detach()
        sigma = sigma_loss(off, prediction.sigma).mean()
        proximity, leader_speed = prediction.leader.T
        wanted_proximity, wanted_leader_speed = batch.leader.T
        # Auxiliary task: the plan does not depend on the predicted leader.
        leader = F.smooth_l1_loss(proximity, wanted_proximity, beta=0.05)
        leader = (
            leader + 0.02 * (wanted_proximity * (leader_speed - wanted_leader_speed).abs()).mean()
        )
        parts = {
            "leader": leader,
            "path": path,
            "heading": 0.3 * heading,
            "speed": speed,
            "sigma": 0.05 * sigma,
        }
        if self.net.views[1:]:
            parts["crossing"] = F.binary_cross_entropy_with_logits(
                prediction.crossing, batch.crossing
            )
        numbers = {name: value.detach() for name, value in parts.items()}
        numbers["lateral_m"] = lateral[:, SIGMA_KNOT].detach().abs().mean()
        numbers["speed_mps"] = speed_error.detach().abs().mean()
        return torch.stack(list(parts.values())).sum(), numbers

    def errors(
        self, heading: Tensor, speed: Tensor, batch: PolicyBatch
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return lateral errors ``(B, 9)`` (m), heading errors ``(B, 9)`` (rad) and speed errors
        ``(B, 8)`` (m/s).
        """
        points, yaw = integrate_path(heading, self.weights)
        offset = points[:, self.rows] - batch.points
        lateral = (
            torch.cos(batch.headings) * offset[..., 1] - torch.sin(batch.headings) * offset[..., 0]
        )
        return lateral, yaw[:, self.rows] - batch.headings, speed - batch.speeds

    def _sample(self, number: int, random: np.random.Generator | None) -> tuple[Any, ...]:
        """Return a sample's images, inputs and targets, in the order of `PolicyBatch`.

        Args:
            number: Of the sample, over all scenes.
            random: Draws how it is varied; None leaves it as it is.
        """
        scene = int(np.searchsorted(self.ends, number, side="right"))
        demonstrations = self.demonstrations[scene]
        row = number - int(self.ends[scene] - len(demonstrations))
        table = demonstrations.arrays
        speeds_mps = [float(table["speed"][row]), float(table["desired_speed"][row])]
        state = np.array(speeds_mps, dtype=np.float32)
        contrast = brightness = 1.0
        if random is not None:
            jitter = self.recipe.brightness_jitter
            contrast, brightness = 1.0 + random.uniform(-jitter, jitter, 2)
            noise = self.recipe.speed_noise * random.standard_normal(2)
            state = state * (1.0 + noise).astype(np.float32)
        images = self._images(demonstrations, row, contrast, brightness, random)
        has_earlier = float(table["frame"][row] != table["before"][row])
        gap_m = float(table["gap"][row])
        proximity = 0.0 if gap_m >= SIGHT_M else np.exp(-max(gap_m, 0.0) / PROXIMITY_M)
        return (
            images,
            np.array([*(state / SPEED_UNIT_MPS), has_earlier], dtype=np.float32),
            table["command"][row],
            table["points"][row],
            table["headings"][row],
            table["speed"][row],
            table["speeds"][row],
            np.array([proximity, table["leader"][row]], dtype=np.float32),
            table["crossing"][row],
        )

    def _images(
        self,
        demonstrations: Demonstrations,
        row: int,
        contrast: float,
        brightness: float,
        random: np.random.Generator | None,
    ) -> list[Tensor]:
        """Return what the network sees in each view, of the newest frame and the one before; with
        ``random``, some views beside the front one are black.
        """
        table = demonstrations.arrays
        images = []
        for view, camera, frames in zip(
            demonstrations.views, demonstrations.cameras, demonstrations.frames, strict=True
        ):
            pair = []
            for frame, yaw in (("frame", "yaw"), ("before", "yaw_before")):
                image = level_view(frames[table[frame][row]], camera, float(table[yaw][row]), view)
                pair.append(_jitter_brightness(image, contrast, brightness))
            if random is not None and view != FRONT and random.random() < self.recipe.black_share:
                pair = [np.zeros_like(image) for image in pair]
            newest, before = (in_planes(image) for image in pair)
            images.append(network_input(newest, before)[0])
        return images


def start_from_front(net: LearnedNet, front: LearnedNet) -> None:
    """Give a network of several views the weights of one that has the front view alone.

    The convolutions over the front view stay as they are, those over the others begin with the same
    weights. What the first full layer makes of the other views begins at zero, so the network begins
    with the plans of ``front``.
    """
    weights = front.state_dict()
    wide = net.state_dict()["plan.0.weight"]
    narrow = weights["plan.0.weight"]
    others = wide.shape[1] - narrow.shape[1]
    after = narrow.shape[1] - front.state[0].out_features - front.word.embedding_dim
    zeros = torch.zeros(len(wide), others)
    weights["plan.0.weight"] = torch.cat([narrow[:, :after], zeros, narrow[:, after:]], dim=1)
    weights |= {f"side_encoder.{name}": value for name, value in front.see.state_dict().items()}
    net.load_state_dict(weights, strict=False)


@dataclass(frozen=True)
class PolicyStage:
    """A stage of a policy's training; it begins at the averaged weights of the one before.

    Attributes:
        name: Its folder within that of the run; empty: the run's own.
        updates: Its part of the updates of all stages.
        peak_lr: Learning rate after the warm-up.
        keeps_front: Whether the convolutions over the front view stay as they are.
    """

    name: str
    updates: int
    peak_lr: float = 1.5e-3
    keeps_front: bool = False


def _counted(report: Report, before: int, step: int, numbers: Mapping[str, float]) -> None:
    report(before + step, numbers)


ONE_CAMERA = (PolicyStage("", 1),)
# The updates of `learned-three`.
SEVERAL_CAMERAS = (
    PolicyStage("front", 7300),
    PolicyStage("sides", 2800, keeps_front=True),
    PolicyStage("", 1900, peak_lr=1e-3, keeps_front=True),
)


def train(
    net: LearnedNet,
    demonstrations: Sequence[Demonstrations],
    out: Path,
    steps: int,
    recipe: PolicyRecipe,
    report: Report | None = None,
) -> list[tuple[PolicyTask, Trainer[PolicyBatch]]]:
    """Train a network in the stages for its views, and leave it with the averaged weights of the
    last; the same call resumes.

    Args:
        net: One with several views has the weights of `start_from_front`.
        demonstrations: With the network's views.
        out: Folder of the run.
        steps: Updates of all stages; each has its part, and one at least.
        recipe: Of the first stage; each later one has the next seed.
        report: Called after each update with its number and what was measured.

    Returns:
        Task and trainer of each stage.

    Raises:
        InputError, InfrastructureError: See `Trainer`.
    """
    stages = SEVERAL_CAMERAS if len(net.views) > 1 else ONE_CAMERA
    whole = sum(stage.updates for stage in stages)
    done = []
    before = 0
    for index, stage in enumerate(stages):
        net.see.requires_grad_(not stage.keeps_front)
        task = PolicyTask(net, demonstrations, replace(recipe, seed=recipe.seed + index))
        length = max(round(steps * stage.updates / whole), 1)
        schedule = Schedule(
            length,
            peak_lr=stage.peak_lr,
            warmup=min(200, length // 10 + 1),
            weight_decay=0.02,
            ema=0.998,
        )
        trainer = Trainer(net, out / stage.name, schedule, task.batch, task.loss, task.facts)
        trainer.run(report and partial(_counted, report, before))
        before += length
        net.load_state_dict(trainer.averaged())
        done.append((task, trainer))
    return done


def _jitter_brightness(view: U8, contrast: float, brightness: float) -> U8:
    """Change contrast about the middle level, then brightness; levels end at 0 and 255."""
    levels = np.arange(256.0)
    changed = brightness * (contrast * levels + 128.0 * (1.0 - contrast))
    table = np.clip(np.rint(changed), 0, 255).astype(np.uint8)
    return np.asarray(cv2.LUT(view, table), dtype=np.uint8)


def sigma_loss(off: Tensor, sigma: Tensor) -> Tensor:
    """Return the negative log-likelihood of errors under normal deviations; beyond `WIDEST` of them
    it goes on as a straight line, so that few large errors do not outweigh all others and still widen
    sigma.

    Args:
        off: ``(...)`` errors.
        sigma: ``(...)`` standard deviations, above 0.
    """
    deviations = (off / sigma).abs()
    inside = deviations.clamp_max(WIDEST)
    return torch.log(sigma) + inside * (deviations - 0.5 * inside)


def measure(task: PolicyTask, stride: int = 1, batch: int = 64) -> dict[str, float]:
    """Return mean absolute errors over the samples of a task (or every n-th): lateral and heading
    at 16 m, and speed.
    """
    sums = np.zeros(4)
    chosen = np.arange(0, int(task.ends[-1]), stride)
    with torch.inference_mode():
        for begin in range(0, len(chosen), batch):
            samples = task.collect(chosen[begin : begin + batch])
            prediction = task.net(samples.images, samples.state, samples.command)
            lateral, heading_error, speed_error = task.errors(
                prediction.heading, prediction.speed, samples
            )
            off = (lateral[:, SIGMA_KNOT], heading_error[:, SIGMA_KNOT], speed_error.abs().mean(1))
            sums += [*(float(x.abs().sum()) for x in off), len(lateral)]
    return {
        "lateral_16m_m": sums[0] / sums[3],
        "heading_16m_rad": sums[1] / sums[3],
        "speed_mps": sums[2] / sums[3],
        "samples": sums[3],
    }
