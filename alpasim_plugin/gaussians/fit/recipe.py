"""Say how a reconstruction is fitted: amounts, rates and schedule."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SplatRecipe:
    """How Gaussians are fitted to posed views.

    What is done is 3D Gaussian Splatting (Kerbl et al. 2023, Sec. 5 and its published code) with
    its schedule as shares of the steps. A CPU takes hundreds of steps where they take 30,000, so
    Gaussians start more opaque and smaller, and rates are higher: centres and scales four times
    (theirs: 1.6e-4 to 1.6e-6 extents, 5e-3), rotations five times, colours twice.

    Attributes:
        steps: Updates; each sees one view.
        views: Views rendered from a scenario's log.
        width: Pixels across of rendered views of 16:9; others have as many pixels.
        points: Gaussians of the background at the start, drawn from the views' depth.
        actor_points: Most Gaussians of an actor at the start.
        start_size: Of the Gaussians at the start, in distances to their neighbours.
        cap: Where densification stops, the largest screen gradients first; a start with more is not
            cut.
        sh_degree: Highest degree of view-dependent colour, reached by one degree every ``sh_share``
            of the steps.
        sh_share: See ``sh_degree``.
        lr_means: Rate of the centres at the start, in scene extents; falls exponentially to
            ``lr_means_end``.
        lr_means_end: See ``lr_means``.
        lr_scales: Rate of the scales' logarithms.
        lr_quaternions: Rate of the rotations.
        lr_opacities: Rate of the opacities' logits.
        lr_colour: Rate of the constant colour; view-dependent coefficients get a twentieth.
        ssim_weight: Share of 1 - SSIM in the image loss, the rest is the mean absolute error.
        sky_weight: Weight of opacity where a view shows sky.
        coarse_share: Share of the steps, at their beginning, that see views of half the width: a
            quarter of the work.
        depth_weight: Weight of the difference between rendered depth and the views' depth, as a
            share of the latter; 0 does not look at it.
        needle_weight: Weight of how much longer than ``needle_ratio`` times its middle axis a
            Gaussian is, by logarithm.
        needle_ratio: See ``needle_weight``.
        lr_exposure: Rate of the gain by which each view's colours differ from the model's; 0 leaves
            all at 1.
        densify_from: Share of the steps after which Gaussians are cloned and split.
        densify_until: Share of the steps until which they are.
        densify_every: Steps in between; 0 never densifies or prunes.
        densify_gradient: Mean norm of the loss's gradient by a Gaussian's place on the screen, in
            half image widths, above which it is densified.
        dense_share: Gaussians larger than this share of the extent are split, others cloned.
        prune_opacity: Gaussians fainter than this are removed whenever Gaussians are densified.
        prune_share: Gaussians larger than this share of the extent are removed as well.
        save_every: Steps between checkpoints.
        seed: Of the start, the order of views and the splits.
    """

    steps: int = 500
    views: int = 100
    width: int = 256
    points: int = 20_000
    actor_points: int = 400
    start_size: float = 0.6
    cap: int = 30_000
    sh_degree: int = 2
    sh_share: float = 0.25
    lr_means: float = 6e-4
    lr_means_end: float = 2e-5
    lr_scales: float = 0.02
    lr_quaternions: float = 5e-3
    lr_opacities: float = 0.05
    lr_colour: float = 5e-3
    ssim_weight: float = 0.2
    sky_weight: float = 0.05
    coarse_share: float = 0.0
    depth_weight: float = 0.0
    needle_weight: float = 0.0
    needle_ratio: float = 6.0
    lr_exposure: float = 0.0
    densify_from: float = 0.1
    densify_until: float = 0.6
    densify_every: int = 25
    densify_gradient: float = 2e-4
    dense_share: float = 0.01
    prune_opacity: float = 0.005
    prune_share: float = 0.1
    save_every: int = 250
    seed: int = 0

    @classmethod
    def street(cls) -> SplatRecipe:
        """Return the recipe of a recorded street: what three minutes of two cores allow
        (docs/experiments/references.md).
        """
        return cls(
            steps=1300,
            points=50_000,
            cap=80_000,
            start_size=0.8,
            coarse_share=0.5,
            depth_weight=0.05,
            needle_weight=0.02,
            lr_exposure=1e-3,
            sky_weight=0.2,
        )

    def lr_means_at(self, step: int) -> float:
        """Return the rate of the centres at a step, in scene extents."""
        t = min(step / self.steps, 1.0)
        return float(self.lr_means ** (1 - t) * self.lr_means_end**t)

    def sh_size_at(self, step: int) -> int:
        """Return how many colour coefficients are in use at a step."""
        steps_per_degree = self.sh_share * self.steps
        degree = (
            self.sh_degree
            if steps_per_degree <= 0
            else min(self.sh_degree, int(step / steps_per_degree))
        )
        return (degree + 1) ** 2

    def densifies_after(self, done: int) -> bool:
        """Return whether Gaussians are densified and pruned when ``done`` updates are made."""
        inside = self.densify_from * self.steps < done <= self.densify_until * self.steps
        return inside and self.densify_every > 0 and done % self.densify_every == 0
