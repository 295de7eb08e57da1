"""What a comparison leaves behind: means and paired differences by protocol, from which claims can
be judged again without its arms.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.core.reading import parsing, read_json_object
from alpasim_plugin.lab.paper.claims import CLAIMS, PER_FRAME, PSNR, STANDS_IN
from alpasim_plugin.lab.paper.measured import Difference
from alpasim_plugin.lab.paper.verdict import ORACLE, Evidence
from alpasim_plugin.lab.video_metrics.facts import KNOWN
from evaluators.statistics.intervals import Interval

DOING = "reading what an earlier comparison measured"
METRICS = frozenset(
    {one.metric for claim in CLAIMS for one in claim.comparisons} | set(STANDS_IN.values())
)
Means = Mapping[str, Mapping[str, Sequence[float | None]]]  # ARM -> METRIC -> centre, low, high


class Recorded:
    """Means and differences of one protocol, as `Measured` gives them.

    Args:
        means: Of arms.
        differences: Those that were kept; each also counts the other way round.
    """

    def __init__(self, means: Means, differences: Sequence[Difference]) -> None:
        self.means = means
        self.pairs = {(one.metric, one.first, one.second): one for one in differences}
        for one in differences:
            low, high = (None if bound is None else -bound for bound in (one.high, one.low))
            turned = Difference(
                one.metric,
                one.second,
                one.first,
                -one.difference,
                low,
                high,
                one.p_value,
                one.n,
                -one.favours,
            )
            self.pairs.setdefault((one.metric, one.second, one.first), turned)

    def has(self, arm: str, metric: str) -> bool:
        """Whether an arm has a metric, alone or in a difference."""
        return metric in self.means.get(arm, {}) or any(
            (metric, arm) == pair[:2] for pair in self.pairs
        )

    def compares(self, metric: str, first: str, second: str) -> bool:
        """Whether the difference of two arms was kept, or those of both from a third one."""
        return (metric, first, second) in self.pairs or bool(self._thirds(metric, first, second))

    def _thirds(self, metric: str, first: str, second: str) -> list[tuple[Difference, Difference]]:
        kept = [
            (one, self.pairs.get((metric, third, second)))
            for (m, a, third), one in self.pairs.items()
            if (m, a) == (metric, first)
        ]
        return [
            (a, b)
            for a, b in kept
            if b is not None and a.bounds is not None and b.bounds is not None
        ]

    def mean(self, arm: str, metric: str) -> Interval:
        """Return an arm's mean; NaN where differences alone were kept."""
        centre, low, high = self.means.get(arm, {}).get(metric, (None, None, None))
        return Interval(float("nan") if centre is None else centre, low, high)

    def difference(self, metric: str, first: str, second: str, share: float = 0.0) -> Difference:
        """Return a paired difference; one that was not kept by way of a third arm.

        The deviation of a sum is at most the sum of the deviations, so that the widths of two
        intervals over the same clips add up to one that is never too narrow.

        Raises:
            EvaluatorError: It was not kept, or a share is asked for, which needs what it was made
                of.
        """
        if share or not self.compares(metric, first, second):
            raise EvaluatorError(
                f"{metric} of {first} and {second}: no such difference", "measure it again"
            )
        if (metric, first, second) in self.pairs:
            return self.pairs[metric, first, second]
        sums = [
            [x + y for x, y in zip(a.bounds or (), b.bounds or (), strict=True)]
            for a, b in self._thirds(metric, first, second)
        ]
        low, high = min(sums, key=lambda bounds: bounds[1] - bounds[0])
        n = min(one.n for pair in self._thirds(metric, first, second) for one in pair)
        favours = (
            0
            if low <= 0.0 <= high
            else (1 if low > 0.0 else -1) * (-1 if KNOWN.info(metric).direction == "lower" else 1)
        )
        return Difference(metric, first, second, (low + high) / 2, low, high, None, n, favours)

    def margin(self, metric: str, arm: str, bound: float) -> Difference:
        """Return by how much an arm's recorded mean exceeds a bound; a mean without an interval
        shows nothing.
        """
        found = self.mean(arm, metric)
        low, high = (None if x is None else x - bound for x in (found.low, found.high))
        return Difference(metric, arm, f"{bound:g}", found.centre - bound, low, high, None, 2, 0)


def recorded(path: Path) -> dict[str, Recorded]:
    """Read a record: PROTOCOL -> what it kept.

    Raises:
        InputError: No such file, or something else.
    """
    do = "give a paper.json of 'simrun bench paper'"
    document = read_json_object(path, do_this=do)
    names = [field.name for field in fields(Difference)]
    with parsing(path, do, "no record of protocols"):
        return {
            protocol: Recorded(
                kept["means"],
                [Difference(**{name: one[name] for name in names}) for one in kept["differences"]],
            )
            for protocol, kept in document["protocols"].items()
        }


def record_of(
    measured: Mapping[str, Evidence], arms: Mapping[str, Sequence[str]]
) -> dict[str, Any]:
    """Return what is kept of measurements: every arm's means, and the differences that claims and
    their oracle histories ask for.

    Args:
        measured: By protocol.
        arms: Names of the arms, by protocol.
    """
    out: dict[str, Any] = {}
    for protocol, found in measured.items():
        asked = [
            one
            for claim in CLAIMS
            for one in claim.comparisons
            if one.protocol == protocol and one.bound is None and not one.share
        ]
        pairs = {
            (name, one.first, one.second)
            for one in asked
            for name in (one.metric, STANDS_IN.get(one.metric, one.metric))
        }
        pairs |= {
            (PSNR, f"{arm}, {ORACLE}", arm) for one in asked for arm in (one.first, PER_FRAME)
        }
        means = {
            arm: {m: _bounds(found.mean(arm, m)) for m in sorted(METRICS) if found.has(arm, m)}
            for arm in arms[protocol]
        }
        differences = [
            asdict(found.difference(*pair)) for pair in sorted(pairs) if found.compares(*pair)
        ]
        out[protocol] = {"means": means, "differences": differences}
    return out


def _bounds(found: Interval) -> list[float | None]:
    return [found.centre, found.low, found.high]
