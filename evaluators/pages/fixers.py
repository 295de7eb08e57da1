"""What a reader must know of the fixers of a run, and how fast the run was."""

from collections.abc import Mapping

from alpasim_plugin.core.json_types import JsonView
from evaluators.statistics.numbers import duration, listed_counts, plural, short

GUARD = "fixer-"


def fixer_cautions(summary: JsonView) -> list[str]:
    """Say what a reader must know of the fixers before using the numbers."""
    cautions = []
    for name, entry in (summary.get("fixers") or {}).items():
        if not entry.get("trained"):
            label = entry.get("label")
            cautions.append(f"{name} is {label}: its results say nothing about a trained fixer.")
        events = refused(summary, name)
        if events:
            cautions.append(
                f"{name}: the fixer failed on {plural(sum(events.values()), 'frame')} of "
                f"{entry.get('frames')} ({listed_counts(events)}); the raw frames were passed on."
            )
    return cautions


def refused(summary: JsonView, renderer: str) -> dict[str, int]:
    """Return how many frames of a renderer the fixer's guard replaced, by kind of event."""
    events = ((summary.get("censoring") or {}).get(renderer) or {}).get("frame_events") or {}
    return {
        kind.removeprefix(GUARD): int(count)
        for kind, count in sorted(events.items())
        if kind.startswith(GUARD)
    }


def pool_text(pool: Mapping[str, float]) -> str:
    """Say how many workers a run had, how many frames they made a second, and how long it took."""
    texts = []
    if pool.get("workers"):
        threads = plural(int(pool.get("threads_per_worker") or 1), "thread")
        texts.append(f"{plural(int(pool['workers']), 'worker')} with {threads} each")
    if pool.get("frames_per_s_total") is not None:
        texts.append(f"{short(pool['frames_per_s_total'])} camera frames/s in total")
    if pool.get("wall_s") is not None:
        texts.append(f"{duration(pool['wall_s'])} of wall time")
    return ", ".join(texts)
