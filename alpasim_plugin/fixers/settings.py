"""Settings of a fixer: ``configs/fixers/NAME.yaml``, validated, with dotted overrides on top."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, TypeVar

from pydantic import BaseModel, ConfigDict, Field, model_validator

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.config import Document, apply_overrides, load_yaml, validate
from alpasim_plugin.fixers.network import schedule

Positive = Annotated[int, Field(ge=1)]


class Part(BaseModel):
    """A section: frozen, without unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


@dataclass(frozen=True)
class Unit:
    """What a fixer makes at a time, in the middle of a rollout."""

    frames: int  # new ones that leave at a time
    network_calls: int  # forwards of the network, that of a cache write included
    latents: int  # of one forward
    lookahead_frames: int  # later frames that must be known before the first frame can leave


class FixerSettings(Part):
    """Settings of any fixer, read by the closed loop."""

    name: str = Field(description="Name in tables and reports.")
    block_latents: Positive = Field(
        default=2, description="Latents of a block: 2 are 8 frames, 5 at the start of a rollout."
    )
    mode: Literal["chunk", "speculative"] = Field(
        default="speculative",
        description="chunk: the plan is committed for a block. speculative: a block is fixed along the predicted poses, and again where "
        "the true poses differ.",
    )
    tolerance_m: float = Field(
        default=0.02,
        ge=0,
        description="Speculative: largest camera displacement from the predicted pose.",
    )
    tolerance_deg: float = Field(
        default=0.1,
        ge=0,
        description="Speculative: largest camera rotation from the predicted pose.",
    )
    uses_map: bool = Field(
        default=False, description="Whether the semantic map is drawn and given to the fixer."
    )
    references: int = Field(
        default=0,
        ge=0,
        le=8,
        description="Recorded frames that are warped into each view, at most; 0: none.",
    )
    recording: Literal["all", "past"] = Field(
        default="all",
        description="Which recorded frames may be references: all of the recording, or those from before the frame's time.",
    )

    @property
    def loop_mode(self) -> str:
        """How the closed loop runs the fixer, in one word."""
        return self.mode

    @property
    def is_offline(self) -> bool:
        """Whether the fixer needs whole clips, so that it cannot run in a closed loop."""
        return False

    @property
    def unit(self) -> Unit | None:
        """What the fixer makes at a time and what that costs, for tables; None where it does not
        say.
        """
        return None

    @classmethod
    def load(cls, name: str, overrides: Sequence[str] = ()) -> Self:
        """Return the settings of a fixer's name; see `load_settings`."""
        return load_settings(name, cls, overrides)


class DigestSettings(Part):
    """Expected SHA-256 digests, hexadecimal, checked before the tensors are read."""

    bundle: str | None = None
    dit: str | None = None
    vae: str | None = None
    decoder: str | None = None
    prompt: str | None = None


class WeightsSettings(Part):
    """Files with weights; relative paths start at the folder of the file that names them, or at the
    working folder.
    """

    bundle: str | None = Field(
        default=None, description="One safetensors file with everything (docs/fixers.md)."
    )
    dit: str | None = Field(default=None, description="The transformer alone.")
    vae: str | None = Field(default=None, description="The autoencoder alone.")
    decoder: str | None = Field(default=None, description="The tiny Wan decoder.")
    prompt: str | None = Field(
        default=None,
        description="Safetensors with 'text' (tokens, text_width).",
    )
    sha256: DigestSettings = Field(
        default=DigestSettings(), description="Expected digests by the keys above."
    )

    def path(self, part: str) -> Path | None:
        """Return where a part's weights lie: ``bundle``, ``dit``, ``vae``, ``decoder`` or
        ``prompt``; None where it has no file.
        """
        path: str | None = getattr(self, part)
        return None if path is None else Path(path)

    @model_validator(mode="after")
    def _one_source(self) -> WeightsSettings:
        parts = [
            key for key in ("dit", "vae", "decoder", "prompt") if getattr(self, key) is not None
        ]
        if self.bundle is not None and parts:
            raise ValueError(
                f"a bundle and {', '.join(parts)} | give the bundle alone, or the parts"
            )
        return self


@dataclass(frozen=True)
class BundleKind:
    """What a kind of bundle holds; the module that owns a fixer's settings declares its kind.

    Args:
        name: In the header of a bundle.
        needed, optional: Parts, which are the first words of the tensors' keys.
        must_match: Settings that give wrong images at other values than those of the training.
        may_differ: Settings that may have other values, which the label then names.
    """

    name: str
    needed: frozenset[str]
    optional: frozenset[str] = frozenset()
    must_match: tuple[str, ...] = ()
    may_differ: tuple[str, ...] = ()

    def problems(self, parts: Iterable[str]) -> list[str]:
        """Return what is missing and what does not belong."""
        present = set(parts)
        unknown = sorted(present - self.needed - self.optional)
        return [f"no {part}.*" for part in sorted(self.needed - present)] + [
            f"unknown part {part}.*" for part in unknown
        ]


class WeightedSettings(FixerSettings):
    """Settings of a fixer whose network has weights."""

    bundle_kind: ClassVar[BundleKind]
    weights: WeightsSettings = Field(default=WeightsSettings(), description="Files with weights.")
    untrained: Literal["identity", "random", "refuse"] = Field(
        default="refuse",
        description="Initialisation without weights: returns the render (identity), random, or an error (refuse).",
    )

    @property
    def needed_weights(self) -> tuple[str, ...]:
        """Files of ``weights`` that the fixer needs where no bundle is given."""
        return ("bundle",)


def counted_steps(value: Any) -> Any:
    """Take a count of steps for the schedule's own, as ``NAME@STEPS`` gives it."""
    if isinstance(value, int) and not isinstance(value, bool):
        return schedule.names(value)
    # Strict validation takes no list for a tuple after this step
    return tuple(value) if isinstance(value, list) else value


def check_steps(steps: tuple[float, ...]) -> None:
    """Refuse steps that do not fall from 1000.

    Raises:
        ValueError: With what to write, as pydantic's validators report it.
    """
    if (
        any(later >= earlier for earlier, later in pairwise(steps))
        or steps[0] != 1000
        or steps[-1] <= 0
    ):
        raise ValueError(
            f"steps = {list(steps)} | give named steps falling from 1000, such as [1000] or [1000, 500]"
        )


def check_no_blocks(settings: FixerSettings) -> None:
    """Refuse settings of blocks for a fixer that has none.

    Raises:
        ValueError: With what to do, as pydantic's validators report it.
    """
    for key in ("block_latents", "mode", "tolerance_m", "tolerance_deg"):
        if getattr(settings, key) != FixerSettings.model_fields[key].default:
            raise ValueError(
                f"{key} = {getattr(settings, key)} | one frame at a time has no blocks: leave it out, or take a onefixer-dit"
            )


S = TypeVar("S", bound=FixerSettings)


def load_settings(name: str, model: type[S], overrides: Sequence[str] = ()) -> S:
    """Read ``configs/fixers/NAME.yaml`` (a fixer without a file has its model's defaults) and apply
    overrides.

    Args:
        name: The fixer.
        model: What its settings are.
        overrides: ``window=4``, ``decoder.kind=latent``.

    Raises:
        InputError: An unknown key with the nearest known one, or a bad value, with file, line and
            column.
    """
    path = Path(str(resources.files("configs.fixers"))) / f"{name}.yaml"
    document = (
        load_yaml(path)
        if os.path.isfile(path)
        else Document({"name": name}, {}, f"the defaults of {name}")
    )
    document = _without_shipped(document, overrides)
    nested = Document(
        {"fixer": document.data},
        {("fixer", *loc): mark for loc, mark in document.marks.items()},
        document.path,
    )
    done = apply_overrides(nested, [f"fixer.{text}" for text in overrides])
    marks = {loc[1:]: mark for loc, mark in done.marks.items()}
    return validate(model, _absolute(Document(done.data["fixer"], marks, document.path)))


def _without_shipped(document: Document, overrides: Sequence[str]) -> Document:
    """Let parts named in overrides take the place of the bundle that the file names; sizes are what
    its weights are, so they stay.

    Raises:
        InputError: Other sizes for weights that have theirs.
    """
    keys = {text.partition("=")[0].strip() for text in overrides}
    weights = document.data.get("weights")
    if not isinstance(weights, dict) or weights.get("bundle") is None or "weights.bundle" in keys:
        return document
    sizes = sorted(key for key in keys if key.partition(".")[0] in ("dit", "vae", "generator"))
    if sizes:
        raise InputError(
            f"{', '.join(f'fixer.{key}' for key in sizes)}: the weights in {weights['bundle']} have their sizes",
            "add --set fixer.weights.bundle=null for an untrained network of other sizes, or give a bundle of yours",
        )
    if not any(f"weights.{part}" in keys for part in ("dit", "vae", "decoder", "prompt")):
        return document
    kept = {key: value for key, value in weights.items() if key not in ("bundle", "sha256")}
    return replace(document, data={**document.data, "weights": kept})


def _absolute(document: Document) -> Document:
    """Resolve relative paths of weights against the file, or the working folder, that they were
    written in.
    """
    weights = document.data.get("weights")
    if not isinstance(weights, dict):
        return document
    paths = {
        key: str(document.folder_of(("weights", key)) / value)
        for key, value in weights.items()
        if isinstance(value, str)
    }
    return replace(document, data={**document.data, "weights": {**weights, **paths}})


WeightsStamp = tuple[tuple[str, int, int], ...]  # path, time of change in nanoseconds, bytes


def weights_stamp(weights: WeightsSettings) -> WeightsStamp:
    """Return the files that weights name, with their times of change and sizes: what is kept of
    them in a process is kept under this, so that a file that was replaced is read again.
    """
    named = [value for value in weights.model_dump().values() if isinstance(value, str)]
    stamps = []
    for name in named:
        if os.path.isfile(name):
            status = os.stat(name)
            stamps.append((name, status.st_mtime_ns, status.st_size))
    return tuple(stamps)
