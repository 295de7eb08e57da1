"""What changed between a run and the one before it of the same scenes and seeds."""

from collections.abc import Sequence
from dataclasses import dataclass

from alpasim_plugin.log.run_folder.records import RunInfo
from alpasim_plugin.log.run_folder.schema import cell_name
from evaluators.results import Change, Endings, Summary


@dataclass(frozen=True)
class PastRun:
    """A finished run, as far as it can be compared with others.

    Attributes:
        info: ``run.json``.
        summary: ``summary.json``.
    """

    info: RunInfo
    summary: Summary

    def endings(self, variant: str) -> Endings | None:
        """Return how the rollouts of RENDERER/POLICY ended; None where it drove none."""
        return self.summary.outcomes.get(variant)


def changes_between(runs: Sequence[PastRun | None]) -> list[dict[str, Change]]:
    """Return for each run RENDERER/POLICY -> its change since the run before that drove the same
    scenes and seeds with it.

    Args:
        runs: The newest first; None for a run that is not finished or cannot be read.
    """
    changes: list[dict[str, Change]] = []
    for number, later in enumerate(runs):
        of_run: dict[str, Change] = {}
        changes.append(of_run)
        if later is None:
            continue
        for renderer in later.info.renderers:
            for policy in later.info.policies:
                variant = cell_name(renderer, policy)
                change = _change(later, runs, number + 1, variant)
                if change is not None:
                    of_run[variant] = change
    return changes


def _change(
    later: PastRun, runs: Sequence[PastRun | None], first: int, variant: str
) -> Change | None:
    """Return the change of a variant since the first of ``runs[first:]`` that can be compared."""
    now = later.endings(variant)
    if now is None:
        return None
    for place in range(first, len(runs)):
        earlier = runs[place]
        if earlier is None or not is_same_question(later.info, earlier.info):
            continue
        before = earlier.endings(variant)
        if before is not None and before.n_rollouts == now.n_rollouts:
            failures = failed_in(before), failed_in(now)
            return Change(place, *failures, more_failed=failures[1] - failures[0])
    return None


def failed_in(endings: Endings) -> int:
    """Count the rollouts of a variant that had an outcome or could not be run."""
    return endings.n_failed + endings.n_rollouts - endings.n_ended


def is_same_question(first: RunInfo, second: RunInfo) -> bool:
    """Tell whether two runs drove the same scenes, with the same content, seeds and preset, so that
    their counts can be compared.
    """
    return (
        _scene_contents(first) == _scene_contents(second)
        and set(first.seeds) == set(second.seeds)
        and (first.kind, first.preset) == (second.kind, second.preset)
    )


def _scene_contents(info: RunInfo) -> dict[str, str]:
    """Return SCENE -> digest of its content, of a run."""
    return {name: facts.content_hash for name, facts in info.scenes.items()}
