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

from collections.abc import Mapping
from pathlib import Path
from typing import Self

import torch
from torch import Tensor, nn

from alpasim_plugin.block_fixers.clips import (
    DROPPED,
    GROUP,
    SIDE,
    check_frames,
    check_video,
    frame_counts,
    whole_groups,
)
from alpasim_plugin.block_fixers.codec_weights import LatentStats, fill_random
from alpasim_plugin.block_fixers.streaming import (
    State,
    StreamingCodec,
    StreamingState,
    channels_first,
    channels_last,
    channels_to_frames,
    in_passes,
)
from alpasim_plugin.block_fixers.tiny_vae_nets import (
    COLOURS,
    LATENT,
    CosineTransform,
    TinySizes,
    TinyVAEDecoder,
    TinyVAEEncoder,
    from_grid,
    to_grid,
)
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.atomic import write_safetensors
from alpasim_plugin.fixers.network.checkpoints import load_checked, unwrap

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
        self.stats = LatentStats([0.0] * LATENT, [1.0] * LATENT, stored=True)
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
        vae.requires_grad_(False)
        return vae

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
        latents = self.latents_of_passes(m)
        frames = frame_counts(latents, state is None)
        parts = [torch.split(z.float(), latents, dim=2)]
        if render is not None:
            cover = torch.ones_like(render[:, :1]) if opacity is None else opacity
            for guide, channels in ((render, COLOURS), (cover, 1)):
                expected = [b, channels, sum(frames), h * SIDE, w * SIDE]
                if list(guide.shape) != expected:
                    raise InputError(
                        f"a render or opacity of shape {list(guide.shape)}",
                        f"give that of the frames that come out, {expected}",
                    )
                parts.append(torch.split(guide.float(), frames, dim=2))
        video, state = in_passes(self._decode_pass, state, zip(*parts, strict=True))
        return video.clamp(-1, 1) if clamp else video, state

    def _encode_pass(self, state: State | None, frames: Tensor) -> tuple[Tensor, State]:
        streaming = StreamingState(state)
        grid = to_grid(whole_groups(frames, streaming.first))
        mu = self.transform.analyse(grid) + self.encoder.next(grid.to(self.dtype), streaming)
        return self.stats.normalise(channels_first(mu)).to(self.dtype), streaming.state

    def _decode_pass(self, state: State | None, z: Tensor, *guides: Tensor) -> tuple[Tensor, State]:
        """Decode latents; ``guides`` is the render and its opacity, or nothing."""
        streaming = StreamingState(state)
        mu = channels_last(self.stats.denormalise(z))
        grid = self.transform.synthesise(mu)
        skipped = DROPPED if streaming.first else 0

        def as_frames(x: Tensor) -> Tensor:
            return channels_to_frames(x, GROUP)[:, skipped:]

        condition = None
        if guides:
            render, cover = (to_grid(whole_groups(part, streaming.first)) for part in guides)
            colours = as_frames(_per_pixel(render, cover).to(self.dtype))
            condition = colours, as_frames(cover.to(self.dtype))
        correction, gate = self.decoder.next(mu.to(self.dtype), condition, streaming)
        image = as_frames(grid) + correction
        if guides:
            detail = as_frames(self.transform.residue(_per_pixel(render - grid, cover)))
            image = image + _per_pixel(detail, gate.float())
        return from_grid(image).to(self.dtype), streaming.state


def _per_pixel(colours: Tensor, factor: Tensor) -> Tensor:
    """Multiply ``(..., n * 3)`` by one number a pixel ``(..., n)``."""
    return (torch.unflatten(colours, -1, (-1, COLOURS)) * factor[..., None]).flatten(-2)
