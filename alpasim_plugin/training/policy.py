"""Teach the learned policy: batches of lessons, what a prediction should have been, and how far off it is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.seeding import stream
from alpasim_plugin.training.demonstrations import Lessons, lessons_digest
from alpasim_plugin.training.policy_expert import SIGHT_M
from alpasim_plugin.training.trainer import Loss
from alpasim_plugin.types import U8
from policies.learned_net import KNOTS_M, NEARNESS_M, SPEED_UNIT_MPS, LearnedNet, knot_weights, path_from_headings
from policies.learned_view import look, picture

SIGMA_AT = KNOTS_M.index(16.0)


@dataclass(frozen=True)
class PolicyRecipe:
    """What a batch holds and what counts.

    Args:
        batch: Lessons in a batch.
        light: Largest change of contrast and brightness, as a share.
        speed_noise: Standard deviation of the error of both speeds, as a share.
        near_m, grow: An error to the side counts in units of ``near_m + grow * distance``.
        seed: Of draws and noise.
    """

    batch: int = 32
    light: float = 0.15
    speed_noise: float = 0.02
    near_m: float = 0.08
    grow: float = 0.025
    seed: int = 0


@dataclass(frozen=True)
class PolicyBatch:
    """B lessons: what is seen, and what the teacher does."""

    picture: Tensor  # (B, 4, 80, 192)
    state: Tensor  # (B, 3)
    command: Tensor  # (B,)
    points: Tensor  # (B, 9, 2) metres
    headings: Tensor  # (B, 9) radians
    speed: Tensor  # (B,) metres per second
    speeds: Tensor  # (B, 8) changes of speed, metres per second
    leader: Tensor  # (B, 2) nearness of who is ahead and their speed, as in `Answer`


class PolicyTask:
    """Batches and loss of the learned policy, for `Trainer`."""

    def __init__(self, net: LearnedNet, lessons: Sequence[Lessons], recipe: PolicyRecipe) -> None:
        self.net, self.lessons, self.recipe = net, lessons, recipe
        self.ends = np.cumsum([len(one) for one in lessons])
        self.weights = torch.from_numpy(knot_weights()).float()
        self.rows = torch.tensor(KNOTS_M).long()  # knots lie on whole metres
        self.unit_m = recipe.near_m + recipe.grow * torch.tensor(KNOTS_M)

    @property
    def facts(self) -> dict[str, Any]:
        """Identify the training data and recipe."""
        return {
            "scenes": [one.folder.name for one in self.lessons],
            "lessons": int(self.ends[-1]),
            "data": lessons_digest(self.lessons),
            "recipe": asdict(self.recipe),
        }

    def batch(self, index: int) -> PolicyBatch:
        """Make batch ``index``."""
        random = stream("training", self.recipe.seed, "policy.batch", index)
        return self.collect(random.integers(0, self.ends[-1], self.recipe.batch), random)

    def collect(self, which: Sequence[int] | Any, random: np.random.Generator | None = None) -> PolicyBatch:
        """Return lessons by number; without ``random`` they are as they were made, without noise."""
        rows = [self._lesson(int(number), random) for number in which]
        return PolicyBatch(*(torch.from_numpy(np.stack([row[i] for row in rows])) for i in range(8)))

    def loss(self, batch: PolicyBatch, index: int) -> Loss:
        """Return the loss of a batch and its parts."""
        pictures = batch.picture.contiguous(memory_format=torch.channels_last)  # a third faster with the net in the same order
        prediction = self.net(pictures, batch.state, batch.command)
        aside, turned, faster = self.errors(prediction.heading, prediction.speed, batch)
        path = F.smooth_l1_loss(aside / self.unit_m, torch.zeros_like(aside), beta=1.0)
        heading = F.smooth_l1_loss(turned / 0.03, torch.zeros_like(turned), beta=1.0)
        speed = F.smooth_l1_loss(faster, torch.zeros_like(faster), beta=0.5)
        # Sigma is fitted to detached errors, so that it does not change the path or the speed.
        mean_speed = batch.speed + batch.speeds.mean(1)
        off = torch.stack([aside[:, SIGMA_AT], faster.mean(1) / mean_speed.clamp_min(3.0)], dim=1).detach()
        sigma = (torch.log(prediction.sigma) + 0.5 * (off / prediction.sigma).clamp(-6.0, 6.0) ** 2).mean()
        nearness, pace = prediction.leader.T
        near, their_pace = batch.leader.T
        # Naming who is ahead helps to see them; the plan is not made from it.
        ahead = F.smooth_l1_loss(nearness, near, beta=0.05) + 0.02 * (near * (pace - their_pace).abs()).mean()
        parts = {"leader": ahead, "path": path, "heading": 0.3 * heading, "speed": speed, "sigma": 0.05 * sigma}
        numbers = {name: float(value.detach()) for name, value in parts.items()}
        numbers["aside_m"] = float(aside[:, SIGMA_AT].detach().abs().mean())
        numbers["speed_mps"] = float(faster.detach().abs().mean())
        return torch.stack(list(parts.values())).sum(), numbers

    def errors(self, heading: Tensor, speed: Tensor, batch: PolicyBatch) -> tuple[Tensor, Tensor, Tensor]:
        """Return errors to the side ``(B, 9)`` in metres, of the heading ``(B, 9)`` in radians and of the speed ``(B, 8)``."""
        points, yaw = path_from_headings(heading, self.weights)
        away = points[:, self.rows] - batch.points
        aside = torch.cos(batch.headings) * away[..., 1] - torch.sin(batch.headings) * away[..., 0]
        return aside, yaw[:, self.rows] - batch.headings, speed - batch.speeds

    def _lesson(self, number: int, random: np.random.Generator | None) -> tuple[Any, ...]:
        scene = int(np.searchsorted(self.ends, number, side="right"))
        lessons = self.lessons[scene]
        a, row = lessons.arrays, number - int(self.ends[scene] - len(lessons))
        frames = a["frames"]
        now = look(frames[a["frame"][row]], lessons.camera, float(a["turn"][row]))
        before = look(frames[a["before"][row]], lessons.camera, float(a["turn_before"][row]))
        speed, wanted = float(a["speed"][row]), float(a["wanted"][row])
        real = float(a["frame"][row] != a["before"][row])
        state = np.array([speed, wanted], dtype=np.float32)
        if random is not None:
            contrast, brightness = 1.0 + random.uniform(-self.recipe.light, self.recipe.light, 2)
            now, before = (_relit(view, contrast, brightness) for view in (now, before))
            state = state * (1.0 + self.recipe.speed_noise * random.standard_normal(2)).astype(np.float32)
        seen = picture(now, before)
        told = np.array([*(state / SPEED_UNIT_MPS), real], dtype=np.float32)
        gap = float(a["gap"][row])
        leader = np.array([0.0 if gap >= SIGHT_M else np.exp(-max(gap, 0.0) / NEARNESS_M), a["leader"][row]], dtype=np.float32)
        return seen, told, a["command"][row], a["points"][row], a["headings"][row], a["speed"][row], a["speeds"][row], leader


def _relit(view: U8, contrast: float, brightness: float) -> U8:
    return np.asarray(cv2.convertScaleAbs(view, alpha=contrast * brightness, beta=128.0 * brightness * (1.0 - contrast)), dtype=np.uint8)


def measure(task: PolicyTask, every: int = 1, batch: int = 64) -> dict[str, float]:
    """Return mean absolute errors over all lessons of a task (or every n-th): to the side at 16 m, of heading and of speed."""
    sums = np.zeros(4)
    chosen = np.arange(0, int(task.ends[-1]), every)
    with torch.inference_mode():
        for begin in range(0, len(chosen), batch):
            lessons = task.collect(chosen[begin : begin + batch])
            prediction = task.net(lessons.picture, lessons.state, lessons.command)
            aside, turned, faster = task.errors(prediction.heading, prediction.speed, lessons)
            off = (aside[:, SIGMA_AT], turned[:, SIGMA_AT], faster.abs().mean(1))
            sums += [*(float(x.abs().sum()) for x in off), len(aside)]
    return {"aside_16m_m": sums[0] / sums[3], "heading_16m_rad": sums[1] / sums[3], "speed_mps": sums[2] / sums[3], "lessons": sums[3]}
