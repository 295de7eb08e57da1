"""SOG: what a writer quantised comes back, from a folder and from a zip; real models; and what
cannot be is said.
"""

import json
import zipfile

import cv2
import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.gaussians.files import read_gaussians

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
    turned = np.zeros((N, 4), np.uint8)
    for i, q in enumerate(quats):
        k = int(np.argmax(np.abs(q)))
        rest = np.delete(q * np.sign(q[k]), k)
        turned[i] = [*np.rint((rest / np.sqrt(2) + 0.5) * 255), 252 + k]

    def save(name, rgba, shape=(SIDE, SIDE)):
        full = np.zeros((shape[0] * shape[1], 4), np.uint8)
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


@pytest.mark.parametrize("zipped", [False, True], ids=["folder", "zip"])
def test_a_model_comes_back(tmp_path, zipped):
    true = write_sog(tmp_path / "model")
    path = tmp_path / "model"
    if zipped:
        path = tmp_path / "model.sog"
        with zipfile.ZipFile(path, "w") as archive:
            for file in sorted((tmp_path / "model").iterdir()):
                archive.write(file, file.name)
    cloud, report = read_gaussians(path)
    assert report.n_kept == N
    assert np.abs(np.log1p(np.abs(cloud.means)) - np.log1p(np.abs(true["means"]))).max() < 1e-4
    assert np.abs(np.abs((cloud.quats * true["quats"]).sum(axis=1)) - 1).max() < 1e-4
    assert np.allclose(cloud.scales, true["scales"], rtol=1e-5)
    assert np.allclose(cloud.opacities, true["opacities"], atol=1e-6)
    assert np.allclose(cloud.sh, true["sh"], atol=1e-5)


def test_three_levels_of_a_real_model_agree(data_set):
    folder = data_set("gaussians/playbot")
    clouds = [read_gaussians(folder / level)[0] for level in ("4_0", "5_0", "6_0")]
    assert [len(cloud) for cloud in clouds] == [8406, 3000, 1873]
    for cloud in clouds[1:]:
        assert np.abs(cloud.means.min(axis=0) - clouds[0].means.min(axis=0)).max() < 0.02
        assert np.abs(cloud.means.mean(axis=0) - clouds[0].means.mean(axis=0)).max() < 0.1


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("meta.json", lambda data: data.replace(b"quats.webp", b"gone.webp")),
        ("sh0.webp", lambda data: data[:40]),
        ("scales.webp", lambda data: b"\x89PNG"),
        ("meta.json", lambda data: data.replace(b'"version": 2', b'"version": 1')),
        ("meta.json", lambda data: data.replace(b'"count": 90', b'"count": 101')),
        ("meta.json", lambda data: data.replace(b'"count": 90', b'"count": 30000000')),
    ],
)
def test_what_cannot_be_a_model_is_said(tmp_path, name, change):
    write_sog(tmp_path / "model")
    path = tmp_path / "model" / name
    path.write_bytes(change(path.read_bytes()))
    with pytest.raises(InputError):
        read_gaussians(tmp_path / "model")
