"""SOG: what a writer quantised comes back, from a folder and from a zip; real models; and what
cannot be is said.
"""

import zipfile

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.gaussians.files import read_gaussians
from tests.gaussians.sog_writer import N, write_sog


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
