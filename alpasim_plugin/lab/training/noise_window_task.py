"""A stage of GSFix3D or 3DGS-Enhancer: configuration, batches and loss (`training.noise_window` has
the equations).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.lab.image_fixers.settings import NoiseWindowSettings
from alpasim_plugin.lab.training.cut_outs import cut_out
from alpasim_plugin.lab.training.multi_resolution_noise import multi_resolution_noise
from alpasim_plugin.lab.training.noise_window import (
    edm_error,
    log_normal_times,
    noise_window_errors,
    seen_latents,
    squared_error,
    uniform_times,
)
from alpasim_plugin.lab.training.picture_batches import PictureBatches, Pictures
from alpasim_plugin.lab.training.recipes.recipe import StageInputs
from alpasim_plugin.lab.training.recipes.start import (
    channel_weights_of,
    no_text,
    transformer_with_render,
)
from alpasim_plugin.lab.training.shared_rollout import channel_weighted
from alpasim_plugin.lab.training.trainer import Loss

TIMES = {"uniform": uniform_times, "log-normal": log_normal_times}
ERRORS = {"squared": squared_error, "edm": edm_error}


@dataclass(frozen=True)
class NoiseWindowLoss:
    """Flow matching from noise, with the render as a condition.

    Args:
        times: Distribution of t, one a window.
        error: Power and weight of the velocity's error.
        multi_resolution: Whether the noise has structure at several scales; otherwise it is white.
        cut_outs: Whether soft parts of the render are hidden.
        dropout: Share of a window's latents without their condition, the first and the last
            excepted.
    """

    times: Literal["uniform", "log-normal"]
    error: Literal["squared", "edm"]
    multi_resolution: bool = False
    cut_outs: bool = False
    dropout: float = 0.0
    perceptual: bool = False

    def task(self, inputs: StageInputs) -> NoiseWindowTask:
        """Make the stage's batches and loss."""
        return NoiseWindowTask(self, inputs)


class NoiseWindowBatch(NamedTuple):
    """Frames of windows with their noise ``(B, 16, latents, H / 8, W / 8)``, times ``(B,)``, and
    which latents keep their condition ``(B, latents)``.
    """

    pictures: Pictures
    eps: Tensor
    t: Tensor
    keeps_condition: Tensor


class NoiseWindowTask:
    """Batches and loss of `NoiseWindowLoss`; every window is encoded from its own first frame.

    Raises:
        InputError: A fixer that does not start from noise, or clips that are shorter than its
            windows.
    """

    def __init__(self, config: NoiseWindowLoss, inputs: StageInputs) -> None:
        settings = inputs.settings
        if not isinstance(settings, NoiseWindowSettings):
            raise InputError(
                f"--fixer: {'a fixer' if settings is None else settings.name} that does not sample windows from noise",
                "leave it out, or name gsfix3d or 3dgs-enhancer",
            )
        self.config, self.vae, self.latents = config, inputs.vae, settings.latents
        self.batches = PictureBatches(inputs, settings.window_frames)
        self.net = transformer_with_render(inputs, "dit")
        self.parts = nn.ModuleDict({"dit": self.net, "vae": inputs.vae})
        self.channel_weights = channel_weights_of(inputs)

    @property
    def facts(self) -> dict[str, Any]:
        """Identify the configuration."""
        return {
            "objective": "windows from noise",
            **asdict(self.config),
            "window_frames": self.batches.frames,
        }

    def batch(self, index: int) -> NoiseWindowBatch:
        """Make batch ``index``."""
        (render, clean), seed = self.batches[index], self.batches.seed
        t = TIMES[self.config.times](
            stream("training", seed, "noise_window.times", index), len(render)
        )
        shape = (
            len(render),
            self.vae.stats.mean.numel(),
            self.latents,
            render.shape[3] // 8,
            render.shape[4] // 8,
        )
        rng = stream("training", seed, "noise_window.eps", index)
        white = not self.config.multi_resolution
        eps = (
            torch.from_numpy(rng.standard_normal(shape, dtype=np.float32))
            if white
            else multi_resolution_noise(rng, shape, t)
        )
        if self.config.cut_outs:
            render = cut_out(stream("training", seed, "noise_window.cut_outs", index), render)
        rng = stream("training", seed, "noise_window.dropout", index)
        return NoiseWindowBatch(
            Pictures(render, clean),
            eps,
            t,
            seen_latents(rng, (len(render), self.latents), self.config.dropout),
        )

    def loss(self, batch: NoiseWindowBatch, index: int) -> Loss:
        """Return the loss of a batch."""
        with torch.no_grad():
            z_r, z_0 = self.vae.encode(torch.cat(batch.pictures)).chunk(2)
            z_r = z_r * batch.keeps_condition[:, None, :, None, None]
        errors = noise_window_errors(
            self.net,
            z_0,
            z_r,
            batch.eps,
            batch.t,
            no_text(self.net, z_0),
            ERRORS[self.config.error],
        )
        loss = channel_weighted(errors, self.channel_weights).mean()
        return loss, {"flow": loss.detach()}
