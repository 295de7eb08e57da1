"""How long a fit takes on this machine, found by a few of its own updates."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from alpasim_plugin.gaussians.fit.loop import SplatFit
from alpasim_plugin.gaussians.fit.recipe import SplatRecipe
from alpasim_plugin.gaussians.fit.start import Start
from alpasim_plugin.gaussians.fit.views import PosedView

UPDATES = 3  # that are timed of each size, after one that may compile kernels


@dataclass(frozen=True)
class Trial:
    """What updates of a fit take, as a few of them did.

    Attributes:
        recipe: Of the fit.
        coarse_s: Of an update of views of half the width; 0 where there are none.
        whole_s: Of an update of whole views; 0 where there are none.
    """

    recipe: SplatRecipe
    coarse_s: float
    whole_s: float

    def seconds_until(self, step: int) -> float:
        """Return what the first ``step`` updates take. Gaussians that are added on the way are not known
        yet, and take more.
        """
        coarse_steps = self.recipe.coarse_share * self.recipe.steps
        return min(step, coarse_steps) * self.coarse_s + max(step - coarse_steps, 0) * self.whole_s

    def share_of(self, step: int) -> float:
        """Return the share of the time of all updates that the first ``step`` take."""
        return self.seconds_until(step) / self.seconds_until(self.recipe.steps)


def trial_of(
    views: Sequence[PosedView],
    start: Start,
    recipe: SplatRecipe,
    *,
    threads: int | None = None,
    device: str = "cpu",
    clock: Callable[[], float] = time.perf_counter,
) -> Trial:
    """Time some updates of a fit of each size, and drop what they learned.

    Args:
        views, start, recipe, threads, device: As `alpasim_plugin.gaussians.fit.loop.fit` takes them.
        clock: Gives seconds.

    Raises:
        InfrastructureError: There is no such device.
    """
    few = list(views[:: max(1, len(views) // (UPDATES + 1))])[: UPDATES + 1]

    def timed(coarse_share: float) -> float:
        run = SplatFit(
            few, start, replace(recipe, coarse_share=coarse_share), "trial", threads, None, device
        )
        run.update()
        began_s = clock()
        for _ in range(UPDATES):
            run.update()
        return (clock() - began_s) / UPDATES

    return Trial(
        recipe,
        timed(1.0) if recipe.coarse_share > 0 else 0.0,
        timed(0.0) if recipe.coarse_share < 1 else 0.0,
    )
