"""What a reader must know of the fixers of a run, and how fast the run was."""

from alpasim_plugin.log.run_folder.records import Pool
from evaluators.results import Summary
from evaluators.statistics.numbers import duration, listed_counts, plural, short

GUARD = "fixer-"


def fixer_cautions(summary: Summary) -> list[str]:
    """Say what a reader must know of the fixers before using the numbers."""
    cautions = []
    for name, entry in summary.fixers.items():
        if not entry.trained:
            cautions.append(
                f"{name} is {entry.label}: its results say nothing about a trained fixer."
            )
        events = refused(summary, name)
        if events:
            cautions.append(
                f"{name}: the fixer failed on {plural(sum(events.values()), 'frame')} of "
                f"{entry.frames} ({listed_counts(events)}); the raw frames were passed on."
            )
    return cautions


def refused(summary: Summary, renderer: str) -> dict[str, int]:
    """Return how many frames of a renderer the fixer's guard replaced, by kind of event."""
    events = summary.censoring[renderer].frame_events
    return {
        kind.removeprefix(GUARD): count
        for kind, count in sorted(events.items())
        if kind.startswith(GUARD)
    }


def pool_text(pool: Pool | None) -> str:
    """Say how many workers a run had, how many frames they made a second, and how long it took."""
    if pool is None:
        return ""
    threads = plural(pool.threads_per_worker, "thread")
    texts = [f"{plural(pool.workers, 'worker')} with {threads} each"]
    if pool.frames_per_s_total is not None:
        texts.append(f"{short(pool.frames_per_s_total)} camera frames/s in total")
    return ", ".join([*texts, f"{duration(pool.wall_s)} of wall time"])
