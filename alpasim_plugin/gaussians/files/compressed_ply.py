"""Read SuperSplat's compressed PLY: 16 bytes a Gaussian, quantised within chunks of 256."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.gaussians.arrays import SH_C0, GaussianArrays
from alpasim_plugin.gaussians.files.ply_header import PlyHeader, read_ply_element, read_ply_header

CHUNK = 256
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_MAX_LOG_SCALE = 20.0


def is_compressed_ply(header: PlyHeader) -> bool:
    """Return whether a PLY header announces the packed layout."""
    return any("packed_position" in element.properties for element in header.elements)


def read_compressed_ply(path: Path | str) -> GaussianArrays:
    """Read a compressed PLY file.

    Returns:
        The Gaussians in the axes of the file, ``N`` rows in file order (Morton order, as the writer sorts them).

    Raises:
        InputError: Truncated file, missing properties, or fewer chunks than the Gaussians need.
    """
    header = read_ply_header(path)
    chunk_rows, rows = read_ply_element(header, "chunk"), read_ply_element(header, "vertex")
    _check(header, chunk_rows, rows)
    chunk = np.arange(len(rows)) // CHUNK
    bounds = {name: chunk_rows[name].astype(np.float64) for name in chunk_rows.dtype.names or ()}

    def spread(fractions: NDArray[np.float64], names: tuple[str, ...]) -> NDArray[np.float64]:
        low = np.stack([bounds[f"min_{name}"] for name in names], axis=1)[chunk]
        high = np.stack([bounds[f"max_{name}"] for name in names], axis=1)[chunk]
        return low * (1 - fractions) + high * fractions

    means = spread(_unpack_11_10_11(rows["packed_position"]), ("x", "y", "z"))
    log_scales = spread(_unpack_11_10_11(rows["packed_scale"]), ("scale_x", "scale_y", "scale_z"))
    rgba = _unpack_8888(rows["packed_color"])
    # Files from before the colour bounds were introduced store colours over 0..1.
    rgb = spread(rgba[:, :3], ("r", "g", "b")) if "min_r" in bounds else rgba[:, :3]
    dc = (rgb - 0.5) / SH_C0
    return GaussianArrays(
        means=means.astype(np.float32),
        quats=unpack_rotation(rows["packed_rotation"]).astype(np.float32),
        scales=np.exp(np.clip(log_scales, -_MAX_LOG_SCALE, _MAX_LOG_SCALE)),
        opacities=rgba[:, 3],
        sh=np.concatenate([dc[:, None, :], _read_sh(header, len(rows))], axis=1).astype(np.float32),
    )


def unpack_rotation(packed: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Return unit quaternions ``(N, 4)`` wxyz from 2 + 3 x 10 bits.

    The top two bits say which of w, x, y, z is the largest and left out; the others follow in order as ``0.5 + q / sqrt(2)``.
    """
    fractions = np.stack([(packed >> shift) & 1023 for shift in (20, 10, 0)], axis=1) / 1023.0
    others = (fractions - 0.5) * np.sqrt(2.0)
    largest = (packed >> 30).astype(np.intp)
    quats = np.empty((len(packed), 4))
    slots = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])[largest]
    np.put_along_axis(quats, slots, others, axis=1)
    # Rounding can bring the three slightly above length 1.
    left_out = np.sqrt(np.maximum(1.0 - np.sum(others**2, axis=1), 0.0))
    np.put_along_axis(quats, largest[:, None], left_out[:, None], axis=1)
    return quats


def _unpack_11_10_11(packed: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Return fractions ``(N, 3)`` in 0..1."""
    return np.stack([(packed >> 21) / 2047.0, ((packed >> 11) & 1023) / 1023.0, (packed & 2047) / 2047.0], axis=1)


def _unpack_8888(packed: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Return fractions ``(N, 4)`` in 0..1."""
    return np.stack([(packed >> shift) & 255 for shift in (24, 16, 8, 0)], axis=1) / 255.0


def _read_sh(header: PlyHeader, n: int) -> NDArray[np.float64]:
    """Return the higher bands ``(N, K - 1, 3)``: bytes at the centres of 256 bins over -4..4, channel-major as in a plain PLY."""
    if all(element.name != "sh" for element in header.elements):
        return np.zeros((n, 0, 3))
    rows = read_ply_element(header, "sh")
    n_rest = len(rows.dtype.names or ())
    if n_rest not in (9, 24, 45, 72) or len(rows) != n:
        raise InputError(
            "reading a compressed PLY file",
            f"{header.path}, element 'sh'",
            f"{len(rows)} rows of {n_rest} values for {n} Gaussians",
            "export the file again",
        )
    table = np.stack([rows[f"f_rest_{i}"] for i in range(n_rest)], axis=1).astype(np.float64)
    # The two end bytes stand for the ends of the range, so that clipped values keep their size.
    fractions = np.where(table == 0, 0.0, np.where(table == 255, 1.0, (table + 0.5) / 256.0))
    return np.swapaxes(((fractions - 0.5) * 8.0).reshape(n, 3, n_rest // 3), 1, 2)


def _check(header: PlyHeader, chunks: NDArray[np.void], rows: NDArray[np.void]) -> None:
    missing = [name for name in _PACKED if name not in (rows.dtype.names or ())]
    bounds = [f"{end}_{name}" for end in ("min", "max") for name in ("x", "y", "z", "scale_x", "scale_y", "scale_z")]
    missing += [name for name in bounds if name not in (chunks.dtype.names or ())]
    need = -(-len(rows) // CHUNK)
    if missing or len(chunks) < need:
        found = f"missing properties {missing}" if missing else f"{len(chunks)} chunks where {need} are needed"
        raise InputError("reading a compressed PLY file", str(header.path), found, "export the file again")
