"""The Wan autoencoder on its own: streams, sizes, hard inputs, checkpoints."""

import copy
from collections.abc import Callable

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.testing import assert_close

from alpasim_plugin.block_fixers.clips import crop_clip, pad_clip
from alpasim_plugin.block_fixers.networks import at_precision
from alpasim_plugin.block_fixers.wan_vae import WanVAE
from alpasim_plugin.block_fixers.wan_vae_blocks import (
    causal_conv,
)
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers.network.checkpoints import load_weights
from tests.block_fixers.codec_cases import (
    SMALL,
    clip,
    decoder_stream,
    encoder_stream,
    noise,
)
from tests.examples import examples, first_of

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def vae():
    return WanVAE.random(SMALL)


def push_all(stream, x, counts):
    assert sum(counts) == x.shape[2]
    return torch.cat([stream.push(part) for part in x.split(counts, dim=2)], dim=2)


# Streams


@pytest.mark.parametrize(
    "counts", first_of([[1, 4, 4, 4], [5, 8], [5, 4, 4], [13], [1, 12], [9, 4]])
)
def test_encoding_in_any_blocks_is_bit_equal_to_the_whole_clip(vae, counts):
    video = clip(13, 16, 24, batch=2)
    assert torch.equal(push_all(encoder_stream(vae), video, counts), vae.encode(video))


@pytest.mark.parametrize("counts", first_of([[1, 1, 1, 1, 1], [2, 2, 1], [5], [1, 4], [3, 2]]))
def test_decoding_in_any_blocks_is_bit_equal_to_the_whole_clip(vae, counts):
    z = noise(2, 16, 5, 2, 3)
    assert torch.equal(push_all(decoder_stream(vae), z, counts), vae.decode(z))


def test_one_pass_over_the_whole_clip_agrees_with_one_latent_a_pass():
    whole = WanVAE.random(SMALL)
    steps = WanVAE.random(SMALL)
    whole.latents_per_pass = None
    video = clip(13, 24, 16)
    z = noise(1, 16, 4, 3, 2)
    assert_close(whole.encode(video), steps.encode(video), atol=1e-5, rtol=0)
    assert_close(whole.decode(z, clamp=False), steps.decode(z, clamp=False), atol=1e-5, rtol=0)


def test_a_state_holds_no_more_than_its_own_frames(vae):
    stream = encoder_stream(vae)
    push_all(stream, clip(9, 32, 32), [5, 4])
    assert len(stream.state) == 24
    assert all(
        kept.untyped_storage().nbytes() == kept.numel() * kept.element_size() and kept.shape[1] <= 2
        for kept in stream.state
    )


# Sizes and hard inputs


def test_one_and_five_frames_give_one_and_two_latents(vae):
    one = vae.encode(clip(1, 16, 24))
    five = vae.encode(clip(5, 16, 24))
    assert one.shape == (1, 16, 1, 2, 3)
    assert five.shape == (1, 16, 2, 2, 3)
    assert vae.decode(one).shape == (1, 3, 1, 16, 24)
    assert vae.decode(five).shape == (1, 3, 5, 16, 24)


def test_six_frames_padded_encode_as_nine_and_crop_back(vae):
    video = clip(6, 18, 23)
    padded, size = pad_clip(video)
    assert padded.shape == (1, 3, 9, 24, 24)
    assert torch.equal(padded[:, :, 6:], padded[:, :, 5:6].expand(-1, -1, 3, -1, -1))
    assert torch.equal(crop_clip(padded, size), video)
    assert crop_clip(vae.decode(vae.encode(padded)), size).shape == video.shape


@pytest.mark.parametrize("frames", [5, 1, 0])
def test_odd_counts_in_the_middle_of_a_stream_are_refused_and_leave_it_alone(vae, frames):
    stream = encoder_stream(vae)
    stream.push(clip(1, 16, 16))
    before = stream.state
    with pytest.raises(InputError):
        stream.push(clip(frames, 16, 16))
    assert stream.state is before


@pytest.mark.parametrize(("height", "width"), [(17, 24), (16, 30), (4, 8)])
def test_sides_that_are_no_multiple_of_eight_are_refused(vae, height, width):
    with pytest.raises(InputError):
        vae.encode(clip(1, height, width))


@pytest.mark.parametrize(
    "bad",
    [
        torch.zeros(1, 3, 1, 16, 16, dtype=torch.uint8),
        torch.zeros(3, 1, 16, 16),
        torch.zeros(1, 4, 1, 16, 16),
    ],
    ids=["uint8", "4d", "rgba"],
)
def test_what_is_no_video_is_refused(vae, bad):
    with pytest.raises(InputError):
        vae.encode(bad)


def test_latents_of_another_width_are_refused(vae):
    with pytest.raises(InputError):
        vae.decode(torch.zeros(1, 8, 1, 2, 2))


@pytest.mark.parametrize("value", [-1.0, 0.0, 1.0, 1e4])
def test_constant_and_saturated_clips_stay_finite(vae, value):
    video = torch.full((1, 3, 9, 16, 16), value)
    z = vae.encode(video)
    out = vae.decode(z)
    assert z.isfinite().all()
    assert out.isfinite().all()
    assert out.abs().max() <= 1


def test_one_bad_pixel_does_not_reach_earlier_frames(vae):
    video = clip(9, 16, 16)
    video[0, 0, 5, 3, 3] = torch.nan
    z = vae.encode(video)
    assert z[:, :, :2].isfinite().all()
    assert z[:, :, 2].isnan().any()


# Convolutions


@settings(max_examples=examples(30), deadline=None)
@given(
    past=st.integers(0, 2),
    frames=st.integers(1, 5),
    inputs=st.integers(1, 5),
    outputs=st.integers(1, 5),
    side=st.sampled_from([1, 3]),
)
def test_summed_2d_convolutions_equal_the_3d_one(past, frames, inputs, outputs, side):
    joined = noise(2, past + frames, 4, 5, inputs, seed=past)
    weight = noise(outputs, inputs, 3, side, side)
    bias = noise(outputs)
    past_and_padding = F.pad(joined, (0, 0, 0, 0, 0, 0, 2 - past, 0)).permute(0, 4, 1, 2, 3)
    pad = side // 2
    expected = F.conv3d(past_and_padding, weight, bias, padding=(0, pad, pad)).permute(
        0, 2, 3, 4, 1
    )
    assert_close(causal_conv(joined, weight, bias, frames), expected, atol=1e-5, rtol=1e-5)


# Checkpoints


def test_sizes_are_read_off_the_tensors():
    made = WanVAE.random(12)
    video = clip(5, 16, 16)
    assert torch.equal(WanVAE.from_state_dict(made.state_dict()).encode(video), made.encode(video))


@pytest.mark.parametrize("prefix", ["", "module."])
def test_a_torch_file_of_tensors_loads(vae, tmp_path, prefix):
    path = tmp_path / "Wan2.1_VAE.pth"
    torch.save({prefix + key: value for key, value in vae.state_dict().items()}, path)
    back = WanVAE.from_state_dict(load_weights(path)).state_dict()
    assert all(torch.equal(back[key], value) for key, value in vae.state_dict().items())


@pytest.mark.parametrize(("base", "millions"), [(96, 126.9), (24, 8.04)])
def test_published_widths_have_the_published_number_of_weights(base, millions):
    with torch.device("meta"):
        count = sum(p.numel() for p in WanVAE(base).parameters())
    assert count / 1e6 == pytest.approx(millions, abs=0.06)


def test_the_keys_are_those_of_the_published_file(vae):
    keys = set(vae.state_dict())
    assert len(keys) == 194
    assert {
        "encoder.conv1.weight",
        "encoder.downsamples.3.shortcut.weight",
        "encoder.downsamples.5.time_conv.bias",
        "encoder.middle.1.norm.gamma",
        "decoder.upsamples.4.shortcut.bias",
        "decoder.upsamples.11.resample.1.weight",
        "decoder.head.2.bias",
        "conv1.weight",
        "conv2.bias",
    } <= keys
    assert not [key for key in keys if "stats" in key]


@pytest.mark.parametrize("stored", [torch.float16, torch.bfloat16, torch.float64])
def test_half_and_double_precision_tensors_load_into_single(vae, stored):
    sd = {key: value.to(stored) for key, value in vae.state_dict().items()}
    loaded = WanVAE.from_state_dict(sd)
    assert loaded.dtype == torch.float32
    z = loaded.encode(clip(5, 16, 16))
    assert z.dtype == torch.float32
    assert (z - vae.encode(clip(5, 16, 16))).abs().max() < {
        torch.float16: 2e-3,
        torch.bfloat16: 2e-2,
        torch.float64: 1e-6,
    }[stored]


def test_running_in_half_precision_stays_close(vae):
    half = at_precision(copy.deepcopy(vae), "bf16")
    dtype = torch.bfloat16
    video = clip(9, 16, 16)
    z = half.encode(video)
    assert z.dtype == dtype
    assert half.decode(z).dtype == dtype
    assert (z.float() - vae.encode(video)).abs().max() < 0.05
    assert half.stats.mean.dtype == torch.float32


Spoil = Callable[[dict[str, Tensor]], object]
SPOILED = {
    "missing bias": (
        lambda sd: sd.pop("encoder.middle.0.residual.2.bias"),
        "missing: encoder.middle.0.residual.2.bias",
    ),
    "missing width": (
        lambda sd: sd.pop("encoder.downsamples.6.residual.3.gamma"),
        "missing: encoder.downsamples.6.residual.3.gamma",
    ),
    "no halving": (
        lambda sd: [sd.pop(key) for key in list(sd) if ".resample." in key],
        "missing: encoder.downsamples.2.resample.1.weight",
    ),
    "missing block": (
        lambda sd: [sd.pop(key) for key in list(sd) if key.startswith("decoder.upsamples.13.")],
        "missing: decoder.upsamples.13.residual.0.gamma",
    ),
    "extra": (
        lambda sd: sd.update({"encoder.extra.weight": torch.zeros(1)}),
        "unexpected: encoder.extra.weight",
    ),
    "transposed": (
        lambda sd: sd.update(
            {
                "encoder.downsamples.3.residual.2.weight": sd[
                    "encoder.downsamples.3.residual.2.weight"
                ].transpose(0, 1)
            }
        ),
        r"encoder.downsamples.3.residual.2.weight is \[8, 16, 3, 3, 3\] for \[16, 8, 3, 3, 3\], transposed",
    ),
    "transposed kernel": (
        lambda sd: sd.update(
            {
                "decoder.upsamples.3.time_conv.weight": sd[
                    "decoder.upsamples.3.time_conv.weight"
                ].transpose(2, 4)
            }
        ),
        r"decoder.upsamples.3.time_conv.weight is \[64, 32, 1, 1, 3\] for \[64, 32, 3, 1, 1\], transposed",
    ),
    "wrong shape": (
        lambda sd: sd.update({"conv2.weight": torch.zeros(16, 16)}),
        r"wrong shape: conv2.weight is \[16, 16\] for \[16, 16, 1, 1, 1\]",
    ),
    "integers": (
        lambda sd: sd.update({"conv2.bias": torch.zeros(16, dtype=torch.int64)}),
        "conv2.bias holds torch.int64",
    ),
}


@pytest.mark.parametrize("name", SPOILED)
def test_a_spoiled_checkpoint_is_named_in_four_parts(vae, name):
    spoil, _text = SPOILED[name]
    sd = dict(vae.state_dict())
    spoil(sd)
    with pytest.raises(InputError) as error:
        WanVAE.from_state_dict(sd, source="weights.safetensors")
    assert "weights.safetensors" in error.value.message
