"""Renderers with one deliberate fault each: known-bad input that metrics, guards and gates must
detect.

Each renders the clean scene and corrupts the frame, or renders it from a wrong place; what else a
frame carries (time, alpha, depth) stays as a fault in a real pipeline would leave it.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import cv2
import numpy as np

from alpasim_plugin.core.interfaces import Renderer
from alpasim_plugin.core.types import U8, Frame, RenderRequest, Scenario
from alpasim_plugin.renderers.gaussian import CleanRenderer

SHIFT_M = 0.5
BLUR_SHARE = 0.02  # of the image's width
LATE_US = 1_000_000

Corruption = Callable[[U8], U8]


class BrokenRenderer(Renderer):
    """Render the clean scene and corrupt every frame on its own."""

    def __init__(self, clean: CleanRenderer, corrupt: Corruption) -> None:
        self.clean = clean
        self.draws_lenses = clean.draws_lenses
        self.corrupt = corrupt

    def render(self, request: RenderRequest) -> Frame:
        """Render one frame and corrupt it."""
        frame = self.clean.render(request)
        return replace(frame, rgb=self.corrupt(frame.rgb))


class ShiftedRenderer(Renderer):
    """Render the clean scene from a camera that stands beside its place, as a wrong extrinsic
    calibration or map offset would.
    """

    def __init__(self, clean: CleanRenderer, right_m: float) -> None:
        self.clean = clean
        self.draws_lenses = clean.draws_lenses
        self.right_m = right_m

    def render(self, request: RenderRequest) -> Frame:
        """Render one frame with the camera moved along its x axis."""
        moved = request.T_world_camera.copy()
        moved[..., :3, 3] += self.right_m * moved[..., :3, 0]
        return self.clean.render(replace(request, T_world_camera=moved))


class StaleRenderer(Renderer):
    """Show an earlier image of the same camera under the new time: the newest one that is
    ``age_us`` old, or always the first one.
    """

    def __init__(self, clean: CleanRenderer, age_us: int | None) -> None:
        self.clean = clean
        self.draws_lenses = clean.draws_lenses
        self.age_us = age_us
        self._past: dict[str, deque[tuple[int, U8]]] = {}

    def render(self, request: RenderRequest) -> Frame:
        """Render one frame and swap its image for an older one; before there is one that old, for
        the first.
        """
        frame = self.clean.render(request)
        past = self._past.setdefault(request.camera.name, deque())
        if self.age_us is not None or not past:
            past.append((frame.t_us, frame.rgb))
        while self.age_us is not None and len(past) > 1 and past[1][0] <= frame.t_us - self.age_us:
            past.popleft()
        return replace(frame, rgb=past[0][1])


def black(rgb: U8) -> U8:
    """Return a black image."""
    return np.zeros_like(rgb)


def mirrored(rgb: U8) -> U8:
    """Swap left and right."""
    return np.ascontiguousarray(rgb[:, ::-1])


def blurred(rgb: U8) -> U8:
    """Blur the image with a standard deviation of `BLUR_SHARE` of its width."""
    return cv2.GaussianBlur(rgb, (0, 0), BLUR_SHARE * rgb.shape[1])


def _made(
    scenario: Scenario,
    seed: int,
    device: str,
    threads: int | None,
    *,
    fault: Callable[[CleanRenderer], Renderer],
) -> Renderer:
    return fault(CleanRenderer(scenario, seed, device, threads))


black_renderer = partial(_made, fault=partial(BrokenRenderer, corrupt=black))
mirrored_renderer = partial(_made, fault=partial(BrokenRenderer, corrupt=mirrored))
blurred_renderer = partial(_made, fault=partial(BrokenRenderer, corrupt=blurred))
shifted_renderer = partial(_made, fault=partial(ShiftedRenderer, right_m=SHIFT_M))
frozen_renderer = partial(_made, fault=partial(StaleRenderer, age_us=None))
late_renderer = partial(_made, fault=partial(StaleRenderer, age_us=LATE_US))
