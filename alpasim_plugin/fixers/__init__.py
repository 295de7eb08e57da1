"""Fixers, by name: what repairs a rendered frame."""

from collections.abc import Sequence
from dataclasses import replace

from alpasim_plugin.core.interfaces import Fixer
from alpasim_plugin.core.parts import build, unidentified
from alpasim_plugin.fixers.settings import FixerSettings

__all__ = ["fixer_settings", "make_fixer"]


def make_fixer(
    name: str,
    settings: FixerSettings | None = None,
    *,
    scene_id: str,
    seed: int = 0,
    device: str = "cpu",
    threads: int | None = None,
) -> Fixer:
    """Make one rollout's fixer. Networks are loaded once per process and shared.

    Args:
        name: A fixer as `alpasim_plugin.core.parts.resolve` takes it: ``onefixer``, ``onefixer@2``,
            ``package.module:Class``.
        settings: From `fixer_settings`; None for the settings that the name stands for.
        scene_id, seed: Key of the noise, with the camera and the index in the rollout.
        device: ``cpu`` or ``cuda``.
        threads: Torch threads of this process; None leaves their number.

    Raises:
        InputError: Unknown name, bad settings, or weights that are missing or wrong.
    """
    spec = unidentified("fixer", name)
    return build(
        spec if settings is None else replace(spec, settings=settings),
        scene_id=scene_id,
        seed=seed,
        device=device,
        threads=threads,
    )


def fixer_settings(name: str, overrides: Sequence[str] = ()) -> FixerSettings:
    """Return the settings of ``NAME`` or ``NAME@STEPS`` with dotted overrides (``window=4``,
    ``decoder.kind=latent``) on top.

    Raises:
        InputError: Unknown name or key (with the nearest), or a bad value, with its position.
    """
    settings = unidentified("fixer", name, overrides).settings
    assert isinstance(settings, FixerSettings), "the settings of a fixer derive from FixerSettings"
    return settings
