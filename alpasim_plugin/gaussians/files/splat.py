"""Read and write the 32-byte ``.splat`` layout: no header, constant colour only, lossy."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.gaussians.arrays import SH_C0, GaussianArrays
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.io.atomic import atomic_file
from alpasim_plugin.io.limits import GAUSSIANS
from alpasim_plugin.io.reading import read_bytes

_ROW = np.dtype(
    [("position", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("rotation", "u1", 4)],
)


def read_splat(path: Path | str) -> GaussianArrays:
    """Read a ``.splat`` file.

    Raises:
        InputError: Missing or empty file, or a size that is not a multiple of 32 bytes.
    """
    path = Path(path)
    data = read_bytes(path, "reading a .splat file")
    if not data or len(data) % _ROW.itemsize:
        raise InputError(
            "reading a .splat file",
            str(path),
            f"{len(data)} bytes, not a whole number of {_ROW.itemsize}-byte rows",
            "copy or export the file again; it has no header, so a cut file shows only in its size",
        )
    GAUSSIANS.check(len(data) // _ROW.itemsize, "reading a .splat file", path)
    rows = np.frombuffer(data, dtype=_ROW)
    rgba = rows["rgba"].astype(np.float64) / 255.0
    return GaussianArrays(
        means=rows["position"].copy(),
        quats=(rows["rotation"].astype(np.float32) - 128.0) / 128.0,
        scales=rows["scale"].copy(),
        opacities=rgba[:, 3],
        sh=((rgba[:, None, :3] - 0.5) / SH_C0).astype(np.float32),
    )


def write_splat(path: Path | str, cloud: GaussianCloud) -> None:
    """Write a cloud as ``.splat``; bands above the constant colour are lost and colours are clipped to 0..1.

    Rotations keep 7 bits and sign, colours and opacity 8 bits; positions and scales are exact in float32.

    Raises:
        InfrastructureError: The folder is missing or not writable, or the disk is full.
    """
    rows = np.zeros(len(cloud.means), dtype=_ROW)
    rows["position"] = cloud.means
    rows["scale"] = cloud.scales
    rgb = 0.5 + SH_C0 * np.asarray(cloud.sh, dtype=np.float64)[:, 0, :]
    rgba = np.concatenate([rgb, np.asarray(cloud.opacities, dtype=np.float64)[:, None]], axis=1)
    rows["rgba"] = np.rint(np.clip(rgba, 0.0, 1.0) * 255.0)
    rows["rotation"] = np.clip(np.rint(np.asarray(cloud.quats, dtype=np.float64) * 128.0 + 128.0), 0, 255)
    with atomic_file(path, "writing a .splat file") as partial:
        partial.write_bytes(rows.tobytes())
