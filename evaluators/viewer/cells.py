"""Which cells of a run a page replays, and what it replays of them as JSON: an index of the run,
and one document for each cell.

Changed outcomes come first, then events, then a few quiet ones, the most different drives first.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

from alpasim_plugin.core.errors import InputError, SimrunError
from alpasim_plugin.core.flags import Flag
from alpasim_plugin.core.types import CameraSpec, RolloutLog
from alpasim_plugin.log import read_asl
from alpasim_plugin.log.run_folder.reader import read_json
from alpasim_plugin.log.run_folder.rows import Rollout
from alpasim_plugin.log.run_folder.schema import LOG_NAME, WHY_NAME
from evaluators.metrics.outcomes import has_ended, in_words, outcomes_of
from evaluators.opening import Run
from evaluators.report.flips import FLIPS_NAME, Flip, baseline_of, find_flips, key_of_entry
from evaluators.report.rollouts import clock_zero_us
from evaluators.viewer.drive_data import (
    Place,
    Tracks,
    drive_data,
    map_data,
    plans_part,
    recorded_drive,
)
from evaluators.viewer.pictures import (
    NO_FRAMES,
    Fineness,
    encoded,
    frame_rows,
    sources,
    trust_by_time,
)

DOING, READING = "choosing rollouts to watch", "reading a rollout to watch"
QUIET_CELLS = 3  # cells in which nothing happened, shown by default

Interest = Literal["flip", "event", "failure", "quiet"]
ORDER: tuple[Interest, ...] = ("flip", "event", "failure", "quiet")


@dataclass(frozen=True)
class WatchedCell:
    """The rollouts of one scene, policy and seed, one for each renderer, which are replayed side by
    side.

    Attributes:
        policy: The policy; where policies stand side by side, their renderer.
        take: 0, except where several logs of one renderer have the same scene, policy and seed.
        rollouts: In the order of the run's renderers; the failed ones too.
        flips: Changed outcomes among them.
    """

    scene: str
    policy: str
    seed: int
    take: int
    rollouts: tuple[Rollout, ...]
    flips: tuple[Flip, ...]
    by_policy: bool = False  # one renderer's rollouts, one for each policy

    def side(self, rollout: Rollout) -> str:
        """Give what a rollout is called beside the others."""
        return rollout.policy if self.by_policy else rollout.renderer

    @property
    def id(self) -> str:
        """Give a name for addresses and elements: letters and digits."""
        return hashlib.sha256(
            repr((self.scene, self.policy, self.seed, self.take)).encode()
        ).hexdigest()[:12]

    @property
    def name(self) -> str:
        """Give the name for people."""
        return f"{self.scene}, {self.policy}, seed {self.seed}" + (
            f", log {self.take + 1}" if self.take else ""
        )

    @property
    def interest(self) -> Interest:
        """Say why somebody would look at it."""
        if self.flips:
            return "flip"
        if any(outcomes_of(rollout) for rollout in self.rollouts if rollout.ok):
            return "event"
        return "quiet" if all(rollout.ok for rollout in self.rollouts) else "failure"

    @property
    def apart_m(self) -> float:
        """Say how different the drives are: between the longest and the shortest, and the largest
        distance from the recorded path.
        """
        driven = [m for r in self.rollouts if (m := r.metrics.get("dist_traveled_m")) is not None]
        aside = [m for r in self.rollouts if (m := r.metrics.get("lateral_distance_m")) is not None]
        return max(driven, default=0.0) - min(driven, default=0.0) + max(aside, default=0.0)

    @property
    def watchable(self) -> bool:
        """Tell whether any of its rollouts ran to its end."""
        return any(rollout.ok for rollout in self.rollouts)

    def outcomes(self) -> dict[str, str]:
        """Give the outcome of each rollout in words, by what it is called."""
        failed = {
            self.side(r): f"failed: {r.failure_class or 'unknown'}"
            for r in self.rollouts
            if not has_ended(r)
        }
        return {
            self.side(r): failed.get(self.side(r)) or in_words(outcomes_of(r))
            for r in self.rollouts
        }


@dataclass(frozen=True)
class Wanted:
    """What was asked for; an empty tuple is everything. A scene may be named as when it was driven:
    smoke/curve is smoke-curve.
    """

    scenes: Annotated[tuple[str, ...], Flag("Scene to show. Repeatable.", "--scene")] = ()
    policies: Annotated[tuple[str, ...], Flag("Policy to show. Repeatable.", "--policy")] = ()
    seeds: Annotated[tuple[int, ...], Flag("Seed to show. Repeatable.", "--seed")] = ()
    renderers: Annotated[
        tuple[str, ...], Flag("Renderer to show; all by default. Repeatable.", "--renderer")
    ] = ()

    @property
    def is_all(self) -> bool:
        """Tell whether nothing was asked for."""
        return not (self.scenes or self.policies or self.seeds or self.renderers)


def check_wanted(run: Run, wanted: Wanted) -> None:
    """Refuse what the run neither has nor plans.

    Raises:
        InputError: Something of that kind was asked for.
    """
    for flag, asked, known in (
        ("--scene", wanted.scenes, run.scenes),
        ("--policy", wanted.policies, run.policies),
        ("--renderer", wanted.renderers, run.renderers),
        (
            "--seed",
            wanted.seeds,
            sorted({*(run.info.get("seeds") or ()), *(r.seed for r in run.rollouts)}),
        ),
    ):
        strange = [one for one in asked if not _spellings(one) & {*known}]
        if strange:
            raise InputError(
                f"{flag} {strange[0]}: the run has none; it has {', '.join(map(str, known[:8]))}",
                "name one of these",
            )


def has_policies_alone(run: Run) -> bool:
    """Tell whether a run compares policies and not renderers."""
    return len(run.renderers) == 1 and len(run.policies) > 1


def cells_of(run: Run, wanted: Wanted = Wanted(), arms: bool = False) -> list[WatchedCell]:
    """List the cells of a run that were asked for, the most telling first.

    Args:
        run: The run.
        wanted: What was asked for.
        arms: Where the run has one renderer, its policies stand side by side.
    """
    by_policy = arms and has_policies_alone(run)
    grouped: dict[tuple[str, str, int, int], list[Rollout]] = {}
    base = baseline_of(run)
    rank = {
        name: i
        for i, name in enumerate(
            run.policies if by_policy else sorted(run.renderers, key=lambda name: name != base)
        )
    }
    scene = {name: i for i, name in enumerate(run.scenes)}
    for rollout in sorted(
        run.rollouts,
        key=lambda r: (
            scene[r.scene],
            *((r.seed, rank[r.policy]) if by_policy else (r.policy, r.seed, rank[r.renderer])),
        ),
    ):
        if not _asked(rollout, wanted):
            continue
        key, take = (
            (rollout.scene, rollout.renderer if by_policy else rollout.policy, rollout.seed),
            0,
        )
        while any(
            (r.renderer, r.policy) == (rollout.renderer, rollout.policy)
            for r in grouped.get((*key, take), ())
        ):
            take += 1
        grouped.setdefault((*key, take), []).append(rollout)
    flips: dict[tuple[str, str, int], list[Flip]] = {}
    for flip in find_flips(run)[0]:
        inside = (
            flip.base.renderer == flip.other.renderer
            if by_policy
            else flip.base.policy == flip.other.policy
        )
        if inside and _asked(
            flip.other, wanted
        ):  # a cell shows one policy behind all renderers, or the other way round
            fixed = flip.other.renderer if by_policy else flip.other.policy
            flips.setdefault((flip.other.scene, fixed, flip.other.seed), []).append(flip)
    cells = [
        WatchedCell(*key, tuple(members), tuple(flips.get(key[:3], ())), by_policy)
        for key, members in grouped.items()
    ]
    return sorted(
        cells, key=lambda cell: (ORDER.index(cell.interest), -cell.apart_m)
    )  # stable: equal ones stay in the run's order


def shown_by_default(
    cells: Sequence[WatchedCell], wanted: Wanted, at_most: int | None
) -> list[WatchedCell]:
    """Return the cells that a page tries to hold: all that are telling and `QUIET_CELLS` others, or
    all that were asked for.

    Args:
        cells: As `cells_of` returns them.
        wanted: What was asked for.
        at_most: Most cells; None is no limit.
    """
    watchable = [cell for cell in cells if cell.watchable]
    if wanted.is_all and at_most is None:
        quiet = [cell for cell in watchable if cell.interest == "quiet"]
        dropped = {cell.id for cell in quiet[QUIET_CELLS:]}
        watchable = [cell for cell in watchable if cell.id not in dropped]
    return watchable[:at_most]


def telling(
    cells: Iterable[WatchedCell], kinds: Sequence[Interest] = ("flip",)
) -> list[WatchedCell]:
    """Return the watchable cells of some kinds."""
    return [cell for cell in cells if cell.interest in kinds and cell.watchable]


def _asked(rollout: Rollout, wanted: Wanted) -> bool:
    pairs: tuple[tuple[object, Sequence[object]], ...] = (
        (rollout.scene, wanted.scenes),
        (rollout.policy, wanted.policies),
        (rollout.seed, wanted.seeds),
        (rollout.renderer, wanted.renderers),
    )
    return all(
        not asked or any(value in _spellings(one) for one in asked) for value, asked in pairs
    )


def _spellings(asked: object) -> set[object]:
    """Return what a name that was asked for may be in the tables."""
    return {asked, asked.replace("/", "-")} if isinstance(asked, str) else {asked}


Logs = Mapping[
    str, RolloutLog | SimrunError | None
]  # folder of a rollout -> its log, or why it cannot be read


def read_logs(run: Run, cell: WatchedCell) -> Logs:
    """Read the logs of a cell's finished rollouts: their own, or those that they were scored from;
    None where neither is there.
    """
    return {rollout.path: _read_log(run, rollout) for rollout in cell.rollouts if rollout.ok}


def _read_log(run: Run, rollout: Rollout) -> RolloutLog | SimrunError | None:
    path = run.file_of(rollout, LOG_NAME)
    if path is None:
        stated = run.manifest(rollout).get(
            "log"
        )  # as it was named to simrun score, so from the same working directory
        path = None if stated is None else Path(str(stated))
    try:
        return read_log(path) if path is not None and path.is_file() else None
    except SimrunError as error:
        return error  # the page says so in this rollout's place; the others are still shown


def read_log(path: Path) -> RolloutLog:
    """Read a log, or return what was read of it a moment ago: flips share their baseline's, and
    pages show what flips were found in.
    """
    return _log_as_of(path, path.stat().st_mtime_ns if path.exists() else 0)


@lru_cache(maxsize=6)  # two cells behind three renderers
def _log_as_of(path: Path, mtime_ns: int) -> RolloutLog:
    return read_asl(path)


def cell_data(
    run: Run, cell: WatchedCell, logs: Logs, fine: Fineness | None, camera: str | None = None
) -> dict[str, Any]:
    """Return everything that a page shows of a cell.

    Args:
        run: The run.
        cell: One of its cells.
        logs: Its logs.
        fine: How finely camera frames are kept; None for none.
        camera: The camera whose frames are kept; None is all.

    Raises:
        InputError: A file is damaged, or the run has no map of the scene.
    """
    content = run.scene_data(cell.scene)
    if content is None:
        raise InputError(
            f"{cell.name}: no file of scene {cell.scene} in {run.folder / 'scenes'}",
            "make the run again; runs of earlier versions kept no maps",
        )
    recorded = recorded_drive(content, cell.scene)
    place = Place(recorded[0], clock_zero_us(content, _first_us(run, cell, logs)))
    tracks = Tracks()
    drives: list[dict[str, Any]] = []
    for rollout in cell.rollouts:
        if not rollout.ok:
            drives.append(
                {
                    "renderer": cell.side(rollout),
                    "failed": f"{rollout.failure_class}: {rollout.failure}",
                }
            )
            continue
        log = logs[rollout.path]
        if isinstance(log, SimrunError):
            drives.append(
                {"renderer": cell.side(rollout), "failed": f"its log cannot be read: {log.message}"}
            )
            continue
        facts = frame_rows(run, rollout)
        drive = {"renderer": cell.side(rollout)} | drive_data(
            run, rollout, log, content, place, tracks, facts
        )
        drive |= {"why": run.href(rollout, WHY_NAME) or ""}
        if fine is not None:
            kept = [one for one in sources(run, rollout, log) if camera in (None, one.camera)]
            drive["cameras"] = [encoded(one, fine, place.zero_us) for one in kept]
            known = {} if log is None else {camera.name: camera for camera in log.info["cameras"]}
            for one in drive["cameras"]:
                trusted = {
                    place.ms([t_us])[0]: text
                    for t_us, text in trust_by_time(facts, one["name"]).items()
                }
                if trusted:
                    one["trust"] = [trusted.get(t, "") for t in one["t"]]
                if one["name"] in known:
                    one["lens"] = lens_data(known[one["name"]], one["width"])
            drive["no_frames"] = (
                "" if kept else no_frames(run.manifest(rollout), log is not None, camera)
            )
        drives.append(drive)
    ends = [drive["ego"]["t"][-1] for drive in drives if "ego" in drive]
    return {
        "id": cell.id,
        "map": map_data(content, recorded, place),
        "users": tracks.all,
        "drives": drives,
        "parts": plans_part(_flip_entries(run, cell), place, cell.by_policy),
        "end": max([*ends, 1]),
        "warmup": round(int(content.get("warmup_us") or 0) / 1000),
        "origin": place.origin.tolist(),
        "zero_us": place.zero_us,
    }


def lens_data(camera: CameraSpec, width_px: int) -> dict[str, Any]:
    """Return what projects rig coordinates into a picture of at most this width: fx, fy, cx, cy,
    and the mounting, 3 rows of 4.
    """
    scale = min(1.0, width_px / camera.width)
    k = [round(float(camera.K[at]) * scale, 3) for at in ((0, 0), (1, 1), (0, 2), (1, 2))]
    return {"k": k, "T": camera.T_rig_camera[:3].round(5).ravel().tolist()}


def _first_us(run: Run, cell: WatchedCell, logs: Logs) -> int:
    """Return the time of a cell's first logged pose."""
    firsts = [int(log.ego.t_us[0]) for log in logs.values() if isinstance(log, RolloutLog)]
    tables = (
        run.steps_of(rollout)["t_us"]
        for rollout in cell.rollouts
        if logs.get(rollout.path, "") is None
    )
    return min([*firsts, *(min(t.to_pylist()) for t in tables if len(t))], default=0)


def no_frames(manifest: Mapping[str, Any], has_log: bool, camera: str | None) -> str:
    """Say why a rollout has no pictures, and how to get them."""
    if not has_log and manifest.get("log"):
        return f"The log that this rollout was scored from is not at {manifest['log']}. Run simrun view where simrun score was run."
    return NO_FRAMES if camera is None else f"This rollout has no frames of a camera {camera}."


def index_data(
    run: Run, cells: Sequence[WatchedCell], here: Sequence[WatchedCell], state: Mapping[str, Any]
) -> dict[str, Any]:
    """Return what a page must know before it shows a cell.

    Args:
        run: The run.
        cells: All cells that were asked for, the most telling first.
        here: Those whose documents the page has or can get.
        state: ``notes`` (what was left out, one sentence each) and ``report`` (its address, or "").
    """
    ids, by_policy = {cell.id for cell in here}, any(cell.by_policy for cell in cells)
    units = {
        name: facts
        for table in (run.summary.get("metrics") or {}).values()
        for name, facts in table.items()
    }
    metrics = {}
    for name in run.table.ordered({*run.table, *units}):
        metric, stated = run.table.shown(name), units.get(name) or {}
        metrics[name] = {
            "unit": metric.unit or str(stated.get("unit") or ""),
            "help": metric.help,
            "flag": metric.is_flag,
        }
    return {
        "run": run.folder.resolve().name,
        "renderers": run.policies if by_policy else run.renderers,
        "baseline": next(
            (cell.side(flip.base) for cell in cells for flip in cell.flips), baseline_of(run)
        ),
        "first_curves": run.table.first_curves(),
        "metrics": metrics,
        "cells": [
            {
                "id": cell.id,
                "scene": cell.scene,
                "policy": cell.policy,
                "seed": cell.seed,
                "take": cell.take,
                "interest": cell.interest,
                "outcomes": cell.outcomes(),
                "flips": [
                    {
                        "renderer": cell.side(flip.other),
                        "was": flip.was,
                        "now": flip.now,
                        "tone": flip.tone,
                    }
                    for flip in cell.flips
                ],
                "here": cell.id in ids,
            }
            for cell in cells
        ],
        **state,
    }


def _flip_entries(run: Run, cell: WatchedCell) -> list[Mapping[str, Any]]:
    path = run.folder / FLIPS_NAME
    if not cell.flips or not path.is_file():
        return []
    keys = {flip.key for flip in cell.flips}
    entries = read_json(path).get("cells") or []
    return [entry for entry in entries if key_of_entry(entry) in keys]
