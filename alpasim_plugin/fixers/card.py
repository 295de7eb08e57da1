"""What a fixer is, told from its settings and files alone: no network is built."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from alpasim_plugin.errors import InputError
from alpasim_plugin.fixers.base import fixer_settings
from alpasim_plugin.fixers.settings import FixerSettings, OneFixerSettings
from alpasim_plugin.nets.checkpoints import file_sha256, read_metadata

PARTS = ("bundle", "dit", "vae", "decoder", "prompt")


@dataclass(frozen=True)
class Card:
    """A fixer as a run names it.

    Attributes:
        name: As on the command line, ``onefixer@2``.
        note: Whose weights: "untrained (identity)", "trained", "no network", "weights missing".
        trained: Whether the weights were learned.
        weights: File -> SHA-256.
    """

    name: str
    settings: FixerSettings
    note: str
    trained: bool
    weights: Mapping[str, str] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """Give the fixer and its weights in a few words."""
        return f"{self.settings.name}, {self.note}"

    def as_dict(self) -> dict[str, Any]:
        """Return everything, for run.json."""
        return {
            "name": self.name,
            "label": self.label,
            "trained": self.trained,
            "weights": dict(self.weights),
            "settings": self.settings.model_dump(mode="json"),
        }

    def content(self) -> dict[str, Any]:
        """Return what decides its pictures: weights by their digests, not by where they lie, so that a moved file keeps its rollouts."""
        settings = self.settings.model_dump(mode="json")
        if isinstance(self.settings, OneFixerSettings):
            settings["weights"] = {part: self.weights[path] for part in PARTS if (path := getattr(self.settings.weights, part)) is not None}
        return {"name": self.name, "settings": settings}


def fixer_card(name: str, overrides: Sequence[str] = ()) -> Card:
    """Describe the fixer that a name and overrides stand for.

    Args:
        name: ``NAME`` or ``NAME@STEPS``.
        overrides: ``KEY=VALUE`` of its settings.

    Raises:
        InputError: Unknown name or key, a bad value, or weights that are named but cannot be read.
    """
    settings = fixer_settings(name, overrides)
    if not isinstance(settings, OneFixerSettings):
        return Card(name, settings, "no network", False)
    paths = {part: path for part in PARTS if (path := getattr(settings.weights, part)) is not None}
    for part, path in paths.items():
        if not Path(path).is_file():
            do = f"correct --set fixer.weights.{part}, or where it is written"
            raise InputError("looking for a fixer's weights", f"{name}: weights.{part} = {path}", "no such file", do)
    weights = {path: file_sha256(path) for path in paths.values()}
    if "bundle" in paths:
        trained = read_metadata(paths["bundle"]).get("trained") == "true"
        return Card(name, settings, "trained" if trained else "untrained", trained, weights)
    if "dit" in paths:
        return Card(name, settings, "weights of a checkpoint", True, weights)
    note = "weights missing" if settings.untrained == "refuse" else f"untrained ({settings.untrained})"
    return Card(name, settings, note, False, weights)
