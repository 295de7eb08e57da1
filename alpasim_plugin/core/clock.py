"""The integer-microsecond clock of a rollout."""

from collections.abc import Iterator
from dataclasses import dataclass

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import Rates


@dataclass(frozen=True)
class Tick:
    """One control instant and what is due at it."""

    step: int
    t_us: int
    policy_due: bool
    is_last: bool  # the world is observed once more but not advanced


@dataclass(frozen=True)
class Clock:
    """Ticks from ``start_us`` in whole control periods up to the last one that fits before
    ``end_us``.

    Raises:
        InputError: A period is not positive, does not divide as required, or not a single step
            fits.

    Example:
        >>> [t.t_us for t in Clock(0, 250_000, Rates()).ticks()]
        [0, 100000, 200000]
    """

    start_us: int
    end_us: int
    rates: Rates

    def __post_init__(self) -> None:
        for name in ("control_us", "camera_us", "policy_us"):
            period = getattr(self.rates, name)
            if period <= 0 or period % self.rates.control_us:
                raise InputError(
                    f"rates.{name} = {period} us: not a positive multiple of rates.control_us = {self.rates.control_us} us",
                    "choose periods that are whole multiples of the control period",
                )
        if self.n_steps < 1:
            raise InputError(
                f"{self.end_us - self.start_us} microseconds to drive, and a control step takes {self.rates.control_us}: not a single control step fits",
                "give timing.duration_us in microseconds, from one control step up, or use a longer log",
            )

    @property
    def n_steps(self) -> int:
        """Number of control steps; there is one more tick than steps."""
        return (self.end_us - self.start_us) // self.rates.control_us

    def ticks(self) -> Iterator[Tick]:
        """Yield every control instant in order."""
        for step in range(self.n_steps + 1):
            elapsed = step * self.rates.control_us
            yield Tick(
                step=step,
                t_us=self.start_us + elapsed,
                policy_due=elapsed % self.rates.policy_us == 0,
                is_last=step == self.n_steps,
            )
