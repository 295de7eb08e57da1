"""LPIPS and DISTS equal their reference implementations: `golden.json` holds what the packages
``lpips`` 0.1.4 and ``dists-pytorch`` 0.1 gave for the same twenty clips with the same random
weights.
"""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import file_sha256
from alpasim_plugin.lab.video_metrics import dists
from alpasim_plugin.lab.video_metrics.dists import DISTS
from alpasim_plugin.lab.video_metrics.image_distance import (
    available,
    image_distances,
    load_distance,
)
from alpasim_plugin.lab.video_metrics.lpips import LPIPS
from tests.lab.video_metrics.golden_inputs import (
    CLIPS,
    CLOSE,
    clip,
    golden,
    images,
    seed_network,
)
from tests.lab.video_metrics.published_files import write_trunk

NETWORKS = {
    "dists": DISTS,
    "lpips_alex": lambda: LPIPS("alex"),
    "lpips_vgg": lambda: LPIPS("vgg"),
}


def trained_keys(key):
    """Return the key under which a weight is seeded; None for constants."""
    return key if key.startswith(("features.", "heads.")) or key in ("alpha", "beta") else None


@pytest.mark.parametrize("name", NETWORKS)
def test_twenty_clips_have_the_distances_of_the_reference(name):
    net = seed_network(NETWORKS[name](), trained_keys)
    truth, made = (np.concatenate(side) for side in zip(*map(clip, range(CLIPS)), strict=True))
    values = image_distances(net, made, truth).reshape(CLIPS, -1).mean(axis=1)
    # DISTS is one minus a sum near one, in float32.
    assert values == pytest.approx(golden(name)["values"], rel=CLOSE, abs=1e-6)


def test_dists_is_zero_for_equal_images_and_symmetric():
    net = seed_network(DISTS(), trained_keys)
    truth, made = (images(frames) for frames in clip(7))
    assert_close(net.distance(truth, truth), torch.zeros(2), atol=1e-6, rtol=0)
    assert_close(net.distance(truth, made), net.distance(made, truth))


def test_dists_is_read_from_the_published_layout_and_refused_when_modified(tmp_path, monkeypatch):
    write_trunk(tmp_path, "vgg", monkeypatch)
    assert "dists" not in available(tmp_path)
    with pytest.raises(InputError, match=r"dists-weights\.pt"):
        load_distance("dists", tmp_path)
    heads = {name: torch.rand(1, 1475, 1, 1) for name in ("alpha", "beta")}
    torch.save(heads, tmp_path / dists.HEADS_FILE)
    assert "dists" in available(tmp_path)
    with pytest.raises(InputError, match="sha256"):
        load_distance("dists", tmp_path)
    monkeypatch.setattr(dists, "HEADS_SHA256", file_sha256(tmp_path / dists.HEADS_FILE))
    net = load_distance("dists", tmp_path)
    assert torch.equal(net.alpha, heads["alpha"].flatten())
    assert not any(parameter.requires_grad for parameter in net.parameters())
