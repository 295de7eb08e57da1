"""Which cells of a run a page replays, and what it replays of them as JSON: an index of the run,
and one document for each cell.

Changed outcomes come first, then events, then a few quiet ones, the most different drives first.
"""

import hashlib
import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

from alpasim_plugin.cameras.lens import reach_of
from alpasim_plugin.core.errors import InputError, SimrunError
from alpasim_plugin.core.files import real
from alpasim_plugin.core.flags import Flag
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.core.types import CameraSpec, RolloutLog
from alpasim_plugin.log import read_asl
from alpasim_plugin.log.run_folder.rows import Rollout
from alpasim_plugin.log.run_folder.schema import LOG_NAME, WHY_NAME
from evaluators.metrics.outcomes import has_ended, in_words, outcomes_of
from evaluators.pages.drive_data import (
    Place,
    Tracks,
    drive_data,
    map_data,
    plans_part,
    scene_of,
)
from evaluators.pages.flips import (
    Flip,
    baseline_of,
    find_flips,
    flip_entries,
    key_of_entry,
    takes_of,
)
from evaluators.pages.images import (
    NO_FRAMES,
    Rows,
    encoded,
    frame_rows,
    sources,
    trust_by_time,
)
from evaluators.pages.rollouts import clock_zero_us
from evaluators.statistics.opening import Run

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
        key = repr((self.scene, self.policy, self.seed, self.take))
        return hashlib.sha256(key.encode()).hexdigest()[:12]

    @property
    def name(self) -> str:
        """Give the name for people."""
        take = f", log {self.take + 1}" if self.take else ""
        return f"{self.scene}, {self.policy}, seed {self.seed}{take}"

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
        """Say how different the rollouts are: between the longest and the shortest, and the largest
        distance from the recorded path.
        """
        driven_m, offsets_m = (
            [
                rollout.metrics[name] or 0.0
                for rollout in self.rollouts
                if rollout.metrics.get(name) is not None
            ]
            or [0.0]
            for name in ("dist_traveled_m", "lateral_distance_m")
        )
        return max(driven_m) - min(driven_m) + max(offsets_m)

    @property
    def watchable(self) -> bool:
        """Tell whether any of its rollouts ran to its end."""
        return any(rollout.ok for rollout in self.rollouts)

    def outcomes(self) -> dict[str, str]:
        """Give the outcome of each rollout in words, by what it is called."""
        return {
            self.side(rollout): in_words(outcomes_of(rollout))
            if has_ended(rollout)
            else f"failed: {rollout.failure_class or 'unknown'}"
            for rollout in self.rollouts
        }


@dataclass(frozen=True)
class Wanted:
    """What was asked for; an empty tuple is everything. A scene may be named as when it was driven:
    smoke/curve is smoke-curve.
    """

    scenes: Annotated[tuple[str, ...], Flag("Take this scene alone. Repeatable.", "--scene")] = ()
    policies: Annotated[
        tuple[str, ...], Flag("Take this policy alone. Repeatable.", "--policy")
    ] = ()
    seeds: Annotated[tuple[int, ...], Flag("Take this seed alone. Repeatable.", "--seed")] = ()
    renderers: Annotated[
        tuple[str, ...], Flag("Take this renderer alone. Repeatable.", "--renderer")
    ] = ()

    @property
    def axes(self) -> dict[str, tuple[object, ...]]:
        """Give what was asked for of each axis of a run."""
        names_by_axis = {
            "scene": self.scenes,
            "policy": self.policies,
            "seed": self.seeds,
            "renderer": self.renderers,
        }
        return {axis: names for axis, names in names_by_axis.items() if names}

    def takes(self, rollout: Rollout) -> bool:
        """Tell whether a rollout was asked for."""
        return all(
            any(_is_called(getattr(rollout, axis), name) for name in names)
            for axis, names in self.axes.items()
        )


def _is_called(value: object, name: object) -> bool:
    return value == name or value == str(name).replace("/", "-")


def check_wanted(run: Run, wanted: Wanted) -> None:
    """Refuse what no rollout of the run has.

    Raises:
        InputError: Something of that kind was asked for.
    """
    for axis, names in wanted.axes.items():
        names_of_run = list(dict.fromkeys(getattr(rollout, axis) for rollout in run.rollouts))
        for name in names:
            if not any(_is_called(value, name) for value in names_of_run):
                examples = ", ".join(map(str, names_of_run[:8]))
                raise InputError(
                    f"--{axis} {name}: the run has none; it has {examples}", "Name one of these."
                )


def cells_of(run: Run, wanted: Wanted = Wanted(), arms: bool = False) -> list[WatchedCell]:
    """List the cells of a run that were asked for, the most telling first.

    Args:
        run: The run.
        wanted: What was asked for.
        arms: Where the run has one renderer, its policies stand side by side.
    """
    by_policy = arms and len(run.renderers) == 1 and len(run.policies) > 1
    fixed, side = ("renderer", "policy") if by_policy else ("policy", "renderer")
    base = baseline_of(run)
    sides = run.policies if by_policy else sorted(run.renderers, key=lambda name: name != base)
    grouped: dict[tuple[str, str, int, int], list[Rollout]] = {}
    takes: Counter[tuple[str, str, str, int]] = Counter()
    rollouts = [rollout for rollout in run.rollouts if getattr(rollout, side) in sides]
    in_order = sorted(rollouts, key=lambda rollout: sides.index(getattr(rollout, side)))
    for rollout in in_order:
        if wanted.takes(rollout):
            take = takes[rollout.cell]
            takes[rollout.cell] += 1
            key = (rollout.scene, getattr(rollout, fixed), rollout.seed, take)
            grouped.setdefault(key, []).append(rollout)
    takes_by_key = dict(
        zip((rollout.key for rollout in run.rollouts), takes_of(run.rollouts), strict=True)
    )
    flips: dict[tuple[str, str, int, int], list[Flip]] = {}
    for flip in find_flips(run)[0]:
        other = flip.other
        held = getattr(flip.other, fixed)
        # a cell shows one policy behind all renderers, or the other way round
        if getattr(flip.base, fixed) == held and wanted.takes(other):
            key = (other.scene, held, other.seed, takes_by_key[other.key])
            flips.setdefault(key, []).append(flip)
    cells = [
        WatchedCell(*key, tuple(members), tuple(flips.get(key, ())), by_policy)
        for key, members in grouped.items()
    ]

    def rank(cell: WatchedCell) -> tuple[int, float, int, str, int, int]:
        place = run.scenes.index(cell.scene), cell.policy, cell.seed, cell.take
        return ORDER.index(cell.interest), -cell.apart_m, *place

    return sorted(cells, key=rank)


def shown_by_default(cells: Sequence[WatchedCell], wanted: Wanted) -> list[WatchedCell]:
    """Return the cells that a page tries to hold: all that are telling and `QUIET_CELLS` others, or
    all that were asked for.

    Args:
        cells: As `cells_of` returns them.
        wanted: What was asked for.
    """
    watchable = [cell for cell in cells if cell.watchable]
    if wanted.axes:
        return watchable
    quiet = [cell for cell in watchable if cell.interest == "quiet"]
    left_out = {cell.id for cell in quiet[QUIET_CELLS:]}
    return [cell for cell in watchable if cell.id not in left_out]


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
    try:
        if path is None:
            # As it was named to simrun score, so from the same working directory.
            stated = _scored_log(run, rollout)
            path = None if stated is None else Path(stated)
        return read_log(path) if path is not None and os.path.isfile(path) else None
    except SimrunError as error:
        return error  # the page says so in this rollout's place; the others are still shown


def _scored_log(run: Run, rollout: Rollout) -> str | None:
    """Return the path of the log that a rollout was scored from; None where it was driven."""
    manifest = run.manifest(rollout)
    return None if manifest is None else manifest.log


def read_log(path: Path) -> RolloutLog:
    """Read a log, or return what was read of it a moment ago: flips share their baseline's, and
    pages show what flips were found in.
    """
    return _log_as_of(path, path.stat().st_mtime_ns if os.path.exists(path) else 0)


@lru_cache(maxsize=6)  # two cells behind three renderers
def _log_as_of(path: Path, mtime_ns: int) -> RolloutLog:
    return read_asl(path)


def cell_data(run: Run, cell: WatchedCell, logs: Logs) -> JsonObject:
    """Return everything that a page shows of a cell.

    Args:
        run: The run.
        cell: One of its cells.
        logs: Its logs.

    Raises:
        InputError: A file is damaged, or the run has no map of the scene.
    """
    content, recorded = scene_of(run, cell.scene)
    firsts_us = [int(log.ego.t_us[0]) for log in logs.values() if isinstance(log, RolloutLog)]
    place = Place(recorded[0], clock_zero_us(content, min(firsts_us, default=0)))
    tracks = Tracks()
    drives: list[JsonObject] = [
        {"renderer": cell.side(rollout)} | _drive(run, rollout, logs, place, tracks)
        for rollout in cell.rollouts
    ]
    keys = {flip.key for flip in cell.flips}
    entries = [entry for entry in flip_entries(run) if key_of_entry(entry) in keys]
    ends = [drive["ego"]["t"][-1] for drive in drives if "ego" in drive]
    return {
        "id": cell.id,
        "map": map_data(content, recorded, place),
        "users": tracks.all,
        "drives": drives,
        "parts": plans_part(entries, place, cell.by_policy),
        "end": max([*ends, 1]),
        "warmup": round(int(content.get("warmup_us") or 0) / 1000),
        "origin": place.origin.tolist(),
        "zero_us": place.zero_us,
    }


def _drive(run: Run, rollout: Rollout, logs: Logs, place: Place, tracks: Tracks) -> JsonObject:
    """Return what a page draws of a rollout, camera frames included, or why it has nothing to draw.

    Args:
        run: The run.
        rollout: One of its rollouts.
        logs: By the rollout's path.
        place: Where numbers count from.
        tracks: Gets the ways of the road users.
    """
    if not rollout.ok:
        return {"failed": f"{rollout.failure_class}: {rollout.failure}"}
    log = logs.get(rollout.path)
    if log is None:
        file = _scored_log(run, rollout) or LOG_NAME
        return {"failed": f"its log cannot be read: {file} is missing"}
    if not isinstance(log, RolloutLog):
        return {"failed": f"its log cannot be read: {log.message}"}
    frames = frame_rows(run, rollout)
    drive = drive_data(run, rollout, log, place, tracks, frames)
    cameras = _cameras(run, rollout, log, place, frames)
    return drive | {
        "why": run.href(rollout, WHY_NAME) or "",
        "cameras": cameras,
        "no_frames": "" if cameras else NO_FRAMES,
    }


def _cameras(
    run: Run, rollout: Rollout, log: RolloutLog, place: Place, frames: Rows
) -> list[JsonObject]:
    """Return the camera frames of a rollout with the fixer's trust in each, and with the lens of a
    camera that the log describes.
    """
    cameras = [encoded(source, place.zero_us) for source in sources(run, rollout, log)]
    specs = {spec.name: spec for spec in log.info["cameras"]}
    for camera in cameras:
        trust = trust_by_time(frames, camera["name"])
        by_ms = dict(zip(place.ms(list(trust)), trust.values(), strict=True))
        if by_ms:
            camera["trust"] = [by_ms.get(t_ms, "") for t_ms in camera["t"]]
        spec = specs.get(camera["name"])
        lens = None if spec is None else lens_data(spec, camera["width"])
        if lens is not None:
            camera["lens"] = lens
    return cameras


def lens_data(camera: CameraSpec, width_px: int) -> JsonObject | None:
    """Return what projects rig coordinates into an image of at most this width, as ``lens.js`` reads
    it: the ``kind`` of lens, fx, fy, cx, cy at the calibrated size, the image's ``scale``, the
    mounting ``T``, 3 rows of 4, and of a lens its terms and how far it is described. None where its
    values make no lens.
    """
    fx, fy, cx, cy = (float(camera.K[index]) for index in ((0, 0), (1, 1), (0, 2), (1, 2)))
    facts = {
        "k": [fx, fy, cx, cy],
        "scale": min(1.0, width_px / camera.width),
        "T": camera.T_rig_camera[:3].ravel().tolist(),
    }
    lens = camera.lens
    if lens is None:
        return {"kind": "pinhole"} | facts
    try:
        reach = reach_of(camera)
    except InputError:  # of a log that was written elsewhere: its image has no overlay
        return None
    facts |= {"kind": lens.kind, "terms": list(lens.coefficients), "reach": reach._asdict()}
    if lens.kind == "ftheta":
        facts |= {"inverse": list(lens.pixel_to_angle), "linear": list(lens.linear)}
    return facts


def index_data(
    run: Run,
    cells: Sequence[WatchedCell],
    page_cells: Sequence[WatchedCell],
    notes: Sequence[str],
    report: str,
) -> JsonObject:
    """Return what a page must know before it shows a cell.

    Args:
        run: The run.
        cells: All cells that were asked for, the most telling first.
        page_cells: Those whose documents the page has.
        notes: What was left out, one sentence each.
        report: Address of the run's report, or "".
    """
    ids = {cell.id for cell in page_cells}
    tables = run.summary.metrics.values()
    metrics = {}
    for name in run.table.ordered({*run.table, *(name for table in tables for name in table)}):
        metric = run.table.shown(name)
        metrics[name] = {"unit": metric.unit, "help": metric.help, "flag": metric.is_flag}
        metrics[name] |= {"label": metric.label}
    bases = [cell.side(flip.base) for cell in cells for flip in cell.flips]
    rows = []
    for cell in cells:
        flips = [
            {"renderer": cell.side(flip.other)}
            | {"was": flip.was, "now": flip.now, "tone": flip.tone}
            for flip in cell.flips
        ]
        rows.append(
            {
                "id": cell.id,
                "scene": cell.scene,
                "policy": cell.policy,
                "seed": cell.seed,
                "take": cell.take,
                "interest": cell.interest,
                "outcomes": cell.outcomes(),
                "flips": flips,
                "here": cell.id in ids,
            }
        )
    return {
        "run": real(run.folder).name,
        "renderers": run.policies if any(cell.by_policy for cell in cells) else run.renderers,
        "baseline": bases[0] if bases else baseline_of(run),
        "first_curves": run.table.first_curves(),
        "metrics": metrics,
        "cells": rows,
        "notes": list(notes),
        "report": report,
    }
