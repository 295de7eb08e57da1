"""How the rollouts of a run ended, counted by variant, with where and when."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from alpasim_plugin.log.run_folder.records import Manifest
from alpasim_plugin.log.run_folder.rows import Rollout
from evaluators.metrics.outcomes import (
    ENDINGS,
    OUTCOMES,
    ending_of,
    has_ended,
    outcome_events,
    outcomes_of,
    reached_end,
    told,
)
from evaluators.results import Endings, EventCount, EventPlace

Times = Mapping[str, Mapping[str, float]]  # rollout's folder -> outcome -> seconds after frame 0
LISTED = 20  # rollouts named per outcome in summary.json
DISTANCE = "lateral_distance_m"


def times_of(manifests: Iterable[Manifest]) -> Times:
    """Return when the outcomes of manifests began, by the folders of their rollouts: several logs
    may have one cell.
    """
    return {
        manifest.path: {name: event.t_s for name, event in outcome_events(manifest.events).items()}
        for manifest in manifests
    }


def outcome_table(rollouts: Sequence[Rollout], times: Times | None = None) -> dict[str, Endings]:
    """Count outcomes by variant.

    Args:
        rollouts: Those of a run, in its order.
        times: When outcomes began, as far as it is known.

    Returns:
        RENDERER/POLICY -> how its rollouts ended; of each outcome the first `LISTED` are named.
    """
    variants: dict[str, list[Rollout]] = {}
    for rollout in rollouts:
        variants.setdefault(rollout.variant, []).append(rollout)
    return {name: _of_variant(rollouts, times or {}) for name, rollouts in variants.items()}


def _of_variant(rollouts: Sequence[Rollout], times: Times) -> Endings:
    ended = [rollout for rollout in rollouts if has_ended(rollout)]
    distances = [
        v for rollout in rollouts if rollout.ok and (v := rollout.metrics.get(DISTANCE)) is not None
    ]
    counts = Counter(map(ending_of, rollouts))
    places: dict[str, list[EventPlace]] = {}
    for rollout in ended:
        began = times.get(rollout.path, {})
        for outcome in told(outcomes_of(rollout)):
            place = EventPlace(rollout.scene, rollout.seed, began.get(outcome.name))
            places.setdefault(outcome.name, []).append(place)
    return Endings(
        n_rollouts=len(rollouts),
        n_ended=len(ended),
        n_failed=sum(bool(outcomes_of(rollout)) for rollout in ended),
        n_reached_end=sum(reached_end(rollout) for rollout in ended),
        endings={name: counts[name] for name in ENDINGS if name in counts},
        outcomes={
            name: EventCount(len(places[name]), tuple(places[name][:LISTED]))
            for name in OUTCOMES
            if name in places
        },
        lateral_distance_m_median=float(np.median(distances)) if distances else None,
    )
