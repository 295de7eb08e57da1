"""Say what a frame of a size costs on this machine before the first of its size is made.

A frame's time is nearly a constant plus a part that grows with its pixels. Both are measured on two smaller frames of the same view, which
together take a tenth of the time of the frame itself; what they show is thrown away.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import replace

from alpasim_plugin.alpasim.server.views import View

SHARES = (8, 4)  # of the sides: the first is so small that its time is the constant
SLOW_S = 0.5  # longer than this per frame is a warning: five times as long as the loop's time between frames
log = logging.getLogger("simrun.serve")


def cost_s(make: Callable[[View], object], view: View, clock: Callable[[], float] = time.perf_counter) -> float:
    """Return the expected seconds of one frame.

    Args:
        make: Makes a frame of a view's size and throws it away.
        view: The frame.
        clock: Seconds.
    """
    pixels, seconds = [], []
    for share in SHARES:
        small = scaled(view, max(view.width // share, 1))
        make(small)  # loads what the first frame alone waits for: kernels, recorded frames
        began = clock()
        make(small)
        pixels.append(small.width * small.height)
        seconds.append(clock() - began)
    per_pixel = max(seconds[1] - seconds[0], 0.0) / max(pixels[1] - pixels[0], 1)
    return seconds[1] + per_pixel * max(view.width * view.height - pixels[1], 0)


def scaled(view: View, width: int) -> View:
    """Return a view at another width, its height in proportion."""
    return replace(view, width=width, height=max(round(view.height * width / view.width), 1))


class Announced:
    """Measures every size once and logs what it costs."""

    def __init__(self, may_shrink: bool) -> None:
        self._said: set[bytes] = set()
        self._may_shrink = may_shrink

    def before(self, view: View, make: Callable[[View], object]) -> None:
        """Measure and log a view's size, unless that was done."""
        if view.lens in self._said:
            return
        self._said.add(view.lens)
        expected = cost_s(make, view)
        text = f"camera {view.camera!r} at {view.width} x {view.height}: about {expected:.2g} s a frame on this machine"
        half = scaled(view, view.width // 2)
        if expected > SLOW_S and self._may_shrink:
            text += (
                f"; --render-width {half.width} makes frames of {half.width} x {half.height} and enlarges them, in about a quarter of that"
            )
        log.log(logging.WARNING if expected > SLOW_S else logging.INFO, text)
