"""The block generators before they are loaded: settings and kind of bundle."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar, Literal, Self

from pydantic import Field, field_validator, model_validator

from alpasim_plugin.fixers.network import schedule
from alpasim_plugin.fixers.settings import (
    BundleKind,
    Part,
    Positive,
    Unit,
    WeightedSettings,
    check_steps,
    counted_steps,
)


class DiTSettings(Part):
    """Sizes of the transformer where they are not read off weights."""

    width: Positive = Field(description="Channels of the token stream.")
    blocks: Positive = Field(description="Transformer blocks.")
    head_width: Positive = Field(description="Channels of an attention head, even.")
    mlp_width: Positive = Field(description="Inner channels of the feed-forward part.")
    adaln_rank: Positive = Field(description="Rank of the time modulation.")
    text_width: Positive = Field(description="Width of the prompt's features.")
    context_width: Positive = Field(description="Width of the projected prompt.")


class CodecSettings(Part):
    """The video autoencoder."""

    kind: Literal["tiny", "wan"] = Field(
        description="tiny: TinyVAE. wan: the Wan 2.1 autoencoder at any width."
    )
    base: Positive = Field(
        default=96,
        description="Width of an untrained wan autoencoder: 96 as published, 24 for LightVAE.",
    )
    widths: tuple[Positive, Positive, Positive, Positive, Positive] = Field(
        default=(64, 96, 96, 64, 48),
        description="Channels of an untrained tiny autoencoder: encoder at 1/4 and 1/8, decoder at 1/8, 1/4 and per frame.",
    )


class DecoderSettings(Part):
    """From latents to frames."""

    kind: Literal["latent", "render", "taehv"] = Field(
        default="latent",
        description="latent: the autoencoder's decoder. render: the same, and it also sees the render's frames (tiny only). "
        "taehv: the tiny Wan decoder.",
    )
    scaled: bool = Field(
        default=False, description="taehv: weights expect de-normalised latents (LightTAE)."
    )


class LatentFixerSettings(WeightedSettings):
    """Any fixer with an autoencoder and a transformer on its latents."""

    dit: DiTSettings = Field(description="Sizes of the transformer where no weights say them.")
    rope_ratios: tuple[float, float, float] = Field(
        default=(3.0, 3.0, 1.0), description="NTK stretch: height, width, time."
    )
    vae: CodecSettings = Field(description="The video autoencoder.")
    decoder: DecoderSettings = Field(
        default=DecoderSettings(), description="From latents to frames."
    )
    trained_by: str | None = Field(
        default=None,
        description="Command that trains the weights, for the error where there are none.",
    )
    precision: Literal["fp32", "bf16"] = Field(default="fp32", description="Of the transformer.")
    codec_precision: Literal["fp32", "bf16"] = Field(
        default="fp32", description="Of the autoencoder."
    )

    @property
    def needed_weights(self) -> tuple[str, ...]:
        """Files of ``weights`` that the fixer needs where no bundle is given."""
        return ("dit", "vae", "decoder") if self.decoder.kind == "taehv" else ("dit", "vae")

    @property
    def shows_render(self) -> bool:
        """Whether the decoder sees the render."""
        return self.decoder.kind == "render"

    @property
    @abstractmethod
    def network_times(self) -> tuple[float, ...]:
        """Time inputs of the network's denoising steps, 0 to 1000."""

    @property
    def finalises(self) -> bool:
        """Whether a further call of the network writes the history."""
        return False

    @model_validator(mode="after")
    def _decodable(self) -> Self:
        if self.decoder.kind == "render" and self.vae.kind != "tiny":
            raise ValueError(
                f"decoder.kind 'render' with vae.kind {self.vae.kind!r} | only the tiny autoencoder can see the render"
            )
        if self.decoder.kind == "taehv" and self.vae.kind != "wan":
            raise ValueError(
                f"decoder.kind 'taehv' with vae.kind {self.vae.kind!r} | it decodes Wan latents: use vae.kind wan"
            )
        return self


def latent_kind(name: str, must_match: tuple[str, ...], may_differ: tuple[str, ...]) -> BundleKind:
    """Return a kind of bundle with a transformer on latents; `BundleKind` explains the
    arguments.
    """
    latent = ("rope_ratios", "vae.kind", "decoder.kind", "decoder.scaled")
    return BundleKind(
        name,
        frozenset({"dit", "vae"}),
        frozenset({"decoder", "prompt"}),
        (*latent, *must_match),
        may_differ,
    )


class OneFixerSettings(LatentFixerSettings):
    """A causal latent fixer: autoencoder, transformer with history, flow steps."""

    bundle_kind: ClassVar[BundleKind] = latent_kind(
        "block",
        must_match=("block_latents", "render_input", "opacity_input"),
        may_differ=("steps", "history", "window", "sink", "holes", "uses_map", "no_map"),
    )
    window: Positive = Field(
        default=6,
        description="Attention window in latents, the block itself and the sink included.",
    )
    sink: int = Field(
        default=0,
        ge=0,
        description="Attention sink: first latents of the rollout that stay in the window.",
    )
    steps: tuple[float, ...] = Field(
        default=(1000.0,), min_length=1, description="Named time steps, falling from 1000."
    )
    history: Literal["finalise", "last-forward"] = Field(
        default="last-forward",
        description="Keys and values cached of a block: those of an extra forward (finalise) or of the last step.",
    )
    holes: Literal["noise", "render", "everywhere"] = Field(
        default="noise",
        description="Source of a block where the render is transparent: noise (Eq. 1), or the render. everywhere: noise alone, which needs "
        "render_input.",
    )
    no_map: Literal["nothing", "black"] = Field(
        default="nothing",
        description="In the map's place where there is none: nothing is added to the tokens, or a black map is encoded.",
    )
    render_input: bool = Field(
        default=False, description="Whether the render's latents are a condition beside the map's."
    )
    opacity_input: bool = Field(
        default=False,
        description="Whether every block of the transformer embeds the opacity (ArtiFixer).",
    )

    @property
    def network_times(self) -> tuple[float, ...]:
        """Time inputs of the network's denoising steps, 0 to 1000."""
        return tuple(level.t for level in schedule.from_names(self.steps))

    @property
    def finalises(self) -> bool:
        """Whether a further call of the network writes the history."""
        return self.history == "finalise"

    @property
    def unit(self) -> Unit:
        """What a block costs."""
        frames = 4 * self.block_latents
        return Unit(frames, len(self.steps) + self.finalises, self.block_latents, frames - 1)

    @field_validator("steps", mode="before")
    @classmethod
    def _counted(cls, value: Any) -> Any:
        return counted_steps(value)

    @model_validator(mode="after")
    def _consistent(self) -> OneFixerSettings:
        check_steps(self.steps)
        if self.sink > self.window:
            raise ValueError(
                f"sink {self.sink} in a window of {self.window} | the window includes the sink: make it larger"
            )
        if self.holes == "everywhere" and not self.render_input:
            raise ValueError(
                "holes 'everywhere' without render_input | the network would see nothing of the render: set render_input true"
            )
        return self
