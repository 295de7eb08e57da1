"""The networks of a fixer, from weights or untrained, loaded once per process.

In bf16 the token stream and the linear layers have that type; the time embedding, the
modulation, the rotary angles and the arithmetic inside norms stay float32.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal, TypeVar

import torch
from torch import Tensor, nn

from alpasim_plugin.block_fixers.dit import (
    FLOAT32_KEYS,
    CosmosCausalDiT,
    TextContext,
    initial_weights,
)
from alpasim_plugin.block_fixers.sampling import OPACITY_CHANNELS
from alpasim_plugin.block_fixers.settings import LatentFixerSettings, OneFixerSettings
from alpasim_plugin.block_fixers.sizes import DiTSizes
from alpasim_plugin.block_fixers.streaming import State, StreamingCodec, StreamingDecoder
from alpasim_plugin.block_fixers.taehv import TinyDecoder
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.block_fixers.tiny_vae_nets import TinySizes
from alpasim_plugin.block_fixers.wan_vae import WanVAE
from alpasim_plugin.core.devices import require_device
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import derive_seed
from alpasim_plugin.fixers.bundle import read_bundle, weights_to_give
from alpasim_plugin.fixers.network.checkpoints import load_weights
from alpasim_plugin.fixers.pixel_network import DTYPES
from alpasim_plugin.fixers.settings import WeightsStamp, weights_stamp

Precision = Literal["fp32", "bf16"]
Net = TypeVar("Net", bound=nn.Module)
TAEHV_WIDTHS = (256, 128, 64, 64)
LATENT = 16


def at_precision(net: Net, precision: Precision, float32: Sequence[str] = ()) -> Net:
    """Return the network, frozen, at another precision; buffers, and parameters whose key contains
    one of ``float32``, stay as they are.
    """
    for key, value in net.requires_grad_(False).named_parameters():
        if not any(part in key for part in float32):
            value.data = value.data.to(DTYPES[precision])
    return net


@dataclass(frozen=True, eq=False)
class Networks:
    """The networks of a fixer; read-only and stateless, so rollouts share them."""

    dit: CosmosCausalDiT
    vae: StreamingCodec
    decoder: StreamingDecoder
    text: TextContext
    trained: bool
    note: str  # description of the weights, for labels

    @property
    def device(self) -> torch.device:
        """Where they run."""
        return self.dit.device


def load_networks(settings: LatentFixerSettings, device: str = "cpu") -> Networks:
    """Build the networks that the settings name, or return them if this process has built them
    before.

    Raises:
        InputError: Weights that are missing or do not fit.
        InfrastructureError: The device is not here.
    """
    return _load(settings, require_device(device), weights_stamp(settings.weights))


def streaming_dit(
    weights: Mapping[str, Tensor], settings: LatentFixerSettings, source: str
) -> CosmosCausalDiT:
    """Build a transformer for streaming inference.

    Args:
        weights: State dict.
        settings: Give the NTK ratios of its rotary embedding.
        source: Where the weights come from, for errors.

    Raises:
        InputError: Weights that do not fit together, or that take another condition than the
            settings give.
    """
    net = CosmosCausalDiT.from_state_dict(weights, settings.rope_ratios, source=source)
    expected = condition_sizes(settings)
    sizes = {key: getattr(net.sizes, key) for key in expected}
    if sizes != expected:
        raise InputError(
            f"{source}: {sizes}, streaming gives {expected}",
            "set fixer.render_input and fixer.opacity_input as in its training; its bundle has them",
        )
    return net


def condition_sizes(settings: LatentFixerSettings) -> dict[str, int]:
    """Return the sizes of the condition that a transformer receives; models without a map take the
    render, or nothing, in its place.
    """
    if not isinstance(settings, OneFixerSettings):
        return {"map_channels": LATENT, "opacity_channels": 0}
    return {
        "map_channels": LATENT * (1 + settings.render_input),
        "opacity_channels": OPACITY_CHANNELS if settings.opacity_input else 0,
    }


def decode(
    networks: Networks,
    settings: LatentFixerSettings,
    z: Tensor,
    render: Tensor,
    opacity: Tensor | None,
    state: State | None = None,
) -> tuple[Tensor, State]:
    """Decode latents as the settings say.

    Args:
        networks: Theirs.
        settings: The kind of decoder.
        z: ``(B, 16, m, h, w)``.
        render: ``(B, 3, n, 8h, 8w)`` in [-1, 1], for a decoder that sees it.
        opacity: ``(B, 1, n, 8h, 8w)`` its opacity; None: opaque everywhere.
        state: The decoder's, None at the start of a video.

    Returns:
        Frames like ``render``, not clipped to [-1, 1], and the decoder's state after them.
    """
    guidance = {"render": render, "opacity": opacity} if settings.shows_render else {}
    return networks.decoder.decode_next(z, state, clamp=False, **guidance)


@lru_cache(maxsize=4)
def _load(settings: LatentFixerSettings, device: str, _: WeightsStamp) -> Networks:
    parts = Parts(settings)
    plain = parts.dit()
    dtype = DTYPES[settings.precision]
    with torch.no_grad():
        text = plain.encode_text(parts.prompt(plain.sizes))
    text = tuple((k.to(device, dtype), v.to(device, dtype)) for k, v in text)
    # Cast before it is moved: the device never holds the float32 weights.
    dit = at_precision(plain, settings.precision, FLOAT32_KEYS).to(device)
    vae = at_precision(parts.vae(), settings.codec_precision).to(device)
    decoder: StreamingDecoder = vae
    if settings.decoder.kind == "taehv":
        decoder = at_precision(parts.decoder(), settings.codec_precision).to(device)
    return Networks(dit, vae, decoder, text, parts.trained, parts.note)


class Parts:
    """The parts of a fixer with their weights: from the bundle, from a file of their own, or
    initialised as ``untrained`` says.
    """

    def __init__(self, settings: LatentFixerSettings) -> None:
        self.settings = settings
        self.weights = settings.weights
        self.seed = derive_seed("fixer", 0, settings.name)
        self.bundle = None
        self.trained = self.weights.dit is not None
        self.note = f"untrained ({settings.untrained})"
        if self.weights.dit is not None:
            self.note = f"weights of {Path(self.weights.dit).name}"
        if self.weights.bundle is not None:
            self.bundle = read_bundle(self.weights.bundle, settings)
            self.trained = self.bundle.trained
            self.note = self.bundle.note

    def tensors(self, part: str) -> tuple[Mapping[str, Tensor] | None, str]:
        """Return a part's tensors, None where no file is named, and where they come from."""
        if self.bundle is not None:
            return self.bundle.parts.get(part), f"{self.weights.bundle} ({part})"
        path: str | None = getattr(self.weights, part)
        if path is None:
            return None, self.settings.name
        return load_weights(path, sha256=getattr(self.weights.sha256, part)), path

    def dit(self) -> CosmosCausalDiT:
        """Build the transformer."""
        settings = self.settings
        weights, source = self.tensors("dit")
        if weights is None:
            self.allow_untrained("dit")
            sizes = DiTSizes(**settings.dit.model_dump(), **condition_sizes(settings))
            is_identity = settings.untrained == "identity"
            weights = initial_weights(sizes, self.seed, zero_velocity=is_identity)
        return streaming_dit(weights, settings, source)

    def prompt(self, sizes: DiTSizes) -> Tensor:
        """Return the prompt's features ``(1, tokens, text_width)``; a zero token for untrained
        weights.

        Raises:
            InputError: The weights have no prompt of that width.
        """
        prompts, source = self.tensors("prompt")
        if prompts is None:
            if self.trained and self.bundle is None:
                self.refuse("prompt", "its transformer needs the features of its prompt")
            return torch.zeros(1, 1, sizes.text_width)
        text = prompts.get("text")
        if text is None or text.ndim != 2 or text.shape[1] != sizes.text_width:
            raise InputError(
                f"{source}: no 'text' of shape [tokens, {sizes.text_width}]",
                "give the features of the prompt that the weights were trained with",
            )
        return text.float()[None]

    def vae(self) -> StreamingCodec:
        """Build the autoencoder."""
        weights, source = self.tensors("vae")
        is_tiny = self.settings.vae.kind == "tiny"
        if weights is not None:
            return (TinyVAE if is_tiny else WanVAE).from_state_dict(weights, source=source)
        self.allow_untrained("vae", is_identity=is_tiny)
        if is_tiny:
            return TinyVAE.random(TinySizes(*self.settings.vae.widths), self.seed)
        return WanVAE.random(self.settings.vae.base, self.seed)

    def decoder(self) -> TinyDecoder:
        """Build the tiny Wan decoder."""
        weights, source = self.tensors("decoder")
        scaled = self.settings.decoder.scaled
        if weights is not None:
            return TinyDecoder.from_state_dict(weights, scaled=scaled, source=source)
        self.allow_untrained("decoder", is_identity=False)
        return TinyDecoder.random(LATENT, TAEHV_WIDTHS, scaled, self.seed)

    def allow_untrained(self, part: str, is_identity: bool = True) -> None:
        """Raise the error for missing weights unless the settings allow an untrained part."""
        untrained = self.settings.untrained
        if untrained == "refuse" or (untrained == "identity" and not is_identity):
            self.refuse(part, f"no weights, and settings.untrained is {untrained!r}")

    def refuse(self, part: str, problem: str) -> None:
        """Raise the error for weights that are missing."""
        raise InputError(
            f"{self.settings.name}, weights.{part}: {problem}",
            weights_to_give(part, self.settings.trained_by),
        )
