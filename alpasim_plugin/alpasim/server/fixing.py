"""The fixer behind a service: a pure step from a past and a render to a frame and the next past."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import U8, Frame
from alpasim_plugin.fixers.pixel_settings import PixelFixerSettings
from alpasim_plugin.plugins.interfaces import BlockRule
from alpasim_plugin.plugins.parts import RendererSpec, build, resolve_renderer

DOING = "choosing a renderer to serve"


class CausalFixer(Protocol):
    """Fix one frame at a time with an explicit past, as `alpasim_plugin.fixers.pixel_fixer.PixelFixer` does."""

    def advance(self, frame: Frame, sdmap: U8 | None, past: Any) -> tuple[Frame, Any]:
        """Return the frame fixed and what the next frame's call is given as ``past``; a past is never written to."""


def resolve_served(name: str, overrides: Sequence[str] = ()) -> RendererSpec:
    """Resolve a renderer for serving: noise is keyed by content, and ``identity`` is no fixer.

    Raises:
        InputError: An unknown name, a bad setting, or a fixer that needs frames ahead of the present.
    """
    spec = resolve_renderer(name, overrides)
    if spec.fixer is None:
        return spec
    if isinstance(spec.fixer.settings, PixelFixerSettings):
        return resolve_renderer(name, [*overrides, "noise=content"])
    if spec.fixer.name == "identity":
        return RendererSpec(spec.name, spec.base)
    settings: Any = spec.fixer.settings
    found = f"{spec.fixer.name} works on blocks of frames, whose poses are not part of a render request"
    if settings.loop_mode == "frame by frame":
        found = f"{spec.fixer.name} has one history a camera, and requests of several drives come over one connection"
    raise InputError(DOING, f"renderer {name!r}", found, "serve a fixer with an explicit past, such as onefixer")


class FixerShelf:
    """One fixer per scene (the scene is in the noise's key); the network is loaded once and shared.

    Args:
        spec: A renderer with a fixer.
        device, threads: For the network.
    """

    def __init__(self, spec: RendererSpec, device: str = "cpu", threads: int | None = None) -> None:
        assert spec.fixer is not None, "a renderer without a fixer has nothing to fix"
        self._spec, self._session = spec.fixer, {"device": device, "threads": threads}
        self._made: dict[tuple[str, int], CausalFixer] = {}

    @property
    def needs_map(self) -> bool:
        """Whether the fixer takes semantic maps."""
        return bool(getattr(self._spec.settings, "uses_map", False))

    def of(self, scene_id: str, seed: int = 0) -> CausalFixer:
        """Return the fixer of a scene; a seed is another stream of noise."""
        key = scene_id, seed
        if key not in self._made:
            if len(self._made) >= 256:  # ids come from requests
                self._made.clear()
            fixer = build(self._spec, scene_id=scene_id, seed=seed, **self._session)
            if fixer.blocks != BlockRule(1, 1) or not hasattr(fixer, "advance"):
                found = f"{type(fixer).__name__} has no advance(frame, map, past)"
                raise InputError(DOING, f"fixer {self._spec.name!r}", found, "serve a fixer of single frames, such as onefixer")
            self._made[key] = fixer
        return self._made[key]


def size_of(value: Any) -> int:
    """Return the bytes that arrays and tensors in a past hold."""
    if hasattr(value, "element_size"):
        return int(value.numel() * value.element_size())
    if hasattr(value, "nbytes"):
        return int(value.nbytes)
    if isinstance(value, tuple):
        return sum(size_of(part) for part in value)
    if hasattr(value, "__dataclass_fields__"):
        return sum(size_of(getattr(value, name)) for name in value.__dataclass_fields__)
    return 0
