"""Writers of PLY files of any layout."""

import numpy as np

from alpasim_plugin.gaussians import GaussianCloud


def make_cloud(n=5, k=16):
    rng = np.random.default_rng(3)
    quats = rng.normal(size=(n, 4))
    return GaussianCloud(
        means=rng.normal(size=(n, 3)).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        scales=np.exp(rng.normal(size=(n, 3)) - 3),
        opacities=rng.uniform(0.01, 0.99, n),
        sh=rng.normal(size=(n, k, 3)).astype(np.float32),
    )


def element(name, names, rows):
    header = f"element {name} {len(rows)}\n" + "".join(f"property float {p}\n" for p in names)
    return header, rows.astype("<f4").tobytes()


def write_elements(path, *parts, fmt="binary_little_endian"):
    head = (
        f"ply\nformat {fmt} 1.0\ncomment made by a test\n"
        + "".join(h for h, _ in parts)
        + "end_header\n"
    )
    path.write_bytes(head.encode() + b"".join(body for _, body in parts))
    return path


NAMES = [
    "x",
    "y",
    "z",
    "f_dc_0",
    "f_dc_1",
    "f_dc_2",
    "opacity",
    *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
]
