"""Claims of the paper as comparisons of rows of its tables: their power before anything is trained, and
their verdicts afterwards.

A comparison of clips is a sign test on the differences of scenes, because nothing bounds these
metrics; one of drives is the test that the run's summary holds. A claim corrects its own
comparisons by Holm's method. It holds where every comparison is shown, does not hold where one is
shown to be the other way round, and is undecided otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import combinations
from typing import Literal

import numpy as np
import scipy
from pydantic import BaseModel, ConfigDict, model_validator

from alpasim_plugin.core.files.config import load_yaml, validate
from alpasim_plugin.core.types import F64
from alpasim_plugin.lab.paper.config import RAW
from alpasim_plugin.lab.paper.printed import HERE, PrintedMetric, printed
from alpasim_plugin.lab.paper.records import ClosedLoop, Quality
from alpasim_plugin.lab.video_metrics.summary import TRUTH
from evaluators.statistics.intervals import median_interval
from evaluators.statistics.verdicts import ALPHA, POWER, holm, sign_test

FILE = HERE / "claims.yaml"
TIME = "ms_per_frame"
Verdict = Literal["holds", "does not hold", "undecided"]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class Claim(_Strict):
    """One sentence of the paper, see claims.yaml for the members."""

    number: int
    place: str
    text: str
    better: tuple[str, ...] = ()
    than: tuple[str, ...] = ()
    metrics: tuple[str, ...] = ()
    matches: bool = False
    drive: bool = False
    untested: str = ""
    missing: str = ""

    @model_validator(mode="after")
    def _says_something(self) -> Claim:
        if bool(self.missing) == bool(self.better and self.than and self.metrics):
            raise ValueError(f"claim {self.number} | give either comparisons or what is missing")
        if self.drive and (self.matches or (RAW in self.better) == (RAW in self.than)):
            raise ValueError(
                f"claim {self.number} | a drive is compared with {RAW}, for a difference"
            )
        return self

    @property
    def rows(self) -> tuple[str, ...]:
        """Rows of tables that it compares."""
        return tuple(dict.fromkeys((*self.better, *self.than)))

    @property
    def comparisons(self) -> list[tuple[str, str, str]]:
        """Row, other row and metric of every comparison."""
        return [
            (row, other, metric)
            for row in self.better
            for other in self.than
            for metric in self.metrics
        ]


class Claims(_Strict):
    """All claims, and the margins of their metrics."""

    version: Literal[1]
    margins: dict[str, float]
    claims: tuple[Claim, ...]


@cache
def claims() -> Claims:
    """Return the paper's claims."""
    return validate(Claims, load_yaml(FILE))


@dataclass(frozen=True)
class Expected:
    """What can be expected of a claim before anything is trained.

    Attributes:
        claim: The claim.
        power: Chance that its weakest comparison shows a true difference of its margin; None where
            it is not computed.
        left_out: Why it is not tested; empty where it is.
    """

    claim: Claim
    power: float | None
    left_out: str

    def as_dict(self) -> dict[str, object]:
        """Return it for JSON."""
        return {
            "claim": self.claim.number,
            "text": self.claim.text,
            "power": self.power,
            "left_out": self.left_out or None,
        }


def sign_test_power(spread: float, margin: float, scenes: int, tests: int) -> float:
    """Return the chance that the two-sided sign test, at Holm's first level for ``tests`` tests, shows
    a difference whose mean is ``margin`` and whose standard deviation between scenes is ``spread``
    (normal differences).

    Example:
        >>> round(sign_test_power(spread=1.0, margin=0.5, scenes=30, tests=1), 2)
        0.55
        >>> sign_test_power(spread=0.0, margin=0.5, scenes=5, tests=1)  # five alike reach p = 0.06
        0.0
    """
    share = float(scipy.special.ndtr(margin / spread)) if spread > 0.0 else 1.0
    needed = next(
        (up for up in range(scenes // 2 + 1, scenes + 1) if _p(up, scenes) <= ALPHA / tests), None
    )
    if needed is None:
        return 0.0
    return float(scipy.special.bdtrc(needed - 1, scenes, share))


def _p(up: int, scenes: int) -> float:
    return sign_test(up, scenes - up)


def mean_test_power(spread: float, margin: float, scenes: int, tests: int) -> float:
    """Return the same of a test of the mean over scenes, by the normal approximation.

    Example:
        >>> round(mean_test_power(spread=1.0, margin=0.5, scenes=31, tests=1), 2)
        0.8
    """
    if spread == 0.0:
        return 1.0
    critical = float(scipy.special.ndtri(1.0 - ALPHA / (2.0 * tests)))
    return float(scipy.special.ndtr(margin * math.sqrt(scenes) / spread - critical))


@dataclass(frozen=True)
class Design:
    """What a configuration measures: its rows and its numbers of scenes."""

    rows: frozenset[str]
    scenes: int
    drive_rows: frozenset[str]
    drive_scenes: int
    times_scenes: int = 0  # 0: times are not measured

    def scenes_of(self, claim: Claim, metric: str) -> int:
        """Return on how many scenes a metric of a claim is compared."""
        if metric == TIME:
            return self.times_scenes
        return self.drive_scenes if claim.drive else self.scenes


def expected(
    claim: Claim, design: Design, pilot: Quality, drive_spreads: Mapping[str, float], least: float
) -> Expected:
    """Return the power of a claim, and why it is left out if it is.

    Args:
        claim: The claim.
        design: What is measured.
        pilot: Open-loop quality of a small measurement. Of a metric the largest spread among its
            pairs of fixers counts.
        drive_spreads: Of differences from the raw render in a small closed loop, by metric of the
            paper (`records.read_drive_spreads`).
        least: Claims of less power are left out.
    """
    if claim.missing:
        return Expected(claim, None, claim.missing)
    rows = design.drive_rows if claim.drive else design.rows
    if absent := [row for row in claim.rows if row not in rows]:
        return Expected(claim, None, f"not among the rows: {', '.join(absent)}")
    powers = []
    for metric in claim.metrics:
        spread = (
            drive_spreads.get(metric)
            if claim.drive
            else quality_spread(pilot, metric, RAW in claim.rows)
        )
        if spread is None:
            return Expected(claim, None, f"the pilot says no spread of {metric}")
        power_of = mean_test_power if claim.drive else sign_test_power
        scenes = design.scenes_of(claim, metric)
        if scenes == 0:
            return Expected(claim, None, "times are not measured")
        margin = claims().margins[metric]
        powers.append(power_of(spread, margin, scenes, len(claim.comparisons)))
    power = min(powers)
    too_weak = f"its power is {100 * power:.0f} %" if power < least else ""
    return Expected(claim, power, too_weak)


def quality_spread(pilot: Quality, metric: str, with_raw: bool) -> float | None:
    """Return the largest standard deviation between scenes of the difference of two variants; None
    where no pair carries the metric in two scenes.

    Args:
        pilot: The record.
        metric: Of the paper.
        with_raw: Whether the raw render is among them: from it fixers differ more than from one
            another.
    """
    names = [name for name in pilot.by_scene if name != TRUTH and (with_raw or name != RAW)]
    ours = measured_as(printed().metrics[metric], pilot)
    if ours is None:
        return None
    spreads = [
        float(np.std(differences, ddof=1))
        for name, other in combinations(names, 2)
        if len(differences := pilot.differences(name, other, ours)) > 1
    ]
    return max(spreads, default=None)


def measured_as(metric: PrintedMetric, quality: Quality) -> str | None:
    """Return the metric of ours that a record holds in place of the paper's; None for none."""
    measured = {name for values in quality.by_scene.values() for name in values}
    return next((name for name in metric.ours if name in measured), None)


@dataclass(frozen=True)
class Tested:
    """One comparison.

    Attributes:
        row, other, metric: What is compared; the metric is ours.
        n: Scenes.
        gain: Mean of the differences, positive where ``row`` is better, in the metric's unit.
        median, interval: Their median, and its 95 % interval where there is one.
        p_value: Two-sided; None where there is no test.
        sign: 1 where the test's side is the claim's, -1 where it is the other.
        more: Scenes at which a true difference like this one would be shown in four of five
            experiments; None where the difference is none.
    """

    row: str
    other: str
    metric: str
    n: int
    gain: float | None
    median: float | None
    interval: tuple[float, float] | None
    p_value: float | None
    sign: int
    more: int | None

    def as_dict(self) -> dict[str, object]:
        """Return it for JSON."""
        return {
            "row": self.row,
            "minus": self.other,
            "metric": self.metric,
            "n": self.n,
            "gain": self.gain,
            "median_gain": self.median,
            "median_ci95": self.interval,
            "p_value": self.p_value,
            "scenes_for_power_80": self.more,
        }


@dataclass(frozen=True)
class Decided:
    """A claim with its verdict."""

    expected: Expected
    verdict: Verdict | None
    tests: tuple[Tested, ...]

    def as_dict(self) -> dict[str, object]:
        """Return it for JSON."""
        return {
            **self.expected.as_dict(),
            "verdict": self.verdict,
            "untested": self.expected.claim.untested or None,
            "comparisons": [test.as_dict() for test in self.tests],
        }


def decide(expectation: Expected, quality: Quality, drive: ClosedLoop) -> Decided:
    """Return the verdict of a claim; one that is left out has none."""
    claim = expectation.claim
    if expectation.left_out:
        return Decided(expectation, None, ())
    tests = tuple(
        drive_test(drive, row, other, metric)
        if claim.drive
        else clip_test(quality, row, other, metric, claim.matches, len(claim.comparisons))
        for row, other, metric in claim.comparisons
    )
    return Decided(expectation, verdict_of(tests), tests)


def verdict_of(tests: Sequence[Tested]) -> Verdict:
    """Return the verdict of comparisons after Holm's correction; one without a test decides
    nothing.
    """
    values = holm([test.p_value for test in tests])
    sides = [
        test.sign if value is not None and value < ALPHA else 0
        for test, value in zip(tests, values, strict=True)
    ]
    if -1 in sides:
        return "does not hold"
    return "holds" if all(side == 1 for side in sides) else "undecided"


def clip_test(
    quality: Quality, row: str, other: str, metric: str, matches: bool, count: int
) -> Tested:
    """Test whether a row is better than another, or with ``matches`` not worse by the margin.

    Args:
        quality: The record.
        row, other: What is compared.
        metric: Of the paper.
        matches: Whether the margin is granted to ``row``.
        count: Comparisons of the claim.
    """
    facts = printed().metrics[metric]
    ours = measured_as(facts, quality)
    differences = np.array([]) if ours is None else quality.differences(row, other, ours)
    if ours is None or not len(differences):
        return Tested(row, other, metric, 0, None, None, None, None, 0, None)
    gains: F64 = differences if facts.better == "higher" else -differences
    tested = gains + (claims().margins[metric] if matches else 0.0)
    up = int(np.sum(tested > 0.0))
    down = int(np.sum(tested < 0.0))
    interval = median_interval(gains, "scenes")
    bounds = (
        None if interval.low is None or interval.high is None else (interval.low, interval.high)
    )
    return Tested(
        row,
        other,
        ours,
        len(gains),
        float(np.mean(gains)),
        interval.centre,
        bounds,
        sign_test(up, down),
        (up > down) - (up < down),
        scenes_for_sign_test(up, down, len(gains) - up - down, count),
    )


def drive_test(drive: ClosedLoop, row: str, other: str, metric: str) -> Tested:
    """Return the test that the run's summary holds about a row and the raw render, in either
    order.
    """
    facts = printed().metrics[metric]
    renderer, side = (row, 1) if row in drive.minus_raw else (other, -1)
    entry = drive.minus_raw[renderer][facts.ours[0]]
    if entry.diff is None:
        return Tested(row, other, metric, 0, None, None, None, None, 0, None)
    gain = side * (entry.diff if facts.better == "higher" else -entry.diff)
    more = entry.more_scenes_to_differ
    sign = (gain > 0.0) - (gain < 0.0)
    return Tested(
        row,
        other,
        facts.ours[0],
        entry.n_scenes,
        gain,
        None,
        None,
        entry.p_value,
        sign,
        None if more is None else entry.n_scenes + more,
    )


def scenes_for_sign_test(up: int, down: int, ties: int, tests: int) -> int | None:
    """Return the number of scenes at which the sign test at Holm's first level for ``tests`` tests
    shows a difference with probability `POWER` (normal approximation), if scenes go up, go down and
    tie as often as these did; None where as many go down. The test leaves ties out.

    Example:
        >>> scenes_for_sign_test(up=20, down=10, ties=0, tests=1)
        69
        >>> scenes_for_sign_test(up=20, down=10, ties=30, tests=1)
        138
        >>> scenes_for_sign_test(up=5, down=0, ties=0, tests=1)  # all to one side: 2 / 2^6 < 5 %
        6
    """
    if up == down:
        return None
    share = max(up, down) / (up + down)
    critical, wanted = scipy.special.ndtri([1.0 - ALPHA / (2.0 * tests), POWER])
    half = critical * 0.5 + wanted * math.sqrt(share * (1.0 - share))
    fewest = math.ceil(math.log2(2.0 * tests / ALPHA))
    untied = max(math.ceil((half / (share - 0.5)) ** 2), fewest)
    return math.ceil(untied * (up + down + ties) / (up + down))
