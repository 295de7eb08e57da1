"""The page of evidence for one rollout, a self-contained HTML file made of what the run stored: how
it ended, what the policy saw, planned and said of itself, what other renderers show at the same
poses, where plans part, and what to ask next.
"""

from __future__ import annotations

import base64
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from markupsafe import Markup

from alpasim_plugin.core.atomic import write_text
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import interpolate, inverse, transform_points
from alpasim_plugin.core.json_types import JsonObject, JsonView
from alpasim_plugin.core.reading import inside, read_bytes, real
from alpasim_plugin.core.types import F64, U8, RolloutLog
from alpasim_plugin.log import decode_image, read_facts
from alpasim_plugin.log.debug import WIDTH_PX, debug_row
from alpasim_plugin.log.images import smaller
from alpasim_plugin.log.run_folder.reader import last_output, read_json
from alpasim_plugin.log.run_folder.rows import Rollout
from alpasim_plugin.log.run_folder.schema import (
    DEBUG_NAME,
    LOG_NAME,
    OUTPUT_NAME,
    SAME_POSES,
    WHY_NAME,
    cell_name,
)
from evaluators.metrics.outcomes import (
    OUTCOMES,
    SHORT_OF_END,
    ending_of,
    first_failure,
    in_words,
    outcomes_of,
)
from evaluators.opening import Run
from evaluators.report.rollouts import clock_zero_us
from evaluators.viewer.cells import lens_data, read_log
from evaluators.viewer.drive_data import (
    MAX_SAMPLES,
    Place,
    half_seconds,
    map_data,
    scene_of,
    user_data,
)
from evaluators.viewer.evidence import plan_facts
from evaluators.viewer.page import as_json, fill
from evaluators.viewer.pictures import frame_rows, jpeg, seen_before

JPEG_START = b"\xff\xd8"
BEFORE_US, AFTER_US = 6_000_000, 1_000_000  # of the failure, that are shown
MOST_QUERIES = 48
SCRIPTS = ("theme.js", "timeline.js", "overlay.js", "cause.js")
STYLES = ("theme.css", "report.css", "cause.css")
Item = TypeVar("Item")


@dataclass(frozen=True)
class Query:
    """One query of the policy.

    Attributes:
        T_world_rig: ``(4, 4)``: where the ego was.
        speed_mps: Of the ego.
        route: ``(N, 2)`` metres, rig frame, as the policy received it; empty where unknown.
        lines: The plan and its samples, each ``(N, 2)`` metres, rig frame, every half second.
        images: What each renderer showed of the first camera at that pose: time, encoded image.
        debug: A row of `alpasim_plugin.log.debug.debug_row`.
    """

    t_us: int
    T_world_rig: F64
    speed_mps: float
    route: F64
    lines: Sequence[F64]
    images: Mapping[str, tuple[int, bytes]]
    debug: JsonView


@dataclass(frozen=True)
class Parting:
    """When plans part from those behind another renderer, or of another policy.

    Attributes:
        name: The renderer or the policy.
        kind: ``renderer`` or ``policy``.
        t_us: The first query at which they are apart.
        gap_m: How far apart they are then.
        images: The other's image and the own one at that query, ``(H, W, 3)`` each; none of a
            policy, which sees the same.
    """

    name: str
    kind: str
    t_us: int
    gap_m: float
    images: Sequence[U8] = ()


@dataclass(frozen=True)
class Cause:
    """What is known of how a rollout ended.

    Attributes:
        outcome: In words.
        failed_us: When it failed first; None where it did not.
        start_us: The first camera frame.
        sentences: What the run shows, the most telling first.
        queries: Those to show, in order of time.
        partings: When plans part from others'.
        commands: What can be asked next: a key, what it shows, the command.
        log: As far as it was written; None where there is none.
    """

    rollout: Rollout
    outcome: str
    failed_us: int | None
    start_us: int
    sentences: Sequence[str]
    queries: Sequence[Query]
    partings: Sequence[Parting]
    commands: Sequence[tuple[str, str, str]]
    log: RolloutLog | None


def worst_failure(run: Run) -> Rollout:
    """Return the rollout of a run that failed worst: one that broke off, then the gravest outcome.

    Raises:
        InputError: No rollout failed.
    """
    gravity = {name: number for number, name in enumerate(OUTCOMES)}

    def rank(rollout: Rollout) -> int:
        if not rollout.ok:
            return -1
        return min((gravity[name] for name in outcomes_of(rollout)), default=len(gravity))

    worst = min(run.rollouts, key=rank, default=None)
    if worst is None or rank(worst) == len(gravity):
        raise InputError(
            f"{run.folder}: no rollout of this run failed",
            "Name a rollout: simrun why RUN/RENDERER/POLICY/SCENE/SEED.",
        )
    return worst


def cause_of(run: Run, rollout: Rollout, entries: Sequence[JsonView]) -> Cause:
    """Return what the files of a run say of how a rollout ended.

    Args:
        run: The run.
        rollout: One of its rollouts.
        entries: Entries of ``flips.json`` about it: when its plans part from those of others.

    Raises:
        InputError: A file of the run is damaged.
    """
    log = _log_so_far(run, rollout)
    start_us, failed_us = 0, failed_at(run.manifest(rollout))
    queries: list[Query] = []
    if log is not None:
        start_us = log.render_start_us
        if not rollout.ok:
            failed_us = int(log.ego.t_us[-1])
        queries = _queries(run, rollout, log, failed_us)
    partings = [
        _parting_of(run, rollout, entry) for entry in entries if entry.get("t_us") is not None
    ]
    outcomes = outcomes_of(rollout)
    outcome = in_words(outcomes) if outcomes else ending_of(rollout)
    breaches, notes = _checked(run, rollout)
    sentences = list(breaches)
    if not rollout.ok:
        outcome = f"{rollout.failure_class}: {rollout.failure}"
        said = last_output(run.folder / rollout.path / OUTPUT_NAME)
        sentences = [*(sentences or [rollout.failure]), *said]
    sentences += [*behind_others(run, rollout), *notes]
    if log is not None and rollout.ok:
        ended_us = int(log.ego.t_us[-1]) if outcome == SHORT_OF_END else failed_us
        if ended_us is not None:
            sentences += plan_facts(log, ended_us, outcomes, _met(run, rollout))
    for one in partings:
        at_s = (one.t_us - start_us) * 1e-6
        sentences.append(
            f"Plans part from those of the {one.kind} {one.name} at {at_s:.1f} s, "
            f"by {one.gap_m:.2f} m."
        )
    if failed_us is not None:
        made_up = seen_before(frame_rows(run, rollout), failed_us)
        sentences += [f"{made_up}."] if made_up else []
    return Cause(
        rollout=rollout,
        outcome=outcome,
        failed_us=failed_us,
        start_us=start_us,
        sentences=sentences,
        queries=queries,
        partings=partings,
        commands=commands(run, rollout, start_us, failed_us, partings),
        log=log,
    )


def _log_so_far(run: Run, rollout: Rollout) -> RolloutLog | None:
    """Return the log of a rollout; of one that broke off, the part that was written."""
    path = run.file_of(rollout, LOG_NAME) or run.file_of(rollout, f"{LOG_NAME}.part")
    if path is None:
        return None
    try:
        return read_log(path)
    except InputError:
        if rollout.ok:
            raise
        return None  # it broke off before there was anything to show


# Notes of a check, and the outcomes beside which they are shown.
TELLING = {
    "lag": tuple(OUTCOMES),
    "images": ("collision_any", "collision_at_fault", "offroad", "wrong_lane", "left_route"),
    "route_rig": ("offroad", "wrong_lane", "left_route"),
    "standstill": ("stalled",),
}


def _checked(run: Run, rollout: Rollout) -> tuple[list[str], list[str]]:
    """Return what the check of the policy found before the run: breaches, and the notes that are
    telling beside the outcome.
    """
    checks = (run.info.get("policy_checks") or {}).get(rollout.policy) or {}
    had = outcomes_of(rollout)
    notes = sorted(checks.get("notes") or (), key=lambda note: note[0] != "lag")
    telling = [note for note in notes if had & {*TELLING.get(note[0], ())}]
    breaches, shown = (
        [f"Check of the policy before the run: {text}." for _, text in found]
        for found in (checks.get("breaches") or (), telling)
    )
    return breaches, shown


def _met(run: Run, rollout: Rollout) -> str:
    """Return the road user of the first contact; empty where there is none."""
    contacts = run.manifest(rollout).get("contacts") or ()
    return str(contacts[0]["actor_id"]) if contacts else ""


def failed_at(manifest: JsonView) -> int | None:
    """Return when a rollout failed first, microseconds; None where it did not."""
    first = first_failure(manifest)
    return None if first is None else int(first["t_us"])


def chosen(all_of: Sequence[Item], failed_us: int | None, times_us: Sequence[int]) -> list[Item]:
    """Return at most `MOST_QUERIES` of what has these times: what lies before the failure, or an
    even choice.
    """
    near = [
        one
        for one, t in zip(all_of, times_us, strict=True)
        if failed_us is None or failed_us - BEFORE_US <= t <= failed_us + AFTER_US
    ]
    return near[::-1][:: -(-len(near) // MOST_QUERIES) or 1][::-1]


def _queries(run: Run, rollout: Rollout, log: RolloutLog, failed_us: int | None) -> list[Query]:
    """Return the queries of a log that the page shows, with what the run stored of them."""
    camera = next(iter(log.info["cameras"]), None)
    images = [image for image in log.images if camera is not None and image.camera == camera.name]
    ends_us = np.array([image.end_us for image in images])
    speeds = np.zeros(len(log.ego))
    if len(log.ego) > 1:
        seconds = (log.ego.t_us - log.ego.t_us[0]) * 1e-6
        speeds = np.linalg.norm(np.gradient(log.ego.xyz[:, :2], seconds, axis=0), axis=1)
    said = run.file_of(rollout, DEBUG_NAME)
    debug: dict[Any, Any] = {}
    if said is not None:
        debug = {row["t_us"]: row for row in read_facts(said)}
    others = same_poses(run, rollout)
    plans = [plan for plan in log.plans if len(plan.trajectory) > 1]
    queries = []
    for plan in chosen(plans, failed_us, [plan.now_us for plan in plans]):
        pose = interpolate(log.ego, [plan.now_us])[0] @ inverse(log.T_rig_box)
        lines = [
            half_seconds(line.t_us, transform_points(inverse(pose), line.xyz))
            for line in (plan.trajectory, *plan.samples[:MAX_SAMPLES])
        ]
        newest = int(np.searchsorted(ends_us, plan.now_us, "right")) - 1
        shown: dict[str, tuple[int, bytes]] = {}
        if newest >= 0:
            t_us = images[newest].end_us
            shown[rollout.renderer] = t_us, images[newest].data
            shown |= {name: (t_us, at[t_us]) for name, at in others.items() if t_us in at}
        queries.append(
            Query(
                t_us=plan.now_us,
                T_world_rig=pose,
                speed_mps=float(np.interp(plan.now_us, log.ego.t_us, speeds)),
                route=plan.route,
                lines=lines,
                images=shown,
                debug=debug.get(plan.now_us) or debug_row({}),
            )
        )
    return queries


def same_poses(run: Run, rollout: Rollout) -> dict[str, dict[int, bytes]]:
    """Return what the run stored of its other renderers at the poses of a rollout: by renderer and
    time, encoded images.
    """
    path = run.file_of(rollout, SAME_POSES)
    if path is None:
        return {}
    try:
        return {
            name: {int(t_us): base64.b64decode(image) for t_us, image in images}
            for name, images in read_json(path).items()
        }
    except (AttributeError, TypeError, ValueError) as error:
        raise InputError(
            f"{path}: {error}", "Delete the file; the page is made without it."
        ) from error


def write_cause(run: Run, cause: Cause) -> Path:
    """Write the page into the folder of the rollout and return its path.

    Raises:
        InputError: The run has no map of the scene.
        InfrastructureError: The disk refuses.
    """
    rollout = cause.rollout
    path = run.folder / rollout.path / WHY_NAME
    report = "../" * len(Path(rollout.path).parts) + "report.html"
    names = dict.fromkeys(name for query in cause.queries for name in query.images)
    html = fill(
        "cause.html.j2",
        SCRIPTS,
        STYLES,
        cause=cause,
        document=Markup(as_json(_document(run, cause))),
        renderers=[name for name in names if name != rollout.renderer],
        has_images=bool(names),
        partings=[_parting(one, cause.start_us) for one in cause.partings],
        run=real(run.folder).name,
        report=report,
        failed_s=None if cause.failed_us is None else (cause.failed_us - cause.start_us) * 1e-6,
    )
    write_text(path, html)
    return path


def _document(run: Run, cause: Cause) -> JsonObject:
    """Return what the script of the page draws; without a log, no query."""
    rollout, log = cause.rollout, cause.log
    if log is None:
        return {"queries": [], "lens": None, "failed": None}
    content, recorded = scene_of(run, rollout.scene)
    place = Place(recorded[0], clock_zero_us(content, int(log.ego.t_us[0])))
    lens, scale = None, 1.0
    if log.info["cameras"]:
        camera = log.info["cameras"][0]
        scale = min(1.0, WIDTH_PX / camera.width)
        lens = lens_data(camera, WIDTH_PX)
    return {
        "own": rollout.renderer,
        "map": map_data(content, recorded, place),
        "users": [user_data(actor, place) for actor in log.actors.values()],
        "ego": place.track(log.ego),
        "rear": round(100 * float(log.T_rig_box[0, 3])),
        "lens": lens,
        "failed": None if cause.failed_us is None else place.ms([cause.failed_us])[0],
        "queries": [_query(query, place, scale) for query in cause.queries],
    }


def _query(query: Query, place: Place, scale: float) -> JsonObject:
    """Return a query for the page: times in milliseconds, lines in world centimetres, boxes in
    pixels of the page's image.
    """

    def line(xy: F64) -> list[list[int]]:
        """Return rig coordinates ``(N, 2)`` in world centimetres, without rows of NaN."""
        known = np.asarray(xy, dtype=np.float64).reshape(-1, 2)
        known = known[np.isfinite(known).all(axis=1)]
        rig = np.column_stack([known, np.zeros(len(known))])
        return place.cm(transform_points(query.T_world_rig, rig)[:, :2])

    def image(data: bytes) -> str:
        if scale == 1.0 and data.startswith(JPEG_START):
            return base64.b64encode(data).decode()
        return jpeg(smaller(decode_image(data, "a camera frame"), WIDTH_PX))

    debug = dict(query.debug)
    debug["lines"] = [[name, line(xy)] for name, xy in debug["lines"]]
    debug["boxes"] = [
        [name, *(round(scale * side, 1) for side in box)]
        for name, boxes in debug["boxes"]
        for box in boxes
    ]
    return {
        "t": place.ms([query.t_us])[0],
        "speed": round(query.speed_mps, 2),
        "route": line(query.route),
        "plan": [line(one) for one in query.lines],
        "seen": {
            name: {"jpeg": image(data), "t": place.ms([t_us])[0]}
            for name, (t_us, data) in query.images.items()
        },
        "said": debug,
    }


def _parting_of(run: Run, rollout: Rollout, entry: JsonView) -> Parting:
    """Return where plans part by an entry of ``flips.json``; a policy sees the same images."""
    t_us, gap_m = int(entry["t_us"]), float(entry["gap_m"])
    if entry["baseline"] == rollout.renderer:
        name = str(entry["against"]).removeprefix(rollout.renderer + "/")
        return Parting(name, "policy", t_us, gap_m)
    paths = [inside(run.folder, name) for name in (entry.get("frames") or {}).values()]
    images = [decode_image(read_bytes(path), str(path)) for path in paths if path is not None]
    is_pair = len(images) == 2 and images[0].shape == images[1].shape
    return Parting(str(entry["baseline"]), "renderer", t_us, gap_m, images if is_pair else ())


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


def commands(
    run: Run, rollout: Rollout, start_us: int, failed_us: int | None, partings: Sequence[Parting]
) -> list[tuple[str, str, str]]:
    """Return what can be asked next: a key, what it shows, the command."""
    if not rollout.ok:
        return [
            ("c", "test the policy alone", f"simrun check policy {shlex.quote(rollout.policy)}")
        ]
    cell = shlex.quote(f"{run.folder}/{cell_name(*rollout.cell)}")
    parted_us = partings[0].t_us if partings else failed_us or start_us
    at_s = max(0.0, (parted_us - start_us) * 1e-6)
    others = [one.name for one in partings if one.kind == "renderer"]
    other = [*others, "3dgs" if rollout.renderer == "clean" else "clean"][0]
    fork = f"simrun fork {cell} --at {at_s:.1f} --renderer {other}"
    view = f"simrun view {shlex.quote(str(run.folder / rollout.path))}"
    return [("f", f"drive on from there behind {other}", fork), ("v", "watch the rollout", view)]


def _parting(one: Parting, start_us: int) -> JsonObject:
    """Return a parting for the template, with the other's image and the own one."""
    images = [jpeg(smaller(image, WIDTH_PX)) for image in one.images]
    at_s = (one.t_us - start_us) * 1e-6
    return {"name": one.name, "at_s": at_s, "gap_m": one.gap_m, "images": images}
