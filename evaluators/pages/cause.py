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
from alpasim_plugin.log.run_folder.records import DriveEvent, PolicyCheck
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
    in_words,
    outcomes_of,
)
from evaluators.pages.cells import lens_data, read_log
from evaluators.pages.drive_data import (
    Place,
    map_data,
    plan_lines,
    rounded,
    scene_of,
    user_data,
)
from evaluators.pages.images import frame_rows, jpeg, seen_before
from evaluators.pages.page import as_json, fill
from evaluators.pages.rollouts import clock_zero_us
from evaluators.statistics.alike import common_to_failures
from evaluators.statistics.approach import gap_series
from evaluators.statistics.evidence import (
    Failure,
    contact_of_failure,
    failure_facts,
    kind_of,
)
from evaluators.statistics.opening import Run
from evaluators.statistics.outcomes import worst_of

JPEG_START = b"\xff\xd8"
BEFORE_US, AFTER_US = 6_000_000, 1_000_000  # of the failure, that are shown
MOST_QUERIES = 48
SCRIPTS = ("theme.js", "timeline.js", "birdseye.js", "overlay.js", "curves.js", "cause.js")
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
    made_up = "" if failed_us is None else seen_before(frame_rows(run, rollout), failed_us)
    sentences += [f"{made_up}."] if made_up else []
    ended = None if manifest is None else manifest.ended
    if rollout.ok and ended in ENDED:
        sentences.append(f"The rollout ended since {ENDED[ended]}.")
    return Cause(rollout, outcome, failed_us, start_us, sentences, partings, log, failure)


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
        *(one.sentence for one in common if one.decisive),
        *facts[:1],
        *behind_others(run, rollout),
        *facts[1:],
        *(one.sentence for one in common if not one.decisive),
    ]


def _telling_notes(check: PolicyCheck, outcomes: frozenset[str]) -> list[str]:
    """Return what the check noted of a policy that has to do with its outcomes. It is about the
    policy, and stands behind what is about this failure.
    """
    notes = sorted(check.notes, key=lambda note: note[0] != "lag")
    return [f"{CHECK}{text}." for name, text in notes if outcomes & {*TELLING.get(name, ())}]


def _log_so_far(run: Run, rollout: Rollout) -> RolloutLog | None:
    """Return the log of a rollout; of one that broke off, the part that was written."""
    path = run.file_of(rollout, LOG_NAME) or run.file_of(rollout, f"{LOG_NAME}.part")
    manifest = run.manifest(rollout)
    if path is None and manifest is not None and manifest.log is not None:
        # As it was named to simrun score, so from the same working directory.
        path = Path(manifest.log) if Path(manifest.log).is_file() else None
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
    document: JsonObject = {"queries": [], "lens": None, "failed": None, "drive": None}
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
            **_drive(cause, log, place),
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
        has_drive=document["drive"] is not None,
        run=real(run.folder).name,
        report="../" * len(Path(rollout.path).parts) + "report.html",
    )
    write_text(path, html)
    return path


def _drive(cause: Cause, log: RolloutLog, place: Place) -> JsonObject:
    """Return what the page draws of the motion: the drive from above, the curves of the seconds
    before the failure, and the span of time that they have in common.
    """
    shown = shown_plans(log, cause.failed_us)
    size = [round(100 * side) for side in (log.ego_box.length_m, log.ego_box.width_m)]
    moments = []
    if cause.failed_us is not None:
        is_contact = cause.failure is not None and cause.failure.contact is not None
        kind = "collision" if is_contact else "event"
        moments = [{"t": place.ms([cause.failed_us])[0], "kind": kind, "text": cause.outcome}]
    curves = curve_data(cause.failure, place)
    ends = [t for curve in curves for line in curve["lines"] for t in line["t"]]
    ends += place.ms([plan.now_us for plan in shown]) or place.ms(log.ego.t_us[[0, -1]])
    return {
        "drive": {
            "renderer": cause.rollout.renderer,
            "ego": place.track(log.ego),
            "size": size,
            "users": list(range(len(log.actors))),
            "plans": [
                {"t": place.ms([plan.now_us])[0], "lines": plan_lines(plan, place)}
                for plan in shown
            ],
            "moments": moments,
        },
        "curves": curves,
        "span": [min(ends), max(max(ends), min(ends) + 1)],
    }


def curve_data(failure: Failure | None, place: Place) -> list[JsonObject]:
    """Return speed, gap and lateral offset in the seconds before a failure, each with its lines: t
    in milliseconds, v with nulls where there is no value.

    Args:
        failure: The measured failure; None where nothing could be measured.
        place: Where times count from.
    """
    approach = None if failure is None else failure.approach
    if failure is None or approach is None:
        return []

    def line(name: str, kind: str, values: F64) -> JsonObject:
        return {"name": name, "kind": kind, "t": place.ms(approach.t_us), "v": rounded(values)}

    speed_lines = [
        line("ego", "ego", approach.speed_mps),
        line("recording, at the same place", "recorded", approach.recorded_mps),
    ]
    if approach.limit_mps is not None:
        posted = np.full(len(approach.t_us), approach.limit_mps)
        speed_lines.append(line("posted, at the last place", "posted", posted))
    curves = [("Speed", "m/s", speed_lines)]
    actor_id = failure.nearest_id
    if actor_id is not None:
        gaps = gap_series(failure.log, approach.t_us, actor_id)
        name = f"to {kind_of(failure.log.actors[actor_id])} {actor_id}"
        curves.append(("Gap", "m", [line(name, "ego", gaps)]))
    offset = line("of the recorded path, left is above", "ego", approach.lateral_m)
    curves.append(("Lateral offset", "m", [offset]))
    return [
        {"name": name, "unit": unit, "lines": lines, "text": f"{name} in {unit} before the failure"}
        for name, unit, lines in curves
    ]


# The end of a value's name -> its unit: a number of `Plan.debug` is shown with a unit alone.
UNITS = {
    "_mps2": "m/s2",
    "_mps": "m/s",
    "_kmh": "km/h",
    "_mph": "mph",
    "_m": "m",
    "_cm": "cm",
    "_s": "s",
    "_ms": "ms",
    "_us": "us",
    "_rad": "rad",
    "_radps": "rad/s",
    "_deg": "deg",
    "_1pm": "1/m",
    "_1pm2": "1/m2",
    "_hz": "Hz",
    "_px": "px",
    "_percent": "%",
}


def with_units(rows: Sequence[Sequence[str]]) -> list[list[str]]:
    """Return names and texts of a policy's debug output: words as they are, numbers with the unit
    that ends their name, and no number without one.

    Example:
        >>> with_units([["mode", "lane"], ["gap_m", "3.2"], ["score", "0.7"]])
        [['mode', 'lane'], ['gap_m', '3.2 m']]
    """
    shown = []
    for name, text in rows:
        unit = next((unit for end, unit in UNITS.items() if name.endswith(end)), "")
        if not _is_number(text):
            shown.append([name, text])
        elif unit:
            shown.append([name, f"{text} {unit}"])
    return shown


def _is_number(text: str) -> bool:
    """Tell whether a text is a number, or a list of numbers."""
    parts = text.strip("[]").split(",") if text.startswith("[") else [text]
    try:
        return all(np.isscalar(float(part)) for part in parts)
    except ValueError:
        return False


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
        debug_facts["text"] = with_units(debug_facts["text"])
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
