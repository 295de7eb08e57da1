"""A small pixel generator, its bundle and sessions of it over drawn frames."""

import torch

from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.fixers.bundle import save_bundle
from alpasim_plugin.fixers.network.pixel_generator import PixelGenerator, PixelSizes
from alpasim_plugin.fixers.pixel_fixer import PixelFixer
from alpasim_plugin.fixers.pixel_settings import PixelFixerSettings
from tests.fixers.clip_cases import maps_of, moving_picture

FRAMES = moving_picture(12)  # the last ones through a recording of the network
MAPS = maps_of(FRAMES)
SIZES = PixelSizes((8, 12, 16), (0, 1, 1, 1, 1), 8, 4)


def generator():
    """Return a network that changes frames and depends on its past."""
    torch.manual_seed(5)
    net = PixelGenerator(SIZES)
    with torch.no_grad():
        net.write.weight.mul_(6)
    return net


def write_bundle(path):
    settings = fixer_settings("onefixer", ["weights.bundle=null", "holes=noise"])
    assert isinstance(settings, PixelFixerSettings)
    save_bundle(
        path, {"generator": generator().state_dict()}, settings, trained=True, note="9 updates"
    )
    return path


def at(bundle, *overrides):
    settings = fixer_settings(
        "onefixer", [f"weights.bundle={bundle}", "precision=fp32", "holes=noise", *overrides]
    )
    assert isinstance(settings, PixelFixerSettings)
    return settings


def session(bundle, *overrides, seed=0):
    return PixelFixer(at(bundle, *overrides), "scene", seed)


def run(fixer, frames, maps=()):
    return [out for i, frame in enumerate(frames) for out in fixer.step([frame], maps[i : i + 1])]
