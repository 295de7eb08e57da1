"""Renderer names of the command line: a renderer, a fixer over the reconstruction, or a fixer over any renderer.

``clean``; ``onefixer`` (short for ``onefixer+3dgs``); ``onefixer@2``; ``onefixer+clean``. Fixers are imported only where one is named.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from alpasim_plugin import renderers
from alpasim_plugin.errors import InputError
from alpasim_plugin.renderers import RENDERERS
from alpasim_plugin.runtime.guards import checked_frames
from alpasim_plugin.types import Frame, Renderer, RenderRequest, Scenario

if TYPE_CHECKING:
    from alpasim_plugin.fixers.card import Card

DOING = "choosing a renderer"
BASE = "3dgs"  # what a fixer stands over where nothing else is said
REMOTE = "nre://"


@dataclass(frozen=True)
class RendererName:
    """A renderer as named: the base, and the fixer over it with its step count.

    Example:
        >>> str(parse_renderer("onefixer@2")), str(parse_renderer("clean"))
        ('onefixer@2+3dgs', 'clean')
    """

    base: str
    fixer: str | None = None

    def __str__(self) -> str:
        return self.base if self.fixer is None else f"{self.fixer}+{self.base}"


def parse_renderer(name: str) -> RendererName:
    """Take a renderer's name apart.

    Raises:
        InputError: Unknown renderer or fixer (with the nearest known), a step count where there is none, or a remote renderer.
    """
    if REMOTE in name:
        raise InputError(DOING, f"renderer {name!r}", "remote AlpaSim renderers are not built yet", f"use {BASE}, or a fixer over it")
    if name in RENDERERS:
        return RendererName(name)
    from alpasim_plugin.fixers.base import split_name

    fixer, plus, base = name.partition("+")
    plain, steps = split_name(fixer)
    fixers = _fixer_names()
    if plain not in fixers:
        if steps is not None and plain in RENDERERS:
            raise InputError(DOING, f"renderer {name!r}", f"{plain!r} has no step count", f"write {plain}, or FIXER@STEPS")
        known = [*RENDERERS, *fixers]
        near = difflib.get_close_matches(plain, known, n=1)
        hint = f"did you mean {near[0]!r}? " if near else ""
        what = "fixer" if plus else "renderer or fixer"
        raise InputError(
            DOING,
            f"renderer {name!r}",
            f"no {what} has the name {plain!r}",
            f"{hint}renderers: {', '.join(RENDERERS)}; fixers: {', '.join(fixers)}; together FIXER+RENDERER",
        )
    if plus:
        RENDERERS.get(base)
    return RendererName(base if plus else BASE, fixer)


def make_renderer(
    name: str, scenario: Scenario, seed: int = 0, device: str = "cpu", threads: int | None = None, overrides: Sequence[str] = ()
) -> Renderer:
    """Make one rollout's renderer.

    Args:
        name: A renderer, or a fixer over one; see `parse_renderer`.
        scenario: What is rendered.
        seed: The rollout's seed: what wanders from frame to frame depends on it, and a fixer's noise.
        device: ``cpu`` or ``cuda``.
        threads: Threads of the CPU rasteriser and of torch; None leaves their numbers.
        overrides: ``KEY=VALUE`` of the fixer's settings.

    Raises:
        InputError: Unknown name, device or setting, or weights that are missing or wrong.
        RendererError: The device does not work.
    """
    parsed = parse_renderer(name)
    base = renderers.make_renderer(parsed.base, scenario, seed, device, threads)
    if parsed.fixer is None:
        return base
    from alpasim_plugin.fixers import fixer_settings, make_fixer
    from alpasim_plugin.fixers.blocks import fixed_renderer

    fixer, settings = parsed.fixer, fixer_settings(parsed.fixer, overrides)

    def render(request: RenderRequest) -> Frame:
        return checked_frames(base, [request])[0]

    return fixed_renderer(
        render,
        lambda: make_fixer(fixer, settings, scene_id=scenario.scene_id, seed=seed, device=device, threads=threads),
        settings,
        scenario,
        threads,
    )


def card_of(name: str, overrides: Sequence[str] = ()) -> Card | None:
    """Describe the fixer in a renderer's name; None where there is none.

    Raises:
        InputError: As `parse_renderer`; an unknown setting or a bad value; weights that cannot be read.
    """
    fixer = parse_renderer(name).fixer
    if fixer is None:
        return None
    from alpasim_plugin.fixers.card import fixer_card

    return fixer_card(fixer, overrides)


def _fixer_names() -> list[str]:
    from alpasim_plugin.fixers import FIXERS

    return list(FIXERS)
