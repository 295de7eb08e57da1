"""The image arms' equations: steps, losses, noise and augmentation against what the papers
write.
"""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from alpasim_plugin.block_fixers.dit import CosmosCausalDiT, initial_weights
from alpasim_plugin.block_fixers.networks import Parts
from alpasim_plugin.block_fixers.sizes import DiTSizes
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.fixers import fixer_settings, make_fixer
from alpasim_plugin.lab.image_fixers.pipeline import (
    fixed_step,
)
from alpasim_plugin.lab.image_fixers.settings import RenderStepSettings
from alpasim_plugin.lab.training.render_step import RenderStep
from tests.fixers.clip_cases import moving_picture, pixels
from tests.lab.training.image_cases import busy_settings

TEXT = torch.zeros(1, 1, 7)
SIZES = DiTSizes(24, 2, 12, 40, 5, 7, 9)


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    return tmp_path_factory.mktemp("weights")


@pytest.fixture(scope="module")
def net():
    return CosmosCausalDiT.from_state_dict(initial_weights(SIZES, 3)).requires_grad_(False)


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(
        1
    )  # matrices this small are slower on several; tests/conftest.py sets the number back


def normal(*shape, key="z"):
    return torch.from_numpy(stream("tests", 0, key).standard_normal(shape, dtype=np.float32))


def ddpm(steps=1000):
    """Return alpha and sigma of Stable Diffusion's schedule, as its scheduler's configuration
    defines them.
    """
    kept = np.cumprod(1 - np.linspace(0.00085**0.5, 0.012**0.5, steps) ** 2)
    return np.sqrt(kept), np.sqrt(1 - kept)


def test_difixs_step_is_the_ddpm_formula_at_199(net):
    settings = fixer_settings("difix")
    level, (alphas, sigmas) = settings.level, ddpm()
    alpha = float(alphas[199])
    sigma = float(sigmas[199])
    assert (alpha, sigma) == pytest.approx((0.86904, 0.49473), abs=1e-5)
    assert (level.alpha, level.sigma) == pytest.approx((alpha, sigma), abs=1e-6)
    assert (level.t, level.scale, level.network_t) == pytest.approx((0.3628, 0.7333, 363), abs=1e-4)
    z_r = normal(2, 16, 1, 4, 6)
    x = z_r / (alpha + sigma)
    eps = x + (1 - sigma / (alpha + sigma)) * net(
        x, 363.0, TEXT, torch.zeros_like(x), block_latents=None
    )  # x = (1-t) z_0 + t eps
    assert_close(fixed_step(net, z_r, level, TEXT), (z_r - sigma * eps) / alpha, atol=1e-5, rtol=0)


@pytest.mark.parametrize("name", ["harmonizer", "harmonizer-temporal"])
def test_the_training_sees_the_outputs_that_the_session_shows(weights, name):
    frames = moving_picture(7, (16, 32))
    settings = busy_settings(weights, name)
    assert isinstance(settings, RenderStepSettings)
    fixer = make_fixer(name, settings, scene_id="s")
    shown = pixels([fixer.step([frame], ())[0] for frame in frames])
    render = torch.from_numpy(pixels(frames)).permute(3, 0, 1, 2)[None].float() / 127.5 - 1
    made = (
        step_of(settings).outputs(render)
        if name.endswith("temporal")
        else step_of(settings).outputs(render[:, :, :4])
    )
    wanted = shown[: made.shape[2]]
    assert np.abs((made[0].permute(1, 2, 3, 0).numpy() + 1) * 127.5 - wanted).max() < 1.01


def step_of(settings):
    parts = Parts(settings)
    vae = parts.vae()
    return RenderStep(
        parts.dit().float(), vae.float(), settings.level, settings.decoder.kind == "render"
    )
