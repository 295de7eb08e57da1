"""Perceptual image distances by name: `perceptual-syn`, shipped with the package; LPIPS and
DISTS, with weights from the user.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import file_sha256
from alpasim_plugin.core.types import F64, U8
from alpasim_plugin.lab.video_metrics import dists
from alpasim_plugin.lab.video_metrics.frames import check_stacks
from alpasim_plugin.lab.video_metrics.lpips import TRUNKS, Kind, load_lpips, missing_files
from alpasim_plugin.lab.video_metrics.perceptual_net import NAME, load_perceptual, shipped_weights

FOLDER_VARIABLE = "SIMRUN_METRIC_WEIGHTS"
KINDS: dict[str, Kind] = {"lpips_alex": "alex", "lpips_vgg": "vgg"}
BATCH = 8  # frames at a time


class ImageDistance(Protocol):
    """A frozen network that measures a perceptual distance."""

    def distance(self, a: Tensor, b: Tensor) -> Tensor:
        """Return ``(B,)`` for images ``(B, 3, H, W)`` in [-1, 1]."""
        ...


def weights_folder(folder: str | Path | None = None) -> Path | None:
    """Return the folder of metric weights: the given one, else ``SIMRUN_METRIC_WEIGHTS``, else
    None.
    """
    named = folder or os.environ.get(FOLDER_VARIABLE)
    return Path(named) if named else None


def available(folder: str | Path | None = None) -> tuple[str, ...]:
    """Return the names of the distances whose weights are on disk."""
    weights = weights_folder(folder)
    if weights is None:
        return (NAME,)
    names = [NAME, *(name for name, kind in KINDS.items() if not missing_files(kind, weights))]
    if not dists.missing_files(weights):
        names.append(dists.NAME)
    return tuple(names)


def digests(folder: str | Path | None = None) -> dict[str, str]:
    """Return the SHA-256 of what calibrates every available distance; the names of the trunks'
    files fix those.
    """
    sha256 = {name: TRUNKS[kind].heads_sha256 for name, kind in KINDS.items()}
    sha256[dists.NAME] = dists.HEADS_SHA256
    sha256[NAME] = file_sha256(shipped_weights())
    return {name: sha256[name] for name in available(folder)}


def load_distance(name: str, folder: str | Path | None = None) -> ImageDistance:
    """Load a distance by name, frozen.

    Raises:
        InputError: Unknown name, no folder of weights, or missing or modified weights.
    """
    if name == NAME:
        return load_perceptual()
    weights = weights_folder(folder)
    published = (*KINDS, dists.NAME)
    if name not in published or weights is None:
        raise InputError(
            f"perceptual distance {name!r}: no such distance, or no folder of weights",
            f"choose {NAME}, or one of {', '.join(published)} with {FOLDER_VARIABLE} set to the folder of its weights",
        )
    return dists.load_dists(weights) if name == dists.NAME else load_lpips(KINDS[name], weights)


def distance_for_training(folder: str | Path | None = None) -> tuple[str, ImageDistance]:
    """Return LPIPS with VGG where its weights are on disk, else `perceptual-syn`, with its name,
    which every result must state.
    """
    name = "lpips_vgg" if "lpips_vgg" in available(folder) else NAME
    return name, load_distance(name, folder)


def image_distances(net: ImageDistance, made: U8, truth: U8) -> F64:
    """Return a network's distance ``(T,)`` of every frame to the true one, ``(T, H, W, 3)`` each.

    Raises:
        EvaluatorError: Stacks that do not belong together.
    """
    check_stacks(made, truth)
    with torch.inference_mode():
        parts = [
            net.distance(_images(made[i : i + BATCH]), _images(truth[i : i + BATCH]))
            for i in range(0, len(made), BATCH)
        ]
    return np.asarray(torch.cat(parts).double().numpy())


def _images(frames: U8) -> Tensor:
    return torch.from_numpy(np.array(frames)).permute(0, 3, 1, 2).float() / 127.5 - 1
