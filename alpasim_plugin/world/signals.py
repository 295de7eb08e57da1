"""Where a line passes traffic lights, and how far a driver may go before one that is red."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.types import Signal
from alpasim_plugin.world.path import Path

STOP_BRAKE_MPS2 = 3.0  # who would have to brake harder for a yellow light drives on


@dataclass(frozen=True)
class LightAhead:
    """A traffic light and the arc length at which a path passes its line."""

    s_m: float
    signal: Signal


def lights_on(path: Path, signals: Sequence[Signal] | None) -> tuple[LightAhead, ...]:
    """Return the lights for vehicles whose lines a path passes in their direction, in its order."""
    found = []
    for signal in signals or ():
        if signal.pedestrians:
            continue
        for k, share in signal.crossings(path.xyz, np.zeros(3)):
            s_m = path.s[k] + share * (path.s[k + 1] - path.s[k])
            found.append(LightAhead(float(s_m), signal))
    return tuple(sorted(found, key=lambda light: light.s_m))


def red_gap_m(lights: Sequence[LightAhead], front_s_m: float, speed_mps: float, t_us: int) -> float:
    """Return the distance from the front bumper to the nearest line at which a driver has to stop;
    infinite without one.

    A yellow light is one to stop at where `STOP_BRAKE_MPS2` is enough for it.
    """
    for light in lights:
        gap_m = light.s_m - front_s_m
        if gap_m < 0.0:
            continue
        colour = light.signal.colour_at(t_us)
        stoppable = speed_mps**2 <= 2.0 * STOP_BRAKE_MPS2 * gap_m
        if colour in ("red", "red_yellow") or (colour == "yellow" and stoppable):
            return gap_m
    return float("inf")
