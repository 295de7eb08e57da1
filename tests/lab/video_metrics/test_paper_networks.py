"""Loaders of FVD's and DISTS's networks, on random weights of the same form; published values only
where the weights are on disk.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers.network.checkpoints import file_sha256
from alpasim_plugin.lab.video_metrics.dists import DISTS, HEADS, load_dists
from alpasim_plugin.lab.video_metrics.i3d import FILE, i3d_features, load_i3d
from alpasim_plugin.lab.video_metrics.lpips import TRUNKS

# VGG-16 with a sixteenth of its channels: the published one costs seconds.
SMALL = replace(
    TRUNKS["vgg"],
    convolutions=tuple(
        replace(c, inputs=max(c.inputs // 16, 3), outputs=c.outputs // 16)
        for c in TRUNKS["vgg"].convolutions
    ),
)


class RandomI3D(nn.Module):
    """The call of the StyleGAN-V protocol around one random layer."""

    def __init__(self, logits: int = 400) -> None:
        super().__init__()
        self.layer = nn.Conv3d(3, logits, (2, 8, 8), (2, 8, 8))

    def forward(
        self, video: Tensor, rescale: bool = True, resize: bool = True, return_features: bool = True
    ) -> Tensor:
        x = video / 127.5 - 1 if rescale else video
        if resize:
            b, c, t, h, w = x.shape
            x = nn.functional.interpolate(
                x.transpose(1, 2).reshape(b * t, c, h, w),
                size=[16, 16],
                mode="bilinear",
                align_corners=False,
            )
            x = x.reshape(b, t, c, 16, 16).transpose(1, 2)
        return self.layer(x).mean([2, 3, 4])


def write_i3d(folder: Path, logits: int = 400) -> RandomI3D:
    torch.manual_seed(0)
    net = RandomI3D(logits).eval()
    torch.jit.script(net).save(str(folder / FILE))
    return net


def test_features_are_one_vector_a_clip_or_a_window(tmp_path: Path) -> None:
    own = write_i3d(tmp_path)
    net, digest = load_i3d(tmp_path)
    assert digest == file_sha256(tmp_path / FILE)
    video = np.random.default_rng(0).integers(0, 255, (35, 20, 28, 3)).astype(np.uint8)
    whole, windows = i3d_features(net, video), i3d_features(net, video, 16)
    assert whole.shape == (1, 400)
    assert windows.shape == (2, 400)
    tensor = torch.from_numpy(video[16:32]).permute(3, 0, 1, 2)[None].float()
    with torch.inference_mode():
        assert windows[1] == pytest.approx(
            own(tensor)[0].numpy(), rel=1e-4, abs=1e-6
        )  # scaled from 0..255 inside


def test_a_missing_file_and_other_forms_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        load_i3d(tmp_path)
    write_i3d(tmp_path, 10)
    with pytest.raises(InputError, match=r"features of shape \(1, 10\)"):
        load_i3d(tmp_path)
    torch.jit.script(nn.Conv2d(3, 4, 1)).save(str(tmp_path / FILE))
    with pytest.raises(InputError, match="not a network of this form"):
        load_i3d(tmp_path)
    (tmp_path / FILE).write_bytes(b"nothing")
    with pytest.raises(InputError, match="not a network of this form"):
        load_i3d(tmp_path)


def test_short_clips_are_refused(tmp_path: Path) -> None:
    write_i3d(tmp_path)
    net, _ = load_i3d(tmp_path)
    with pytest.raises(InputError, match="at least 10 frames"):
        i3d_features(net, np.zeros((9, 16, 16, 3), dtype=np.uint8))


@pytest.fixture(scope="module")
def net() -> DISTS:
    torch.manual_seed(0)
    return DISTS(SMALL).requires_grad_(False).eval()


def pictures(seed: int) -> Tensor:
    return torch.from_numpy(np.random.default_rng(seed).uniform(-1, 1, (2, 3, 32, 32))).float()


def test_dists_is_zero_on_itself_and_symmetric(net: DISTS) -> None:
    a, b = pictures(0), pictures(1)
    assert net.distance(a, a).abs().max() < 1e-5
    found = net.distance(a, b)
    assert torch.all(found > 0)
    torch.testing.assert_close(net.distance(b, a), found)


def test_dists_has_the_published_stages(net: DISTS) -> None:
    stages = net.stages(pictures(0))
    assert [s.shape[1] for s in stages] == [3, 4, 8, 16, 32, 32]
    assert 3 + sum(c.outputs for c in TRUNKS["vgg"].convolutions if c.tapped) == 1475
    assert [s.shape[2] for s in stages] == [32, 32, 16, 8, 4, 2]
    window = np.outer(np.hanning(5)[1:-1], np.hanning(5)[1:-1])
    assert net.hann.numpy() == pytest.approx(window / window.sum())


def test_dists_of_the_image_stage_alone_is_its_formula(net: DISTS) -> None:
    only = DISTS(SMALL).requires_grad_(False)
    only.load_state_dict(net.state_dict())
    only.alpha[:], only.beta[:] = 0.0, 0.0
    only.alpha[:3], only.beta[:3] = 0.2, 0.1
    a, b = pictures(2), pictures(3)
    x, y = ((p.double() + 1) / 2 for p in (a, b))
    mx, my = x.mean((2, 3)), y.mean((2, 3))
    covariance = (x * y).mean((2, 3)) - mx * my
    s1 = (2 * mx * my + 1e-6) / (mx**2 + my**2 + 1e-6)
    s2 = (2 * covariance + 1e-6) / (
        x.var((2, 3), correction=0) + y.var((2, 3), correction=0) + 1e-6
    )
    wanted = 1 - (0.2 * s1 + 0.1 * s2).sum(1) / 0.9
    torch.testing.assert_close(only.distance(a, b).double(), wanted, atol=1e-4, rtol=1e-4)


def test_dists_is_loaded_from_files_of_the_published_form(tmp_path: Path, net: DISTS) -> None:
    plan = net.plan
    trunk = {
        f"features.{c.index}.{part}": getattr(net.features[str(c.index)], part).clone()
        for c in plan.convolutions
        for part in ("weight", "bias")
    }
    heads = {
        "alpha": net.alpha.view(1, -1, 1, 1).clone(),
        "beta": net.beta.view(1, -1, 1, 1).clone(),
    }
    torch.save(heads, tmp_path / HEADS)
    with pytest.raises(InputError, match="not there: vgg16"):
        load_dists(tmp_path, plan=plan)
    torch.save(trunk, tmp_path / plan.file)
    with pytest.raises(InputError, match="does not begin with 397923af"):
        load_dists(tmp_path, plan=plan)
    digest = file_sha256(tmp_path / plan.file)
    named = tmp_path / f"vgg16-{digest[:8]}.pth"
    (tmp_path / plan.file).rename(named)
    own = replace(plan, file=named.name)
    with pytest.raises(InputError, match="sha256"):
        load_dists(tmp_path, plan=own)
    loaded = load_dists(tmp_path, file_sha256(tmp_path / HEADS), own)
    torch.testing.assert_close(
        loaded.distance(pictures(0), pictures(1)), net.distance(pictures(0), pictures(1))
    )
