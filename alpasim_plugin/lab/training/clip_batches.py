"""Batches of the block generators: clips, crops and noise, drawn by the batch's number; and what
the network sees besides its source.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.block_fixers.clips import GROUP, SIDE
from alpasim_plugin.block_fixers.sampling import opacity_values
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.lab.training.latent_clips import LatentClip, LatentClips
from alpasim_plugin.lab.training.shared_rollout import Sample

PATCH = 2  # latents along a side of a token; crops consist of whole tokens


@dataclass(frozen=True)
class Conditioning:
    """What a network sees: its source and its condition, in training and at deployment.

    Args:
        map: The semantic map as ``drawn``; the latents of a ``black`` one, which says that there is
            no road; or ``nothing``, zeros.
        source: Eq. 1 (``mixed``); or ``noise`` alone, with the render's latents as condition after
            the map's.
        opacity: Whether the opacity enters every transformer block (ArtiFixer); it follows the map
            in the condition.
    """

    map: Literal["drawn", "black", "nothing"] = "drawn"
    source: Literal["mixed", "noise"] = "mixed"
    opacity: bool = False

    def settings(self) -> dict[str, Any]:
        """Return the settings of a fixer that sees this."""
        return {
            "uses_map": self.map == "drawn",
            "no_map": "black" if self.map == "black" else "nothing",
            "holes": "noise" if self.source == "mixed" else "everywhere",
            "render_input": self.source == "noise",
            "opacity_input": self.opacity,
        }


@dataclass(frozen=True)
class BatchForm:
    """Clips of a batch.

    Args:
        clips: Their number.
        latents: Latents from a clip's start; None for the whole clip.
        columns: Width of the crop in latents, even; None for the whole image.
        seed: Of sampling and noise.
    """

    clips: int = 4
    latents: int | None = None
    columns: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if self.columns is not None and self.columns % PATCH:
            raise InputError(
                f"columns {self.columns}: half a token",
                "give an even number of latents",
            )


class Drawn(NamedTuple):
    """A batch: its latents and noise, its clips, and the columns of the crop in latents."""

    sample: Sample
    clips: Sequence[LatentClip]
    columns: slice

    def frames(self, end: int, begin: int = 0) -> tuple[Tensor, Tensor]:
        """Return the render ``(B, 3, T, H, W)`` in [-1, 1] and its opacity ``(B, 1, T, H, W)``: the
        clips' frames ``begin`` to ``end``.
        """
        renders = [clip.frames(end, begin) for clip in self.clips]
        return torch.stack([self._cut(render) for render, _ in renders]), torch.stack(
            [self._cut(opacity) for _, opacity in renders]
        )

    def clean(self, end: int, begin: int = 0) -> Tensor:
        """Return the clean frames ``(B, 3, T, H, W)`` in [-1, 1] of the clips' frames ``begin`` to
        ``end``.
        """
        return torch.stack([self._cut(clip.clean(end, begin)) for clip in self.clips])

    def _cut(self, frames: Tensor) -> Tensor:
        return frames[..., self.columns.start * SIDE : self.columns.stop * SIDE]


class ClipBatches:
    """Batches of clips, each drawn by its number.

    Args:
        clips: Training latents.
        vae: Their autoencoder, which encodes the black map.
        form: Number and crop.
        conditioning: What the network sees.
    """

    def __init__(
        self, clips: LatentClips, vae: TinyVAE, form: BatchForm, conditioning: Conditioning
    ) -> None:
        self.clips, self.form, self.conditioning = clips, form, conditioning
        self._map = shown_map(conditioning.map, clips, vae)

    def __getitem__(self, index: int) -> Drawn:
        """Draw batch ``index``: a function of the index and the seed only.

        Every recipe of the same form gets equal clips, crops and noise, so that recipes are
        compared on the same draws.
        """
        form = self.form
        rng = stream("training", form.seed, "generator.clips", index)
        clips = [self.clips[int(i)] for i in rng.integers(len(self.clips), size=form.clips)]
        z_r, z_0, z_map, m = (
            torch.stack(z) for z in zip(*(clip.latents for clip in clips), strict=True)
        )
        columns = self._columns(rng, z_0.shape[-1])
        latents = slice(0, form.latents)
        w = int(rng.integers(len(range(z_0.shape[2])[latents])))
        z_r, z_0, z_map, m = (z[:, :, latents, :, columns] for z in (z_r, z_0, z_map, m))
        b = z_0.shape[0]
        n = z_0.shape[2]

        def normal(name: str) -> Tensor:
            noise = stream("training", form.seed, f"generator.{name}", index).standard_normal(
                z_0.shape, dtype=np.float32
            )
            return torch.from_numpy(noise)

        def uniform() -> Tensor:
            return torch.from_numpy(rng.random((b, n), dtype=np.float32))

        sample = Sample(
            z_r, z_0, z_map, m, normal("eps"), normal("context"), uniform(), uniform(), w
        )
        batch = Drawn(sample, clips, columns)
        return batch._replace(sample=self._as_seen(batch))

    def _as_seen(self, batch: Drawn) -> Sample:
        """Replace map, mask and condition by what the network sees."""
        s = batch.sample
        condition = s.condition
        m = s.m
        if self._map is not None:
            condition = self._map[:, : s.z_0.shape[2], :, batch.columns].expand_as(condition)
        if self.conditioning.source == "noise":
            m = torch.zeros_like(m)
            condition = torch.cat([condition, s.z_r], dim=1)
        if self.conditioning.opacity:
            _, opacity = batch.frames(1 + GROUP * (s.z_0.shape[2] - 1))
            condition = torch.cat([condition, opacity_values(opacity)], dim=1)
        return Sample(s.z_r, s.z_0, condition, m, s.eps, s.eps_context, s.t, s.t_redenoise, s.w)

    def _columns(self, rng: np.random.Generator, width: int) -> slice:
        """Draw the columns of the crop in latents, whole tokens, of an image ``width`` latents wide."""
        columns = self.form.columns
        if columns is None or columns >= width:
            return slice(0, width)
        left = PATCH * int(rng.integers((width - columns) // PATCH + 1))
        return slice(left, left + columns)


@torch.no_grad()
def shown_map(
    map: Literal["drawn", "black", "nothing"], clips: LatentClips, vae: TinyVAE
) -> Tensor | None:
    """Return the latents ``(16, N, H/8, W/8)`` that all clips have in their maps' place; None where
    their own are shown.
    """
    if map == "drawn":
        return None
    like = clips[0].z_map
    if map == "nothing":
        return torch.zeros_like(like)
    _, latents, rows, columns = like.shape
    return vae.encode(
        torch.full((1, 3, 1 + GROUP * (latents - 1), rows * SIDE, columns * SIDE), -1.0)
    )[0]
