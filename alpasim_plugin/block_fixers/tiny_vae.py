"""A causal video autoencoder for CPUs: 4x8x8 compression to 16 channels, as the Wan autoencoder, at
a small part of its work.

Cost: 2D convolutions only, with one past frame; none above a quarter of the resolution
    (space-to-depth); the encoder and half of the
decoder run once per latent, not once per frame; channels last throughout.

The networks predict residuals of a fixed transform (`CosineTransform`). The latent is 16 cosine
components of each 4x8x8 group plus the encoder's correction; the image is their synthesis plus the
decoder's correction. Untrained, both corrections are zero and the round trip is a blurred copy.

The decoder can be conditioned on the render. With P the projection on the components, s the
synthesised image, r the render and a its opacity, it starts from

    s + g (1 - P) a (r - s),

the decoded image with the detail of the render where the render is opaque; the gate g (one value a
pixel, 1 when untrained) and an additive correction are learned. If the latent encodes the render,
untrained decoding returns an opaque render exactly.

Frames: 1 + 4k, as Wan's. The first latent's group is the first frame four times; decoding it gives
    one frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Self

import torch
from torch import Tensor, nn

from alpasim_plugin.block_fixers.clips import (
    GROUP,
    SIDE,
    check_frames,
    check_video,
    frame_ends,
    pass_ends,
)
from alpasim_plugin.block_fixers.codec_weights import LatentStats, fill_random
from alpasim_plugin.block_fixers.streaming import (
    State,
    StreamingCodec,
    StreamingState,
    channels_first,
    channels_last,
    channels_to_frames,
    split_last,
)
from alpasim_plugin.block_fixers.tiny_vae_nets import (
    CELL,
    COLOURS,
    DROPPED,
    LATENT,
    CosineTransform,
    TinySizes,
    TinyVAEDecoder,
    TinyVAEEncoder,
    from_grid,
    to_grid,
)
from alpasim_plugin.core.atomic import write_safetensors
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers.network.checkpoints import load_checked, load_weights, unwrap

DO = "give a file that TinyVAE.save wrote (keys encoder.*, decoder.*, stats.*)"


class TinyVAE(StreamingCodec):
    """Encode video to latents of about unit variance and back, on a CPU in a few milliseconds a
    frame.

    Example:
        >>> vae = TinyVAE.random()
        >>> video = torch.zeros(1, 3, 5, 16, 24)
        >>> z = vae.encode(video)
        >>> tuple(z.shape), tuple(vae.decode(z).shape), tuple(vae.decode(z, render=video).shape)
        ((1, 16, 2, 2, 3), (1, 3, 5, 16, 24), (1, 3, 5, 16, 24))
    """

    def __init__(self, sizes: TinySizes = TinySizes()) -> None:
        super().__init__()
        self.sizes = sizes
        self.encoder = TinyVAEEncoder(sizes)
        self.decoder = TinyVAEDecoder(sizes)
        self.stats = _untrained_stats()
        self.transform = CosineTransform()
        self.eval()

    @classmethod
    def random(cls, sizes: TinySizes = TinySizes(), seed: int = 0) -> Self:
        """Build an untrained, trainable network whose round trip is the cosine transform's blurred
        copy.
        """
        with torch.device("meta"):  # layers would draw initial values from the global generator
            vae = cls(sizes)
        for name, part in (("encoder", vae.encoder), ("decoder", vae.decoder)):
            fill_random(part, seed, f"tiny_vae.{name}")
            nn.init.zeros_(part.head.weight)
        vae.stats, vae.transform = _untrained_stats(), CosineTransform()
        return vae

    @classmethod
    def from_state_dict(
        cls,
        sd: Mapping[str, Tensor],
        *,
        source: str = "a state dict",
    ) -> Self:
        """Build the network that ``sd`` holds, at whatever widths it has, frozen.

        Raises:
            InputError: Missing, unexpected, mis-shaped or transposed keys.
        """
        tensors = unwrap(sd, source)
        sizes = TinySizes.read(tensors, source, DO)
        with torch.device("meta"):
            vae = cls(sizes)
        load_checked(vae, tensors, source, DO)
        vae.transform = CosineTransform()
        vae.requires_grad_(False)
        return vae

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a safetensors file.

        Raises:
            InputError: No such file, not safetensors, or other keys.
        """
        return cls.from_state_dict(load_weights(path), source=str(path))

    def save(self, path: str | Path, metadata: Mapping[str, str] | None = None) -> None:
        """Write a safetensors file atomically."""
        write_safetensors(path, self.state_dict(), metadata)

    def encode_next(self, frames: Tensor, state: State | None) -> tuple[Tensor, State]:
        """Encode the next frames of a stream; a pure function, with the same rules as
        `WanVAE.encode_next`.
        """
        check_frames("frames", frames, COLOURS, first=state is None)
        return self.encode_in_passes(self._encode_pass, frames.float(), state)

    def decode_next(
        self,
        z: Tensor,
        state: State | None,
        *,
        render: Tensor | None = None,
        opacity: Tensor | None = None,
        clamp: bool = True,
    ) -> tuple[Tensor, State]:
        """Decode the next latents of a stream; a pure function, with the same rules as
        `WanVAE.decode_next`.

        Args:
            z: ``(B, 16, m, h, w)``, any m.
            state: What the call before returned, None at the start of the video.
            render: ``(B, 3, n, 8h, 8w)`` in [-1, 1]: frames whose detail the decoder uses, or None.
            opacity: ``(B, 1, n, 8h, 8w)``, 0 to 1: coverage of the render; None is opaque
                everywhere.
            clamp: Whether to cut the result to [-1, 1].

        Returns:
            Frames ``(B, 3, n, 8h, 8w)``, n = 4m, or 1 + 4 (m - 1) at the start; and the state for
            the next call.

        Raises:
            InputError: Another shape.
        """
        check_video("latents", z, LATENT)
        b, _, m, h, w = z.shape
        frames = GROUP * m - (DROPPED if state is None else 0)
        size = frames, h * SIDE, w * SIDE
        for given, channels in ((render, COLOURS), (opacity, 1)):
            if given is not None and given.shape != (b, channels, *size):
                raise InputError(
                    f"a render or opacity of shape {list(given.shape)}",
                    f"give that of the frames that come out, {[b, channels, *size]}",
                )
        parts = []
        start = 0
        first = 0
        ends = pass_ends(m, self.latents_per_pass)
        for end, last in zip(ends, frame_ends(ends, state is None), strict=True):
            condition = [
                None if x is None else x[:, :, first:last].float() for x in (render, opacity)
            ]
            part, state = self._decode_pass(
                z[:, :, start:end].float(), condition[0], condition[1], state
            )
            parts.append(part)
            start = end
            first = last
        assert state is not None
        video = torch.cat(parts, dim=2) if len(parts) > 1 else parts[0]
        return video.clamp(-1, 1) if clamp else video, state

    def _encode_pass(self, frames: Tensor, state: State | None) -> tuple[Tensor, State]:
        streaming = StreamingState(state)
        grid = to_grid(_whole_groups(frames, streaming.first))
        mu = self.transform.analyse(grid) + self.encoder.next(grid.to(self.dtype), streaming)
        return self.stats.normalise(channels_first(mu)).to(self.dtype), streaming.state

    def _decode_pass(
        self,
        z: Tensor,
        render: Tensor | None,
        opacity: Tensor | None,
        state: State | None,
    ) -> tuple[Tensor, State]:
        streaming = StreamingState(state)
        mu = channels_last(self.stats.denormalise(z))
        grid = self.transform.synthesise(mu)
        skipped = DROPPED if streaming.first else 0

        def as_frames(x: Tensor) -> Tensor:
            return channels_to_frames(x, GROUP)[:, skipped:]

        frames = as_frames(grid)
        if render is None:
            correction, _ = self.decoder.next(mu.to(self.dtype), None, streaming)
            return from_grid(frames + correction).to(self.dtype), streaming.state
        shown = to_grid(_whole_groups(render, streaming.first))
        if opacity is None:
            cover, difference = None, shown  # the synthesised image has no detail to subtract
        else:
            cover = to_grid(_whole_groups(opacity, streaming.first))
            shown, difference = _per_pixel(shown, cover), _per_pixel(shown - grid, cover)
        condition = (
            as_frames(shown.to(self.dtype)),
            None if cover is None else as_frames(cover.to(self.dtype)),
        )
        correction, gate = self.decoder.next(mu.to(self.dtype), condition, streaming)
        assert gate is not None
        detail = split_last(as_frames(self.transform.residue(difference)), CELL)
        image = torch.addcmul(
            split_last(frames + correction, CELL), detail, gate.float()[..., None]
        )
        return from_grid(image.flatten(-2)).to(self.dtype), streaming.state


def _untrained_stats() -> LatentStats:
    return LatentStats([0.0] * LATENT, [1.0] * LATENT, stored=True)


def _per_pixel(colours: Tensor, factor: Tensor) -> Tensor:
    """Multiply ``(..., n * 3)`` by one number a pixel ``(..., n)``."""
    return (split_last(colours, factor.shape[-1]) * factor[..., None]).flatten(-2)


def _whole_groups(frames: Tensor, first: bool) -> Tensor:
    """Repeat the video's first frame three times before it, so that the first latent has a group of
    four frames.
    """
    return (
        torch.cat([frames[:, :, :1].expand(-1, -1, DROPPED, -1, -1), frames], dim=2)
        if first
        else frames
    )
