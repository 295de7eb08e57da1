"""The noise schedule: time steps of a sampler and their noise levels.

With shift 5, ``sigma(u) = 5 u / (1 + 4 u)`` for ``u`` in (0, 1], tabulated at 1000 points; the
network takes ``1000 sigma``. A *named* step, as in "1000, 750, 500, 250", is ``1000 u``, before the
shift. The cache write at 128 is after the shift: it is the network's time input, and its noise
level is that of the nearest entry in the table (0.12993).

Source: OmniDreams' flow-matching scheduler and self-forcing sampler.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

from alpasim_plugin.core.errors import InputError

if TYPE_CHECKING:
    from torch import Tensor

SHIFT = 5.0
TABLE = 1000


@dataclass(frozen=True)
class NoiseLevel:
    """One point of the schedule."""

    t: float  # time input of the network, 0 to 1000
    sigma: float  # noise weight of the interpolant, 0 to 1


def shifted(u: float) -> float:
    """Return ``sigma`` for a uniform time.

    Example:
        >>> round(shifted(0.45), 4)
        0.8036
    """
    return SHIFT * u / (1 + (SHIFT - 1) * u)


def named(step: float) -> NoiseLevel:
    """Return the noise level of a named step, 0 < step <= 1000.

    Raises:
        InputError: A step outside that range.
    """
    if not 0 < step <= TABLE:
        raise InputError(
            f"named step: {step:g}",
            f"use steps above 0 and up to {TABLE}",
        )
    sigma = shifted(step / TABLE)
    return NoiseLevel(TABLE * sigma, sigma)


def names(count: int) -> tuple[float, ...]:
    """Return the named steps of ``NAME@count``, evenly spaced from 1000 down.

    Example:
        >>> names(1), names(2), names(4)
        ((1000.0,), (1000.0, 500.0), (1000.0, 750.0, 500.0, 250.0))
    """
    if count < 1:
        raise InputError(f"step count: {count}", "take at least one step")
    return tuple(TABLE * (count - i) / count for i in range(count))


def steps(count: int) -> tuple[NoiseLevel, ...]:
    """Return the schedule of ``NAME@count``; one, two and four steps are the released lists."""
    return from_names(names(count))


def from_names(names: Sequence[float]) -> tuple[NoiseLevel, ...]:
    """Return the schedule of a list of named steps, strictly falling, such as [1000, 450].

    Raises:
        InputError: An empty or not strictly falling list, or a step out of range.
    """
    if not names or any(later >= earlier for earlier, later in pairwise(names)):
        raise InputError(
            f"named steps: {list(names)}",
            "give at least one step, strictly falling from 1000",
        )
    return tuple(named(step) for step in names)


def interpolant(z_0: Tensor, z_1: Tensor, t: Tensor | float) -> Tensor:
    """Return ``z_t = (1 - t) z_0 + t z_1``, the straight path from the clean latents to the
    source.
    """
    return (1 - t) * z_0 + t * z_1
