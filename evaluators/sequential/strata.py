"""Draw a finite suite in batches that hold every family of scenes in proportion, and bet on them.

A batch of B scenes is drawn from the L that are left by ordered pivotal sampling along the list of families (Deville and Tille, Unequal
probability sampling without replacement through a splitting method, Biometrika 85, 1998): each scene left has the chance B / L, and of
every stretch of the list, so of every family, its share of the batch is drawn, rounded up or down. With families of equal size and a
batch of one scene each, this is stratified sampling.

**Sums.** The chances are equal, so given the batches before, the mean of a batch is expected to be that of the scenes left. Deviations of
batches from it are martingale differences, whose variance has no part between families but where a stretch of L / B scenes has several.

**Bets.** The scenes of a batch are drawn together, so they cannot be bet on one after another. They are bet on with one stake: the capital
is multiplied by the product over the batch of a_i = 1 + stake (x_i - c_i), where the c_i are known before the batch and their mean over
the scenes left is what the hypothesis gives them. Every scene has its own bounds, so the stake is that of single scenes. The product is
expected to be at most 1 if the hypothesis holds:

1. Pivotal sampling exchanges two scenes, or not, again and again, by coins that do not depend on each other. The polynomial
   g(a) = E prod a_i over the batch is therefore stable (partial symmetrisation keeps stability: Borcea, Branden and Liggett, Negative
   dependence and the geometry of polynomials, J. AMS 22, 2009), and homogeneous of degree B.
2. So g^(1/B) is concave where all a_i are above 0 (Garding, An inequality for hyperbolic polynomials, J. Math. Mech. 8, 1959). Its
   tangent at (1, ..., 1), where g is 1 and the derivatives are the chances B / L, lies above it: g(a) <= (mean of a over scenes left)^B.
3. Under the hypothesis that mean is at most 1.

For one scene of every family this is the inequality of the arithmetic and geometric means. The capital at the ends of batches is thus a
supermartingale for every suite (tested by enumeration). It grows as fast as in random order, not faster: what families have in common
shows in the product as a loss below 1 that no bet can count on. Sums gain what stratified sampling gains.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import PurePath

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F64, I64
from evaluators.sequential.draws import Draws, without_replacement

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
        left, order = sorted(mixed, key=self.family_of.__getitem__), list[str]()  # stable: at random within families
        for size in self.sizes:
            places = set(pivotal_sample(len(left), size, generator))
            order += [scene for i, scene in enumerate(left) if i in places]
            left = [scene for i, scene in enumerate(left) if i not in places]
        return order + left

    def begins(self, n: int) -> I64:
        """Return the index of the first scene of the batch of each of the first n scenes ``(n,)``."""
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
    by_file = len(set(paths.values())) <= len(paths) / 2
    family = {scene: path if by_file else PurePath(path).parent.name for scene, path in paths.items()}
    names = sorted(set(family.values()))
    if len(names) < 2:
        found = f"all {len(paths)} scenes are of one family, {names[0]}"
        raise InputError(DOING, with_what, found, "leave it out, or give a suite with scenes of several files or folders")
    return family


def pivotal_sample(left: int, wanted: int, generator: np.random.Generator) -> list[int]:
    """Return the places of ``wanted`` of ``left`` scenes, evenly spread over their list, each with the same chance.

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
            winner, loser = (carried, rival) if generator.integers(2 * left - total) < left - wanted else (rival, carried)
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
    """Return draws of a finite suite in stratified random order; their spread is that within families.

    Args:
        x: ``(n,)`` differences as driven.
        low: Least possible difference.
        high: Greatest possible difference.
        family: ``(size,)`` numbers of the families of all scenes, those drawn first.
        begin: ``(n,)`` as in `Draws`.
        removed, reach: ``(n,)`` as for `without_replacement`.
        less_means: Take off the families' means in earlier batches too. Sums gain where a stretch has several families; bets do not.
    """
    n, size = len(x), len(family)
    off, wide = (np.zeros(n), np.zeros(n)) if removed is None or reach is None else (removed, reach)
    rest, members = x - off, np.eye(int(family.max()) + 1)[family]  # (n,), (size, F)
    drawn, sums = np.cumsum(members[:n], axis=0), np.cumsum(members[:n] * rest[:, None], axis=0)
    before, sums_before = (drawn - members[:n])[begin], (sums - members[:n] * rest[:, None])[begin]
    share = (members.sum(axis=0) - before) / (size - begin)[:, None]  # of the scenes left, by family
    known = _shrunken(before, sums_before) * float(less_means)
    known = np.where(share > 0.0, known - np.sum(share * known, axis=1)[:, None], 0.0)
    off, wide = off + known[np.arange(n), family[:n]], wide + np.abs(known).max(axis=1)
    freedom = np.sum(np.maximum(drawn - 1.0, 0.0), axis=1)
    means = sums / np.maximum(drawn, 1.0)
    within = np.maximum(np.cumsum(rest**2) - np.sum(sums * means, axis=1), 0.0) / np.maximum(freedom, 1.0)
    between = _between(share, begin, means, known)
    draws = without_replacement(x, low, high, size, off, wide, begin)
    return replace(draws, spread=np.sqrt(within + between / np.arange(1, n + 1)), freedom=freedom)


def _shrunken(count: F64, sums: F64) -> F64:
    """Return the families' means ``(n, F)``, drawn to the mean of all scenes by `SHRINKAGE`."""
    overall = sums.sum(axis=1, keepdims=True) / np.maximum(count.sum(axis=1, keepdims=True), 1.0)
    return np.asarray((sums + SHRINKAGE * overall) / (count + SHRINKAGE))


def _between(share: F64, begin: I64, means: F64, known: F64) -> F64:
    """Return the variance between families that is left in the sum of the first scenes ``(n,)``: of stretches that have several.

    Args:
        share: ``(n, F)`` of the scenes left before each scene's batch.
        begin: ``(n,)`` first scenes of batches.
        means: ``(n, F)`` of the families, after each scene.
        known: ``(n, F)`` what is taken off of each family's scenes.
    """
    found = np.zeros(len(begin))
    for start, size in zip(*np.unique(begin, return_counts=True), strict=True):
        ends = np.concatenate([[0.0], np.cumsum(share[start])]) * size  # of the families, along stretches of length 1
        stretch = np.arange(size)[:, None]
        mix = np.maximum(np.minimum(ends[1:], stretch + 1.0) - np.maximum(ends[:-1], stretch), 0.0)  # (B, F), rows sum to 1
        off = means[start:] - known[start]
        found[start:] += off**2 @ mix.sum(axis=0) - np.sum((off @ mix.T) ** 2, axis=1)
    return np.maximum(found, 0.0)
