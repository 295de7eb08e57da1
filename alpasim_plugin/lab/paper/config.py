"""Configuration of the comparison: which systems, at which budget, on which scenes."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from alpasim_plugin.core.files.config import Document, load_yaml, own_or_shipped, validate
from alpasim_plugin.lab.training.recipes.registry import RECIPES
from alpasim_plugin.lab.training.scenes import Split

LIBRARY = Path(__file__).resolve().parents[3] / "configs" / "paper"
RAW = "3dgs"


def system_of(label: str) -> str:
    """Return the recipe of a row of a table: ``omnidreams`` of ``omnidreams@4``.

    Example:
        >>> system_of("omnidreams@4"), system_of("V9")
        ('omnidreams', 'V9')
    """
    return label.partition("@")[0]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SceneSet(_Strict):
    """Scenes of one split, drawn anew from their seeds."""

    split: Split = Field(description="Split of simrun train scenes.")
    scenes: int = Field(ge=1, description="How many, the first ones.")
    duration_s: float | None = Field(
        default=None, ge=1.0, description="Length of each drive; none: the split's."
    )


class Training(_Strict):
    """The budget: updates, and what an update sees."""

    autoencoder_updates: int = Field(ge=1, description="Of the autoencoder.")
    base_updates: int = Field(ge=1, description="Of each common initialisation.")
    updates: int = Field(ge=1, description="U: of a stage of share 1 (docs/lab/arms.md).")
    detector_updates: int | None = Field(
        default=None, ge=1, description="Of our own detectors; none: there are none."
    )
    updates_of: dict[str, int] = Field(default={}, description="U of single systems.")
    size: str = Field(default="256x144", description="Of the sequences, WIDTHxHEIGHT.")
    clips: int = Field(default=4, ge=1, description="Clips of a batch.")
    accumulate: int = Field(default=2, ge=1, description="Batches of an update.")
    latents: int = Field(default=12, ge=2, description="Latents of a clip.")
    columns: int | None = Field(default=None, ge=2, description="Width of a crop, in latents.")
    stride: int = Field(default=24, ge=1, description="Frames between starts of clips.")
    lr: float = Field(default=2e-4, gt=0.0, description="Peak learning rate.")
    ema: float = Field(default=0.99, ge=0.0, lt=1.0, description="Decay of the averaged weights.")
    precision: Literal["fp32", "bf16"] = Field(default="fp32", description="Of forward passes.")
    seed: int = Field(default=0, ge=0, description="Of weights, sampling and noise.")


class Drive(_Strict):
    """The closed loop of Table 2b."""

    renderers: tuple[str, ...] = Field(min_length=2, description="Rows of the table.")
    scenes: tuple[SceneSet, ...] = Field(min_length=1, description="What is driven.")
    seeds: int = Field(ge=1, description="Seeds of each scene.")
    policy: str = Field(default="learned", description="Policy that drives.")
    preset: str = Field(default="paper", description="Preset of the evaluators.")


class Times(_Strict):
    """The times of all rows, measured side by side on one machine, one process at a time."""

    scenes: int = Field(ge=2, description="How many of the test scenes, evenly chosen.")
    frames: int = Field(default=41, ge=2, description="First frames of a clip.")


class Pilot(_Strict):
    """Records of a small measurement whose spread gives the power of the claims."""

    quality: str = Field(description="A quality.json, relative to this file.")
    drive: str | None = Field(
        default=None,
        description="A summary.json, or a document of simrun compare --json, relative to this file.",
    )


class PaperConfig(_Strict):
    """A configuration of ``simrun bench paper``."""

    version: Literal[1] = Field(description="Version of this schema: 1.")
    train: SceneSet = Field(description="Scenes to train on.")
    test: SceneSet = Field(description="Scenes to measure on.")
    frames: int = Field(default=198, ge=2, description="First frames of a clip that are measured.")
    training: Training = Field(description="The budget.")
    systems: tuple[str, ...] = Field(min_length=1, description="Rows of Table 1, NAME[@STEPS].")
    ablation: tuple[str, ...] = Field(default=(), description="Rows of the ablation.")
    drive: Drive | None = Field(default=None, description="The closed loop; none: not driven.")
    times: Times | None = Field(default=None, description="Times of a frame; none: not measured.")
    pilot: Pilot = Field(description="What the power is computed from.")
    least_power: float = Field(
        default=0.5, ge=0.0, le=1.0, description="Claims of less power are left out."
    )
    metric_weights: str | None = Field(
        default=None, description="Folder of the metrics' weights, relative to this file."
    )

    @model_validator(mode="after")
    def _names_recipes(self) -> PaperConfig:
        rows = (*self.systems, *self.ablation, *(self.drive.renderers if self.drive else ()))
        for name in (*(system_of(row) for row in rows), *self.training.updates_of):
            if name != RAW and name not in RECIPES:
                raise ValueError(
                    f"no system {name!r} | choose {RAW} or one of {', '.join(RECIPES)}"
                )
        if self.train.split != "train":
            raise ValueError(
                f"train: split {self.train.split!r} | networks are trained on the split 'train'"
            )
        if RAW in (*self.systems, *self.ablation):
            raise ValueError(f"{RAW} is always measured | leave it out of systems and ablation")
        return self

    @property
    def labels(self) -> tuple[str, ...]:
        """Rows of all tables of quality, each once, the raw render first."""
        return tuple(dict.fromkeys((RAW, *self.systems, *self.ablation)))

    def updates_of(self, system: str) -> int:
        """Return U of a system."""
        return self.training.updates_of.get(system, self.training.updates)


def load_config(path_or_name: str) -> tuple[PaperConfig, Document, Path]:
    """Read a configuration: a file, or a shipped one by name (``small``).

    Returns:
        The configuration, its document, and the file.

    Raises:
        InputError: No such file, bad YAML or an unknown key, with file, line and column.
    """
    path = own_or_shipped(path_or_name, LIBRARY, "configuration", "--config")
    document = load_yaml(path)
    return validate(PaperConfig, document), document, path
