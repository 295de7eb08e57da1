"""Measure how often the rules of docs/statistics.md are wrong and how often they decide, beside
classical tests, and write the tables into that page.

    python docs/scripts/calibration.py [--repeats N] [--part NAME]

Differences are drawn scene by scene. "Wrong" is how often a rule answers although its answer is
false, with the truth as near to it as it can be; "right" is how often it answers where that is
true. A classical test stands beside a rule where it keeps its level for that kind of differences.
"""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import scipy

from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F64, MetricInfo
from alpasim_plugin.log.run_folder.sides import Side
from evaluators.metrics import METRICS
from evaluators.statistics.betting import Draws, Plan, bet_sizes, log_capital
from evaluators.statistics.bounded import mean_interval
from evaluators.statistics.intervals import TAIL, exact_rate, t_interval
from evaluators.statistics.paired import compare, flag_interval, reach_of
from evaluators.statistics.verdicts import ALPHA, sign_flip, sign_test

DOCS = Path(__file__).resolve().parents[1]
PAGES = (DOCS / "statistics.md", DOCS / "experiments" / "verdict-error.md")
METRES, RATE, PROGRESS = (METRICS[n] for n in ("lateral_distance_m", "offroad", "progress"))
Draw = Callable[[np.random.Generator, int], F64]  # generator, scenes -> differences


def normal(mean: float) -> Draw:
    """Return draws with a spread of 0.2."""
    return lambda g, n: g.normal(mean, 0.2, n)


def heavy(mean: float) -> Draw:
    """Return draws of t with two degrees of freedom: their variance is infinite."""
    return lambda g, n: mean + 0.1 * g.standard_t(2, n)


def rare(mean: float, jump: float) -> Draw:
    """Return draws that are 0 but in rare scenes."""
    return lambda g, n: np.where(g.random(n) < mean / jump, jump, 0.0)


def seeds(gained: float, of: int) -> Draw:
    """Return differences of a rate over some seeds a scene: 2 % of scenes lose events, ``gained``
    more of them gain some.
    """

    def draw(g: np.random.Generator, n: int) -> F64:
        sign = g.choice([1.0, -1.0, 0.0], n, p=[gained + 0.02, 0.02, 0.96 - gained])
        return np.asarray(sign * g.integers(1, of + 1, n) / of)

    return draw


def t_test(x: F64) -> float:
    """Return the two-sided p of the paired t test."""
    if np.ptp(x) == 0.0:
        return 1.0
    t = float(np.mean(x) / (np.std(x, ddof=1) / np.sqrt(len(x))))
    return 2.0 * float(scipy.special.stdtr(len(x) - 1, -abs(t)))


def signs(x: F64) -> float:
    """Return the exact p of the sign test on scenes; McNemar's of one seed."""
    return sign_test(int(np.sum(x > 0)), int(np.sum(x < 0)))


def classical_bounds(x: F64, reach: float) -> list[float]:
    """Return upper bounds of a mean of values within a reach of 0 that hold for every distribution:
    Hoeffding's, Maurer and Pontil's (empirical Bernstein), and Clopper and Pearson's of how many
    scenes are worse at all.
    """
    x, n, log = np.clip(x, -reach, reach), len(x), math.log(1 / TAIL)
    hoeffding = np.mean(x) + 2 * reach * math.sqrt(log / (2 * n))
    log += math.log(2.0)
    spread = math.sqrt(2 * float(np.var(x, ddof=1)) * log / n)
    bernstein = np.mean(x) + spread + 14 * reach * log / (3 * (n - 1))
    worse = reach * exact_rate(float(np.sum(x > 0)), n)[1]
    return [float(hoeffding), float(bernstein), worse]


def verdict_on(x: F64, metric: MetricInfo, margin: float) -> str:
    """Return what `compare` says of scene differences, positive is worse; a scene that is worse by
    what counts of it at most has left the route.
    """
    cells = [("p", f"s{i:04d}", 0) for i in range(len(x))]
    nothing = np.full(len(x), np.nan)

    def side(values: F64, left: F64) -> Side:
        columns = {metric.name: values, "left_route": left}
        ok = np.ones(len(x), dtype=np.bool_)
        return Side.laid_out(
            cells,
            ok,
            lambda name: columns.get(name, nothing),
            lambda row, name: "",
            lambda row: "",
        )

    worse = -x if metric.direction == "higher" else x
    base = np.maximum(-worse, 0.0)
    left = (x >= reach_of(metric, margin)).astype(np.float64)
    pair = side(base + worse, left), side(base, np.zeros(len(x)))
    return str(compare(*pair, metric, "base", margin)["verdict"])


def share(hits: Sequence[bool]) -> str:
    """Print a share in percent."""
    return f"{100 * float(np.mean(hits)):.1f}"


def differs(repeats: int) -> list[str]:
    """Measure "differs on these scenes"."""
    lines = ["| differences | " + " | ".join(f"{n} scenes" for n in (6, 14, 42, 100)) + " |"]
    lines.append("|---|" + "---:|" * 4)
    rows: list[tuple[str, Callable[[float], Draw], float, Callable[[F64], float]]] = [
        ("0.1 m, spread 0.2 m; t test", normal, 0.1, t_test),
        ("0.1 m, tails of t(2); t test", heavy, 0.1, t_test),
        ("rate +10 points, 1 seed; McNemar", lambda m: seeds(m, 1), 0.1, signs),
        ("rate +10 points, 5 seeds; sign test", lambda m: seeds(m, 5), 0.1, signs),
    ]
    for words, family, effect, classical in rows:
        cells = []
        for n in (6, 14, 42, 100):
            g = stream(words, n, "docs/calibration")
            null = [sign_flip(family(0.0)(g, n))[0] <= ALPHA for _ in range(repeats)]
            drawn = [family(effect)(g, n) for _ in range(repeats // 2)]
            own = [sign_flip(x)[0] <= ALPHA for x in drawn]
            cells.append(
                f"{share(null)} / {share(own)} / {share([classical(x) <= ALPHA for x in drawn])}"
            )
        lines.append(f"| {words} | " + " | ".join(cells) + " |")
    return lines


def verdicts(repeats: int) -> list[str]:
    """Measure `non-inferior` and `worse`."""
    scenes = (42, 100, 400)
    lines = ["| verdict, margin, differences | " + " | ".join(f"{n} scenes" for n in scenes) + " |"]
    lines.append("|---|" + "---:|" * len(scenes))
    quiet = rare(0.0, 1.0)
    noise = normal(0.0)
    rows: list[tuple[str, str, MetricInfo, float, Draw, Draw]] = [
        ("0.1 m: all alike, spread 0.2 m", "non-inferior", METRES, 0.1, normal(0.1), noise),
        ("0.1 m: 2.5 % of scenes by 4 m", "non-inferior", METRES, 0.1, rare(0.1, 4.0), quiet),
        ("0.1 m: 1 % of scenes by 15 m", "non-inferior", METRES, 0.1, rare(0.15, 15.0), quiet),
        ("5 points: 5 % of scenes", "non-inferior", RATE, 0.05, rare(0.05, 1.0), quiet),
        ("5 points, 5 seeds", "non-inferior", RATE, 0.05, seeds(0.083, 5), quiet),
        ("0.05 of progress: 10 % by half", "non-inferior", PROGRESS, 0.05, rare(0.05, 0.5), quiet),
        ("0.1 m: 1 m, spread 0.2 m", "worse", METRES, 0.1, normal(0.1), normal(1.0)),
        ("5 points: 30 % of scenes", "worse", RATE, 0.05, rare(0.05, 1.0), rare(0.3, 1.0)),
    ]
    for words, answer, metric, margin, at_margin, truth in rows:
        cells = []
        for n in scenes:
            g = stream(words, n, "docs/calibration")
            false = [at_margin(g, n) for _ in range(repeats)]
            true = [truth(g, n) for _ in range(repeats // 4)]
            wrong, right = (
                [verdict_on(x, metric, margin) == answer for x in drawn] for drawn in (false, true)
            )
            reach = reach_of(metric, margin)
            bounds = [classical_bounds(x if answer != "worse" else -x, reach) for x in true]
            accepted = margin if answer != "worse" else -margin
            best = 100 * np.mean(np.array(bounds) < accepted, axis=0).max()
            cells.append(f"{share(wrong)} / {share(right)} / {best:.1f}")
        lines.append(f"| `{answer}`, {words} | " + " | ".join(cells) + " |")
    return lines


def intervals(repeats: int) -> list[str]:
    """Measure the intervals of a mean."""
    scenes = (3, 6, 12, 20, 60)
    lines = ["| scene means | " + " | ".join(f"{n} scenes" for n in scenes) + " |"]
    lines.append("|---|" + "---:|" * len(scenes))

    def stops(g: np.random.Generator, n: int) -> F64:
        return np.where(g.random(n) < 0.1, g.uniform(0.0, 0.8, n), 1.0)

    def jumps(g: np.random.Generator, n: int) -> F64:
        return 0.1 + 0.02 * g.random(n) + np.where(g.random(n) < 0.02, 3.0, 0.0)

    def rate(g: np.random.Generator, n: int) -> F64:
        return g.binomial(5, g.beta(0.3, 2.7, n)) / 5.0

    def once(g: np.random.Generator, n: int) -> F64:
        return (g.random(n) < 0.1).astype(np.float64)

    def always(g: np.random.Generator, n: int) -> F64:
        chance = np.where(g.random(n) < 0.1, 1.0, 0.05)
        return (g.random((n, 10)) < chance[:, None]).astype(np.float64)

    for words, metric, truth, draw in (
        ("progress, one drive in ten stops early", PROGRESS, 0.94, stops),
        ("metres, 2 % of scenes by 3 m", METRES, 0.17, jumps),
        ("rate of 10 %, 1 seed", RATE, 0.1, once),
        ("rate of 10 %, 5 seeds, correlated", RATE, 0.1, rate),
        ("rate, 10 seeds, always in 10 % of scenes, 5 % in others", RATE, 0.145, always),
        ("difference of that rate from 0", None, 0.145, always),
    ):
        cells = []
        for n in scenes:
            g = stream(words, n, "docs/calibration")
            drawn = [draw(g, n) for _ in range(repeats)]
            held = []
            for x in drawn:
                if metric is None:
                    of_cells = np.repeat(np.arange(n), x.shape[1])
                    found = flag_interval(x.ravel(), of_cells)
                else:
                    found = mean_interval(x.reshape(n, -1).mean(axis=1), metric)
                low, high = found.bounds or (0.0, 0.0)
                held.append(low <= truth <= high)
            by_t = []
            for x in drawn:
                means = x.reshape(n, -1).mean(axis=1)
                low, high = t_interval(means).bounds or (float(means[0]),) * 2
                by_t.append(low <= truth <= high)
            cells.append(f"{share(held)} / {share(by_t)}")
        lines.append(f"| {words} | " + " | ".join(cells) + " |")
    return lines


def betting(repeats: int) -> list[str]:
    """Measure ``--until-decided`` with a ceiling of 400 scenes."""
    lines = [
        "| margin, differences | wrong | right | a fixed number of scenes |",
        "|---|" + "---:|" * 3,
    ]
    for words, reach, margin, at_margin, truth in (
        ("0.1 m: spread 0.2 m", 4.0, 0.1, normal(0.1), normal(0.0)),
        ("0.1 m: 2.5 % of scenes by 4 m", 4.0, 0.1, rare(0.1, 4.0), rare(0.0, 1.0)),
        ("5 points: 5 % of scenes", 1.0, 0.05, rare(0.05, 1.0), rare(0.0, 1.0)),
        ("5 points, 5 seeds", 1.0, 0.05, seeds(0.083, 5), seeds(0.0, 5)),
    ):
        g = stream(words, 0, "docs/calibration")
        plan = Plan(margin, 400, ALPHA)
        answers = []
        for draw in (at_margin, truth):
            x = np.clip([draw(g, 400) for _ in range(repeats)], -reach, reach)
            draws = Draws(-x, reach)
            capital = log_capital(draws, -margin, bet_sizes(draws, -margin, plan))
            answers.append(capital.max(axis=-1) >= plan.log_bar)
        fixed = [
            any(bound < margin for bound in classical_bounds(draw_x, reach)) for draw_x in x[:200]
        ]
        lines.append(f"| {words} | {share(answers[0])} | {share(answers[1])} | {share(fixed)} |")
    return lines


def main() -> None:
    """Write the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parts = {part.__name__: part for part in (differs, verdicts, intervals, betting)}
    parser.add_argument("--repeats", type=int, default=2000)
    parser.add_argument("--part", choices=list(parts), action="append", help="default: all")
    arguments = parser.parse_args()
    repeats = arguments.repeats
    for part in [parts[name] for name in arguments.part or parts]:
        table = "\n".join(part(repeats))
        begin, end = f"<!-- begin {part.__name__} -->", f"<!-- end {part.__name__} -->"
        for page in PAGES:
            text = page.read_text(encoding="utf-8")
            text = re.sub(f"{begin}.*?{end}", f"{begin}\n{table}\n{end}", text, flags=re.DOTALL)
            page.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
