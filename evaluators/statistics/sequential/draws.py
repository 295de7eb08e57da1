"""Scene differences in the order in which they were drawn, what their conditional mean is under a
hypothesis, and drawing by family.

**Batches.** A finite suite is drawn in batches that hold every family of scenes in proportion. A
batch of B scenes is drawn from the L that are left by ordered pivotal sampling along the list of
families (Deville and Tille, Unequal probability sampling without replacement through a splitting
method, Biometrika 85, 1998): each scene left has the chance B / L, and of every stretch of the
list, so of every family, its share of the batch is drawn, rounded up or down. With families of
equal size and a batch of one scene each, this is stratified sampling.

**Sums.** The chances are equal, so given the batches before, the mean of a batch is expected to be
that of the scenes left. Deviations of batches from it are martingale differences, whose variance
has no part between families but where a stretch of L / B scenes has several.

**Bets.** The scenes of a batch are drawn together, so they cannot be bet on one after another. They
are bet on with one stake: the capital is multiplied by the product over the batch of a_i = 1 +
stake (x_i - c_i), where the c_i are known before the batch and their mean over the scenes left is
what the hypothesis gives them. Every scene has its own bounds, so the stake is that of single
scenes. The product is expected to be at most 1 if the hypothesis holds:

1. Pivotal sampling exchanges two scenes, or not, again and again, by coins that do not depend on
   each other. The polynomial g(a) = E prod a_i over the batch is therefore stable (partial
   symmetrisation keeps stability: Borcea, Branden and Liggett, Negative dependence and the geometry
   of polynomials, J. AMS 22, 2009), and homogeneous of degree B.
2. So g^(1/B) is concave where all a_i are above 0 (Garding, An inequality for hyperbolic
   polynomials, J. Math. Mech. 8, 1959). Its tangent at (1, ..., 1), where g is 1 and the
   derivatives are the chances B / L, lies above it: g(a) <= (mean of a over scenes left)^B.
3. Under the hypothesis that mean is at most 1.

For one scene of every family this is the inequality of the arithmetic and geometric means. The
capital at the ends of batches is thus a supermartingale for every suite (tested by enumeration). It
grows as fast as in random order, not faster: what families have in common shows in the product as a
loss below 1 that no bet can count on. Sums gain what stratified sampling gains.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F64, I64, Bool
from evaluators.statistics.families import grouped


@dataclass(frozen=True)
class Draws:
    """Values of scenes in the order drawn, with the line on which their conditional mean lies.

    If the mean that is asked for is m, the expected value of scene i given all scenes before it is
    ``offset[i] + slope[i] * m``. For scenes that are independent draws from a population this is m;
    `without_replacement` gives it for a finite suite.

    Scenes are drawn in batches: what is known before a scene is drawn is known before its batch. A
    batch is one scene, but where its scenes depend on each other (`stratified`); then something can
    be said at the ends of batches only, and n is one.

    Attributes:
        x: ``(..., n)`` differences, positive is worse.
        low: ``(..., n)`` least possible value of each, known before it is drawn; -inf where there
            is no bound.
        high: ``(..., n)`` greatest possible value.
        offset: ``(..., n)`` known before the scene is drawn.
        slope: ``(..., n)`` above 0, known before the scene is drawn.
        begin: ``(n,)`` index of the first scene of each scene's batch.
        spread: ``(..., n)`` standard deviation of a scene, such that its square times n is the
            variance of the sum of the first n, as estimated from them.
        freedom: ``(n,)`` degrees of freedom of ``spread``.
    """

    x: F64
    low: F64
    high: F64
    offset: F64
    slope: F64
    begin: I64
    spread: F64
    freedom: F64

    @property
    def n(self) -> int:
        """Give the number of scenes."""
        return int(self.x.shape[-1])

    @property
    def is_end(self) -> Bool:
        """Tell which scenes are the last of their batch ``(n,)``."""
        return np.append(self.begin[1:], self.n) > np.arange(self.n)

    def mirrored(self) -> Draws:
        """Return the draws of the negated difference."""
        return replace(self, x=-self.x, low=-self.high, high=-self.low, offset=-self.offset)

    def first(self, n: int) -> Draws:
        """Return the first n scenes, which end with a batch."""
        return Draws(**{field.name: getattr(self, field.name)[..., :n] for field in fields(self)})


def independent(x: F64, low: float, high: float) -> Draws:
    """Return draws from a population of scenes: each has the mean that is asked for, whatever came
    before.

    Args:
        x: ``(..., n)`` differences.
        low: Least possible difference.
        high: Greatest possible difference.
    """
    x = np.asarray(x, dtype=np.float64)
    n = np.arange(x.shape[-1])
    return Draws(
        x,
        np.full_like(x, low),
        np.full_like(x, high),
        np.zeros_like(x),
        np.ones_like(x),
        n,
        sample_spread(x),
        n.astype(np.float64),
    )


def without_replacement(
    x: F64,
    low: float,
    high: float,
    size: int,
    removed: F64 | None = None,
    reach: F64 | None = None,
    begin: I64 | None = None,
) -> Draws:
    """Return draws without replacement from a suite, whose own mean is asked for.

    If that mean is m, the scenes that are left before draw i (from 0) have the mean (size m - sum
    of the drawn) / (size - i) (Waudby-Smith and Ramdas, Estimating means of bounded random
    variables by betting, JRSS B 86, 2024, section 5).

    Args:
        x: ``(..., n)`` differences as driven.
        low: Least possible difference.
        high: Greatest possible difference.
        size: Scenes of the suite.
        removed: ``(..., n)`` what a control predicts of each difference, less its mean over the
            scenes left; taken off the difference.
        reach: ``(..., n)`` greatest size that ``removed`` could have had for any scene left.
        begin: ``(n,)`` as in `Draws`; None: every scene is a batch.
    """
    x = np.asarray(x, dtype=np.float64)
    off = np.zeros_like(x) if removed is None else removed
    wide = np.zeros_like(x) if reach is None else reach
    n = np.arange(x.shape[-1])
    batch = n if begin is None else begin
    left = (size - batch).astype(np.float64)
    before = (np.cumsum(x, axis=-1) - x)[..., batch]
    slope = np.broadcast_to(size / left, x.shape)
    rest = x - off
    return Draws(
        rest,
        low - wide,
        high + wide,
        -before / left,
        np.asarray(slope),
        batch,
        sample_spread(rest),
        n.astype(np.float64),
    )


def sample_spread(x: F64) -> F64:
    """Return the sample standard deviation ``(..., n)`` of the first 1, 2, ... n values."""
    n = np.arange(1, x.shape[-1] + 1)
    # About the first value: sums of squares of large values that hardly differ would lose all
    # digits.
    x = x - x[..., :1]
    square = np.cumsum(x * x, axis=-1) - np.cumsum(x, axis=-1) ** 2 / n
    return np.asarray(np.sqrt(np.maximum(square, 0.0) / np.maximum(n - 1, 1)))


SHRINKAGE = 1.0  # scenes' worth
DOING = "drawing scenes by family"


@dataclass(frozen=True)
class Strata:
    """Families of a suite, and batches.

    Attributes:
        family_of: SCENE -> its family.
        sizes: Scenes of each batch; what they leave is the last.
    """

    family_of: Mapping[str, str]
    sizes: tuple[int, ...]

    def order(self, generator: np.random.Generator) -> list[str]:
        """Return the scenes in stratified random order."""
        names = sorted(self.family_of)
        mixed = [names[i] for i in generator.permutation(len(names))]
        left, order = (
            sorted(mixed, key=self.family_of.__getitem__),
            list[str](),
        )  # stable: at random within families
        for size in self.sizes:
            places = set(pivotal_sample(len(left), size, generator))
            order += [scene for i, scene in enumerate(left) if i in places]
            left = [scene for i, scene in enumerate(left) if i not in places]
        return order + left

    def begins(self, n: int) -> I64:
        """Return the index of the first scene of the batch of each of the first n scenes
        ``(n,)``.
        """
        starts = np.cumsum([0, *self.sizes])
        return np.asarray(starts[np.searchsorted(starts, np.arange(n), side="right") - 1])

    def numbers(self, scenes: Sequence[str]) -> I64:
        """Return the numbers of scenes' families ``(n,)``, from 0 in the order of their names."""
        place = {name: i for i, name in enumerate(sorted(set(self.family_of.values())))}
        return np.array([place[self.family_of[scene]] for scene in scenes], dtype=np.int64)


def families_of(paths: Mapping[str, str], with_what: str) -> dict[str, str]:
    """Return SCENE -> its family: scenes made from one file by seeds, else scenes of one folder.

    Args:
        paths: SCENE -> path of its scenario.
        with_what: The option that asks for families, for errors.

    Raises:
        InputError: There is only one family.
    """
    family = grouped(paths)
    names = sorted(set(family.values()))
    if len(names) < 2:
        raise InputError(
            f"{with_what}: all {len(paths)} scenes are of one family, {names[0]}",
            "leave it out, or give a suite with scenes of several files or folders",
        )
    return family


def pivotal_sample(left: int, wanted: int, generator: np.random.Generator) -> list[int]:
    """Return the places of ``wanted`` of ``left`` scenes, evenly spread over their list, each with
    the same chance.

    Example:
        >>> pivotal_sample(3, 3, np.random.default_rng(0))
        [0, 1, 2]
    """
    if wanted >= left:
        return list(range(left))
    chosen, carried, chance = [], 0, wanted  # chances in units of 1 / left, exactly
    for rival in range(1, left):
        total = chance + wanted
        if total <= left:  # one of the two is out, and the other has the chance of both
            carried = carried if generator.integers(total) < chance else rival
            chance = total
        else:  # one is chosen, and the other has what is left over
            winner, loser = (
                (carried, rival)
                if generator.integers(2 * left - total) < left - wanted
                else (rival, carried)
            )
            chosen.append(winner)
            carried, chance = loser, total - left
    return sorted([*chosen, carried] if chance == left else chosen)


def stratified(
    x: F64,
    low: float,
    high: float,
    family: I64,
    begin: I64,
    removed: F64 | None = None,
    reach: F64 | None = None,
    less_means: bool = False,
) -> Draws:
    """Return draws of a finite suite in stratified random order; their spread is that within
    families.

    Args:
        x: ``(n,)`` differences as driven.
        low: Least possible difference.
        high: Greatest possible difference.
        family: ``(size,)`` numbers of the families of all scenes, those drawn first.
        begin: ``(n,)`` as in `Draws`.
        removed, reach: ``(n,)`` as for `without_replacement`.
        less_means: Take off the families' means in earlier batches too. Sums gain where a stretch
            has several families; bets do not.
    """
    n, size = len(x), len(family)
    off, wide = (np.zeros(n), np.zeros(n)) if removed is None or reach is None else (removed, reach)
    rest, members = x - off, np.eye(int(family.max()) + 1)[family]  # (n,), (size, F)
    drawn, sums = np.cumsum(members[:n], axis=0), np.cumsum(members[:n] * rest[:, None], axis=0)
    before, sums_before = (drawn - members[:n])[begin], (sums - members[:n] * rest[:, None])[begin]
    share = (members.sum(axis=0) - before) / (size - begin)[
        :, None
    ]  # of the scenes left, by family
    known = _shrunken(before, sums_before) * float(less_means)
    known = np.where(share > 0.0, known - np.sum(share * known, axis=1)[:, None], 0.0)
    off, wide = off + known[np.arange(n), family[:n]], wide + np.abs(known).max(axis=1)
    freedom = np.sum(np.maximum(drawn - 1.0, 0.0), axis=1)
    means = sums / np.maximum(drawn, 1.0)
    within = np.maximum(np.cumsum(rest**2) - np.sum(sums * means, axis=1), 0.0) / np.maximum(
        freedom, 1.0
    )
    between = _between(share, begin, means, known)
    draws = without_replacement(x, low, high, size, off, wide, begin)
    return replace(draws, spread=np.sqrt(within + between / np.arange(1, n + 1)), freedom=freedom)


def _shrunken(count: F64, sums: F64) -> F64:
    """Return the families' means ``(n, F)``, drawn to the mean of all scenes by `SHRINKAGE`."""
    overall = sums.sum(axis=1, keepdims=True) / np.maximum(count.sum(axis=1, keepdims=True), 1.0)
    return np.asarray((sums + SHRINKAGE * overall) / (count + SHRINKAGE))


def _between(share: F64, begin: I64, means: F64, known: F64) -> F64:
    """Return the variance between families that is left in the sum of the first scenes ``(n,)``: of
    stretches that have several.

    Args:
        share: ``(n, F)`` of the scenes left before each scene's batch.
        begin: ``(n,)`` first scenes of batches.
        means: ``(n, F)`` of the families, after each scene.
        known: ``(n, F)`` what is taken off of each family's scenes.
    """
    found = np.zeros(len(begin))
    for start, size in zip(*np.unique(begin, return_counts=True), strict=True):
        ends = (
            np.concatenate([[0.0], np.cumsum(share[start])]) * size
        )  # of the families, along stretches of length 1
        stretch = np.arange(size)[:, None]
        mix = np.maximum(
            np.minimum(ends[1:], stretch + 1.0) - np.maximum(ends[:-1], stretch), 0.0
        )  # (B, F), rows sum to 1
        off = means[start:] - known[start]
        found[start:] += off**2 @ mix.sum(axis=0) - np.sum((off @ mix.T) ** 2, axis=1)
    return np.maximum(found, 0.0)
