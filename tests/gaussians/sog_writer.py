"""A writer of SOG files."""

import json

import cv2
import numpy as np

from alpasim_plugin.core.seeding import stream

N = 90
SIDE = 10


def write_sog(folder):
    """Write random Gaussians, one by one as the format's page says it, and return them."""
    rng = stream("sog", 0, "model")
    folder.mkdir()
    means = rng.normal(0, 3, (N, 3))
    quats = rng.normal(0, 1, (N, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    codebook = np.sort(rng.uniform(-6, 0, 256))
    scales, colours, alphas = (
        rng.integers(0, 256, shape).astype(np.uint8) for shape in ((N, 3), (N, 3), N)
    )
    bands = rng.integers(0, 256, (64, 3, 3)).astype(np.uint8)
    palette = rng.integers(0, 64, N)
    logs = np.sign(means) * np.log1p(np.abs(means))
    low = logs.min(axis=0)
    high = logs.max(axis=0)
    sixteen = np.rint((logs - low) / (high - low) * 65535).astype(np.int64)
    turned = np.zeros((N, 4), dtype=np.uint8)
    for i, q in enumerate(quats):
        k = int(np.argmax(np.abs(q)))
        rest = np.delete(q * np.sign(q[k]), k)
        turned[i] = [*np.rint((rest / np.sqrt(2) + 0.5) * 255), 252 + k]

    def save(name, rgba, shape=(SIDE, SIDE)):
        full = np.zeros((shape[0] * shape[1], 4), dtype=np.uint8)
        full[:, 3] = 255
        full[: len(rgba), : rgba.shape[1]] = rgba
        image = cv2.cvtColor(full.reshape(*shape, 4), cv2.COLOR_RGBA2BGRA)
        cv2.imwrite(str(folder / name), image, [cv2.IMWRITE_WEBP_QUALITY, 101])

    save("means_l.webp", sixteen & 255)
    save("means_u.webp", sixteen >> 8)
    save("quats.webp", turned)
    save("scales.webp", scales)
    save("sh0.webp", np.column_stack([colours, np.maximum(alphas, 1)]))
    save("shN_centroids.webp", bands.reshape(-1, 3), (1, 64 * 3))
    save("shN_labels.webp", np.column_stack([palette, 0 * palette]))
    meta = {
        "version": 2,
        "count": N,
        "means": {
            "mins": low.tolist(),
            "maxs": high.tolist(),
            "files": ["means_l.webp", "means_u.webp"],
        },
        "scales": {"codebook": codebook.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": codebook.tolist(), "files": ["sh0.webp"]},
        "shN": {
            "count": 64,
            "bands": 1,
            "codebook": codebook.tolist(),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        },
    }
    (folder / "meta.json").write_text(json.dumps(meta))
    sh = np.concatenate([codebook[colours][:, None], codebook[bands][palette]], axis=1)
    return {
        "means": means,
        "quats": quats,
        "scales": np.exp(codebook[scales]),
        "opacities": np.maximum(alphas, 1) / 255,
        "sh": sh,
    }
