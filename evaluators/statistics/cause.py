"""Why a rollout failed, as far as its run shows it: the evidence in sentences, the most telling
first, and what a page draws of it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import inside
from alpasim_plugin.core.json_types import JsonView
from alpasim_plugin.core.types import RolloutLog
from alpasim_plugin.log.run_folder.reader import last_output
from alpasim_plugin.log.run_folder.records import DriveEvent, PolicyCheck
from alpasim_plugin.log.run_folder.rows import Rollout
from alpasim_plugin.log.run_folder.schema import OUTPUT_NAME
from evaluators.metrics.measured import BEYOND
from evaluators.metrics.outcomes import (
    ENDED,
    OUTCOMES,
    SHORT_OF_END,
    ending_of,
    first_failure,
    in_words,
    outcomes_of,
    worst_of,
)
from evaluators.statistics.alike import common_to_failures
from evaluators.statistics.evidence import Failure, contact_of_failure, failure_facts
from evaluators.statistics.opening import Run
from evaluators.statistics.sentences import beyond_reason, seen_before

CHECK = "Check of the policy before the run: "
# Notes of a check, and the outcomes beside which they are shown.
TELLING = {
    "lag": tuple(OUTCOMES),
    "images": ("collision_any", "collision_at_fault", "offroad", "wrong_lane", "left_route"),
    "route_rig": ("offroad", "wrong_lane", "left_route"),
    "standstill": ("stalled",),
}
# Of a policy of simrun, or of one behind an address.
UNCHECKED = PolicyCheck(None)


@dataclass(frozen=True)
class Parting:
    """When plans part from those behind another renderer, or of another policy.

    Attributes:
        name: The renderer or the policy.
        kind: ``renderer`` or ``policy``.
        at_s: Seconds from the first camera frame to the first query at which they are apart.
        gap_m: How far apart they are then.
        images: Files of the other's image and the own one at that query; none of a policy, which
            sees the same.
    """

    name: str
    kind: str
    at_s: float
    gap_m: float
    images: tuple[Path, ...] = ()


@dataclass(frozen=True)
class Cause:
    """What is known of how a rollout ended.

    Attributes:
        outcome: In words.
        failed_us: When it failed first; None where it did not.
        start_us: The first camera frame.
        sentences: What the run shows, the most telling first.
        partings: When plans part from others'.
        log: As far as it was written; None where there is none.
        failure: The seconds before it failed, measured; None where nothing could be measured.
    """

    rollout: Rollout
    outcome: str
    failed_us: int | None
    start_us: int
    sentences: Sequence[str]
    partings: Sequence[Parting]
    log: RolloutLog | None
    failure: Failure | None = None

    @property
    def failed_s(self) -> float | None:
        """Give when it failed, seconds from the first camera frame."""
        return None if self.failed_us is None else (self.failed_us - self.start_us) * 1e-6


def worst_failure(run: Run, rollouts: Sequence[Rollout] | None = None) -> Rollout:
    """Return the rollout of a run that failed worst; see `worst_of`.

    Args:
        run: The run.
        rollouts: Those of it that are compared; all by default.

    Raises:
        InputError: No rollout failed.
    """
    worst = worst_of(run.rollouts if rollouts is None else rollouts)
    if worst is None:
        raise InputError(
            f"{run.folder}: no rollout of this run failed",
            "Name a rollout: simrun why RUN/RENDERER/POLICY/SCENE/SEED.",
        )
    return worst


def cause_of(
    run: Run,
    rollout: Rollout,
    entries: Sequence[JsonView],
    log: RolloutLog | None,
    frame_rows: Sequence[Mapping[str, Any]],
) -> Cause:
    """Return what the files of a run say of how a rollout ended.

    Args:
        run: The run.
        rollout: One of its rollouts.
        entries: Entries of ``flips.json`` about it: when its plans part from those of others.
        log: As far as it was written; None where there is none.
        frame_rows: Facts of its camera frames, as ``frames.jsonl`` has them.

    Raises:
        InputError: A file of the run is damaged.
    """
    manifest = run.manifest(rollout)
    first = None if manifest is None else first_failure(manifest.events)
    failed_us = None if first is None else first.t_us
    start_us = 0 if log is None else log.render_start_us
    if log is not None and not rollout.ok:
        failed_us = int(log.ego.t_us[-1])
    partings = [
        _parting_of(run, rollout, entry, start_us)
        for entry in entries
        if entry.get("t_us") is not None
    ]
    outcomes = outcomes_of(rollout)
    outcome = in_words(outcomes) if outcomes else ending_of(rollout)
    check = run.info.policy_checks.get(rollout.policy, UNCHECKED)
    sentences = [f"{CHECK}{text}." for _, text in check.breaches]
    if not rollout.ok:
        outcome = f"{rollout.failure_class}: {rollout.failure}"
        last_lines = last_output(run.folder / rollout.path / OUTPUT_NAME)
        sentences = [*(sentences or [rollout.failure]), *last_lines]
    failure = None
    if log is not None and rollout.ok:
        failure = _measured(run, rollout, log, first, failed_us)
    sentences += _evidence(run, rollout, failure)
    sentences += _telling_notes(check, outcomes)
    sentences += [
        f"Plans part from those of the {parting.kind} {parting.name} at {parting.at_s:.1f} s, "
        f"by {parting.gap_m:.2f} m."
        for parting in partings
    ]
    made_up = "" if failed_us is None else seen_before(frame_rows, failed_us)
    sentences += [f"{made_up}."] if made_up else []
    if failed_us is not None and BEYOND in run.table and rollout.ok:
        reason = beyond_reason(run.scene_data(rollout.scene))
        sentences += beyond_sentences(run.steps_of(rollout), failed_us, reason)
    ended = None if manifest is None else manifest.ended
    if rollout.ok and ended in ENDED:
        sentences.append(f"The rollout ended since {ENDED[ended]}.")
    return Cause(rollout, outcome, failed_us, start_us, sentences, partings, log, failure)


def beyond_sentences(steps: pa.Table, failed_us: int, reason: str) -> list[str]:
    """Say since when, before a failure, the ego drove beyond the range of the scene, or that this is
    not known; nothing where it did not at the failure.

    Args:
        steps: Of the rollout, as `Run.steps_of` reads them.
        failed_us: When it failed.
        reason: Of `beyond_reason`.
    """
    keep = (pc.field("metric") == BEYOND) & (pc.field("t_us") <= failed_us)
    rows = steps.filter(keep).sort_by("t_us")
    flags = rows["value"].to_pylist()
    if flags and not rows["valid"][-1].as_py():
        return [f"Whether it can be trusted there is not known: {rows['reason'][-1].as_py()}."]
    if not flags or not flags[-1]:
        return []
    since = len(flags) - [*flags[::-1], 0.0].index(0.0)
    since_s = (failed_us - rows["t_us"][since].as_py()) * 1e-6
    return [f"For the last {since_s:.1f} s before the failure it drove {reason}."]


def _measured(
    run: Run, rollout: Rollout, log: RolloutLog, first: DriveEvent | None, failed_us: int | None
) -> Failure | None:
    """Measure the seconds before a failure, or before an end short of the path's; None where a
    rollout had neither.
    """
    outcomes = outcomes_of(rollout)
    if failed_us is None and ending_of(rollout) == SHORT_OF_END:
        failed_us = int(log.ego.t_us[-1])
    if failed_us is None:
        return None
    manifest = run.manifest(rollout)
    contact = None
    if manifest is not None and first is not None:
        contact = contact_of_failure(log, first, manifest.contacts)
    content = run.scene_data(rollout.scene) or {}
    return Failure.of(log, failed_us, outcomes, contact, content)


def _evidence(run: Run, rollout: Rollout, failure: Failure | None) -> list[str]:
    """Return what the run shows of a failure: what decides it among its rollouts, what happened
    before it, what else they have in common.
    """
    common = common_to_failures(run, rollout)
    facts = [] if failure is None else failure_facts(failure)
    return [
        *(fact.sentence for fact in common if fact.decisive),
        *facts[:1],
        *behind_others(run, rollout),
        *facts[1:],
        *(fact.sentence for fact in common if not fact.decisive),
    ]


def _telling_notes(check: PolicyCheck, outcomes: frozenset[str]) -> list[str]:
    """Return what the check noted of a policy that has to do with its outcomes. It is about the
    policy, and stands behind what is about this failure.
    """
    notes = sorted(check.notes, key=lambda note: note[0] != "lag")
    return [f"{CHECK}{text}." for name, text in notes if outcomes & {*TELLING.get(name, ())}]


def _parting_of(run: Run, rollout: Rollout, entry: JsonView, start_us: int) -> Parting:
    """Return where plans part by an entry of ``flips.json``; a policy sees the same images."""
    at_s = (int(entry["t_us"]) - start_us) * 1e-6
    gap_m = float(entry["gap_m"])
    if entry["baseline"] == rollout.renderer:
        name = str(entry["against"]).removeprefix(rollout.renderer + "/")
        return Parting(name, "policy", at_s, gap_m)
    paths = [inside(run.folder, name) for name in (entry.get("frames") or {}).values()]
    images = tuple(path for path in paths if path is not None)
    return Parting(str(entry["baseline"]), "renderer", at_s, gap_m, images)


def behind_others(run: Run, rollout: Rollout) -> list[str]:
    """Say behind which renderers of the run the same rollout ends without an event."""
    better = [
        other.renderer
        for other in run.rollouts
        if other.ok and other.cell[1:] == rollout.cell[1:] and not outcomes_of(other)
    ]
    if not better or not outcomes_of(rollout):
        return []
    return [f"Behind {' and '.join(better)} the same rollout ends without an event."]
