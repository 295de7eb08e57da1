"""What a paired difference and a change on a suite say in words: the one builder for the gate, the
report and the terminal.
"""

from alpasim_plugin.core.json_types import JsonView
from alpasim_plugin.core.types import MetricInfo
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
    needed = more_scenes_text(entry.more_scenes)
    if needed:
        text += f"; {needed} on the margin of {short(entry.margin * scale, unit)}"
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
    return f"{text}; {beyond_text(to_json(entry.beyond))}"


def beyond_text(beyond: JsonView) -> str:
    """Say how many scenes lie beyond the cap of a claim, and how many others may.

    Args:
        beyond: An `evaluators.results.Beyond`.
    """
    scenes = plural(beyond["n_scenes"], "scene")
    at_most = f"{100 * beyond['at_most']:.2g}\u00a0%"
    return f"{beyond['n']} of {scenes} {beyond['event']}, of others at most {at_most}"


def more_scenes_text(more: int | None) -> str:
    """Say how many more scenes an undecided verdict needs; empty where that is unknown."""
    if more is None:
        return ""
    if more > MANY_SCENES:
        return f"more than {MANY_SCENES} more scenes would decide"
    return f"at least {plural(more, 'more scene')} would decide"


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
        parts.insert(0, f"mean {mean:+.3g}, margin {margin:.3g} {unit}".rstrip())
    if entry["worst"] and entry["verdict"] != "non-inferior":
        parts.append(f"worst in {_some([_place(pair) for pair in entry['worst']])}")
    if entry["cut_mean"] is not None:
        parts.extend(_cut_texts(entry, scale, unit))
    if entry["n_far"]:
        parts.append(f"{plural(entry['n_far'], 'scene')} beyond three margins")
    if entry["cut"]:
        parts.append(f"not compared, as an event ended one side: {_some(entry['cut'])}")
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


def _some(names: list[str]) -> str:
    more = len(names) - NAMED
    return ", ".join(names[:NAMED]) + (f" and {more} more" if more > 0 else "")
