"""Perceptual image distances by name: `perceptual-syn`, shipped with the package; LPIPS and DISTS,
with weights from the user.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Literal, Protocol, get_args

from torch import Tensor

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.video_metrics import dists
from alpasim_plugin.lab.video_metrics.lpips import Kind, load_lpips, missing_files
from alpasim_plugin.lab.video_metrics.perceptual_net import NAME, load_perceptual

DistanceName = Literal["perceptual-syn", "lpips_alex", "lpips_vgg", "dists"]
FOLDER_VARIABLE = "SIMRUN_METRIC_WEIGHTS"
DISTS = "dists"
_KINDS: dict[str, Kind] = {"lpips_alex": "alex", "lpips_vgg": "vgg"}


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


def available(folder: str | Path | None = None) -> tuple[DistanceName, ...]:
    """Return the names of the distances whose weights are on disk."""
    found = weights_folder(folder)
    names: tuple[DistanceName, ...] = get_args(DistanceName)
    return tuple(
        name for name in names if name == NAME or (found is not None and not _missing(name, found))
    )


def _missing(name: str, folder: Path) -> list[str]:
    return dists.missing_files(folder) if name == DISTS else missing_files(_KINDS[name], folder)


def load_distance(name: str, folder: str | Path | None = None) -> ImageDistance:
    """Load a distance by name, frozen.

    Raises:
        InputError: Unknown name, no folder of weights, or missing or modified weights.
    """
    if name == NAME:
        return load_perceptual()
    if name not in (*_KINDS, DISTS):
        raise InputError(
            f"name {name!r}: no such distance",
            f"choose one of {get_args(DistanceName)}",
        )
    found = weights_folder(folder)
    if found is None:
        raise InputError(
            f"{name}: no folder of weights is set",
            f"set {FOLDER_VARIABLE} to the folder that holds the files named in docs/lab/video-metrics.md, or use {NAME}",
        )
    return dists.load_dists(found) if name == DISTS else load_lpips(_KINDS[name], found)


def distance_for_training(folder: str | Path | None = None) -> tuple[DistanceName, ImageDistance]:
    """Return LPIPS with VGG where its weights are on disk, else `perceptual-syn`, with its name,
    which every result must state.
    """
    name: DistanceName = "lpips_vgg" if "lpips_vgg" in available(folder) else "perceptual-syn"
    return name, load_distance(name, folder)
