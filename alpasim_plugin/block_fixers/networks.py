"""Cast a trained network to another precision for inference.

In bf16 and fp16 the token stream and the linear layers have that type; the time embedding, the
modulation, the rotary angles and the arithmetic inside norms stay float32. Cast last: fold at
float32 and cast the folded network, so that each weight is rounded once.

The networks of a fixer, from weights or untrained, loaded once per process.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal, TypeVar

import torch
from torch import Tensor, nn

from alpasim_plugin.block_fixers.dit import FLOAT32_KEYS, CosmosCausalDiT, TextContext
from alpasim_plugin.block_fixers.sampling import CONTEXT_STEP, OPACITY_CHANNELS
from alpasim_plugin.block_fixers.settings import LatentFixerSettings, OneFixerSettings
from alpasim_plugin.block_fixers.sizes import DiTSizes, initial_weights
from alpasim_plugin.block_fixers.streaming import State
from alpasim_plugin.block_fixers.taehv import TinyDecoder
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.block_fixers.tiny_vae_nets import TinySizes
from alpasim_plugin.block_fixers.wan_vae import WanVAE
from alpasim_plugin.block_fixers.wan_vae_blocks import WanLayout
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import derive_seed
from alpasim_plugin.fixers.bundle import parts_of, read_bundle, weights_to_give
from alpasim_plugin.fixers.network import checkpoints
from alpasim_plugin.fixers.network.checkpoints import load_weights
from alpasim_plugin.fixers.pixel_network import require_device
from alpasim_plugin.fixers.settings import FixerSettings

Precision = Literal["fp32", "bf16", "fp16"]
DTYPES: Mapping[Precision, torch.dtype] = {
    "fp32": torch.float32,
    "bf16": torch.bfloat16,
    "fp16": torch.float16,
}
Net = TypeVar("Net", bound=nn.Module)
DOING = "loading the networks of a fixer"
TAEHV_WIDTHS = (256, 128, 64, 64)
LATENT = 16
Codec = TinyVAE | WanVAE


def at_precision(net: CosmosCausalDiT, precision: Precision) -> CosmosCausalDiT:
    """Return a frozen copy of a transformer, folded or not, at another precision.

    Equal bit for bit to loading the same tensors with ``dtype=``.

    Args:
        net: At float32, for one rounding only.
        precision: See the module.

    Raises:
        InputError: A weight that overflows the precision, named.
    """
    return _cast(net, DTYPES[precision], lambda key: any(part in key for part in FLOAT32_KEYS))


def codec_at_precision(codec: Net, precision: Precision) -> Net:
    """Return a frozen copy of a video autoencoder or decoder at another precision; its constants
    stay float32.

    Raises:
        InputError: A weight that overflows the precision, named.
    """
    return _cast(codec, DTYPES[precision], lambda key: False)


def text_at_precision(text: TextContext, precision: Precision) -> TextContext:
    """Return a prompt's keys and values at another precision."""
    dtype = DTYPES[precision]
    return TextContext(tuple((k.to(dtype), v.to(dtype)) for k, v in text.keys_values))


def weight_bytes(net: nn.Module) -> int:
    """Return the bytes of all parameters and buffers."""
    parts: list[Tensor] = [*net.parameters(), *net.buffers()]
    return sum(part.numel() * part.element_size() for part in parts)


def _cast(net: Net, dtype: torch.dtype, stays: Callable[[str], bool]) -> Net:
    """Copy ``net`` without ever holding a second copy at the old precision."""
    cast: dict[int, object] = {}
    for key, value in net.named_parameters():
        kept = torch.float32 if stays(key) else dtype
        cast[id(value)] = nn.Parameter(
            checkpoints.convert(key, value.detach(), kept, "network"), requires_grad=False
        )
    return copy.deepcopy(net, cast)


@dataclass(frozen=True, eq=False)
class Networks:
    """The networks of a fixer; read-only and stateless, so rollouts share them."""

    dit: CosmosCausalDiT  # folded where there is one step
    finalise_dit: CosmosCausalDiT  # the same weights for the cache write
    vae: Codec
    decoder: Codec | TinyDecoder
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
        FixerError: The device does not work.
    """
    require_device(device)
    loop = FixerSettings(name="")  # settings of the loop do not change the networks
    return _load(
        settings.model_copy(
            update={key: getattr(loop, key) for key in ("mode", "tolerance_m", "tolerance_deg")}
        ),
        device,
    )


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
    found = {key: getattr(net.sizes, key) for key in expected}
    if found != expected:
        raise InputError(
            f"{source}: {_listed(found)}, streaming gives {_listed(expected)}",
            "set fixer.render_input and fixer.opacity_input as in its training; its bundle has them",
        )
    return net


def condition_sizes(settings: LatentFixerSettings) -> dict[str, int]:
    """Return the sizes of the condition that a transformer is given; models without a map take the
    render, or nothing, in its place.
    """
    if not isinstance(settings, OneFixerSettings):
        return {"map_channels": LATENT, "opacity_channels": 0}
    return {
        "map_channels": LATENT * (1 + settings.render_input),
        "opacity_channels": OPACITY_CHANNELS if settings.opacity_input else 0,
    }


def _listed(sizes: Mapping[str, int]) -> str:
    return ", ".join(f"{key} {value}" for key, value in sizes.items())


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
    if not settings.shows_render:
        return networks.decoder.decode_next(z, state, clamp=False)
    assert isinstance(networks.decoder, TinyVAE), (
        "settings allow no other decoder to see the render"
    )
    return networks.decoder.decode_next(z, state, render=render, opacity=opacity, clamp=False)


@lru_cache(maxsize=4)
def _load(settings: LatentFixerSettings, device: str) -> Networks:
    return build_networks(Parts(settings), device, device)


def build_networks(parts: Parts, dit_device: str, codec_device: str) -> Networks:
    """Build, fold and cast the networks; nothing is kept for the next call."""
    settings, precision = parts.settings, parts.settings.precision
    plain = parts.dit().to(dit_device)
    with torch.no_grad():
        text = text_at_precision(
            plain.encode_text(parts.prompt(plain.sizes).to(dit_device)), precision
        )
    times = settings.network_times
    fold = settings.fold and len(times) == 1
    # Folded at float32 and cast after that, so that every weight is rounded once.
    dit = at_precision(plain.folded(times[0]) if fold else plain, precision)
    finalise = (
        at_precision(plain.folded(CONTEXT_STEP), precision) if fold and settings.finalises else dit
    )
    vae = codec_at_precision(parts.vae(), settings.codec_precision).to(codec_device)
    own = settings.decoder.kind != "taehv"
    decoder = (
        vae
        if own
        else codec_at_precision(parts.decoder(), settings.codec_precision).to(codec_device)
    )
    return Networks(dit, finalise, vae, decoder, text, parts.trained, parts.note)


class Parts:
    """The parts of a fixer with their weights: from the bundle, from a file of their own, or
    initialised as ``untrained`` says.
    """

    def __init__(self, settings: LatentFixerSettings) -> None:
        self.settings, self.weights = settings, settings.weights
        self.bundle = (
            read_bundle(self.weights.bundle, settings) if self.weights.bundle is not None else None
        )
        self.trained = self.bundle.trained if self.bundle else self.weights.dit is not None
        self.note = (
            self.bundle.note
            if self.bundle
            else f"weights of {Path(self.weights.dit).name}"
            if self.weights.dit
            else ""
        )
        self.note = self.note or f"untrained ({settings.untrained})"
        self.seed = derive_seed("fixer", 0, settings.name)

    def tensors(self, part: str) -> tuple[Mapping[str, Tensor], str] | None:
        """Return a part's tensors and where they come from; None where no file is named."""
        if self.bundle is not None:
            found = self.bundle.parts.get(part)
            return None if found is None else (found, f"{self.weights.bundle} ({part})")
        path: str | None = getattr(self.weights, part)
        return (
            None
            if path is None
            else (load_weights(path, sha256=getattr(self.weights.sha256, part)), path)
        )

    def dit(self) -> CosmosCausalDiT:
        """Build the transformer."""
        settings = self.settings
        given = self.tensors("dit")
        if given is None:
            self.allow_untrained("dit")
            sizes = DiTSizes(**settings.dit.model_dump(), **condition_sizes(settings))
            given = (
                initial_weights(sizes, self.seed, zero_velocity=settings.untrained == "identity"),
                "initial weights",
            )
        return streaming_dit(given[0], settings, given[1])

    def prompt(self, sizes: DiTSizes) -> Tensor:
        """Return the prompt's features ``(1, tokens, text_width)``; a zero token for untrained
        weights.
        """
        given, name = self.tensors("prompt"), self.prompt_name
        if name is not None:
            return self.named_prompt(name, sizes)
        if given is None:
            if self.trained and self.bundle is None:
                self.refuse(
                    "prompt",
                    "its transformer needs the features of the prompt that it was trained with",
                )
            return torch.zeros(1, 1, sizes.text_width)
        text = given[0].get("text")
        if text is None and given[0]:
            raise InputError(
                f"{given[1]}: its weights learned several prompts: {', '.join(sorted(given[0]))}",
                f"choose one: --set fixer.prompt={min(given[0])}",
            )
        if text is None or text.ndim != 2 or text.shape[1] != sizes.text_width:
            found = "no tensor 'text'" if text is None else f"text is {list(text.shape)}"
            raise InputError(
                f"{given[1]}: {found}", f"give 'text' of shape [tokens, {sizes.text_width}]"
            )
        return text.float()[None]

    @property
    def prompt_name(self) -> str | None:
        """Name of the learned prompt that is asked for."""
        return self.settings.prompt if isinstance(self.settings, OneFixerSettings) else None

    def named_prompt(self, name: str, sizes: DiTSizes) -> Tensor:
        """Return a learned prompt ``(1, tokens, text_width)`` by its name.

        Raises:
            InputError: The weights have learned none, or none of that name.
        """
        given = self.tensors("prompt")
        known = (
            {}
            if given is None
            else {key: value for key, value in given[0].items() if key != "text"}
        )
        if name not in known:
            source = self.settings.name if given is None else given[1]
            found = (
                f"its weights learned the prompts {', '.join(sorted(known))}"
                if known
                else "its weights learned no prompts"
            )
            do = (
                "choose one of these"
                if known
                else "leave fixer.prompt out, or give a bundle that holds prompts"
            )
            raise InputError(f"{source}, fixer.prompt={name}: {found}", do)
        text = known[name]
        if text.ndim != 2 or text.shape[1] != sizes.text_width:
            raise InputError(
                f"prompt {name}: shape {list(text.shape)}",
                f"give [tokens, {sizes.text_width}]",
            )
        return text.float()[None]

    def vae(self) -> Codec:
        """Build the autoencoder."""
        given, tiny = self.tensors("vae"), self.settings.vae.kind == "tiny"
        if given is not None:
            return (TinyVAE if tiny else WanVAE).from_state_dict(given[0], source=given[1])
        self.allow_untrained("vae", always_random=not tiny)
        if tiny:
            return TinyVAE.random(TinySizes(*self.settings.vae.widths), self.seed)
        return WanVAE.random(WanLayout.of_base(self.settings.vae.base), self.seed)

    def decoder(self) -> TinyDecoder:
        """Build the tiny Wan decoder."""
        given, scaled = self.tensors("decoder"), self.settings.decoder.scaled
        if given is not None:
            return TinyDecoder.from_state_dict(given[0], scaled=scaled, source=given[1])
        self.allow_untrained("decoder", always_random=True)
        return TinyDecoder.random(LATENT, TAEHV_WIDTHS, scaled, self.seed)

    def allow_untrained(self, part: str, always_random: bool = False) -> None:
        """Raise the error for missing weights unless the settings allow an untrained part."""
        if self.settings.untrained == "refuse":
            self.refuse(part, "no weights, and settings.untrained is 'refuse'")
        if always_random and self.settings.untrained == "identity":
            self.refuse(part, "no weights, and an untrained one is not an identity")

    def refuse(self, part: str, found: str) -> None:
        """Raise the error for weights that are missing."""
        raise InputError(
            f"{self.settings.name}, weights.{part}: {found}",
            weights_to_give(part, self.settings.trained_by),
        )


def load_tiny_vae(path: str | Path) -> TinyVAE:
    """Return the tiny autoencoder in a file: a bundle's, or one that `TinyVAE.save` wrote.

    Raises:
        InputError: Neither, or a bundle with another kind of autoencoder.
    """
    tensors = load_weights(path)
    return TinyVAE.from_state_dict(parts_of(tensors).get("vae", tensors), source=str(path))
