"""The tiny autoencoder: transform, streams, render input, files."""

import copy
from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from alpasim_plugin.block_fixers.clips import crop_clip, pad_clip
from alpasim_plugin.block_fixers.networks import at_precision
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.block_fixers.tiny_vae_nets import (
    COMPONENTS,
    CosineTransform,
    TinySizes,
    to_grid,
)
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers.network.checkpoints import load_weights
from tests.block_fixers.codec_cases import clip, decoder_stream, encoder_stream, noise

SIZES = TinySizes(
    encoder_quarter=8, encoder_eighth=12, decoder_eighth=16, decoder_quarter=10, decoder_frame=6
)


def trained_like(seed=0):
    """Return a network whose corrections are not zero and whose statistics are not trivial."""
    vae = TinyVAE.random(SIZES, seed)
    for part in (vae.encoder, vae.decoder):
        torch.nn.init.normal_(
            part.head.weight, std=0.1, generator=torch.Generator().manual_seed(seed)
        )
    vae.stats.mean.copy_(0.1 * noise(16))
    vae.stats.std.copy_(1 + 0.1 * noise(16).tanh())
    return vae.requires_grad_(False)


@pytest.fixture(scope="module")
def vae():
    return trained_like()


# Transform


def test_components_are_orthonormal():
    kernel = CosineTransform().kernel.flatten(1).double()
    assert_close(
        kernel @ kernel.T, torch.eye(len(COMPONENTS), dtype=torch.float64), atol=1e-6, rtol=0
    )


def test_analysis_undoes_synthesis_and_the_residue_holds_the_rest():
    transform = CosineTransform()
    z = noise(2, 3, 2, 3, 16)
    assert_close(transform.analyse(transform.synthesise(z)), z, atol=1e-5, rtol=0)
    grid = to_grid(clip(8, 16, 24))
    assert_close(
        transform.synthesise(transform.analyse(grid)) + transform.residue(grid),
        grid,
        atol=1e-5,
        rtol=0,
    )
    assert (
        transform.analyse(transform.residue(grid))
        .sub(transform.analyse(torch.zeros_like(grid)))
        .abs()
        .max()
        < 1e-5
    )


# Round trips


def test_untrained_decoding_with_its_own_render_returns_the_render():
    untrained = TinyVAE.random(SIZES)
    video = clip(9, 16, 24)
    assert_close(untrained.decode(untrained.encode(video), render=video), video, atol=1e-5, rtol=0)


def test_untrained_round_trip_of_a_smooth_clip_is_close_and_of_noise_is_blurred():
    untrained = TinyVAE.random()
    rows = torch.linspace(-0.5, 0.5, 32).view(-1, 1)
    columns = torch.linspace(-0.4, 0.4, 48)
    smooth = (rows + columns).expand(1, 3, 5, 32, 48).clone()
    assert (untrained.decode(untrained.encode(smooth)) - smooth).abs().max() < 0.02
    rough = clip(5, 32, 48)
    assert (untrained.decode(untrained.encode(rough)) - rough).abs().mean() > 0.3


def test_full_opacity_is_as_none_and_zero_opacity_keeps_no_detail():
    untrained = TinyVAE.random(SIZES)
    video = clip(5, 16, 16)
    z = untrained.encode(video)
    cover = torch.ones(1, 1, 5, 16, 16)
    assert_close(
        untrained.decode(z, render=video, opacity=cover),
        untrained.decode(z, render=video),
        atol=1e-6,
        rtol=0,
    )
    assert_close(
        untrained.decode(z, render=video, opacity=0 * cover), untrained.decode(z), atol=1e-6, rtol=0
    )


def test_a_hole_in_the_render_is_filled_by_the_latent_alone():
    untrained = TinyVAE.random(SIZES)
    truth = clip(5, 16, 32)
    cover = torch.ones(1, 1, 5, 16, 32)
    cover[..., 16:] = 0
    z = untrained.encode(truth)
    out = untrained.decode(z, render=truth * cover, opacity=cover)
    assert_close(out[..., :16], truth[..., :16], atol=1e-5, rtol=0)
    assert_close(out[..., 16:], untrained.decode(z)[..., 16:], atol=1e-5, rtol=0)


# Streams


@pytest.mark.parametrize("counts", [[1, 4, 4, 4], [5, 8], [13], [9, 4]])
def test_encoding_in_any_blocks_is_bit_equal_to_the_whole_clip(vae, counts):
    video = clip(13, 16, 24, batch=2)
    stream = encoder_stream(vae)
    assert torch.equal(
        torch.cat([stream.push(part) for part in video.split(counts, dim=2)], dim=2),
        vae.encode(video),
    )


@pytest.mark.parametrize("seen", ["nothing", "render", "render and opacity"])
@pytest.mark.parametrize("counts", [[1, 1, 1, 1], [2, 2], [1, 3]])
def test_decoding_in_any_blocks_is_bit_equal_to_the_whole_clip(vae, counts, seen):
    z = noise(2, 16, 4, 2, 3)
    stream = decoder_stream(vae)
    start = 0
    parts = []
    given = {} if seen == "nothing" else {"render": clip(13, 16, 24, batch=2)}
    if seen == "render and opacity":
        given["opacity"] = noise(2, 1, 13, 16, 24).sigmoid()
    for part in z.split(counts, dim=2):
        end = start + 4 * part.shape[2] - (3 if start == 0 else 0)
        parts.append(stream.push(part, **{name: x[:, :, start:end] for name, x in given.items()}))
        start = end
    assert torch.equal(torch.cat(parts, dim=2), vae.decode(z, **given))


def test_the_latent_before_is_remembered(vae):
    video = clip(9, 16, 16)
    other = torch.cat([-video[:, :, :5], video[:, :, 5:]], dim=2)
    assert not torch.equal(vae.encode(video)[:, :, 2], vae.encode(other)[:, :, 2])


# Hard inputs


@pytest.mark.parametrize(("frames", "latents"), [(1, 1), (5, 2)])
def test_one_and_five_frames_give_one_and_two_latents(vae, frames, latents):
    z = vae.encode(clip(frames, 16, 24))
    assert z.shape == (1, 16, latents, 2, 3)
    assert vae.decode(z).shape == (1, 3, frames, 16, 24)


def test_six_frames_are_refused_and_padded_ones_crop_back(vae):
    video = clip(6, 15, 17)
    with pytest.raises(InputError):
        vae.encode(video)
    with pytest.raises(InputError):
        vae.encode(clip(6, 16, 16))
    padded, size = pad_clip(video)
    assert crop_clip(vae.decode(vae.encode(padded), render=padded), size).shape == video.shape


@pytest.mark.parametrize("value", [-1.0, 0.0, 1.0, 1e4])
def test_constant_and_saturated_clips_stay_finite(vae, value):
    video = torch.full((1, 3, 5, 16, 16), value)
    out = vae.decode(vae.encode(video), render=video)
    assert out.isfinite().all()
    assert out.abs().max() <= 1


def test_a_render_of_another_length_is_refused(vae):
    with pytest.raises(InputError):
        vae.decode(noise(1, 16, 2, 2, 2), render=clip(8, 16, 16))


def test_running_in_bfloat16_stays_close_and_keeps_constants_exact(vae):
    half = at_precision(copy.deepcopy(vae), "bf16")
    assert torch.equal(half.stats.mean, vae.stats.mean)
    assert torch.equal(half.transform.kernel, vae.transform.kernel)
    video = clip(5, 16, 16)
    out = half.decode(half.encode(video), render=video)
    assert out.dtype == torch.bfloat16
    assert (out.float() - vae.decode(vae.encode(video), render=video)).abs().mean() < 0.05


# Weights


def test_random_weights_depend_on_the_seed_alone():
    before = torch.get_rng_state()
    a = TinyVAE.random(SIZES, 1).state_dict()
    b = TinyVAE.random(SIZES, 1).state_dict()
    c = TinyVAE.random(SIZES, 2).state_dict()
    assert all(torch.equal(a[key], b[key]) for key in a)
    assert not torch.equal(a["encoder.stem.weight"], c["encoder.stem.weight"])
    assert torch.equal(torch.get_rng_state(), before)


def test_saving_and_loading_gives_bit_equal_results(vae, tmp_path):
    path = tmp_path / "tiny.safetensors"
    vae.save(path, {"trained": "no"})
    loaded = TinyVAE.from_state_dict(load_weights(path))
    video = clip(5, 16, 16)
    assert loaded.sizes == SIZES
    assert torch.equal(
        loaded.decode(loaded.encode(video), render=video),
        vae.decode(vae.encode(video), render=video),
    )
    assert "transform.kernel" not in load_weights(path)


Spoil = Callable[[dict[str, Tensor]], object]
SPOILED = {
    "missing": (lambda sd: sd.pop("decoder.grow.weight"), "missing: decoder.grow.weight"),
    "missing width": (lambda sd: sd.pop("encoder.stem.bias"), "missing: encoder.stem.bias"),
    "extra": (lambda sd: sd.update({"decoder.extra": torch.zeros(1)}), "unexpected: decoder.extra"),
    "transposed": (
        lambda sd: sd.update({"encoder.fold.weight": sd["encoder.fold.weight"].transpose(0, 1)}),
        r"encoder.fold.weight is \[8, 12, 2, 2\] for \[12, 8, 2, 2\], transposed",
    ),
}


@pytest.mark.parametrize("name", SPOILED)
def test_a_spoiled_file_is_named_in_four_parts(vae, name):
    spoil, _text = SPOILED[name]
    sd = vae.state_dict()
    spoil(sd)
    with pytest.raises(InputError) as error:
        TinyVAE.from_state_dict(sd, source="tiny.safetensors")
    assert "tiny.safetensors" in error.value.message
    assert "TinyVAE.save" in error.value.hint


def test_components_follow_their_names():
    names = [name for name, _ in COMPONENTS]
    grey = CosineTransform().analyse(to_grid(torch.full((1, 3, 4, 8, 8), 0.5))).flatten()
    black = CosineTransform().analyse(to_grid(torch.zeros(1, 3, 4, 8, 8))).flatten()
    changed = (grey - black).abs() > 1e-5
    assert changed.tolist() == [name == (0, 0, 0, 0) for name in names]
    ramp = (
        torch.linspace(-1, 1, 8).view(1, 1, 1, 8, 1).expand(1, 3, 4, 8, 8)
    )  # grey, constant in time and along rows: darker at the top
    seen = (CosineTransform().analyse(to_grid(ramp)).flatten() - black).abs() > 1e-5
    assert [name for name, on in zip(names, seen.tolist(), strict=True) if on] == [
        (0, 0, 1, 0),
        (0, 0, 3, 0),
    ]


def test_full_opacity_is_as_none_for_a_trained_network(vae):
    video = clip(5, 16, 16)
    z = vae.encode(video)
    cover = torch.ones(1, 1, 5, 16, 16)
    assert_close(
        vae.decode(z, render=video, opacity=cover), vae.decode(z, render=video), atol=1e-5, rtol=0
    )
