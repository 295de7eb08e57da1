"""What the cameras saw at the instant of a run's worst change: the baseline, the variant that
failed, and a variant that repairs it, side by side.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.errors import SimrunError
from alpasim_plugin.core.types import U8, RolloutLog
from alpasim_plugin.log.images import smaller
from alpasim_plugin.log.run_folder.rows import Rollout
from alpasim_plugin.log.run_folder.schema import LOG_NAME, WHY_NAME
from evaluators.metrics.outcomes import first_failure, gravity, in_words, outcomes_of
from evaluators.pages.cells import read_log
from evaluators.pages.flips import find_flips
from evaluators.pages.images import Source, jpeg, sources
from evaluators.pages.overview import variant_name
from evaluators.statistics.opening import Run

SHOWN = 3
LOOKED_AT = 8  # changes, until one has an image
WIDTH_PX = 420


@dataclass(frozen=True)
class Shot:
    """The images of a rollout's cameras.

    Attributes:
        t_s: Seconds since the first camera frame.
        outcome: How that rollout ended.
        tone: Colour of the outcome.
        src: The images as one, a ``data:`` address.
        link: Where the rollout is shown, relative to the run folder.
    """

    variant: str
    scene: str
    t_s: float
    outcome: str
    tone: str
    src: str
    link: str | None


def worst_change(run: Run) -> list[Shot]:
    """Return at most three images of one scene and seed at one instant; none where no frames were
    kept.

    The instant is that of the first event of the rollout that changed for the worse, or else of the
    gravest failure; without a failure it is the middle of the rollout farthest from its path. What
    led to an event is shown: after a contact the camera may be inside the other vehicle.
    """
    flips, _ = find_flips(run)
    changes: Sequence[tuple[Rollout, Rollout | None]] = [
        (flip.other, flip.base) for flip in flips if flip.tone != "better"
    ]
    if not changes:
        changes = [(rollout, None) for rollout in sorted(run.rollouts, key=_rank) if rollout.ok][:1]
    # A rollout that broke off before it saw anything has no image: the next change stands there.
    for worst, base in changes[:LOOKED_AT]:
        t_us = _instant_of(run, worst)
        if t_us is not None and _shot(run, worst, t_us) is not None:
            return _shots_at(run, worst, base, t_us)
    return []


def _instant_of(run: Run, worst: Rollout) -> int | None:
    """Return the instant of a rollout that is shown, microseconds; None without a log."""
    log = _log_of(run, worst)
    if log is None:
        return None
    if not worst.ok:
        return int(log.ego.t_us[-1])
    manifest = run.manifest(worst)
    failure = None if manifest is None else first_failure(manifest.events)
    return int(log.ego.t_us[len(log.ego.t_us) // 2] if failure is None else failure.t_us)


def _shots_at(run: Run, worst: Rollout, base: Rollout | None, t_us: int) -> list[Shot]:
    """Return the images of a rollout, of what it is compared with, and of others beside it."""
    chosen = {worst.key, *(() if base is None else (base.key,))}
    beside = [
        rollout
        for rollout in run.by_scene[worst.scene]
        if rollout.seed == worst.seed
        and (rollout.policy == worst.policy or rollout.renderer == worst.renderer)
    ]
    bases = run.info.bases
    for rollout in sorted(beside, key=lambda other: bases.get(other.renderer) != worst.renderer):
        if len(chosen) < SHOWN:
            chosen.add(rollout.key)
    shots = (_shot(run, rollout, t_us) for rollout in beside if rollout.key in chosen)
    return [shot for shot in shots if shot is not None]


def _rank(rollout: Rollout) -> tuple[int, float]:
    """Return the order of rollouts: the gravest outcome, or else the farthest from its path first."""
    return gravity(rollout), -(rollout.metrics.get("lateral_distance_m") or 0.0)


def _log_of(run: Run, rollout: Rollout) -> RolloutLog | None:
    path = run.file_of(rollout, LOG_NAME) or run.file_of(rollout, f"{LOG_NAME}.part")
    try:
        return None if path is None else read_log(path)
    except SimrunError:
        return None  # the report says elsewhere what cannot be read


def _shot(run: Run, rollout: Rollout, t_us: int) -> Shot | None:
    log = _log_of(run, rollout)
    cameras = [] if log is None else sources(run, rollout, log)
    images = [
        image for image in (_frame_at(camera, t_us) for camera in cameras) if image is not None
    ]
    if log is None or not images:
        return None
    outcomes = outcomes_of(rollout)
    # The first camera's image above a row of the others'.
    first, *others = images
    rows = [smaller(first, WIDTH_PX)]
    if others:
        small = [smaller(image, rows[0].shape[1] // len(others)) for image in others]
        row = np.zeros((max(map(len, small)), *rows[0].shape[1:]), dtype=np.uint8)
        step = row.shape[1] // len(others)
        for i, image in enumerate(small):
            row[: len(image), i * step : i * step + image.shape[1]] = image
        rows.append(row)
    return Shot(
        variant_name(run, rollout.variant),
        rollout.scene,
        (t_us - log.render_start_us) * 1e-6,
        in_words(outcomes),
        "worse" if outcomes else "better",
        f"data:image/jpeg;base64,{jpeg(np.concatenate(rows))}",
        run.href(rollout, WHY_NAME) or run.href(rollout),
    )


def _frame_at(source: Source, t_us: int) -> U8 | None:
    """Return the newest image ``(H, W, 3)`` at an instant, or the first one; None where the images
    cannot be decoded.
    """
    try:
        if source.images:
            before = [image for image in source.images if image.end_us <= t_us]
            return source.decoded(before[-1] if before else source.images[0])
        newest = None
        for taken_us, image in source.filmed():
            if newest is not None and taken_us > t_us:
                break
            newest = image
        return newest
    except SimrunError:
        return None
