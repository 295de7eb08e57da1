"""Sizes of a Wan 2.1 autoencoder, read from its tensors.

The graph is fixed: four stages, one residual block more per stage in the decoder than in the encoder, time halved after the second and
third encoder stage. The widths of the stages vary (96, 192, 384, 384 in the published network, a quarter of that in LightVAE)
and so may the number of blocks (2).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from alpasim_plugin.core.errors import InputError

STAGES = 4
ENCODER_TIME = (False, True, True)  # which of the three halvings also halve the frame rate
DECODER_TIME = (True, True, False)
DOING = "loading Wan VAE weights"
DO = "give the state dict of a Wan 2.1 VAE or LightVAE (keys encoder.*, decoder.*, conv1.*, conv2.*, no prefix; docs/lab/vae.md lists shapes)"


@dataclass(frozen=True)
class WanLayout:
    """Widths of one autoencoder.

    Args:
        colours: Channels of the video.
        latent: Channels of the latent.
        stem: Channels after the encoder's first convolution.
        encoder: Channels of the four encoder stages.
        decoder_in: Channels that enter each of the four decoder stages.
        decoder_out: Channels that leave the residual blocks of each decoder stage.
        blocks: Residual blocks of an encoder stage; a decoder stage has one more.
    """

    colours: int
    latent: int
    stem: int
    encoder: tuple[int, ...]
    decoder_in: tuple[int, ...]
    decoder_out: tuple[int, ...]
    blocks: int = 2

    @classmethod
    def of_base(cls, base: int, latent: int = 16) -> WanLayout:
        """Return the published proportions: base 96 is the Wan 2.1 autoencoder, 24 is LightVAE.

        Example:
            >>> WanLayout.of_base(96).encoder
            (96, 192, 384, 384)
        """
        one, two, four = base, 2 * base, 4 * base
        return cls(3, latent, one, (one, two, four, four), (four, two, two, one), (four, four, two, one))


def read_layout(sd: Mapping[str, Tensor], source: str = "a state dict") -> WanLayout:
    """Read the widths from vectors (biases and norm gains), which cannot be transposed.

    Raises:
        InputError: A key that gives a width is missing.
    """
    halvings = [int(key.split(".")[2]) for key in sd if key.startswith("encoder.downsamples.") and ".resample." in key]
    if not halvings:
        raise InputError(DOING, f"{source} ({len(sd)} tensors)", "missing: encoder.downsamples.2.resample.1.weight", DO)
    blocks = min(halvings)
    encoder_starts = [stage * (blocks + 1) for stage in range(STAGES)]
    decoder_starts = [stage * (blocks + 2) for stage in range(STAGES)]
    return WanLayout(
        colours=_length(sd, source, "decoder.head.2.bias"),
        latent=_length(sd, source, "conv2.bias"),
        stem=_length(sd, source, "encoder.conv1.bias"),
        encoder=tuple(_length(sd, source, f"encoder.downsamples.{i}.residual.3.gamma") for i in encoder_starts),
        decoder_in=tuple(_length(sd, source, f"decoder.upsamples.{i}.residual.0.gamma") for i in decoder_starts),
        decoder_out=tuple(_length(sd, source, f"decoder.upsamples.{i + blocks}.residual.3.gamma") for i in decoder_starts),
        blocks=blocks,
    )


def _length(sd: Mapping[str, Tensor], source: str, key: str) -> int:
    if key not in sd:
        raise InputError(DOING, f"{source} ({len(sd)} tensors)", f"missing: {key}", DO)
    return sd[key].numel()
