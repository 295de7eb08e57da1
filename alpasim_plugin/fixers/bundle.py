"""Weights of a fixer in one safetensors file: its networks, and the settings they were trained
with.

Keys carry their part. A bundle of the kind ``per-frame`` has ``generator.``; those of latent fixers
(``block``, ``render-step``, ``noise-window``) have ``dit.``, ``vae.``, ``decoder.`` (where it is
not the autoencoder's) and ``prompt.text``.
The header holds ``format``, ``kind``, ``trained``, ``note``, ``settings`` (the JSON of the settings
that the weights were trained with), and ``updates`` where they were trained from nothing. Only safetensors is read: a pickle is refused.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Generic, TypeVar

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.arrays import read_metadata, refuse_shards
from alpasim_plugin.core.files.atomic import write_safetensors
from alpasim_plugin.core.files.reading import parse_json
from alpasim_plugin.core.interfaces import Declaration, Fixer
from alpasim_plugin.fixers.settings import WeightedSettings

if TYPE_CHECKING:
    from torch import Tensor

    from alpasim_plugin.fixers.network.checkpoints import StateDict

FORMAT = "simrun-fixer-1"
HARDLY = "hardly trained: "
HARDLY_UPDATES = 50  # from nothing: weights of fewer are marked wherever the fixer is named
FILES = ("bundle", "dit", "vae", "decoder", "prompt")  # of `WeightsSettings`
S = TypeVar("S", bound=WeightedSettings)


@dataclass(frozen=True)
class FixerFactory(Generic[S]):
    """Makes the sessions of a fixer with weights, and says what they are without loading a network.

    Args:
        settings_model: Of its settings.
        session: Makes one rollout's session from settings, scene id, seed, device and threads. It
            imports what loads torch.
        help: One line for every fixer that the factory makes, by its name.
    """

    settings_model: type[S]
    session: Callable[[S, str, int, str, int | None], Fixer]
    help: Mapping[str, str] = field(default_factory=dict)

    def __call__(
        self,
        settings: S,
        scene_id: str,
        seed: int = 0,
        device: str = "cpu",
        threads: int | None = None,
    ) -> Fixer:
        """Make one rollout's session."""
        return self.session(settings, scene_id, seed, device, threads)

    def describe(self, settings: S) -> Declaration:
        """Say whose weights the settings name.

        Raises:
            InputError: Weights that are named but not there.
        """
        files = {}
        for part in FILES:
            path = settings.weights.path(part)
            if path is not None:
                files[f"weights.{part}"] = path
        for key, path in files.items():
            refuse_shards(path)
            if not os.path.isfile(path):
                raise InputError(
                    f"{settings.name}: {key} = {path}: no such file",
                    f"correct --set fixer.{key}, or where it is written",
                )
        if "weights.bundle" in files:
            header = read_metadata(files["weights.bundle"])
            return Declaration(files, header.get("trained") == "true", training_words(header))
        trained = "weights.dit" in files
        note = "weights of a checkpoint" if trained else f"untrained ({settings.untrained})"
        lacking = [part for part in settings.needed_weights if f"weights.{part}" not in files]
        if settings.untrained != "refuse" or not lacking:
            return Declaration(files, trained, note)
        note = f"weights missing: {lacking[0]}" if files else "weights missing"
        do = weights_to_give(lacking[0], getattr(settings, "trained_by", None))
        return Declaration(files, trained, note, missing=do)


def training_words(header: Mapping[str, str]) -> str:
    """Say how far the weights of a bundle are trained.

    Example:
        >>> training_words({"trained": "true", "updates": "4"}), training_words({"trained": "true"})
        ('hardly trained: 4 updates', 'trained')
    """
    if header.get("trained") != "true":
        return "untrained"
    updates = header.get("updates", "")
    if updates.isdecimal() and int(updates) < HARDLY_UPDATES:
        return f"{HARDLY}{_updates(int(updates))}"
    return "trained"


def _updates(updates: int) -> str:
    return "1 update" if updates == 1 else f"{updates} updates"


def weights_to_give(part: str, trained_by: str | None = None) -> str:
    """Return what to do about missing weights, as the last part of an error.

    Args:
        part: Key of the settings' ``weights``.
        trained_by: The command that trains them, where there is one.
    """
    choice = "" if part == "bundle" else " (or fixer.weights.bundle=FILE)"
    do = f"give --set fixer.weights.{part}=FILE{choice}; for timing alone, fixer.untrained=random"
    return do if trained_by is None else f"train it: {trained_by}; then {do}"


@dataclass(frozen=True)
class Bundle:
    """Contents of a bundle."""

    parts: Mapping[str, StateDict]  # by part, keys without it
    trained: bool
    note: str  # description, and settings that differ from training


def save_bundle(
    path: str | Path,
    parts: Mapping[str, Mapping[str, Tensor]],
    settings: WeightedSettings,
    *,
    trained: bool,
    note: str = "",
    updates: int | None = None,
) -> None:
    """Write a bundle atomically.

    Args:
        path: A ``.safetensors`` file.
        parts: State dicts by part: ``generator``; or ``dit`` and ``vae``, and where there are any
            ``decoder`` and ``prompt`` (``text``: tokens, text_width).
        settings: What the weights were trained with.
        trained: Whether they were learned.
        note: Description for labels.
        updates: Of a training that began from nothing; None where it went on from other weights,
            or is not known.

    Raises:
        InputError: A part that is not known, or one that is missing.
    """
    kind = settings.bundle_kind
    problems = kind.problems(parts)
    if problems:
        raise InputError(
            f"{path}: {'; '.join(problems)}",
            f"give {', '.join(sorted(kind.needed))}, and nothing else but {', '.join(sorted(kind.optional)) or 'these'}",
        )
    tensors = {f"{part}.{key}": value for part, sd in parts.items() for key, value in sd.items()}
    plain = settings.model_dump(mode="json", exclude={"weights"})
    header = {
        "format": FORMAT,
        "kind": kind.name,
        "trained": str(trained).lower(),
        "note": note,
        "settings": json.dumps(plain),
    }
    if updates is not None:
        header["updates"] = str(updates)
    write_safetensors(path, tensors, header)


def read_bundle(path: str | Path, settings: WeightedSettings) -> Bundle:
    """Read a bundle for use with some settings.

    Raises:
        InputError: Not a safetensors file, not a bundle, a digest that differs, or weights that
            were made for other settings.
    """
    header, trained_with = bundle_header(path)
    kind = settings.bundle_kind
    found_kind = header.get("kind")
    if found_kind != kind.name:
        raise InputError(
            f"{path} with the settings of {settings.name}: a bundle of the kind {found_kind!r}, not {kind.name!r}",
            f"take a fixer of that kind: `simrun list fixers`, this bundle is for {trained_with['name']}",
        )
    used = settings.model_dump(mode="json")
    # A header written before a setting existed lacks it: its weights were trained at its default.
    defaults = {key: field.get_default() for key, field in type(settings).model_fields.items()}
    wrong = []
    others = []
    for key in (*kind.must_match, *kind.may_differ):
        actual = _at(used, key)
        due = _at({**defaults, **trained_with}, key)
        if due != actual and key in kind.must_match:
            wrong.append(f"{key} is {actual} for {due}")
        elif due != actual:
            others.append(f"{key} {actual} instead of {due}")
    if wrong:
        raise InputError(
            f"{path} with the settings of {settings.name}: {'; '.join(wrong)}",
            "set these as the weights need them",
        )
    from alpasim_plugin.fixers.network.checkpoints import load_weights  # loads torch

    parts = parts_of(load_weights(path, sha256=settings.weights.sha256.bundle))
    problems = kind.problems(parts)
    if problems:
        raise InputError(
            f"{path}: {'; '.join(problems)}",
            f"write it with save_bundle (parts {', '.join(sorted(kind.needed | kind.optional))})",
        )
    trained = header.get("trained") == "true"
    words = training_words(header)
    note = header.get("note", "")
    mark = "" if words == "trained" else words
    # A note that counts the updates itself is not followed by a second count.
    if mark.startswith(HARDLY) and mark.removeprefix(HARDLY) in note:
        mark = "hardly trained"
    notes = [mark, note, *others]
    return Bundle(parts, trained, ", ".join(filter(None, notes)) or "trained")


def parts_of(tensors: Mapping[str, Tensor]) -> dict[str, StateDict]:
    """Group tensors by the part of their keys before the first dot; keys lose it."""
    parts: dict[str, StateDict] = {}
    for key, value in tensors.items():
        part, _, inner_key = key.partition(".")
        parts.setdefault(part, {})[inner_key] = value
    return parts


def bundle_header(path: str | Path) -> tuple[Mapping[str, str], dict[str, object]]:
    """Return a bundle's header and the settings in it.

    Raises:
        InputError: Not a bundle.
    """
    header = read_metadata(path)
    settings = parse_json(header.get("settings", "{}"), f"{path}, settings in its header")
    if header.get("format") != FORMAT or not isinstance(settings, dict) or "name" not in settings:
        raise InputError(
            f"{path}: format {header.get('format')!r} in its header",
            f"give a file that save_bundle wrote ({FORMAT}), or the parts as weights.dit and weights.vae",
        )
    return header, settings


def _at(data: object, key: str) -> object:
    for part in key.split("."):
        data = data.get(part) if isinstance(data, dict) else None
    return data
