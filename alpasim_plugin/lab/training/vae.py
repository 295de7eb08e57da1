"""Train the tiny autoencoder on pairs and on driving video.

Three kinds of images are trained: clean frames, decoded with and without the degraded render as a
condition; and degraded renders and semantic maps, which are inputs of the generator. Noise is added
to the latents, since those of a generator have errors.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.block_fixers.clips import GROUP
from alpasim_plugin.block_fixers.codec_weights import LatentStats
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.block_fixers.tiny_vae_nets import LATENT
from alpasim_plugin.core.devices import require_device, upload
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import U8
from alpasim_plugin.fixers.bundle import parts_of
from alpasim_plugin.fixers.network.checkpoints import load_weights
from alpasim_plugin.lab.training.clips import (
    Clip,
    CropSize,
    draw_pair_clip,
    draw_video_clip,
    to_tensor,
)
from alpasim_plugin.lab.training.pair_store import PairDataset, PairSequence, pairs_digest
from alpasim_plugin.lab.training.trainer import Loss, Schedule, Trainer

VAE_FILE = "vae.safetensors"
MEASURED_FRAMES = 97  # of every sequence, for mean and deviation of the latents


@dataclass(frozen=True)
class VaeRecipe:
    """Batch and loss weights.

    Args:
        pair_clips: Clips from pairs in a batch.
        video_clips: Clips from driving videos in a batch.
        size: Frames (1 + 4k) and crop.
        latent_noise: Standard deviation of the noise on latents, which have unit variance.
        edge_weight: Weight of the difference of neighbouring pixels and frames: sharpness and
            flicker.
        auxiliary_weight: Weight of degraded renders and semantic maps.
        seed: Of sampling and noise.
    """

    pair_clips: int = 2
    video_clips: int = 1
    size: CropSize = CropSize(9, 96, 160)
    latent_noise: float = 0.05
    edge_weight: float = 0.3
    auxiliary_weight: float = 0.3
    seed: int = 0

    def __post_init__(self) -> None:
        if self.size.frames % GROUP != 1:
            raise InputError(
                f"clips of {self.size.frames} frames: the autoencoder takes 1 + {GROUP} k frames",
                f"Train on {whole_groups(self.size.frames)} frames.",
            )


def whole_groups(frames: int) -> int:
    """Return the largest number 1 + 4k of frames up to this one.

    Example:
        >>> [whole_groups(frames) for frames in (1, 4, 5, 60)]
        [1, 1, 5, 57]
    """
    return 1 + (frames - 1) // GROUP * GROUP


@dataclass(frozen=True)
class VaeBatch:
    """``(B, C, T, H, W)`` clips of pairs, and of video alone (None: none)."""

    pairs: Clip | None
    video: Tensor | None
    auxiliary: Tensor | None  # one degraded render or one semantic map


class VaeTask:
    """Batches and loss of the autoencoder, for `Trainer`."""

    def __init__(
        self,
        vae: TinyVAE,
        sequences: Sequence[PairSequence],
        videos: Sequence[U8],
        recipe: VaeRecipe,
    ) -> None:
        self.vae, self.sequences, self.videos, self.recipe = vae, sequences, videos, recipe
        vae.latents_per_pass = None  # one pass a clip is faster; results differ by rounding only

    @property
    def facts(self) -> dict[str, Any]:
        """Identify the training data and recipe."""
        videos = [
            hashlib.blake2b(video.tobytes(), digest_size=8).hexdigest() for video in self.videos
        ]
        return {
            "sequences": len(self.sequences),
            "pairs": pairs_digest(self.sequences),
            "videos": videos,
            "recipe": asdict(self.recipe),
        }

    def batch(self, index: int) -> VaeBatch:
        """Make batch ``index``."""
        r = self.recipe
        pairs = None
        auxiliary = None
        if r.pair_clips:
            clips = [
                draw_pair_clip(self.sequences, r.size, r.seed, index * r.pair_clips + i)
                for i in range(r.pair_clips)
            ]
            pairs = Clip(
                *(
                    torch.stack([getattr(c, name) for c in clips])
                    for name in ("target", "render", "opacity", "sdmap")
                )
            )
            auxiliary = (pairs.render if index % 2 else pairs.sdmap)[:1]  # type: ignore[index]
        video = None
        if r.video_clips and self.videos:
            clips = [
                draw_video_clip(self.videos, r.size, r.seed, index * r.video_clips + i)
                for i in range(r.video_clips)
            ]
            video = torch.stack([c.target for c in clips])
        return VaeBatch(pairs, video, auxiliary)

    def loss(self, batch: VaeBatch, index: int) -> Loss:
        """Return the loss of a batch and its parts."""
        r = self.recipe
        parts: dict[str, Tensor] = {}
        if batch.pairs is not None:
            z, noisy = self._latents(batch.pairs.target, index, 0)
            parts["latent"] = reconstruction_loss(
                self.vae.decode(noisy, clamp=False), batch.pairs.target, r.edge_weight
            )
            conditioned = self.vae.decode(
                noisy, render=batch.pairs.render, opacity=batch.pairs.opacity, clamp=False
            )
            parts["render"] = reconstruction_loss(conditioned, batch.pairs.target, r.edge_weight)
            parts["spread"] = 1e-3 * (z.var(dim=(0, 2, 3, 4)).clamp_min(1e-6).log() ** 2).mean()
        if batch.video is not None:
            _, noisy = self._latents(batch.video, index, 1)
            parts["video"] = reconstruction_loss(
                self.vae.decode(noisy, clamp=False), batch.video, r.edge_weight
            )
        if batch.auxiliary is not None:
            _, noisy = self._latents(batch.auxiliary, index, 2)
            error = reconstruction_loss(
                self.vae.decode(noisy, clamp=False), batch.auxiliary, r.edge_weight
            )
            parts["auxiliary"] = r.auxiliary_weight * error
        total = torch.stack(list(parts.values())).sum()
        return total, {name: value.detach() for name, value in parts.items()}

    def _latents(self, video: Tensor, index: int, which: int) -> tuple[Tensor, Tensor]:
        z = self.vae.encode(video)
        noise = stream("training", self.recipe.seed, f"vae.noise.{which}", index).standard_normal(
            z.shape, dtype="float32"
        )
        return z, z + self.recipe.latent_noise * upload(noise, z.device).to(z.dtype)


def train_vae(
    data: Path,
    video: Path | None,
    out: Path,
    steps: int,
    seed: int,
    init: Path | None,
    report: Callable[[int, Mapping[str, float]], None] | None = None,
    device: str = "cpu",
) -> Path:
    """Train the tiny autoencoder; write OUT/vae.safetensors with averaged weights and measured
    latent statistics.

    Args:
        data: Folder of pairs; its ``train`` split is used.
        video: Folder of video pairs, whose clean frames are further clips.
        out: Folder of the run; the same call resumes.
        steps, seed: Updates; seed of weights and draws.
        init: Initial weights: an autoencoder, or a fixer's bundle.
        report: Called after every update with its number and the logged values.
        device: Where to train; a run may go on on another.
    """
    vae = load_tiny_vae(init).requires_grad_(True) if init else TinyVAE.random(seed=seed)
    sequences = PairDataset(data, "train").sequences
    videos: list[U8] = []
    if video is not None:
        videos = [sequence.clip.rgb_gt for sequence in PairDataset(video, "train").sequences]
    recipe = VaeRecipe(seed=seed, video_clips=1 if videos else 0)
    vae.to(require_device(device))
    task = VaeTask(vae, sequences, videos, recipe)
    trainer = Trainer(vae, out, Schedule(steps), task.batch, task.loss, task.facts)
    trainer.run(report)
    vae.cpu().load_state_dict(trainer.averaged())
    clips = [measured_clip(sequence) for sequence in sequences]
    mean, std = measure_stats(vae, clips)
    vae.stats = LatentStats(
        (mean * vae.stats.std + vae.stats.mean).tolist(),
        (std * vae.stats.std).tolist(),
        stored=True,
    )
    path = out / VAE_FILE
    vae.save(path, {"made_by": "simrun train fixer", "steps": str(steps), "seed": str(seed)})
    return path


def measured_clip(sequence: PairSequence) -> Tensor:
    """Return the clean frames ``(1, 3, T, H, W)`` of a sequence that its latents' statistics are
    measured on.
    """
    frames = sequence.clip.rgb_gt[:MEASURED_FRAMES]
    return to_tensor(frames[: whole_groups(len(frames))])[None]


def reconstruction_loss(made: Tensor, wanted: Tensor, edge_weight: float) -> Tensor:
    """Return a Charbonnier loss of values plus a weighted smooth L1 loss of differences along rows,
    columns and frames.
    """
    d = made - wanted
    value = torch.sqrt(d * d + 1e-4).mean()
    edges = [
        F.smooth_l1_loss(x, torch.zeros_like(x), beta=0.02)
        for x in (d.diff(dim=-1), d.diff(dim=-2), d.diff(dim=-3))
    ]
    return value + edge_weight * torch.stack(edges).sum()


def measure_stats(vae: TinyVAE, clips: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Return mean and standard deviation ``(16,)`` of the latent channels over clips ``(1, 3, T, H,
    W)``.
    """
    with torch.inference_mode():
        z = torch.cat([vae.encode(c).flatten(2)[0] for c in clips], dim=1).double()
    return z.mean(1).float(), z.std(1).float()


@torch.no_grad()
def channel_amplitudes(vae: TinyVAE, sigma: float = 0.3) -> Tensor:
    """Return the root-mean-square pixel error that an error of each latent channel causes, scaled
    to mean 1, ``(16,)``.

    Channels have unit variance, but a unit of the brightness channel changes pixels 4 to 39 times
    as much as a unit of the others (shipped weights). Equal channel weights spend capacity on
    invisible errors.
    """
    noise = torch.from_numpy(
        stream("training", 0, "vae.channel_amplitudes").standard_normal(
            (1, LATENT, 3, 8, 8), dtype="float32"
        )
    )
    z = torch.zeros_like(noise)
    still = vae.decode(z, clamp=False)
    rms = []
    for channel in range(LATENT):
        moved = z.clone()
        moved[:, channel] = sigma * noise[:, channel]
        rms.append((vae.decode(moved, clamp=False) - still).square().mean().sqrt())
    out = torch.stack(rms)
    return out / out.mean()


def load_tiny_vae(path: str | Path) -> TinyVAE:
    """Return the tiny autoencoder in a file: a bundle's, or one that `TinyVAE.save` wrote.

    Raises:
        InputError: Neither, or a bundle with another kind of autoencoder.
    """
    tensors = load_weights(path)
    return TinyVAE.from_state_dict(parts_of(tensors).get("vae", tensors), source=str(path))
