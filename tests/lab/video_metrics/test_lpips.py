"""LPIPS: shapes and laws with random trunks; published values only where the published weights are
on disk.
"""

from dataclasses import replace

import pytest
import torch
from torch.testing import assert_close

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import file_sha256
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.lab.video_metrics.image_distance import (
    FOLDER_VARIABLE,
    available,
    distance_for_training,
    load_distance,
)
from alpasim_plugin.lab.video_metrics.lpips import LPIPS, TRUNKS, load_lpips
from tests.lab.video_metrics.published_files import write_trunk

KINDS = ("alex", "vgg")


def pictures(seed, count=2, side=64):
    return torch.from_numpy(
        stream("nets", seed, "lpips").uniform(-1, 1, (count, 3, side, side))
    ).float()


@pytest.fixture(scope="module", params=KINDS)
def net(request):
    torch.manual_seed(0)
    return LPIPS(request.param).requires_grad_(False)


def test_activations_have_the_published_channels_and_sizes(net):
    channels = {"alex": [64, 192, 384, 256, 256], "vgg": [64, 128, 256, 512, 512]}[net.kind]
    sides = {"alex": [15, 7, 3, 3, 3], "vgg": [64, 32, 16, 8, 4]}[net.kind]
    found = net.activations(pictures(0, 1))
    assert [list(x.shape) for x in found] == [
        [1, c, s, s] for c, s in zip(channels, sides, strict=True)
    ]
    assert all(float(x.min()) >= 0 for x in found)


def test_identity_symmetry_and_independence_of_the_batch(net):
    a = pictures(0)
    b = pictures(1)
    assert torch.equal(net.distance(a, a), torch.zeros(2))
    there = net.distance(a, b)
    assert torch.isfinite(there).all()
    assert torch.all(there > 0)
    assert_close(net.distance(b, a), there)
    assert_close(net.distance(a.flip(0), b.flip(0)), there.flip(0))


def test_missing_weights_are_named_and_no_number_is_made(tmp_path, monkeypatch):
    monkeypatch.delenv(FOLDER_VARIABLE, raising=False)
    with pytest.raises(InputError):
        load_lpips("alex", tmp_path)
    with pytest.raises(InputError, match=FOLDER_VARIABLE):
        load_distance("lpips_vgg")
    with pytest.raises(InputError):
        load_distance("lpips")
    assert available(tmp_path) == ("perceptual-syn",)
    assert distance_for_training(tmp_path)[0] == "perceptual-syn"


def test_published_layout_is_read_tensor_by_tensor(tmp_path, monkeypatch):
    """With the digests of made-up files in place of the published ones; everything else is as for a
    user.
    """
    plan = write_trunk(tmp_path, "alex", monkeypatch)
    net = load_lpips("alex", tmp_path)
    stored = torch.load(tmp_path / plan.file, weights_only=True)
    for c in plan.convolutions:
        assert torch.equal(net.features[str(c.index)].weight, stored[f"features.{c.index}.weight"])
    assert available(tmp_path) == ("perceptual-syn", "lpips_alex")
    assert not any(p.requires_grad for p in net.parameters())
    torch.save({"features.0.weight": torch.zeros(1)}, tmp_path / plan.heads_file)
    monkeypatch.setitem(
        TRUNKS,
        "alex",
        replace(TRUNKS["alex"], heads_sha256=file_sha256(tmp_path / plan.heads_file)),
    )
    with pytest.raises(InputError):
        load_lpips("alex", tmp_path)
