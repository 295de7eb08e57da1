"""The page of evidence for one rollout, a self-contained HTML file made of what the run stored: how
it ended, what the policy saw, planned and said of itself, what other renderers show at the same
poses, where plans part, and what to ask next.
"""

import base64
import shlex
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import inside, parsing, read_bytes, real
from alpasim_plugin.core.files.atomic import write_text
from alpasim_plugin.core.geometry import interpolate, inverse, speeds, transform_points
from alpasim_plugin.core.json_types import JsonObject, JsonView
from alpasim_plugin.core.types import F64, CameraSpec, LoggedImage, LoggedPlan, RolloutLog
from alpasim_plugin.log import decode_image, read_facts
from alpasim_plugin.log.debug import WIDTH_PX, debug_row
from alpasim_plugin.log.images import smaller
from alpasim_plugin.log.run_folder.reader import last_output, read_json
from alpasim_plugin.log.run_folder.records import PolicyCheck
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
    ENDED,
    OUTCOMES,
    SHORT_OF_END,
    ending_of,
    first_failure,
    gravity,
    in_words,
    outcomes_of,
)
from evaluators.pages.cells import lens_data, read_log
from evaluators.pages.drive_data import (
    Place,
    map_data,
    plan_lines,
    scene_of,
    user_data,
)
from evaluators.pages.evidence import contact_of_failure, plan_facts
from evaluators.pages.images import frame_rows, jpeg, seen_before
from evaluators.pages.page import as_json, fill
from evaluators.pages.rollouts import clock_zero_us
from evaluators.statistics.opening import Run

JPEG_START = b"\xff\xd8"
BEFORE_US, AFTER_US = 6_000_000, 1_000_000  # of the failure, that are shown
MOST_QUERIES = 48
SCRIPTS = ("theme.js", "timeline.js", "overlay.js", "cause.js")
STYLES = ("theme.css", "report.css", "cause.css")
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
        images: The other's image and the own one at that query, JPEG in base64; none of a policy,
            which sees the same.
    """

    name: str
    kind: str
    at_s: float
    gap_m: float
    images: Sequence[str] = ()


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
    """

    rollout: Rollout
    outcome: str
    failed_us: int | None
    start_us: int
    sentences: Sequence[str]
    partings: Sequence[Parting]
    log: RolloutLog | None

    @property
    def failed_s(self) -> float | None:
        """Give when it failed, seconds from the first camera frame."""
        return None if self.failed_us is None else (self.failed_us - self.start_us) * 1e-6


def worst_failure(run: Run) -> Rollout:
    """Return the rollout of a run that failed worst: one that broke off, then the gravest outcome.

    Raises:
        InputError: No rollout failed.
    """
    failed = [rollout for rollout in run.rollouts if not rollout.ok or outcomes_of(rollout)]
    if not failed:
        raise InputError(
            f"{run.folder}: no rollout of this run failed",
            "Name a rollout: simrun why RUN/RENDERER/POLICY/SCENE/SEED.",
        )
    return min(failed, key=lambda rollout: gravity(rollout) if rollout.ok else -1)


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
    sentences += behind_others(run, rollout)
    for name, text in sorted(check.notes, key=lambda note: note[0] != "lag"):
        if outcomes & {*TELLING.get(name, ())}:
            sentences.append(f"{CHECK}{text}.")
    if log is not None and rollout.ok:
        ended_us = int(log.ego.t_us[-1]) if outcome == SHORT_OF_END else failed_us
        contact = None
        if manifest is not None and first is not None:
            contact = contact_of_failure(log, first, manifest.contacts)
        if ended_us is not None:
            sentences += plan_facts(log, ended_us, outcomes, contact)
    sentences += [
        f"Plans part from those of the {parting.kind} {parting.name} at {parting.at_s:.1f} s, "
        f"by {parting.gap_m:.2f} m."
        for parting in partings
    ]
    made_up = "" if failed_us is None else seen_before(frame_rows(run, rollout), failed_us)
    sentences += [f"{made_up}."] if made_up else []
    ended = None if manifest is None else manifest.ended
    if rollout.ok and ended in ENDED:
        sentences.append(f"The rollout ended since {ENDED[ended]}.")
    return Cause(rollout, outcome, failed_us, start_us, sentences, partings, log)


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


def shown_plans(log: RolloutLog, failed_us: int | None) -> list[LoggedPlan]:
    """Return at most `MOST_QUERIES` plans: of those that lie before the failure, or of all, an even
    choice that holds the last one.
    """
    near = [
        plan
        for plan in log.plans
        if len(plan.trajectory) > 1
        and (failed_us is None or failed_us - BEFORE_US <= plan.now_us <= failed_us + AFTER_US)
    ]
    return near[::-1][:: -(-len(near) // MOST_QUERIES) or 1][::-1]


def same_poses(run: Run, rollout: Rollout) -> dict[str, dict[int, bytes]]:
    """Return what the run stored of its other renderers at the poses of a rollout: by renderer and
    time, encoded images.
    """
    path = run.file_of(rollout, SAME_POSES)
    if path is None:
        return {}
    with parsing(path, "Delete the file; the page is made without it.", "no images of renderers"):
        return {
            name: {int(t_us): base64.b64decode(image) for t_us, image in images}
            for name, images in read_json(path)["images"].items()
        }


def write_cause(run: Run, cause: Cause) -> Path:
    """Write the page into the folder of the rollout and return its path.

    Raises:
        InputError: The run has no map of the scene.
        InfrastructureError: The disk refuses.
    """
    rollout = cause.rollout
    path = run.folder / rollout.path / WHY_NAME
    document: JsonObject = {"queries": [], "lens": None, "failed": None}
    if cause.log is not None:
        log = cause.log
        content, recorded = scene_of(run, cause.rollout.scene)
        place = Place(recorded[0], clock_zero_us(content, int(log.ego.t_us[0])))
        cameras = log.info["cameras"]
        document = {
            "own": cause.rollout.renderer,
            "map": map_data(content, recorded, place),
            "users": [user_data(actor, place) for actor in log.actors.values()],
            "ego": place.track(log.ego),
            "rear": round(100 * float(log.T_rig_box[0, 3])),
            "lens": lens_data(cameras[0], WIDTH_PX) if cameras else None,
            "failed": None if cause.failed_us is None else place.ms([cause.failed_us])[0],
            "queries": _queries(run, cause, log, place),
        }
    names = dict.fromkeys(name for query in document["queries"] for name in query["seen"])
    html = fill(
        "cause.html.j2",
        SCRIPTS,
        STYLES,
        cause=cause,
        commands=commands(run, cause),
        document=Markup(as_json(document)),
        renderers=[name for name in names if name != rollout.renderer],
        has_images=bool(names),
        run=real(run.folder).name,
        report="../" * len(Path(rollout.path).parts) + "report.html",
    )
    write_text(path, html)
    return path


def _queries(run: Run, cause: Cause, log: RolloutLog, place: Place) -> list[JsonObject]:
    """Return the queries of a log that the page shows, with what the run stored of them: times in
    milliseconds, lines in world centimetres, boxes in pixels of the page's image.
    """
    rollout = cause.rollout
    cameras = log.info["cameras"]
    scale = min(1.0, WIDTH_PX / cameras[0].width) if cameras else 1.0
    taken = [[one for one in log.images if one.camera == camera.name] for camera in cameras]
    driven = speeds(log.ego)
    debug_file = run.file_of(rollout, DEBUG_NAME)
    debug = {} if debug_file is None else {row["t_us"]: row for row in read_facts(debug_file)}
    others = same_poses(run, rollout)

    def jpeg_of(data: bytes, camera: CameraSpec) -> str:
        if camera.width <= WIDTH_PX and data.startswith(JPEG_START):
            return base64.b64encode(data).decode()
        return jpeg(smaller(decode_image(data, "a camera frame"), WIDTH_PX))

    queries = []
    for plan in shown_plans(log, cause.failed_us):
        pose = interpolate(log.ego, [plan.now_us])[0] @ inverse(log.T_rig_box)
        debug_facts: JsonObject = dict(debug.get(plan.now_us) or debug_row({}))
        debug_facts["lines"] = [
            [name, _in_world(pose, xy, place)] for name, xy in debug_facts["lines"]
        ]
        debug_facts["boxes"] = [
            [name, *(round(scale * side, 1) for side in box)]
            for name, boxes in debug_facts["boxes"]
            for box in boxes
        ]
        newest = [_newest(images, plan.now_us) for images in taken]
        views: dict[str, JsonObject] = {}
        if newest and newest[0] is not None:
            t_us = newest[0].end_us
            images_by_renderer = {rollout.renderer: newest[0].data}
            images_by_renderer |= {
                name: frames[t_us] for name, frames in others.items() if t_us in frames
            }
            t_ms = place.ms([t_us])[0]
            views = {
                name: {"jpeg": jpeg_of(data, cameras[0]), "t": t_ms}
                for name, data in images_by_renderer.items()
            }
        beside = [
            [camera.name, jpeg_of(image.data, camera)]
            for camera, image in zip(cameras[1:], newest[1:], strict=True)
            if image is not None
        ]
        queries.append(
            {
                "t": place.ms([plan.now_us])[0],
                "speed": round(float(np.interp(plan.now_us, log.ego.t_us, driven)), 2),
                "route": _in_world(pose, plan.route, place),
                "plan": plan_lines(plan, place),
                "seen": views,
                "beside": beside,
                "said": debug_facts,
            }
        )
    return queries


def _newest(images: Sequence[LoggedImage], t_us: int) -> LoggedImage | None:
    """Return the last image, of a camera's in order of time, that was complete at a time."""
    count = bisect_right(images, t_us, key=lambda image: image.end_us)
    return images[count - 1] if count else None


def _in_world(T_world_rig: F64, xy: F64, place: Place) -> list[list[int]]:
    """Return rig coordinates ``(N, 2)`` in world centimetres, without rows of NaN."""
    points = np.asarray(xy, dtype=np.float64).reshape(-1, 2)
    points = points[np.isfinite(points).all(axis=1)]
    rig = np.column_stack([points, np.zeros(len(points))])
    return place.cm(transform_points(T_world_rig, rig)[:, :2])


def _parting_of(run: Run, rollout: Rollout, entry: JsonView, start_us: int) -> Parting:
    """Return where plans part by an entry of ``flips.json``; a policy sees the same images."""
    at_s = (int(entry["t_us"]) - start_us) * 1e-6
    gap_m = float(entry["gap_m"])
    if entry["baseline"] == rollout.renderer:
        name = str(entry["against"]).removeprefix(rollout.renderer + "/")
        return Parting(name, "policy", at_s, gap_m)
    paths = [inside(run.folder, name) for name in (entry.get("frames") or {}).values()]
    images = [decode_image(read_bytes(path), str(path)) for path in paths if path is not None]
    if len(images) != 2 or images[0].shape != images[1].shape:
        images = []
    encoded = [jpeg(smaller(image, WIDTH_PX)) for image in images]
    return Parting(str(entry["baseline"]), "renderer", at_s, gap_m, encoded)


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


FORK_S = 3.0  # before a failure, where no plans part: a fork at the failure repeats it


def commands(run: Run, cause: Cause) -> list[tuple[str, str, str]]:
    """Return what can be asked next: a key, what it shows, the command."""
    rollout = cause.rollout
    if not rollout.ok:
        check = f"simrun check policy {shlex.quote(rollout.policy)}"
        return [("c", "test the policy alone", check)]
    cell = shlex.quote(f"{run.folder}/{cell_name(*rollout.cell)}")
    at_s = cause.partings[0].at_s if cause.partings else (cause.failed_s or 0.0) - FORK_S
    others = [one.name for one in cause.partings if one.kind == "renderer"]
    other = [*others, "3dgs" if rollout.renderer == "clean" else "clean"][0]
    fork = f"simrun fork {cell} --at {max(0.0, at_s):.1f} --renderer {shlex.quote(other)}"
    view = f"simrun view {shlex.quote(str(run.folder / rollout.path))}"
    since = f"{max(0.0, at_s):.1f} s"
    return [("f", f"drive on from {since} behind {other}", fork), ("v", "watch the rollout", view)]
