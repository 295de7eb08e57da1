"""What a renderer may offer to the loop beyond `Renderer.render`; each is read by name, and a renderer without it does without.

- ``lookahead: int``: requests carry a forecast of so many of the camera's next frames in ``ahead``. Others pay nothing for it.
- ``chunk: tuple[int, int] | None``: frames come in blocks of so many, first and later ones; the policy is asked at each block's end.
- ``render_batch(requests) -> frames``: all requests of an instant (of all cameras; of a whole block with ``chunk``) in one call.
- ``stage_ms: Mapping[str, float]``: parts of the last call's time that are stages of their own, such as ``{"fix": 12.0}``.
- ``facts() -> dict``: what a fixer's session is and did, for the rollout's manifest: ``label``, ``trained``, ``mode``, counts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from alpasim_plugin.types import Frame, Renderer, RenderRequest


def lookahead_of(renderer: Renderer) -> int:
    """Return how many future frames of a camera a renderer wants to be told about."""
    return int(getattr(renderer, "lookahead", 0))


def chunk_of(renderer: Renderer) -> tuple[int, int] | None:
    """Return the frames of the first and of later blocks, or None where frames come one by one."""
    chunk: tuple[int, int] | None = getattr(renderer, "chunk", None)
    return chunk


def batch_of(renderer: Renderer) -> Callable[[Sequence[RenderRequest]], Sequence[Frame]]:
    """Return how to render several requests: together where the renderer can, else one by one."""
    together: Callable[[Sequence[RenderRequest]], Sequence[Frame]] | None = getattr(renderer, "render_batch", None)
    return together or (lambda requests: [renderer.render(request) for request in requests])


def spent_by(renderer: Renderer) -> Mapping[str, float]:
    """Return the stages within the renderer's last call, milliseconds."""
    spent: Mapping[str, float] = getattr(renderer, "stage_ms", {})
    return spent


def facts_of(renderer: Renderer) -> dict[str, Any]:
    """Return what a fixer's session has to say when the rollout is over; empty for a renderer without a fixer."""
    tell: Callable[[], dict[str, Any]] | None = getattr(renderer, "facts", None)
    return {} if tell is None else tell()
