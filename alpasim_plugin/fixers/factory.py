"""The factories of the fixers with networks: what a run knows of it without loading a network."""

from __future__ import annotations

from typing import TYPE_CHECKING

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers.image_settings import NoiseWindowSettings, RenderStepSettings
from alpasim_plugin.fixers.pixel_settings import PixelFixerSettings
from alpasim_plugin.fixers.settings import OneFixerSettings
from alpasim_plugin.nets.headers import read_metadata
from alpasim_plugin.plugins.interfaces import Declaration

if TYPE_CHECKING:
    from alpasim_plugin.fixers.image_fixer import ImageFixer
    from alpasim_plugin.fixers.onefixer import OneFixer
    from alpasim_plugin.fixers.pixel_fixer import PixelFixer
    from alpasim_plugin.fixers.window_fixer import WindowFixer

FixerWithWeights = OneFixerSettings | PixelFixerSettings | RenderStepSettings | NoiseWindowSettings
PARTS = ("bundle", "dit", "vae", "decoder", "prompt")


def onefixer(settings: OneFixerSettings, scene_id: str, seed: int = 0, device: str = "cpu", threads: int | None = None) -> OneFixer:
    """Make one rollout's session; see `alpasim_plugin.fixers.onefixer.OneFixer`."""
    from alpasim_plugin.fixers.onefixer import OneFixer  # loads torch

    return OneFixer(settings, scene_id, seed, device, threads)


def per_frame(settings: PixelFixerSettings, scene_id: str, seed: int = 0, device: str = "cpu", threads: int | None = None) -> PixelFixer:
    """Make one rollout's session; see `alpasim_plugin.fixers.pixel_fixer.PixelFixer`."""
    from alpasim_plugin.fixers.pixel_fixer import PixelFixer  # loads torch

    return PixelFixer(settings, scene_id, seed, device, threads)


def image(settings: RenderStepSettings, scene_id: str, seed: int = 0, device: str = "cpu", threads: int | None = None) -> ImageFixer:
    """Make one rollout's session of an image model; see `alpasim_plugin.fixers.image_fixer.ImageFixer`."""
    from alpasim_plugin.fixers.image_fixer import ImageFixer  # loads torch

    return ImageFixer(settings, scene_id, seed, device, threads)


def windows(
    settings: NoiseWindowSettings, scene_id: str, seed: int = 0, device: str = "cpu", threads: int | None = None
) -> ImageFixer | WindowFixer:
    """Make one rollout's session from noise: of single frames, or, where a window has more, of a whole clip."""
    from alpasim_plugin.fixers.image_fixer import ImageFixer  # loads torch
    from alpasim_plugin.fixers.window_fixer import WindowFixer

    return (WindowFixer if settings.is_offline else ImageFixer)(settings, scene_id, seed, device, threads)


def describe(settings: FixerWithWeights) -> Declaration:
    """Say whose weights the settings name.

    Raises:
        InputError: Weights that are named but not there.
    """
    files = {f"weights.{part}": path for part in PARTS if (path := settings.weights.path(part)) is not None}
    for key, path in files.items():
        if not path.is_file():
            do = f"correct --set fixer.{key}, or where it is written"
            raise InputError("looking for a fixer's weights", f"{settings.name}: {key} = {path}", "no such file", do)
    if "weights.bundle" in files:
        trained = read_metadata(files["weights.bundle"]).get("trained") == "true"
        return Declaration(files, trained, "trained" if trained else "untrained")
    if "weights.dit" in files:
        trained, note = True, "weights of a checkpoint"
    else:
        trained, note = False, "weights missing" if settings.untrained == "refuse" else f"untrained ({settings.untrained})"
    missing = next((part for part in needed_parts(settings) if f"weights.{part}" not in files), None)
    if settings.untrained != "refuse" or missing is None:
        return Declaration(files, trained, note)
    return Declaration(
        files,
        trained,
        f"weights missing: {missing}" if files else note,
        missing=weights_to_give(missing, getattr(settings, "trained_by", None)),
    )


def needed_parts(settings: FixerWithWeights) -> tuple[str, ...]:
    """Return the parts whose weights a fixer without a bundle needs."""
    if isinstance(settings, PixelFixerSettings):
        return ("bundle",)
    return ("dit", "vae", "decoder") if settings.decoder.kind == "taehv" else ("dit", "vae")


def weights_to_give(part: str, trained_by: str | None = None) -> str:
    """Return what to do about missing weights, as the last part of an error."""
    choice = "" if part == "bundle" else " (or fixer.weights.bundle=FILE)"
    do = f"give --set fixer.weights.{part}=FILE{choice}; for timing alone, fixer.untrained=random"
    return do if trained_by is None else f"train it: {trained_by}; then {do}"


onefixer.settings_model = OneFixerSettings  # type: ignore[attr-defined]
onefixer.describe = describe  # type: ignore[attr-defined]
per_frame.settings_model = PixelFixerSettings  # type: ignore[attr-defined]
per_frame.describe = describe  # type: ignore[attr-defined]
image.settings_model = RenderStepSettings  # type: ignore[attr-defined]
image.describe = describe  # type: ignore[attr-defined]
windows.settings_model = NoiseWindowSettings  # type: ignore[attr-defined]
windows.describe = describe  # type: ignore[attr-defined]
