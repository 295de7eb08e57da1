"""What every fixer is: frames in, as many frames out, block by block, with the past of one rollout and of nothing else."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from alpasim_plugin.errors import InputError
from alpasim_plugin.fixers.settings import FixerSettings, load_settings
from alpasim_plugin.nets import schedule
from alpasim_plugin.registry import Registry
from alpasim_plugin.types import U8, Frame


@dataclass(frozen=True)
class BlockRule:
    """How many frames a fixer takes at a time.

    Example:
        >>> BlockRule.of_latents(2)
        BlockRule(first=5, then=8)
        >>> [BlockRule(5, 8).frames(i) for i in range(3)]
        [5, 8, 8]
    """

    first: int  # frames of a rollout's first block
    then: int  # frames of every later block

    @classmethod
    def of_latents(cls, latents: int) -> BlockRule:
        """Return the rule of a causal video autoencoder: the first latent holds one frame, every other one four."""
        return cls(1 + 4 * (latents - 1), 4 * latents)

    def frames(self, block: int) -> int:
        """Return the number of frames of block ``block``, counted from 0."""
        return self.first if block == 0 else self.then


@runtime_checkable
class BlockFixer(Protocol):
    """One rollout's fixer session; extends `types.Fixer`.

    A block holds frames of one or several cameras in any order, each camera with the same number of frames, at most as many as
    ``blocks`` says; shorter blocks are filled up by repeating the last frame, and the result is cropped. ``maps`` are the semantic maps
    of the same frames in the same order, or empty. What comes out has the order, times and cameras of what went in.
    """

    @property
    def blocks(self) -> BlockRule:
        """Frames of the first block and of each later one."""
        ...

    @property
    def trained(self) -> bool:
        """Whether the weights were learned."""
        ...

    @property
    def label(self) -> str:
        """What this is, for tables and reports: "onefixer-tiny, untrained (identity)"."""
        ...

    def reset(self, seed: int) -> None:
        """Forget all history and take the noise of another seed."""
        ...

    def preview(self, block: Sequence[Frame], maps: Sequence[U8]) -> Sequence[Frame]:
        """Fix the block in progress and leave the history as it was; any number of times."""
        ...

    def step(self, block: Sequence[Frame], maps: Sequence[U8]) -> Sequence[Frame]:
        """Fix a block and take it into the history; costs nothing again when it is bit-equal to the last preview's."""
        ...


FIXERS: Registry[BlockFixer] = Registry("fixer", "simrun.fixers")


def make_fixer(
    name: str,
    settings: FixerSettings | None = None,
    *,
    scene_id: str,
    seed: int = 0,
    device: str = "cpu",
    threads: int | None = None,
) -> BlockFixer:
    """Make one rollout's fixer.

    A factory takes ``(settings, scene_id, seed, device, threads)``; networks are loaded once per process and shared.

    Args:
        name: A registered fixer, or ``NAME@STEPS``.
        settings: From `fixer_settings`; None for the settings that the name stands for.
        scene_id, seed: Key of the noise, with the camera and the index in the rollout.
        device: ``cpu`` or ``cuda``.
        threads: Torch threads of this process; None leaves their number.

    Raises:
        InputError: Unknown name, bad settings, or weights that are missing or wrong.
    """
    plain, _ = split_name(name)
    return FIXERS.get(plain)(settings or fixer_settings(name), scene_id, seed, device, threads)


def fixer_settings(name: str, overrides: Sequence[str] = ()) -> FixerSettings:
    """Return the settings of ``NAME`` or ``NAME@STEPS`` with dotted overrides (``window=4``, ``decoder.kind=latent``) on top.

    Raises:
        InputError: Unknown name or key (with the nearest), or a bad value, with its position.
    """
    plain, steps = split_name(name)
    at_steps = [] if steps is None else [f"steps={list(schedule.names(steps))}"]
    model: type[FixerSettings] = getattr(FIXERS.get(plain), "settings_model", FixerSettings)
    return load_settings(plain, model, (*at_steps, *overrides))


def split_name(name: str) -> tuple[str, int | None]:
    """Split ``NAME@STEPS``.

    Example:
        >>> split_name("onefixer@2"), split_name("onefixer")
        (('onefixer', 2), ('onefixer', None))
    """
    plain, at, count = name.partition("@")
    if at and not re.fullmatch("[1-9][0-9]?", count):
        found = f"{count!r} after @ is no step count"
        raise InputError("choosing a fixer", f"name {name!r}", found, "write NAME@STEPS, such as onefixer@2")
    return plain, int(count) if at else None
