"""The Wan 2.1 causal video autoencoder: 4x8x8 compression to 16 channels, whole clips or streams.

Frame accounting: the first latent holds 1 frame and every later one 4: 1 + 4k frames and 1 + k
latents belong together. An encoder stream takes the first frame, alone or with groups of 4 after
it, and groups of 4 afterwards; a decoder stream takes any number of latents.
"""

from collections.abc import Mapping
from typing import Self

import torch
from torch import Tensor, nn

from alpasim_plugin.block_fixers.clips import check_frames, check_video
from alpasim_plugin.block_fixers.codec_weights import (
    LatentStats,
    fill_random,
    first_axes,
)
from alpasim_plugin.block_fixers.streaming import (
    PointwiseConv,
    State,
    StreamingCodec,
    StreamingState,
    channels_first,
    channels_last,
    run_layers,
)
from alpasim_plugin.block_fixers.wan_vae_blocks import (
    DECODER_TIME,
    DO,
    ENCODER_TIME,
    CausalConv,
    ChannelNorm,
    Downsample,
    FrameAttention,
    ResidualBlock,
    Upsample,
)
from alpasim_plugin.fixers.network.checkpoints import clean, load_checked, unwrap

COLOURS = 3
LATENT = 16
STEM = "encoder.conv1.bias"


class Coder(nn.Module):
    """Common part of encoder and decoder: a middle (residual, attention, residual) and a head
    (norm, SiLU, convolution).
    """

    def __init__(self, stem: tuple[int, int], middle: int, head: tuple[int, int]) -> None:
        super().__init__()
        self.conv1 = CausalConv(*stem)
        self.middle = nn.ModuleList(
            [ResidualBlock(middle, middle), FrameAttention(middle), ResidualBlock(middle, middle)]
        )
        self.head = nn.ModuleList([ChannelNorm(head[0]), nn.SiLU(), CausalConv(*head)])


class Encoder(Coder):
    """Frames to means and log-variances of the latent."""

    def __init__(self, base: int) -> None:
        super().__init__((COLOURS, base), 4 * base, (4 * base, 2 * LATENT))
        blocks: list[nn.Module] = []
        inputs = base
        for stage, outputs in enumerate((base, 2 * base, 4 * base, 4 * base)):
            blocks += [ResidualBlock(inputs, outputs), ResidualBlock(outputs, outputs)]
            inputs = outputs
            if stage < len(ENCODER_TIME):
                blocks.append(Downsample(outputs, ENCODER_TIME[stage]))
        self.downsamples = nn.ModuleList(blocks)

    def next(self, x: Tensor, streaming: StreamingState) -> Tensor:
        """Map frames ``(B, T, H, W, 3)`` to ``(B, t, H/8, W/8, 2 * latent)``."""
        return run_layers((self.conv1, *self.downsamples, *self.middle, *self.head), x, streaming)


class Decoder(Coder):
    """Latents to frames."""

    def __init__(self, base: int) -> None:
        super().__init__((LATENT, 4 * base), 4 * base, (base, COLOURS))
        blocks: list[nn.Module] = []
        inputs = 4 * base
        for stage, outputs in enumerate((4 * base, 4 * base, 2 * base, base)):
            blocks += [ResidualBlock(inputs, outputs)]
            blocks += [ResidualBlock(outputs, outputs) for _ in range(2)]
            if stage < len(DECODER_TIME):
                inputs = outputs // 2
                blocks.append(Upsample(outputs, inputs, DECODER_TIME[stage]))
        self.upsamples = nn.ModuleList(blocks)

    def next(self, x: Tensor, streaming: StreamingState) -> Tensor:
        """Map ``(B, t, h, w, latent)`` to frames ``(B, T, 8h, 8w, 3)``."""
        return run_layers((self.conv1, *self.middle, *self.upsamples, *self.head), x, streaming)


class WanVAE(StreamingCodec):
    """Encode video to normalised latents and back.

    Weights are frozen; gradients with respect to the input flow.

    Args:
        base: Channels of the first stage; the others have 2, 4 and 4 times as many.

    Example:
        >>> vae = WanVAE.random(8)
        >>> z = vae.encode(torch.zeros(1, 3, 5, 16, 24))
        >>> tuple(z.shape), tuple(vae.decode(z).shape)
        ((1, 16, 2, 2, 3), (1, 3, 5, 16, 24))
    """

    def __init__(self, base: int) -> None:
        super().__init__()
        self.encoder = Encoder(base)
        self.conv1 = PointwiseConv(2 * LATENT, 2 * LATENT, axes=3)
        self.conv2 = PointwiseConv(LATENT, LATENT, axes=3)
        self.decoder = Decoder(base)
        self.stats = LatentStats()
        self.eval().requires_grad_(False)

    @classmethod
    def from_state_dict(
        cls,
        sd: Mapping[str, Tensor],
        *,
        source: str = "a state dict",
    ) -> Self:
        """Build the network that ``sd`` holds, at whatever width it has (96 as published, 24 for
        LightVAE).

        Args:
            sd: Original keys, alone or under ``model`` or ``state_dict``; any floating precision,
                also mixed.
            source: Where ``sd`` comes from, for messages.

        Raises:
            InputError: Missing, unexpected, mis-shaped or transposed keys.
        """
        tensors = clean(unwrap(sd, source))
        (base,) = first_axes(tensors, [STEM], source, DO)
        with torch.device("meta"):
            vae = cls(base)
        load_checked(vae, tensors, source, DO)
        return vae

    @classmethod
    def random(cls, base: int, seed: int = 0) -> Self:
        """Build an untrained network, for tests and timing."""
        with torch.device("meta"):
            vae = cls(base)
        fill_random(vae, seed, "wan_vae")
        return vae

    def encode_next(self, frames: Tensor, state: State | None) -> tuple[Tensor, State]:
        """Encode the next frames of a stream; a pure function.

        Args:
            frames: ``(B, 3, n, H, W)``: n = 1 + 4k if ``state`` is None (the video starts here),
                else 4k.
            state: State after the previous call.

        Returns:
            Latents ``(B, 16, m, H/8, W/8)`` and the state for the next call.

        Raises:
            InputError: An invalid number of frames or size.
        """
        check_frames("frames", frames, 3, first=state is None)
        return self.encode_in_passes(self._encode_pass, frames.to(self.dtype), state)

    def decode_next(
        self, z: Tensor, state: State | None, *, clamp: bool = True
    ) -> tuple[Tensor, State]:
        """Decode the next latents of a stream; a pure function.

        Args:
            z: ``(B, 16, m, h, w)``, any m.
            state: State after the previous call, None at the start of the video.
            clamp: Whether to cut the result to [-1, 1].

        Returns:
            Frames ``(B, 3, n, 8h, 8w)``, n = 4m, or 1 + 4 (m - 1) at the start; and the state for
            the next call.

        Raises:
            InputError: Another shape.
        """
        check_video("latents", z, LATENT)
        video, state = self.decode_in_passes(self._decode_pass, z, state)
        return video.clamp(-1, 1) if clamp else video, state

    def _encode_pass(self, state: State | None, frames: Tensor) -> tuple[Tensor, State]:
        streaming = StreamingState(state)
        moments = self.conv1(self.encoder.next(channels_last(frames), streaming))
        return self.stats.normalise(channels_first(moments[..., :LATENT])), streaming.state

    def _decode_pass(self, state: State | None, z: Tensor) -> tuple[Tensor, State]:
        streaming = StreamingState(state)
        return channels_first(
            self.decoder.next(self.conv2(channels_last(self.stats.denormalise(z))), streaming)
        ), streaming.state
