"""In which part of the rectangle of two parameters a policy fails: which points of a grid are driven
next, and between which bounds the failing share of the rectangle lies.

A seed is a repeatable policy, monotone in each parameter: whatever lies beyond a failing point in
both failing directions fails, and whatever lies beyond a passing point in the other directions
holds. The boundary therefore runs between two staircases. The nine first points and the edges show
the directions; then the point is driven that decides most of the rectangle whatever its outcome.
Points behind the staircases test the rule. Where outcomes contradict each other, every claim begins
so many steps beyond its point that it contradicts no claim and no outcome.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import numpy.typing as npt
import scipy  # its submodules load on first use

from evaluators.statistics.boundary import BESIDE, Interval, changes_of

AREA_STEPS = 32  # of the grid between both ends of each range
OPEN_SHARE = 0.04  # of the rectangle that may stay undecided
SEARCHED_POINTS = 80  # after which none are driven to decide more
MOST_AREA_POINTS = 100  # that a seed drives, tests of the rule among them
APART = 2  # steps from driven points within which the rule is not tested
AT_ONCE = 4  # points of a round
ENDS = (0, AREA_STEPS // 2, AREA_STEPS)

Point = tuple[int, ...]  # two steps
FIRST: list[Point] = list(product(ENDS, ENDS))
Grid = npt.NDArray[np.bool_]  # (AREA_STEPS + 1, AREA_STEPS + 1)


@dataclass(frozen=True)
class Area(Interval):
    """The share of the rectangle that fails, of one seed.

    Attributes:
        low, high: The least and the largest share.
        fails: Of each parameter, whether the policy fails ``below`` or ``above`` the boundary.
        lower, upper: Values of the second parameter between which the boundary runs, for each of
            the steps of the first one.
        contradictions: Driven points that contradict others.
    """

    fails: tuple[str, ...]
    lower: list[float]
    upper: list[float]
    contradictions: int


@dataclass(frozen=True)
class Claims:
    """What outcomes say of every point of the grid; index 0 is the failing end of both parameters.

    Attributes:
        order: Of the indices of each parameter: 1, or -1 where it fails above.
        driven: Points that were driven.
        fails: Points that fail, since one fails that is no lower in both parameters.
        holds: Points that hold, since one holds that is no higher in both.
    """

    order: Point
    driven: Grid
    fails: Grid
    holds: Grid

    @property
    def contradictions(self) -> int:
        """Count the driven points that are claimed to do both."""
        return int((self.driven & self.fails & self.holds).sum())

    def turned(self, grid: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Return a grid with index 0 at the low end of both parameters, or back."""
        return grid[:: self.order[0], :: self.order[1]]

    def beyond(self, steps: int) -> tuple[Grid, Grid]:
        """Return the points that fail and that hold where claims begin some steps beyond a point."""
        up = ((0, steps), (0, steps))
        down = ((steps, 0), (steps, 0))
        fails = np.pad(self.fails, up, mode="edge")[steps:, steps:]
        end = AREA_STEPS + 1
        return fails, np.pad(self.holds, down, mode="edge")[:end, :end]

    def squares(self, steps: int = 0) -> tuple[Grid, Grid]:
        """Return the squares of the grid (AREA_STEPS, AREA_STEPS) that fail and that hold."""
        fails, holds = self.beyond(steps)
        return fails[1:, 1:], holds[:-1, :-1]


def claims_of(failed: Mapping[Point, bool]) -> list[Claims]:
    """Return what outcomes say in those of the four pairs of directions that they contradict
    least.
    """
    shape = AREA_STEPS + 1, AREA_STEPS + 1
    outcomes = np.zeros((2, *shape), bool)
    for point, has_failed in failed.items():
        outcomes[int(has_failed)][point] = True
    found = []
    for order in product((1, -1), (1, -1)):
        passes, fails = outcomes[:, :: order[0], :: order[1]]
        holds = _raised(passes)
        found.append(Claims(order, passes | fails, _raised(fails[::-1, ::-1])[::-1, ::-1], holds))
    least = min(one.contradictions for one in found)
    return [one for one in found if one.contradictions == least]


def _raised(points: Grid) -> Grid:
    """Return the points of a grid that are no lower than one of some points in both parameters."""
    return np.logical_or.accumulate(np.logical_or.accumulate(points, axis=0), axis=1)


def is_monotone(failed: Mapping[Point, bool]) -> bool:
    """Tell whether the first points contradict each other in no pair of directions."""
    first = {point: failed[point] for point in FIRST if point in failed}
    return claims_of(first)[0].contradictions == 0


def next_area_points(failed: Mapping[Point, bool], skipped: set[Point]) -> list[Point]:
    """Return the points of the grid that a seed drives in the next round; none where its search has
    ended.

    Args:
        failed: Point -> whether the drive failed there.
        skipped: Points at which the scene cannot be built.
    """
    asked: list[Point] = []
    most = AT_ONCE if failed else len(FIRST)
    while len(asked) < most and (point := _next_point(failed, asked, skipped)):
        asked.append(point)
    return asked


def _next_point(
    failed: Mapping[Point, bool], asked: Sequence[Point], skipped: set[Point]
) -> Point | None:
    """Return a further point; None where there is none, or none that does not wait for those that
    are asked.
    """
    busy = {*asked, *skipped}
    first = [point for point in FIRST if point not in skipped]
    if missing := [point for point in first if point not in failed]:
        return next((point for point in missing if point not in busy), None)
    if len(set(failed.values())) == 1 or not is_monotone(failed):
        return None
    claims = claims_of(failed)
    fails, holds = claims[0].squares()
    driven = len(failed) + len(asked)
    if (~(fails | holds)).mean() > OPEN_SHARE and driven < SEARCHED_POINTS:
        between = _between_ends(failed, busy)
        if between or any(0 in point or AREA_STEPS in point for point in asked):
            return between
        if len(claims) == 1 and (point := _deciding_point(claims[0], asked, skipped)):
            return point
    return _testing_point(claims[0], asked, skipped) if driven < MOST_AREA_POINTS else None


def _between_ends(failed: Mapping[Point, bool], busy: set[Point]) -> Point | None:
    """Return a point in the middle of a change of outcome along an edge."""
    for axis, end in product((0, 1), (0, AREA_STEPS)):
        edge = {point[axis]: one for point, one in failed.items() if point[1 - axis] == end}
        for low, high in changes_of(edge)[:1]:
            middle = (low + high) // 2
            point = (middle, end) if axis == 0 else (end, middle)
            if high - low > 1 and point not in busy:
                return point
    return None


def _deciding_point(claims: Claims, asked: Sequence[Point], skipped: set[Point]) -> Point | None:
    """Return the undecided point that decides most whatever its outcome, among those of which none
    that is asked decides anything.
    """
    fails, holds = claims.squares()
    is_open = ~(fails | holds)
    worth = np.zeros((2, AREA_STEPS + 1, AREA_STEPS + 1), int)  # if it fails, if it holds
    worth[0, 1:, 1:] = is_open.cumsum(axis=0).cumsum(axis=1)
    worth[1, :-1, :-1] = is_open[::-1, ::-1].cumsum(axis=0).cumsum(axis=1)[::-1, ::-1]
    decided = claims.fails | claims.holds | _marked(claims, skipped)
    for point in asked:
        one = _marked(claims, [point])
        decided |= _raised(one) | _raised(one[::-1, ::-1])[::-1, ::-1]
    score = claims.turned(np.where(decided, 0, worth.min(axis=0)))
    return _highest(score)


def _testing_point(claims: Claims, asked: Sequence[Point], skipped: set[Point]) -> Point | None:
    """Return the point some steps behind the staircases that is furthest from driven ones; None
    where all are close to one.
    """
    driven = claims.driven | _marked(claims, asked)
    distance = scipy.ndimage.distance_transform_cdt(~driven, metric="chessboard")
    for steps in BESIDE:
        nearer = claims.beyond(steps - 1)
        here = claims.beyond(steps)
        layer = (nearer[0] & ~here[0]) | (nearer[1] & ~here[1])
        score = np.where(layer & ~_marked(claims, skipped), distance, 0)
        if score.max() > APART:
            return _highest(claims.turned(score))
    return None


def _marked(claims: Claims, points: Sequence[Point] | set[Point]) -> Grid:
    """Return a grid, turned like the claims, that is true at some points."""
    grid = np.zeros_like(claims.driven)
    for point in points:
        grid[point] = True
    return claims.turned(grid)


def _highest(score: npt.NDArray[np.int_]) -> Point | None:
    """Return the first point of the highest score; None where no score is above 0."""
    row, column = divmod(int(score.argmax()), score.shape[1])
    return (row, column) if score[row, column] > 0 else None


def _agree(failed: Mapping[Point, bool], claims: Claims, steps: int) -> bool:
    """Tell whether claims that begin some steps beyond a point contradict neither each other nor an
    outcome.
    """
    fails, holds = claims.beyond(steps)
    failing = _marked(claims, {point for point, has_failed in failed.items() if has_failed})
    return not (fails & holds | holds & failing | fails & claims.driven & ~failing).any()


def area_of(failed: Mapping[Point, bool], values: Sequence[float]) -> Area | str:
    """Return the failing share of a seed whose search has ended, or why there is none.

    Args:
        failed: Point -> whether the drive failed there.
        values: Of the second parameter, at the points of the grid.
    """
    if not is_monotone(failed):
        return "not monotone"
    claims = claims_of(failed)[0]
    steps = next(number for number in range(AREA_STEPS) if _agree(failed, claims, number))
    fails, holds = claims.squares(steps)
    below = claims.turned(fails)
    above = claims.turned(holds)
    if claims.order[1] < 0:
        below, above = above, below
    return Area(
        float(fails.mean()),
        float(1 - holds.mean()),
        tuple("below" if one > 0 else "above" for one in claims.order),
        [values[number] for number in below.sum(axis=1)],
        [values[AREA_STEPS - number] for number in above.sum(axis=1)],
        claims.contradictions,
    )
