"""The tiny Wan decoder on its own: streams, checkpoints, hard inputs."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.nets.latent_stats import LatentStats
from alpasim_plugin.nets.taehv import TinyDecoder
from tests.nets.codec_cases import noise

WIDTHS = (16, 12, 8, 4)


@pytest.fixture(scope="module")
def decoder() -> TinyDecoder:
    return TinyDecoder.random(16, WIDTHS)


@pytest.mark.parametrize("counts", [[1, 1, 1, 1], [2, 2], [4], [1, 3]])
def test_decoding_in_any_blocks_is_bit_equal_to_the_whole_clip(decoder: TinyDecoder, counts: list[int]) -> None:
    z = noise(2, 16, 4, 2, 3)
    stream = decoder.decoder_stream()
    assert torch.equal(torch.cat([stream.push(part) for part in z.split(counts, dim=2)], dim=2), decoder(z))


def test_one_pass_over_the_whole_clip_agrees_with_one_latent_a_pass(decoder: TinyDecoder) -> None:
    whole = TinyDecoder.random(16, WIDTHS)
    whole.latents_per_pass = None
    z = noise(1, 16, 5, 3, 2)
    torch.testing.assert_close(whole.decode(z, clamp=False), decoder.decode(z, clamp=False), atol=1e-5, rtol=0)


def test_frames_never_depend_on_later_latents(decoder: TinyDecoder) -> None:
    z = noise(1, 16, 3, 2, 2)
    assert torch.equal(decoder(z)[:, :, :5], decoder(z[:, :, :2]))


def test_huge_and_constant_latents_stay_in_range(decoder: TinyDecoder) -> None:
    for value in (0.0, 1e6, -1e6):
        video = decoder(torch.full((1, 16, 2, 2, 2), value))
        assert video.isfinite().all()
        assert video.abs().max() <= 1


def test_unclamped_frames_may_leave_the_range(decoder: TinyDecoder) -> None:
    z = 3 * noise(1, 16, 2, 4, 4)
    free = decoder(z, clamp=False)
    assert free.abs().max() > 1
    assert torch.equal(free.clamp(-1, 1), decoder(z))


def test_scaled_weights_see_the_denormalised_latent(decoder: TinyDecoder) -> None:
    scaled = TinyDecoder.from_state_dict(decoder.state_dict(), scaled=True)
    z = noise(1, 16, 2, 2, 2)
    assert torch.equal(scaled(z), decoder(LatentStats().denormalise(z)))


def test_an_encoder_in_the_file_is_left_behind(decoder: TinyDecoder) -> None:
    sd = {**decoder.state_dict(), "encoder.0.weight": torch.zeros(64, 3, 3, 3)}
    assert torch.equal(TinyDecoder.from_state_dict(sd)(noise(1, 16, 1, 2, 2)), decoder(noise(1, 16, 1, 2, 2)))


def test_a_growth_layer_with_more_rows_gives_its_last_ones(decoder: TinyDecoder) -> None:
    sd = decoder.state_dict()
    key = "decoder.7.conv.weight"
    sd[key] = torch.cat([torch.full_like(sd[key], 9.0), sd[key]])
    z = noise(1, 16, 2, 2, 2)
    assert torch.equal(TinyDecoder.from_state_dict(sd)(z), decoder(z))


@pytest.mark.parametrize("stored", [torch.float16, torch.bfloat16])
def test_half_precision_tensors_load_and_half_precision_runs(decoder: TinyDecoder, stored: torch.dtype) -> None:
    sd = {key: value.to(stored) for key, value in decoder.state_dict().items()}
    z = noise(1, 16, 2, 2, 2)
    assert (TinyDecoder.from_state_dict(sd)(z) - decoder(z)).abs().max() < 0.02
    out = TinyDecoder.from_state_dict(sd, dtype=stored)(z)
    assert out.dtype == stored
    assert (out.float() - decoder(z)).abs().max() < 0.05


Spoil = Callable[[dict[str, Tensor]], object]
SPOILED: dict[str, tuple[Spoil, str]] = {
    "missing": (lambda sd: sd.pop("decoder.10.conv.2.weight"), "missing: decoder.10.conv.2.weight"),
    "missing width": (lambda sd: sd.pop("decoder.3.conv.0.bias"), "missing: decoder.3.conv.0.bias"),
    "extra": (lambda sd: sd.update({"decoder.23.weight": torch.zeros(1)}), "unexpected: decoder.23.weight"),
    "transposed": (
        lambda sd: sd.update({"decoder.8.weight": sd["decoder.8.weight"].transpose(0, 1)}),
        r"decoder.8.weight is \[16, 12, 3, 3\] for \[12, 16, 3, 3\], transposed",
    ),
    "transposed stem": (
        lambda sd: sd.update({"decoder.22.weight": sd["decoder.22.weight"].transpose(0, 1)}),
        r"decoder.22.weight is \[4, 3, 3, 3\] for \[3, 4, 3, 3\], transposed",
    ),
    "flat": (lambda sd: sd.update({"decoder.1.weight": torch.zeros(16)}), r"wrong shape: decoder.1.weight is \[16\]"),
    "too few rows": (
        lambda sd: sd.update({"decoder.13.conv.weight": torch.zeros(12, 12, 1, 1)}),
        r"decoder.13.conv.weight is \[12, 12, 1, 1\] for \[24, 12, 1, 1\]",
    ),
}


@pytest.mark.parametrize("name", SPOILED)
def test_a_spoiled_checkpoint_is_named_in_four_parts(decoder: TinyDecoder, name: str) -> None:
    spoil, text = SPOILED[name]
    sd = decoder.state_dict()
    spoil(sd)
    with pytest.raises(InputError, match=text) as error:
        TinyDecoder.from_state_dict(sd, source="light.safetensors")
    assert error.value.doing == "loading tiny decoder weights"
    assert "light.safetensors" in error.value.with_what
    assert "TAEHV" in error.value.do_this


def test_published_widths_have_the_published_number_of_weights() -> None:
    with torch.device("meta"):
        count = sum(p.numel() for p in TinyDecoder(16, (256, 128, 64, 64)).parameters())
    assert count / 1e6 == pytest.approx(9.84, abs=0.01)


def test_what_is_no_latent_is_refused(decoder: TinyDecoder) -> None:
    with pytest.raises(InputError, match="not a video latent"):
        decoder(torch.zeros(1, 2, 16, 2, 2))
