"""Writers of packed splat files: SPZ, compressed PLY and .splat."""

import gzip
import struct

import numpy as np
import zstandard

from alpasim_plugin.gaussians.files.packed import _ROW
from alpasim_plugin.gaussians.sh import C0

BOUNDS = [f"{end}_{axis}" for end in ("min", "max") for axis in ("x", "y", "z")]
BOUNDS += [f"{end}_scale_{axis}" for end in ("min", "max") for axis in ("x", "y", "z")]


def write_compressed(
    path,
    n,
    chunks,
    packed,
    sh=b"",
    n_sh=0,
):
    head = f"ply\nformat binary_little_endian 1.0\nelement chunk {chunks}\n" + "".join(
        f"property float {b}\n" for b in BOUNDS
    )
    head += f"element vertex {n}\n" + "".join(
        f"property uint packed_{p}\n" for p in ("position", "rotation", "scale", "color")
    )
    if n_sh:
        head += f"element sh {n}\n" + "".join(f"property uchar f_rest_{i}\n" for i in range(n_sh))
    bounds = struct.pack("<12f", 0, 10, 20, 2, 12, 22, -3, -3, -3, -1, -1, -1)
    path.write_bytes(
        head.encode() + b"end_header\n" + bounds * chunks + struct.pack("<4I", *packed) * n + sh
    )
    return path


def write_splat(path, cloud):
    """Write a cloud as ``.splat``: constant colours in 8 bits, rotations in 7 bits and sign."""
    rgb = 0.5 + C0 * np.asarray(cloud.sh, dtype=np.float64)[:, 0]
    rgba = np.column_stack([rgb, cloud.opacities])
    rows = np.zeros(len(cloud), dtype=_ROW)
    rows["position"], rows["scale"] = cloud.means, cloud.scales
    rows["rgba"] = np.rint(np.clip(rgba, 0, 1) * 255)
    rows["rotation"] = np.clip(
        np.rint(np.asarray(cloud.quats, dtype=np.float64) * 128 + 128), 0, 255
    )
    path.write_bytes(rows.tobytes())


def body_streams(version, n, degree):
    rng = np.random.default_rng(7)
    sizes = [9 * n, n, 3 * n, 3 * n, (3 if version < 3 else 4) * n, 3 * n * ((degree + 1) ** 2 - 1)]
    return [rng.integers(0, 256, size, dtype=np.uint8).tobytes() for size in sizes]


def write_spz(path, version, n, degree, streams, claim=None):
    head = struct.pack("<IIIBBB", 0x5053474E, version, n if claim is None else claim, degree, 12, 0)
    if version == 4:
        used = streams if degree else streams[:5]
        packed = [zstandard.ZstdCompressor().compress(s) for s in used]
        table = b"".join(
            struct.pack("<QQ", len(p), len(s)) for p, s in zip(packed, used, strict=True)
        )
        path.write_bytes(head + struct.pack("<BI12x", len(used), 32) + table + b"".join(packed))
    else:
        path.write_bytes(gzip.compress(head + b"\0" + b"".join(streams)))
    return path
