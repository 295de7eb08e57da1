"""A small network that depends on its past, and a renderer for it to stand in front of."""

import pytest
import torch

from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.fixers.bundle import save_bundle
from alpasim_plugin.fixers.network.pixel_generator import PixelGenerator, PixelSizes
from tests.alpasim.service_cases import StandInRenderer, hosted


@pytest.fixture(scope="session")
def bundle(tmp_path_factory):
    torch.manual_seed(5)
    net = PixelGenerator(PixelSizes((8, 12, 16), (0, 1, 1, 1, 1), 8, 4))
    with torch.no_grad():
        net.write.weight.mul_(6)
    path = tmp_path_factory.mktemp("served") / "small.safetensors"
    settings = fixer_settings("onefixer", ["weights.bundle=null", "holes=noise"])
    save_bundle(
        path, {"generator": net.state_dict()}, settings, trained=True, note="a small network"
    )
    return path


@pytest.fixture
def overrides(bundle):
    """Settings of the small fixer: noise in holes, so that its key counts."""
    return [f"weights.bundle={bundle}", "precision=fp32", "holes=noise", "keep_render=false"]


@pytest.fixture
def renderer():
    return StandInRenderer()


@pytest.fixture
def upstream(renderer):
    with hosted({"SensorsimService": renderer}) as host:
        yield host
