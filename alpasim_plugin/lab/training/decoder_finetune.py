"""Fine-tune the decoder on the latents of its generator.

The autoencoder was trained on latents of clean frames. A generator's latents have their own errors:
a small transformer's differ from token to token, which is visible as a grid. The decoder is
conditioned on the render, so it can learn which input to trust. It is trained on the generator's
own rollouts, with encoder and generator frozen, with a pixel loss and a perceptual distance.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.block_fixers.clips import GROUP, SIDE
from alpasim_plugin.block_fixers.dit import CosmosCausalDiT
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.atomic import write_array
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.lab.training.clip_batches import shown_map
from alpasim_plugin.lab.training.latent_clips import LatentClip, LatentClips
from alpasim_plugin.lab.training.perceptual_term import Distance, flatten_frames
from alpasim_plugin.lab.training.shared_rollout import roll_out
from alpasim_plugin.lab.training.trainer import Loss
from alpasim_plugin.lab.training.vae import reconstruction_loss


@dataclass(frozen=True)
class DecoderRecipe:
    """Batch and loss weights.

    Args:
        clips: Clips of a batch, whole in time.
        rows, columns: Crop in latents of 8 pixels.
        edge_weight: See `vae.reconstruction_loss`.
        perceptual_weight: Of the perceptual distance of one latent's frames.
        seed: Of sampling.
    """

    clips: int = 2
    rows: int = 10
    columns: int = 16
    edge_weight: float = 0.3
    perceptual_weight: float = 0.1
    seed: int = 0


class Rollouts:
    """A generator's rollouts over training clips, computed once and cached as float16:
    FOLDER/DIGEST/INDEX.npy.

    Args:
        clips: Training clips.
        vae: Their autoencoder.
        net: Frozen generator.
        block_latents, window: As at deployment.
        map: The map that the generator sees, as `Conditioning.map`.
        folder: Cache of the rollouts.
        report: Called with the number of clips done and in all.
    """

    def __init__(
        self,
        clips: LatentClips,
        vae: TinyVAE,
        net: CosmosCausalDiT,
        block_latents: int,
        window: int,
        map: Literal["drawn", "black", "nothing"],
        folder: Path,
        report: Callable[[int, int], None] | None = None,
    ) -> None:
        self.clips = clips
        self.digest = _digest(net.state_dict(), clips, f"{block_latents} {window} {map}")
        self._folder = folder / self.digest
        self._folder.mkdir(parents=True, exist_ok=True)
        text = torch.zeros(1, 1, net.sizes.text_width)
        fixed_map = shown_map(map, clips, vae)
        for index in range(len(clips)):
            path = self._path(index)
            if not path.exists():
                clip = clips[index]
                name = f"{clip.sequence.name}.{clip.start}.{clip.mirrored}"
                eps, context = (
                    torch.from_numpy(
                        stream(name, 0, f"training.rollout.{purpose}").standard_normal(
                            (1, *clip.z_0.shape), dtype=np.float32
                        )
                    )
                    for purpose in ("eps", "context")
                )
                z_map = clip.z_map if fixed_map is None else fixed_map
                z_r, m, condition = (z[None] for z in (clip.z_r, clip.m, z_map))
                z = roll_out(
                    net,
                    z_r,
                    condition,
                    m,
                    eps,
                    context,
                    text,
                    block_latents=block_latents,
                    window=window,
                )
                write_array(path, z[0].half().numpy())
            if report is not None:
                report(index + 1, len(clips))

    def __len__(self) -> int:
        return len(self.clips)

    def __getitem__(self, index: int) -> tuple[LatentClip, Tensor]:
        """Return a clip and the generator's latents of it ``(C, N, H/8, W/8)`` float32."""
        return self.clips[index], torch.from_numpy(np.load(self._path(index)).astype(np.float32))

    def _path(self, index: int) -> Path:
        return self._folder / f"{index:06d}.npy"


@dataclass(frozen=True)
class DecoderBatch:
    """Latents ``(B, C, N, h, w)``, the render, its opacity and the clean frames ``(B, c, 1 + 4 (N -
    1), 8h, 8w)``, and a position.
    """

    z: Tensor
    render: Tensor
    opacity: Tensor
    clean: Tensor
    w: int


class DecoderTask:
    """Batches and loss of the decoder, for `Trainer`; freezes the rest of the autoencoder.

    Args:
        vae: Its decoder is trained.
        rollouts: Its input latents.
        recipe: Batch and loss weights.
        distance: Frozen perceptual distance, with its name; None for none.

    Raises:
        InputError: A crop larger than the clips.
    """

    def __init__(
        self,
        vae: TinyVAE,
        rollouts: Rollouts,
        recipe: DecoderRecipe,
        distance: tuple[str, Distance] | None = None,
    ) -> None:
        size = tuple(rollouts[0][1].shape[2:])
        if recipe.rows > size[0] or recipe.columns > size[1]:
            raise InputError(
                f"its crop: a crop of {recipe.rows} x {recipe.columns} latents from {size[0]} x {size[1]}",
                "choose a smaller crop",
            )
        self.vae, self.rollouts, self.recipe, self.distance = vae, rollouts, recipe, distance
        vae.requires_grad_(False)
        vae.decoder.requires_grad_(True)
        vae.latents_per_pass = None  # one pass a clip is faster; results differ by rounding only

    @property
    def facts(self) -> dict[str, Any]:
        """Identify data and recipe."""
        return {
            "clips": len(self.rollouts),
            "rollouts": self.rollouts.digest,
            "recipe": asdict(self.recipe),
            "distance": self.distance[0] if self.distance else "none",
        }

    def batch(self, index: int) -> DecoderBatch:
        """Make batch ``index``: a function of the index and the recipe's seed only."""
        r = self.recipe
        # A fixed stream name: it determines the draws
        rng = stream("training", r.seed, "painter.clips", index)
        crops = [self._crop(rng) for _ in range(r.clips)]
        z, render, opacity, clean = (torch.stack(parts) for parts in zip(*crops, strict=True))
        return DecoderBatch(z, render, opacity, clean, int(rng.integers(z.shape[2])))

    def loss(self, batch: DecoderBatch, index: int) -> Loss:
        """Return the loss of a batch and its parts."""
        made = self.vae.decode(batch.z, render=batch.render, opacity=batch.opacity, clamp=False)
        parts = {"image": reconstruction_loss(made, batch.clean, self.recipe.edge_weight)}
        if self.distance is not None and self.recipe.perceptual_weight:
            frames = slice(max(1 + GROUP * (batch.w - 1), 0), 1 + GROUP * batch.w)
            distance = self.distance[1](
                flatten_frames(made[:, :, frames]), flatten_frames(batch.clean[:, :, frames])
            ).mean()
            parts["perceptual"] = self.recipe.perceptual_weight * distance
        numbers = {name: value.detach() for name, value in parts.items()}
        numbers["psnr_db"] = _psnr_db(made.detach(), batch.clean)
        numbers["render_psnr_db"] = _psnr_db(batch.render, batch.clean)
        return torch.stack(list(parts.values())).sum(), numbers

    def _crop(self, rng: np.random.Generator) -> tuple[Tensor, ...]:
        clip, z = self.rollouts[int(rng.integers(len(self.rollouts)))]
        top, left = (
            int(rng.integers(have - want + 1))
            for have, want in zip(z.shape[2:], (self.recipe.rows, self.recipe.columns), strict=True)
        )
        rows = slice(top, top + self.recipe.rows)
        columns = slice(left, left + self.recipe.columns)
        pixels = [slice(s.start * SIDE, s.stop * SIDE) for s in (rows, columns)]
        end = 1 + GROUP * (z.shape[1] - 1)
        render, opacity = clip.frames(end)
        videos = [x[:, :, pixels[0], pixels[1]] for x in (render, opacity, clip.clean(end))]
        return (z[:, :, rows, columns], *videos)


def _psnr_db(images: Tensor, truth: Tensor) -> Tensor:
    """Return the PSNR of images in [-1, 1], clipped."""
    error = (images.clamp(-1, 1) - truth.clamp(-1, 1)).square().mean()
    return -10 * torch.log10(error / 4)


def _digest(weights: Mapping[str, Tensor], clips: LatentClips, deployed: str) -> str:
    out = hashlib.blake2b(f"{clips.digest} {deployed}".encode(), digest_size=8)
    for key, value in sorted(weights.items()):
        out.update(key.encode() + value.detach().cpu().contiguous().numpy().tobytes())
    return out.hexdigest()
