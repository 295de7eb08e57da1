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
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.fixers import fixer_settings, make_fixer
from alpasim_plugin.lab.image_fixers.pipeline import (
    CONDITION_KEY,
    LATENT_KEY,
    fixed_step,
    share_embedding,
)
from alpasim_plugin.lab.image_fixers.settings import RenderLevel, RenderStepSettings
from alpasim_plugin.lab.training.noise_window import (
    edm_error,
    noise_window_errors,
    squared_error,
)
from alpasim_plugin.lab.training.render_step import RenderStep, warp_term
from alpasim_plugin.lab.training.warping import flow_between, warping_loss
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
    alpha, sigma = float(alphas[199]), float(sigmas[199])
    assert (alpha, sigma) == pytest.approx((0.86904, 0.49473), abs=1e-5)
    assert (level.alpha, level.sigma) == pytest.approx((alpha, sigma), abs=1e-6)
    assert (level.t, level.scale, level.network_t) == pytest.approx((0.3628, 0.7333, 363), abs=1e-4)
    z_r = normal(2, 16, 1, 4, 6)
    x = z_r / (alpha + sigma)
    eps = x + (1 - sigma / (alpha + sigma)) * net(
        x, 363.0, TEXT, torch.zeros_like(x), block_latents=None
    )  # x = (1-t) z_0 + t eps
    assert_close(fixed_step(net, z_r, level, TEXT), (z_r - sigma * eps) / alpha, atol=1e-5, rtol=0)


def test_the_harmonizers_step_at_a_fifth(net):
    settings = fixer_settings("harmonizer")
    z_r = normal(1, 16, 2, 4, 6)
    v = net(0.8 * z_r, 200.0, TEXT, torch.zeros_like(z_r), block_latents=None)
    assert_close(fixed_step(net, z_r, settings.level, TEXT), 0.8 * z_r - 0.2 * v, atol=1e-6, rtol=0)
    with pytest.raises(InputError):
        RenderLevel(1.0, 0.0)


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


def test_the_warping_loss_is_small_where_the_prediction_moves_with_the_clean_frames():
    clip = (
        torch.from_numpy(pixels(moving_picture(6, (48, 64), holes=False)))
        .permute(3, 0, 1, 2)[None]
        .float()
        / 127.5
        - 1
    )
    earlier, now = clip[:, :, 1:5].flip(2), clip[:, :, 5]
    flow = flow_between(earlier, now)
    assert flow.shape == (1, 4, 48, 64, 2)
    inner = flow[0, 0, 12:-12, 16:-16].mean((0, 1))
    np.testing.assert_allclose(inner, [-3, -1], atol=0.3)  # the picture slides by (-3, -1) a frame
    prediction = now.clone().requires_grad_(True)
    last = earlier[:, :, :1], flow[:, :1]
    moving, still = (
        warping_loss(prediction, *last),
        warping_loss(now, last[0], torch.zeros_like(last[1])),
    )
    assert float(moving.detach()) < 0.3 * float(still)
    moving.backward()  # type: ignore[no-untyped-call]
    assert prediction.grad.abs().sum() > 0
    away = torch.full_like(flow, 1e4)
    assert float(warping_loss(now, earlier, away)) == pytest.approx(1e-3, rel=1e-3), (
        "outside the picture nothing counts: sqrt(1e-6)"
    )
    weighted = warp_term(now[:, :, None], clip, 2.0)["warp-farneback"]
    assert float(weighted) == pytest.approx(
        2 * float(warping_loss(now, earlier, flow)), rel=1e-5
    ), "the last four, newest first"


def test_the_enhancers_loss_is_edms_on_the_clean_latents(net):
    z_0, z_r, eps = (normal(3, 16, 2, 4, 4, key=key) for key in ("clean", "render", "noise"))
    s = torch.tensor([0.1, 2.0, 30.0])
    t = s / (1 + s)
    made = noise_window_errors(net, z_0, z_r, eps, t, TEXT, edm_error)
    x = (z_0 + s.view(-1, 1, 1, 1, 1) * eps) / (1 + s).view(
        -1, 1, 1, 1, 1
    )  # EDM's noised latents on the straight path
    x0_hat = x - t.view(-1, 1, 1, 1, 1) * net(x, 1000 * t[:, None], TEXT, z_r, block_latents=None)
    wanted = ((1 + s**2) / s**2).view(-1, 1, 1, 1, 1) * (x0_hat - z_0).abs()
    assert_close(made, wanted, rtol=1e-3, atol=1e-3)
    plain = noise_window_errors(net, z_0, z_r, eps, t, TEXT, squared_error)
    assert_close(
        plain,
        (made / (((1 - t) ** 2 + t**2) / t).view(-1, 1, 1, 1, 1)).square(),
        rtol=1e-3,
        atol=1e-5,
    )


def test_a_shared_embedding_leaves_the_tokens_of_equal_inputs():
    weights = initial_weights(SIZES, 1)
    shared = share_embedding(weights)
    before, after = (
        CosmosCausalDiT.from_state_dict(w).requires_grad_(False) for w in (weights, shared)
    )
    x = normal(1, 16, 2, 4, 4)
    assert_close(
        after(x, 500.0, TEXT, x), before(x, 500.0, TEXT, torch.zeros_like(x)), atol=1e-5, rtol=0
    )
    assert torch.equal(shared[LATENT_KEY][:, 64:], weights[LATENT_KEY][:, 64:]), (
        "the masks' columns stay"
    )
    assert shared[CONDITION_KEY].shape == weights[CONDITION_KEY].shape
