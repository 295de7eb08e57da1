"""Cameras with lenses in a run: the renderer sees the pinholes that cover each lens, the fixer and
the loop see the lens.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from alpasim_plugin.cameras.lens import resized, sides_of
from alpasim_plugin.cameras.lens_cover import LensCover
from alpasim_plugin.core.interfaces import Renderer, complete
from alpasim_plugin.core.types import CameraSpec, Frame, RecordedFrame, RenderRequest

SMALLER = 4  # by side, of the cameras whose pinholes are counted


def drawn_pixels(cameras: Sequence[CameraSpec]) -> tuple[int, float]:
    """Return how many pinholes cover cameras, and their pixels together, within one in a hundred."""
    count = 0
    pixels = 0.0
    for camera in cameras:
        small = resized(
            camera, *(max(side // SMALLER, 1) for side in (camera.width, camera.height))
        )
        share = camera.width * camera.height / (small.width * small.height)
        sides = sides_of(small)
        count += len(sides)
        pixels += share * sum(side.cover[0] * side.cover[1] for side in sides)
    return count, pixels


class LensRenderer(Renderer):
    """Show what lenses see through pinholes that another renderer draws.

    Args:
        inner: Draws the pinholes.
        cover: Of the cameras.
    """

    def __init__(self, inner: Renderer, cover: LensCover) -> None:
        self._inner = complete(inner, Renderer)
        self._cover = cover
        self.lookahead = inner.lookahead
        self.block = inner.block
        self.has_history = inner.has_history

    @property
    def stage_ms(self) -> Mapping[str, float]:  # type: ignore[override]  # computed when it is read
        """Times of the inner renderer's last call."""
        return self._inner.stage_ms

    def render(self, request: RenderRequest) -> Frame:
        """Render one frame."""
        return self.render_batch([request])[0]

    def render_batch(self, requests: Sequence[RenderRequest]) -> list[Frame]:
        """Render the pinholes of all requests, and join those of each lens."""
        parts = [self._cover.requests(request) for request in requests]
        frames = iter(self._inner.render_batch([part for pinholes in parts for part in pinholes]))
        return [
            self._cover.frame(request.camera.name, [next(frames) for _ in pinholes])
            for request, pinholes in zip(requests, parts, strict=True)
        ]

    def recorded(self) -> Sequence[RecordedFrame]:
        """Return the recorded frames of the inner renderer, by its pinholes."""
        return self._inner.recorded()

    def facts(self) -> Mapping[str, Any]:
        """Return the facts of the inner renderer."""
        return self._inner.facts()
