"""Cameras with lenses in a run: the renderer and its fixer see the pinholes that cover each lens,
the loop sees the lens.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from alpasim_plugin.core.interfaces import Renderer, complete
from alpasim_plugin.core.lens import Lens, joined, lens_shares, resized, sides_of
from alpasim_plugin.core.types import (
    CameraSpec,
    Frame,
    RecordedFrame,
    RenderRequest,
    Scenario,
)

SMALLER = 4  # by side, of the cameras whose pinholes are counted


def through_lenses(scenario: Scenario, make: Callable[[Scenario], Renderer]) -> Renderer:
    """Return a renderer of a scenario's cameras from one that draws pinholes.

    Args:
        scenario: Its cameras may have lenses.
        make: Makes a renderer of a scenario whose cameras are pinholes.

    Raises:
        InputError: Values that make no lens, or a lens that sees too far from its axis.
    """
    if all(camera.lens is None for camera in scenario.cameras):
        return make(scenario)
    sides = {camera.name: sides_of(camera) for camera in scenario.cameras}
    pinholes = [
        side.spec(camera.name, camera.T_rig_camera, camera.shutter_us)
        for camera in scenario.cameras
        for side in sides[camera.name]
    ]
    return LensRenderer(make(replace(scenario, cameras=tuple(pinholes))), sides)


def drawn_pixels(cameras: Sequence[CameraSpec]) -> tuple[int, float]:
    """Return how many pinholes cover cameras, and their pixels together, within one in a hundred."""
    count, pixels = 0, 0.0
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
        sides: Of each camera of the scenario.
    """

    def __init__(self, inner: Renderer, sides: Mapping[str, Sequence[Lens]]) -> None:
        self._inner, self._sides = complete(inner, Renderer), sides
        self.lookahead, self.block = inner.lookahead, inner.block
        self.has_history = inner.has_history
        self._shares: dict[tuple[str, str], Any] = {}

    @property
    def stage_ms(self) -> Mapping[str, float]:  # type: ignore[override]  # computed when it is read
        """Times of the inner renderer's last call."""
        return self._inner.stage_ms

    def render(self, request: RenderRequest) -> Frame:
        """Render one frame."""
        return self.render_batch([request])[0]

    def render_batch(self, requests: Sequence[RenderRequest]) -> list[Frame]:
        """Render the pinholes of all requests, and join those of each lens."""
        drawn = [
            self._through(request, side)
            for request in requests
            for side in self._sides[request.camera.name]
        ]
        frames = iter(self._inner.render_batch(drawn))
        out = []
        for request in requests:
            sides = self._sides[request.camera.name]
            whole = joined(sides, [next(frames) for _ in sides])
            out.append(replace(whole, camera=request.camera.name))
        return out

    def recorded(self) -> Sequence[RecordedFrame]:
        """Return the recorded frames of the inner renderer, by its pinholes."""
        return self._inner.recorded()

    def facts(self) -> Mapping[str, Any]:
        """Return the facts of the inner renderer."""
        return self._inner.facts()

    def _through(self, request: RenderRequest, side: Lens) -> RenderRequest:
        """Return the request of one pinhole of a lens."""
        camera, exposure = request.camera, request.exposure
        if exposure is not None and camera.lens is not None:
            key = camera.name, side.side
            if key not in self._shares:
                self._shares[key] = lens_shares(camera, side, "rows", backwards=False)
            share = self._shares[key]
            exposure = replace(exposure, share=share)
        return replace(
            request,
            camera=side.spec(camera.name, camera.T_rig_camera, camera.shutter_us),
            T_world_camera=request.T_world_camera @ side.T_lens_pinhole,
            ahead=[self._through(later, side) for later in request.ahead],
            exposure=exposure,
        )
