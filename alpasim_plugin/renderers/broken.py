"""Renderers with one deliberate fault each: known-bad input with which metrics, guards and gates prove that they notice.

Each renders the clean scene and then spoils the frame; what else a frame carries (time, alpha, depth) stays as a fault in a real pipeline
would leave it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from alpasim_plugin.renderers.base import RENDERERS
from alpasim_plugin.renderers.gaussian import CleanRenderer
from alpasim_plugin.types import U8, Frame, Renderer, RenderRequest, Scenario

SHIFT_SHARE = 0.12  # of the image's width
BLUR_SHARE = 0.02
LATE_FRAMES = 5

Spoil = Callable[[U8], U8]


class BrokenRenderer:
    """Render the clean scene and spoil every frame on its own."""

    def __init__(self, clean: CleanRenderer, spoil: Spoil) -> None:
        self.clean, self.spoil = clean, spoil

    def render(self, request: RenderRequest) -> Frame:
        """Render one frame and spoil it."""
        frame = self.clean.render(request)
        return replace(frame, rgb=self.spoil(frame.rgb))


class StaleRenderer:
    """Show the picture of an earlier frame of the same camera under the new time: ``frames`` ago, or the first one for ever."""

    def __init__(self, clean: CleanRenderer, frames: int | None) -> None:
        self.clean, self.frames = clean, frames
        self._past: dict[str, deque[U8]] = {}

    def render(self, request: RenderRequest) -> Frame:
        """Render one frame and swap its picture for an older one."""
        frame = self.clean.render(request)
        past = self._past.setdefault(request.camera.name, deque(maxlen=None if self.frames is None else self.frames + 1))
        if self.frames is not None or not past:
            past.append(frame.rgb)
        return replace(frame, rgb=past[0])


def black(rgb: U8) -> U8:
    """Return a black picture."""
    return np.zeros_like(rgb)


def mirrored(rgb: U8) -> U8:
    """Swap left and right."""
    return np.ascontiguousarray(rgb[:, ::-1])


def shifted(rgb: U8) -> U8:
    """Move the picture to the right by `SHIFT_SHARE` of its width; the left border repeats its first column."""
    n = max(1, round(SHIFT_SHARE * rgb.shape[1]))
    return np.concatenate([np.repeat(rgb[:, :1], n, axis=1), rgb[:, :-n]], axis=1)


def blurred(rgb: U8) -> U8:
    """Blur the picture with a standard deviation of `BLUR_SHARE` of its width."""
    return np.asarray(cv2.GaussianBlur(rgb, (0, 0), BLUR_SHARE * rgb.shape[1]), dtype=np.uint8)


def _register_spoiled(name: str, spoil: Spoil, help_text: str) -> None:
    @RENDERERS.register(name, help_text)
    def _make(scenario: Scenario, seed: int, device: str, threads: int | None) -> Renderer:
        return BrokenRenderer(CleanRenderer(scenario, seed, device, threads), spoil)


def _register_stale(name: str, frames: int | None, help_text: str) -> None:
    @RENDERERS.register(name, help_text)
    def _make(scenario: Scenario, seed: int, device: str, threads: int | None) -> Renderer:
        return StaleRenderer(CleanRenderer(scenario, seed, device, threads), frames)


_register_spoiled("broken-black", black, "deliberate fault: black frames")
_register_spoiled("broken-mirrored", mirrored, "deliberate fault: left and right swapped")
_register_spoiled("broken-shifted", shifted, "deliberate fault: the picture moved sideways")
_register_spoiled("broken-blurred", blurred, "deliberate fault: strong blur")
_register_stale("broken-frozen", None, "deliberate fault: the first frame for ever")
_register_stale("broken-late", LATE_FRAMES, f"deliberate fault: pictures {LATE_FRAMES} frames old")
