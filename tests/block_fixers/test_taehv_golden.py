"""The tiny decoder against numbers that the original code produced."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from alpasim_plugin.block_fixers.streaming import StreamingState, channels_last, run_layers
from alpasim_plugin.block_fixers.taehv import TinyDecoder
from tests.block_fixers.codec_cases import decoder_stream, golden

TOLERANCE = 2e-5
CASES = ["latent_n1_t1_4x6", "latent_n1_t3_4x6", "latent_n1_t5_3x5"]


@pytest.fixture(scope="module")
def numbers(shared_data: Path) -> tuple[dict[str, Tensor], dict[str, Tensor], dict[str, Any]]:
    return golden(shared_data, "taehv")


@pytest.mark.parametrize("latents_per_pass", [1, 2, None])
@pytest.mark.parametrize("name", CASES)
def test_latents_decode_to_the_original_frames(
    numbers: Any, name: str, latents_per_pass: int | None
) -> None:
    decoder = TinyDecoder.from_state_dict(numbers[0])
    decoder.latents_per_pass = latents_per_pass
    video = decoder(numbers[1][f"in.{name}"].transpose(1, 2))
    expected = numbers[1][f"out.{name}.decode_parallel"].transpose(1, 2) * 2 - 1
    torch.testing.assert_close(video, expected, atol=TOLERANCE, rtol=0)


@pytest.mark.parametrize("name", CASES)
def test_frames_that_are_dropped_are_the_original_ones_too(numbers: Any, name: str) -> None:
    decoder = TinyDecoder.from_state_dict(numbers[0])
    frames = run_layers(
        decoder.decoder,
        channels_last(numbers[1][f"in.{name}"].transpose(1, 2)),
        StreamingState(None),
    )
    expected = numbers[1][f"out.{name}.decoder_raw_all_frames_unclamped"].permute(0, 1, 3, 4, 2)
    torch.testing.assert_close(frames, expected, atol=TOLERANCE, rtol=0)


def test_lighttae_convention_takes_the_denormalised_latent(numbers: Any) -> None:
    z, expected = (
        numbers[1]["in.latent_n1_t3_4x6"].transpose(1, 2),
        numbers[1]["out.latent_n1_t3_4x6.lighttae_decode_BCTHW_minus1_1"],
    )
    torch.testing.assert_close(
        TinyDecoder.from_state_dict(numbers[0], scaled=True)(z), expected, atol=TOLERANCE, rtol=0
    )
    assert (TinyDecoder.from_state_dict(numbers[0])(z) - expected).abs().max() > 0.05


def test_a_stream_returns_one_frame_then_four(numbers: Any) -> None:
    decoder = TinyDecoder.from_state_dict(numbers[0])
    stream = decoder_stream(decoder)
    z = numbers[1]["in.latent_n1_t5_3x5"].transpose(1, 2)
    counts = [stream.push(z[:, :, i : i + 1]).shape[2] for i in range(5)]
    assert counts == numbers[2]["cases"]["latent_n1_t5_3x5"]["streaming_frames_returned_per_latent"]


def test_full_width_network_from_the_weight_formula(numbers: Any) -> None:
    config = numbers[2]["fullwidth"]
    weights = _formula_weights(TinyDecoder(16, config["decoder_widths"]).state_dict(), config)
    decoder = TinyDecoder.from_state_dict(weights)
    z = numbers[1]["in.fullwidth.latent"].transpose(1, 2)
    torch.testing.assert_close(
        decoder(z),
        numbers[1]["out.fullwidth.decode_parallel"].transpose(1, 2) * 2 - 1,
        atol=TOLERANCE,
        rtol=0,
    )


def _formula_weights(due: dict[str, Tensor], config: dict[str, Any]) -> dict[str, Tensor]:
    """Make the weights that the settings file describes instead of storing, and check them on its
    probes.
    """
    out = {}
    keys = sorted(due)
    last = max(int(key.split(".")[1]) for key in keys)
    for j, key in enumerate(keys):
        x = np.arange(due[key].numel(), dtype=np.uint32) * np.uint32(2654435761) + np.uint32(
            (config["seed"] * 1000003 + j * 7919) % 2**32
        )
        x = (x ^ (x >> np.uint32(16))) * np.uint32(2246822507)
        x = (x ^ (x >> np.uint32(13))) * np.uint32(3266489909)
        u = ((x ^ (x >> np.uint32(16))).astype(np.float64) + 0.5) / 2**32 - 0.5
        if key.endswith("bias"):
            value = 0.2 * u + (0.5 if key == f"decoder.{last}.bias" else 0.0)
        else:
            gain = (
                0.7
                if ".conv.4." in key
                else 1.0
                if due[key].shape[-1] == 1
                else 0.12
                if key == f"decoder.{last}.weight"
                else 1.4
            )
            value = u * np.sqrt(12) * gain / np.sqrt(due[key][0].numel())
        out[key] = torch.from_numpy(value.astype(np.float32)).view(due[key].shape)
    for key, probe in config["probe"].items():
        np.testing.assert_allclose(out[key].flatten()[: len(probe)].numpy(), probe, rtol=1e-6)
    return out
