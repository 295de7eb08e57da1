"""``run --settings``: a file of keys for ``--set``, with the preset and the number of workers that
belong to them; those that ship are in ``configs/settings``.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from alpasim_plugin.core.files.config import guess, load_yaml, own_or_shipped, validate
from alpasim_plugin.core.json_types import JsonObject
from evaluators.metrics.presets import PRESETS

LIBRARY = Path(__file__).resolve().parents[2] / "configs" / "settings"


class SettingsSpec(BaseModel):
    """A settings file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    version: Literal[1] = Field(description="Version of this schema: 1.")
    description: str = Field(default="", description="One sentence for people.")
    preset: str | None = Field(default=None, description="Evaluator preset; none: the default.")
    workers: int | None = Field(
        default=None, ge=1, description="Rollouts at once; none: one a core."
    )
    set: JsonObject = Field(default={}, description="Dotted key to value, as --set would.")


@dataclass(frozen=True)
class Settings:
    """What a settings file says.

    Attributes:
        preset: Evaluator preset; None: the file names none.
        workers: Rollouts at once; None: the file says nothing.
        overrides: ``KEY=VALUE``, as of ``--set``.
    """

    preset: str | None = None
    workers: int | None = None
    overrides: tuple[str, ...] = ()


def load_settings(path_or_name: str | None) -> Settings:
    """Read a settings file, or shipped settings by name; nothing where none is named.

    Raises:
        InputError: No such file, bad YAML, an unknown key or preset: with file, line and column.
    """
    if path_or_name is None:
        return Settings()
    path = own_or_shipped(path_or_name, LIBRARY, "settings file", "--settings")
    document = load_yaml(path)
    spec = validate(SettingsSpec, document)
    if spec.preset is not None and spec.preset not in PRESETS:
        hint = f"{guess(spec.preset, PRESETS)}known: {', '.join(PRESETS)}"
        raise document.error(("preset",), f"preset {spec.preset!r}", hint)
    overrides = tuple(f"{key}={json.dumps(value)}" for key, value in spec.set.items())
    return Settings(spec.preset, spec.workers, overrides)
