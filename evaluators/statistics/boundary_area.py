"""Where in the rectangle of two parameters a policy fails: which points of a grid are driven next,
and what the driven points say.

The first points are a grid. Along each of its lines a change of outcome between neighbours is halved,
as along one parameter (`evaluators.statistics.boundary`). A claim counts driven points of the grid and
names their distances. Nothing is assumed of the shape of what fails: what fits between the points is
not seen, and no share of the rectangle is claimed.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise, product

from evaluators.statistics.boundary import middles_of_changes

AREA_SPACINGS = 8  # between the first points of a range whose key names no spacing
AREA_PARTS = 2  # of a spacing

Point = tuple[int, ...]  # two steps
Lines = tuple[Sequence[int], Sequence[int]]  # the steps of the first points, of each parameter


@dataclass(frozen=True)
class Claims:
    """What the first points of a seed say.

    Attributes:
        points: How many were driven.
        failed: At how many the drive failed.
        squares: Squares between four of them that were all driven.
        changing: Squares whose corners differ: a boundary runs through each.
    """

    points: int
    failed: int
    squares: int
    changing: int


def claims_of(failed: Mapping[Point, bool], lines: Lines) -> Claims:
    """Count the first points and the squares between them.

    Args:
        failed: Point -> whether the drive failed there.
        lines: The steps of the first points.
    """
    outcomes = [failed[point] for point in product(*lines) if point in failed]
    squares = 0
    changing = 0
    for columns, rows in product(pairwise(lines[0]), pairwise(lines[1])):
        corners = [failed.get(corner) for corner in product(columns, rows)]
        if None not in corners:
            squares += 1
            changing += len(set(corners)) > 1
    return Claims(len(outcomes), sum(outcomes), squares, changing)


def next_area_points(
    failed: Mapping[Point, bool], lines: Lines, skipped: set[Point]
) -> list[Point]:
    """Return the points of the grid that a seed drives in the next round; none where its search has
    ended.

    Args:
        failed: Point -> whether the drive failed there.
        lines: The steps of the first points.
        skipped: Points at which the scene cannot be built.
    """
    missing: list[Point] = [
        point for point in product(*lines) if point not in failed and point not in skipped
    ]
    if missing:
        return missing
    points: set[Point] = set()
    for row in lines[1]:
        along = {step: has_failed for (step, other), has_failed in failed.items() if other == row}
        gone = {step for step, other in skipped if other == row}
        points |= {(step, row) for step in middles_of_changes(along, gone)}
    for column in lines[0]:
        along = {
            step: has_failed for (other, step), has_failed in failed.items() if other == column
        }
        gone = {step for other, step in skipped if other == column}
        points |= {(column, step) for step in middles_of_changes(along, gone)}
    return sorted(points)
