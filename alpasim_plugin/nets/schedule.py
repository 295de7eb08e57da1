"""The noise schedule: time steps of a sampler and their noise levels.

With shift 5, ``sigma(u) = 5 u / (1 + 4 u)`` for ``u`` in (0, 1], tabulated at 1000 points; the network takes ``1000 sigma``. A *named*
step, as in "1000, 750, 500, 250", is ``1000 u``, before the shift. The cache write at 128 is after the shift: it is the network's time
input, and its noise level is that of the nearest entry in the table (0.12993).

Source: OmniDreams' flow-matching scheduler and self-forcing sampler.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from alpasim_plugin.core.errors import InputError

SHIFT = 5.0
TABLE = 1000
CONTEXT_STEP = 128.0


@dataclass(frozen=True)
class NoiseLevel:
    """One point of the schedule."""

    t: float  # time input of the network, 0 to 1000
    sigma: float  # noise weight of the interpolant, 0 to 1


@dataclass(frozen=True)
class RenderLevel:
    """The noise level that a render is taken to have: ``z_r = alpha z_0 + sigma eps``.

    Example:
        >>> harmonizer = RenderLevel(1.0, 0.25)
        >>> harmonizer.t, harmonizer.scale, harmonizer.network_t
        (0.2, 0.8, 200.0)

    Raises:
        InputError: Values that are not positive.
    """

    alpha: float
    sigma: float

    def __post_init__(self) -> None:
        if not (self.alpha > 0 and self.sigma > 0):
            found = f"alpha {self.alpha:g}, sigma {self.sigma:g}"
            raise InputError("choosing the noise level of a render", "alpha and sigma", found, "give values above 0")

    @property
    def t(self) -> float:
        """Time on the straight path, 0 to 1."""
        return self.sigma / (self.alpha + self.sigma)

    @property
    def scale(self) -> float:
        """Factor from the render's latents to the point on the path."""
        return 1 / (self.alpha + self.sigma)

    @property
    def network_t(self) -> float:
        """Time input of the network, a whole number of 0 to 1000."""
        return float(round(TABLE * self.t))


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
        raise InputError("choosing denoising steps", "named step", f"{step:g}", f"use steps above 0 and up to {TABLE}")
    sigma = shifted(step / TABLE)
    return NoiseLevel(TABLE * sigma, sigma)


def context_level(t: float = CONTEXT_STEP) -> NoiseLevel:
    """Return the noise level of the cache write: time input ``t``, sigma of the table's nearest entry.

    Example:
        >>> round(context_level().sigma, 5)
        0.12993
    """
    table = (shifted(1 - i / TABLE) for i in range(TABLE))
    return NoiseLevel(t, min(table, key=lambda sigma: abs(TABLE * sigma - t)))


def names(count: int) -> tuple[float, ...]:
    """Return the named steps of ``NAME@count``, evenly spaced from 1000 down.

    Example:
        >>> names(1), names(2), names(4)
        ((1000.0,), (1000.0, 500.0), (1000.0, 750.0, 500.0, 250.0))
    """
    if count < 1:
        raise InputError("choosing denoising steps", "step count", str(count), "take at least one step")
    return tuple(TABLE * (count - i) / count for i in range(count))


def steps(count: int) -> tuple[NoiseLevel, ...]:
    """Return the schedule of ``NAME@count``; one, two and four steps are the released lists."""
    return from_names(names(count))


def from_names(names: Sequence[float]) -> tuple[NoiseLevel, ...]:
    """Return the schedule of a list of named steps, strictly falling, such as [1000, 450].

    Raises:
        InputError: An empty or not strictly falling list, or a step out of range.
    """
    if not names or any(b >= a for a, b in pairwise(names)):
        raise InputError("choosing denoising steps", "named steps", str(list(names)), "give at least one step, strictly falling from 1000")
    return tuple(named(step) for step in names)
