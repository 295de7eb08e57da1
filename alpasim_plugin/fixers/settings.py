"""Settings of a fixer: ``configs/fixers/NAME.yaml``, validated, with dotted overrides on top."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.io.config import apply_overrides, load_yaml, validate
from alpasim_plugin.io.yaml_positions import Document
from alpasim_plugin.nets import schedule
from alpasim_plugin.nets.styles import CLEAR

DOING = "reading the settings of a fixer"
Positive = Annotated[int, Field(ge=1)]


class Part(BaseModel):
    """A section: frozen, without unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


@dataclass(frozen=True)
class Unit:
    """What a fixer makes at a time, in the middle of a rollout.

    Example:
        >>> Unit(frames=8, network_calls=2, latents=2, lookahead_frames=7).calls_per_frame
        0.25
    """

    frames: int  # new ones that leave at a time
    network_calls: int  # forwards of the network, that of a cache write included
    latents: int  # of one forward
    lookahead_frames: int  # later frames that must be known before the first frame can leave

    @property
    def calls_per_frame(self) -> float:
        """Network calls for a frame."""
        return self.network_calls / self.frames


class FixerSettings(Part):
    """Settings of any fixer, read by the closed loop."""

    name: str = Field(description="Name in tables and reports.")
    block_latents: Positive = Field(default=2, description="Latents of a block: 2 are 8 frames, 5 at the start of a rollout.")
    mode: Literal["chunk", "speculative"] = Field(
        default="speculative",
        description="chunk: the plan is committed for a block. speculative: a block is fixed along the predicted poses, and again where "
        "the true poses differ.",
    )
    tolerance_m: float = Field(default=0.02, ge=0, description="Speculative: largest camera displacement from the predicted pose.")
    tolerance_deg: float = Field(default=0.1, ge=0, description="Speculative: largest camera rotation from the predicted pose.")
    uses_map: bool = Field(default=False, description="Whether the semantic map is drawn and given to the fixer.")

    @property
    def loop_mode(self) -> str:
        """How the closed loop runs the fixer, in one word."""
        return self.mode

    @property
    def is_offline(self) -> bool:
        """Whether the fixer needs whole clips, so that it cannot run in a closed loop."""
        return False

    @property
    def keeps_appearance(self) -> bool:
        """Whether the output is meant to look like the render; a fixer asked for another appearance changes every pixel."""
        return True

    @property
    def unit(self) -> Unit | None:
        """What the fixer makes at a time and what that costs, for tables; None where it does not say."""
        return None

    @classmethod
    def load(cls, name: str, overrides: Sequence[str] = ()) -> Self:
        """Return the settings of a fixer's name; see `load_settings`."""
        return load_settings(name, cls, overrides)


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

    kind: Literal["tiny", "wan"] = Field(description="tiny: TinyVAE. wan: the Wan 2.1 autoencoder at any width.")
    base: Positive = Field(default=96, description="Width of an untrained wan autoencoder: 96 as published, 24 for LightVAE.")
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
    scaled: bool = Field(default=False, description="taehv: weights expect de-normalised latents (LightTAE).")


class DigestSettings(Part):
    """Expected SHA-256 digests, hexadecimal, checked before the tensors are read."""

    bundle: str | None = None
    dit: str | None = None
    vae: str | None = None
    decoder: str | None = None
    prompt: str | None = None


class WeightsSettings(Part):
    """Files with weights; relative paths start at the folder of the file that names them, or at the working folder."""

    bundle: str | None = Field(default=None, description="One safetensors file with everything (docs/fixer-weights.md).")
    dit: str | None = Field(default=None, description="The transformer alone.")
    vae: str | None = Field(default=None, description="The autoencoder alone.")
    decoder: str | None = Field(default=None, description="The tiny Wan decoder.")
    prompt: str | None = Field(default=None, description="Safetensors with 'text' (tokens, text_width), or with a prompt under each name.")
    sha256: DigestSettings = Field(default=DigestSettings(), description="Expected digests by the keys above.")

    def path(self, part: str) -> Path | None:
        """Return where a part's weights lie: ``bundle``, ``dit``, ``vae``, ``decoder`` or ``prompt``; None where it has no file."""
        path: str | None = getattr(self, part)
        return None if path is None else Path(path)

    @model_validator(mode="after")
    def _one_source(self) -> WeightsSettings:
        parts = [key for key in ("dit", "vae", "decoder", "prompt") if getattr(self, key) is not None]
        if self.bundle is not None and parts:
            raise ValueError(f"a bundle and {', '.join(parts)} | give the bundle alone, or the parts")
        return self


def counted_steps(value: Any) -> Any:
    """Take a count of steps for the schedule's own, as ``NAME@STEPS`` gives it."""
    if isinstance(value, int) and not isinstance(value, bool):
        return schedule.names(value)
    return tuple(value) if isinstance(value, list) else value  # strict validation takes no list for a tuple after this step


def check_steps(steps: tuple[float, ...]) -> None:
    """Refuse steps that do not fall from 1000.

    Raises:
        ValueError: With what to write, as pydantic's validators report it.
    """
    if any(b >= a for a, b in pairwise(steps)) or steps[0] != 1000 or steps[-1] <= 0:
        raise ValueError(f"steps = {list(steps)} | give named steps falling from 1000, such as [1000] or [1000, 500]")


class LatentFixerSettings(FixerSettings):
    """Any fixer with an autoencoder and a transformer on its latents."""

    bundle_kind: ClassVar[str]  # of `alpasim_plugin.fixers.bundle.KINDS`
    dit: DiTSettings = Field(description="Sizes of the transformer where no weights say them.")
    rope_ratios: tuple[float, float, float] = Field(default=(3.0, 3.0, 1.0), description="NTK stretch: height, width, time.")
    vae: CodecSettings = Field(description="The video autoencoder.")
    decoder: DecoderSettings = Field(default=DecoderSettings(), description="From latents to frames.")
    weights: WeightsSettings = Field(default=WeightsSettings(), description="Files with weights.")
    untrained: Literal["identity", "random", "refuse"] = Field(
        default="refuse", description="Initialisation without weights: an identity, random, or an error (refuse)."
    )
    trained_by: str | None = Field(default=None, description="Command that trains the weights, for the error where there are none.")
    precision: Literal["fp32", "bf16", "fp16"] = Field(default="fp32", description="Of the transformer.")
    codec_precision: Literal["fp32", "bf16", "fp16"] = Field(default="fp32", description="Of the autoencoder.")
    fold: bool = Field(default=True, description="Fold the modulation into the linears where there is one step.")

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
            raise ValueError(f"decoder.kind 'render' with vae.kind {self.vae.kind!r} | only the tiny autoencoder can see the render")
        if self.decoder.kind == "taehv" and self.vae.kind != "wan":
            raise ValueError(f"decoder.kind 'taehv' with vae.kind {self.vae.kind!r} | it decodes Wan latents: use vae.kind wan")
        return self


class OneFixerSettings(LatentFixerSettings):
    """A causal latent fixer: autoencoder, transformer with history, flow steps."""

    bundle_kind: ClassVar[str] = "block"
    window: Positive = Field(default=6, description="Attention window in latents, the block itself and the sink included.")
    sink: int = Field(default=0, ge=0, description="Attention sink: first latents of the rollout that stay in the window.")
    steps: tuple[float, ...] = Field(default=(1000.0,), min_length=1, description="Named time steps, falling from 1000.")
    history: Literal["finalise", "last-forward", "none"] = Field(
        default="last-forward",
        description="Keys and values cached of a block: those of an extra forward (finalise) or of the last step. none: no history, "
        "every frame is fixed by itself.",
    )
    holes: Literal["noise", "render", "everywhere"] = Field(
        default="noise",
        description="Source of a block where the render is transparent: noise (Eq. 1), or the render. everywhere: noise alone, which needs "
        "render_input.",
    )
    no_map: Literal["nothing", "black"] = Field(
        default="nothing", description="In the map's place where there is none: nothing is added to the tokens, or a black map is encoded."
    )
    render_input: bool = Field(default=False, description="Whether the render's latents are a condition beside the map's.")
    opacity_input: bool = Field(default=False, description="Whether every block of the transformer embeds the opacity (ArtiFixer).")
    prompt: str | None = Field(
        default=None, description="Name of a prompt that its weights learned, such as night; recipe appearance has clear, night, fog, snow."
    )
    graphs: Literal["auto", "off"] = Field(default="auto", description="auto: on a GPU, blocks are recorded as CUDA graphs and replayed.")

    @property
    def network_times(self) -> tuple[float, ...]:
        """Time inputs of the network's denoising steps, 0 to 1000."""
        return tuple(level.t for level in schedule.from_names(self.steps))

    @property
    def shows_render(self) -> bool:
        """Whether the decoder sees the render; in another appearance than the render's, its detail would show the clear day through."""
        return super().shows_render and self.keeps_appearance

    @property
    def keeps_appearance(self) -> bool:
        """Whether no prompt asks for another appearance than the render's."""
        return self.prompt in (None, CLEAR)

    @property
    def finalises(self) -> bool:
        """Whether a further call of the network writes the history."""
        return self.history == "finalise"

    @property
    def unit(self) -> Unit:
        """What a block costs."""
        frames = 1 if self.history == "none" else 4 * self.block_latents
        return Unit(frames, len(self.steps) + self.finalises, self.block_latents, frames - 1)

    @field_validator("steps", mode="before")
    @classmethod
    def _counted(cls, value: Any) -> Any:
        return counted_steps(value)

    @model_validator(mode="after")
    def _consistent(self) -> OneFixerSettings:
        check_steps(self.steps)
        if self.sink > self.window:
            raise ValueError(f"sink {self.sink} in a window of {self.window} | the window includes the sink: make it larger")
        if self.history == "none" and self.block_latents != 1:
            raise ValueError(f"block_latents {self.block_latents} without history | frames are fixed one by one: set block_latents 1")
        if self.holes == "everywhere" and not self.render_input:
            raise ValueError("holes 'everywhere' without render_input | the network would see nothing of the render: set render_input true")
        return self


def check_no_blocks(settings: FixerSettings) -> None:
    """Refuse settings of blocks for a fixer that has none.

    Raises:
        ValueError: With what to do, as pydantic's validators report it.
    """
    for key in ("block_latents", "mode", "tolerance_m", "tolerance_deg"):
        if getattr(settings, key) != FixerSettings.model_fields[key].default:
            raise ValueError(f"{key} = {getattr(settings, key)} | one frame at a time has no blocks: leave it out, or take a onefixer-dit")


S = TypeVar("S", bound=FixerSettings)


def load_settings(name: str, model: type[S], overrides: Sequence[str] = ()) -> S:
    """Read ``configs/fixers/NAME.yaml`` (a fixer without a file has its model's defaults) and apply overrides.

    Args:
        name: The fixer.
        model: What its settings are.
        overrides: ``window=4``, ``decoder.kind=latent``.

    Raises:
        InputError: An unknown key with the nearest known one, or a bad value, with file, line and column.
    """
    path = Path(str(resources.files("configs.fixers"))) / f"{name}.yaml"
    document = load_yaml(path, DOING) if path.is_file() else Document({"name": name}, {}, f"the defaults of {name}")
    return validate(model, _absolute(_override(_without_shipped(document, overrides), overrides)), DOING)


def _without_shipped(document: Document, overrides: Sequence[str]) -> Document:
    """Let parts named in overrides take the place of the bundle that the file names; sizes are what its weights are, so they stay.

    Raises:
        InputError: Other sizes for weights that have theirs.
    """
    keys = {text.partition("=")[0].strip() for text in overrides}
    weights = document.data.get("weights")
    if not isinstance(weights, dict) or weights.get("bundle") is None or "weights.bundle" in keys:
        return document
    sizes = sorted(key for key in keys if key.partition(".")[0] in ("dit", "vae", "generator"))
    if sizes:
        found = f"the weights in {weights['bundle']} have their sizes"
        do = "add --set fixer.weights.bundle=null for an untrained network of other sizes, or give a bundle of yours"
        raise InputError(DOING, ", ".join(f"fixer.{key}" for key in sizes), found, do)
    if not any(f"weights.{part}" in keys for part in ("dit", "vae", "decoder", "prompt")):
        return document
    kept = {key: value for key, value in weights.items() if key not in ("bundle", "sha256")}
    return replace(document, data={**document.data, "weights": kept})


def _override(document: Document, overrides: Sequence[str]) -> Document:
    """Apply overrides under the prefix that users write, ``--set fixer.KEY=VALUE``, so that messages show it."""
    nested = Document({"fixer": document.data}, {("fixer", *loc): mark for loc, mark in document.marks.items()}, document.path)
    done = apply_overrides(nested, [f"fixer.{text}" for text in overrides], DOING)
    marks = {loc[1:]: mark for loc, mark in done.marks.items()}
    return Document(done.data["fixer"], marks, document.path, document.sources, tuple(overrides))


def _absolute(document: Document) -> Document:
    """Resolve relative paths of weights against the file, or the working folder, that they were written in."""
    weights = document.data.get("weights")
    if not isinstance(weights, dict):
        return document
    paths = {key: str(document.folder_of(("weights", key)) / value) for key, value in weights.items() if isinstance(value, str)}
    return replace(document, data={**document.data, "weights": {**weights, **paths}})
