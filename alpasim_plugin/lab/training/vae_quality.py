"""Reconstruction quality of an autoencoder: PSNR, and temporal flicker relative to the motion of
the original.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.block_fixers.clips import crop_clip, pad_clip
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.core.image_metrics import CAP_DB, decibels


@dataclass(frozen=True)
class VaeQuality:
    """Mean over a clip's frames.

    Args:
        psnr_db: Peak signal-to-noise ratio of 8-bit images, per frame, dB.
        flicker: Root mean square of the temporal difference of the error, grey levels of 255; zero
            for a static error.
        copy_flicker: Root mean square of the temporal difference of the original: the effect of
            motion alone.
    """

    psnr_db: float
    flicker: float
    copy_flicker: float


def round_trip(
    vae: TinyVAE, video: Tensor, render: Tensor | None = None, opacity: Tensor | None = None
) -> Tensor:
    """Encode and decode a clip ``(1, 3, T, H, W)`` of any size; a render conditions the decoder."""
    with torch.inference_mode():
        padded, size = pad_clip(video)
        condition = [None if x is None else pad_clip(x)[0] for x in (render, opacity)]
        return crop_clip(
            vae.decode(vae.encode(padded), render=condition[0], opacity=condition[1]), size
        )


def quality(made: Tensor, wanted: Tensor) -> VaeQuality:
    """Compare clips ``(1, 3, T, H, W)`` in [-1, 1]."""
    a, b = (
        np.rint((x.numpy().astype(np.float64) + 1) * 127.5).clip(0, 255) for x in (made, wanted)
    )
    error = a - b
    mse = (error**2).mean(axis=(0, 1, 3, 4))
    psnr = np.array([min(CAP_DB, decibels(max(float(m), 1e-10))) for m in mse])
    change = np.diff(error, axis=2)
    return VaeQuality(
        float(psnr.mean()),
        float(np.sqrt((change**2).mean())),
        float(np.sqrt((np.diff(b, axis=2) ** 2).mean())),
    )
