"""What a paired difference and a change on a suite say in words: the one builder for the gate, the
report and the terminal.
"""

import shlex
from collections.abc import Mapping, Sequence
from typing import Any

from alpasim_plugin.core.files import some_of
from alpasim_plugin.core.json_types import JsonView
from alpasim_plugin.core.types import GUESSED_SHARE, RECORDED_SHARE, MetricInfo
from evaluators.results import Difference, to_json
from evaluators.statistics.intervals import FEW_SCENES, LEAST_SCENES
from evaluators.statistics.numbers import (
    plural,
    printed,
    scale_and_unit,
    short,
)

MANY_SCENES = 1000  # an estimate beyond this says no more than "many"
NAMED = 3  # scenes and cells in a sentence
SHIPPED = "suites/all"
SHIPPED_SCENES = 42  # of that suite


def difference_text(entry: Difference, metric: MetricInfo) -> str:
    """Say a paired difference, its interval, what its verdict is about, and what would decide it.

    Args:
        entry: The difference.
        metric: What was compared.
    """
    if entry.diff is None:
        return entry.reason or "no difference"
    scale, unit = scale_and_unit(metric, metric.unit)
    bounds = entry.ci95 or ()
    numbers = printed(metric, entry.diff, *bounds, sign=True)
    text = f"{numbers[0]}\u00a0{unit}".strip("\u00a0")
    n = entry.n_scenes
    if entry.p_value is not None and 1 < n < FEW_SCENES:
        can = "" if n >= LEAST_SCENES else f", {plural(n, 'scene')} cannot decide"
        text = f"exact test p = {short(entry.p_value)}{can}; {text}"
    if bounds:
        text += f", 95\u00a0% interval {numbers[1]} to {numbers[2]}"
    elif entry.reason is not None:
        text += f"; no interval: {entry.reason}"
    claim = claim_text(entry, metric)
    if claim:
        text += f"; {claim}"
    needed = more_scenes_text(entry)
    if needed:
        text += f"; {needed} the margin of {short(entry.margin * scale, unit)}"
    return text


def claim_text(entry: Difference, metric: MetricInfo) -> str:
    """Say what the verdict on a distance is about, and what lies beyond; empty where nothing is cut.

    Args:
        entry: The difference.
        metric: What was compared.
    """
    if entry.beyond is None or entry.cut_mean is None:
        return ""
    text = f"the verdict is about the {entry.claim}"
    if entry.beyond.n:
        centre = printed(metric, entry.cut_mean, sign=True)[0]
        text += f", {centre}\u00a0{metric.unit}".rstrip("\u00a0")
    if metric.event:
        text += f", {metric.event} about what lies beyond"
    return f"{text}; {beyond_text(to_json(entry.beyond))}"


def beyond_text(beyond: JsonView) -> str:
    """Say how many scenes lie beyond the cap of a claim, and how many others may.

    Args:
        beyond: An `evaluators.results.Beyond`.
    """
    scenes = plural(beyond["n_scenes"], "scene")
    at_most = f"{100 * beyond['at_most']:.2g}\u00a0%"
    return f"{beyond['n']} of {scenes} {beyond['event']}, of others at most {at_most}"


def is_beyond_margin(entry: Difference) -> bool:
    """Tell which answer an undecided verdict is nearer to: "worse" where the mean of these scenes is
    beyond the margin, else "non-inferior".
    """
    if entry.cut_mean is None:
        return False
    worse = {"lower": entry.cut_mean, "higher": -entry.cut_mean, "none": abs(entry.cut_mean)}
    return worse[entry.direction] > entry.margin


def more_scenes_text(entry: Difference) -> str:
    """Say how many more scenes an undecided verdict needs, and for which answer; empty where that is
    unknown.
    """
    if entry.more_scenes is None:
        return ""
    answer = "beyond" if is_beyond_margin(entry) else "within"
    number = f"at least {plural(entry.more_scenes, 'more scene')}"
    if entry.more_scenes > MANY_SCENES:
        number = f"more than {MANY_SCENES} more scenes"
    return f"{number} would show that it is {answer}"


def open_text(name: str, baseline: str, entry: Difference, metric: MetricInfo) -> str:
    """Say how many scenes would answer what is open about a variant, each question by itself; empty
    where no number is known.

    Args:
        name: Of the variant.
        baseline: What it is compared with.
        entry: Its undecided difference.
        metric: What was compared.
    """
    scale, unit = scale_and_unit(metric, metric.unit)
    margin = f"{entry.margin * scale:g} {unit}".rstrip()
    is_beyond = is_beyond_margin(entry)
    is_worse = (
        is_beyond or (entry.diff or 0.0) * (-1.0 if entry.direction == "higher" else 1.0) > 0.0
    )
    parts: list[str] = []
    to_differ = entry.more_scenes_to_differ
    if to_differ is not None and not (is_beyond and to_differ == entry.more_scenes):
        side = "worse" if is_worse else "better"
        parts.append(
            f"{_scenes_in_all(entry, to_differ)} would show that {name} is {side} than {baseline}"
        )
    if entry.more_scenes is not None:
        number = _scenes_in_all(entry, entry.more_scenes)
        who = "it" if parts else name
        if not is_beyond:
            claim = f"{who} is within {margin} of {baseline}"
        elif parts:
            claim = f"{who} is by more than {margin}"
        else:
            claim = f"{who} is worse than {baseline} by more than {margin}"
        parts.append(f"{number} {'' if parts else 'would show '}that {claim}")
    return " and ".join(parts)


def fewest_scenes(entry: Difference) -> int | None:
    """Return how many scenes in all answer one of the open questions about a variant; None where no
    number is known.
    """
    numbers = [n for n in (entry.more_scenes, entry.more_scenes_to_differ) if n is not None]
    return entry.n_scenes + min(numbers) if numbers else None


def are_shipped(n_scenes: int) -> bool:
    """Tell whether so many scenes ship."""
    return n_scenes <= SHIPPED_SCENES


def shipped_text(renderers: Sequence[str], policies: Sequence[str]) -> str:
    """Name the command that drives all scenes that ship.

    Args:
        renderers, policies: That are driven.

    Example:
        >>> shipped_text(["clean", "3dgs"], ["lane-camera"])
        'simrun --renderer clean,3dgs --policy lane-camera suites/all drives 42'
    """
    options = ["--renderer", ",".join(renderers), "--policy", ",".join(policies)]
    return f"simrun {shlex.join(options)} {SHIPPED} drives {SHIPPED_SCENES}"


def _scenes_in_all(entry: Difference, more: int) -> str:
    """Print a number of scenes, those of the run included."""
    needed = entry.n_scenes + more
    return f"more than {MANY_SCENES}" if needed > MANY_SCENES else f"about {needed}"


def change_text(entry: JsonView, metric: MetricInfo) -> str:
    """Say what changed on a suite, and where.

    Args:
        entry: Of a check of `evaluators.statistics.gate`.
        metric: What was compared.
    """
    scale, unit = scale_and_unit(metric, metric.unit)
    counts = ", ".join(f"{n} {name}" for name, n in entry["counts"].items())
    parts = [f"{counts} of {plural(entry['n_cells'], 'pair')}"]
    if not entry["n_cells"]:
        parts = ["no pair is compared"]
    elif not metric.is_flag:
        mean = entry["diff"] * scale
        margin = entry["margin"] * scale
        change = f"mean {mean:+.3g} {unit}".rstrip()
        parts.insert(0, f"{change}, margin {margin:.3g} {unit}".rstrip())
    if entry["worst"] and entry["verdict"] != "non-inferior":
        parts.append(f"worst in {some_of([_place(pair) for pair in entry['worst']], NAMED)}")
    if entry["cut_mean"] is not None:
        parts.extend(_cut_texts(entry, scale, unit))
    if entry["n_far"]:
        parts.append(f"{plural(entry['n_far'], 'scene')} beyond three margins")
    if entry["cut"]:
        parts.append(f"not compared, as an event ended one side: {some_of(entry['cut'], NAMED)}")
    if entry["n_short"]:
        parts.append(f"an event cut both sides short in {plural(entry['n_short'], 'pair')}")
    if entry["n_neither"]:
        parts.append(f"no value on either side in {plural(entry['n_neither'], 'pair')}")
    if entry["missing"]:
        first = entry["missing"][0]
        missing = f"{plural(entry['n_missing'], 'pair')} missing"
        parts.append(f"{missing}, first {_place(first)} ({first['why']})")
    if entry["verdict"] == "undecided":
        parts.append(_seeds_text(entry["seeds"]))
    return "; ".join(parts)


def _cut_texts(entry: JsonView, scale: float, unit: str) -> list[str]:
    """Say the mean of cells cut at three margins, and what lies beyond."""
    cut = entry["cut_mean"] * scale
    most = 3.0 * entry["margin"] * scale
    drives = entry["beyond"]
    at_most = 100 * drives["at_most"]
    return [
        f"mean of drives cut at {most:.3g} {unit}".rstrip() + f": {cut:+.3g}",
        f"{drives['worse']} of {plural(drives['of'], 'drive')} beyond {most:.3g} {unit}".rstrip()
        + f": at most {at_most:.0f}\u00a0%",
    ]


def _seeds_text(seeds: int | None) -> str:
    """Say how many seeds would decide."""
    if seeds is None:
        return "no number of seeds would show from this that it is chance"
    return f"{plural(seeds, 'seed')} a scene would show whether this is chance"


def _place(pair: JsonView) -> str:
    return f"{pair['scene']} seed {pair['seed']}"


BEFORE_US = 1_000_000  # of an event: the images that led to it


def seen_before(rows: Sequence[Mapping[str, Any]], t_us: int) -> str:
    """Say how much of the images in the second before an instant was guessed and recorded; empty
    where no fixer says so.

    Example:
        >>> seen_before([{"t_us": 0, "guessed_share": 0.1, "recorded_share": 0.5}], 300_000)
        '10 % of what it saw in the second before was made up by the fixer, 50 % was recorded'
    """
    near = [
        row for row in rows if GUESSED_SHARE in row and t_us - BEFORE_US <= int(row["t_us"]) <= t_us
    ]
    if not near:
        return ""
    guessed, recorded = (
        sum(float(row[name]) for row in near) / len(near)
        for name in (GUESSED_SHARE, RECORDED_SHARE)
    )
    return f"{guessed:.0%} of what it saw in the second before was made up by the fixer, {recorded:.0%} was recorded".replace(
        "%", " %"
    )


def beyond_reason(scene: JsonView | None) -> str:
    """Say what is not known beyond the range of a scene, whose file is given where there is one."""
    if scene is not None and scene.get("plan_ranges"):
        return "where its plans are not known to be near those behind clean"
    return "where nothing was compared with a photograph"
