"""The tiny decoder against numbers that the original code produced."""

import pytest
from torch.testing import assert_close

from alpasim_plugin.block_fixers.streaming import StreamingState, channels_last, run_layers
from alpasim_plugin.block_fixers.taehv import TinyDecoder
from tests.block_fixers.codec_cases import decoder_stream, golden

TOLERANCE = 2e-5
CASES = ["latent_n1_t1_4x6", "latent_n1_t3_4x6", "latent_n1_t5_3x5"]


@pytest.fixture(scope="module")
def numbers(shared_data):
    return golden(shared_data, "taehv")


@pytest.mark.parametrize("latents_per_pass", [1, 2, None])
@pytest.mark.parametrize("name", CASES)
def test_latents_decode_to_the_original_frames(numbers, name, latents_per_pass):
    decoder = TinyDecoder.from_state_dict(numbers[0])
    decoder.latents_per_pass = latents_per_pass
    video = decoder(numbers[1][f"in.{name}"].transpose(1, 2))
    expected = numbers[1][f"out.{name}.decode_parallel"].transpose(1, 2) * 2 - 1
    assert_close(video, expected, atol=TOLERANCE, rtol=0)


@pytest.mark.parametrize("name", CASES)
def test_frames_that_are_dropped_are_the_original_ones_too(numbers, name):
    decoder = TinyDecoder.from_state_dict(numbers[0])
    frames = run_layers(
        decoder.decoder,
        channels_last(numbers[1][f"in.{name}"].transpose(1, 2)),
        StreamingState(None),
    )
    expected = numbers[1][f"out.{name}.decoder_raw_all_frames_unclamped"].permute(0, 1, 3, 4, 2)
    assert_close(frames, expected, atol=TOLERANCE, rtol=0)


def test_lighttae_convention_takes_the_denormalised_latent(numbers):
    z = numbers[1]["in.latent_n1_t3_4x6"].transpose(1, 2)
    expected = numbers[1]["out.latent_n1_t3_4x6.lighttae_decode_BCTHW_minus1_1"]
    assert_close(
        TinyDecoder.from_state_dict(numbers[0], scaled=True)(z), expected, atol=TOLERANCE, rtol=0
    )
    assert (TinyDecoder.from_state_dict(numbers[0])(z) - expected).abs().max() > 0.05


def test_a_stream_returns_one_frame_then_four(numbers):
    decoder = TinyDecoder.from_state_dict(numbers[0])
    stream = decoder_stream(decoder)
    z = numbers[1]["in.latent_n1_t5_3x5"].transpose(1, 2)
    counts = [stream.push(z[:, :, i : i + 1]).shape[2] for i in range(5)]
    assert counts == numbers[2]["cases"]["latent_n1_t5_3x5"]["streaming_frames_returned_per_latent"]
