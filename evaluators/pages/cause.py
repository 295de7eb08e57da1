"""The page of evidence for one rollout, a self-contained HTML file made of what the run stored: how
it ended, what the policy saw, planned and said of itself, what other renderers show at the same
poses, where plans part, and what to ask next.
"""

import base64
import os
import shlex
from bisect import bisect_right
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from markupsafe import Markup

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import parsing, read_bytes, real
from alpasim_plugin.core.files.atomic import write_text
from alpasim_plugin.core.geometry import interpolate, inverse, speeds, transform_points
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.core.types import F64, CameraSpec, LoggedImage, LoggedPlan, RolloutLog
from alpasim_plugin.log import decode_image, read_facts
from alpasim_plugin.log.debug import WIDTH_PX, debug_row
from alpasim_plugin.log.images import smaller
from alpasim_plugin.log.run_folder.reader import read_json
from alpasim_plugin.log.run_folder.rows import Rollout
from alpasim_plugin.log.run_folder.schema import (
    DEBUG_NAME,
    LOG_NAME,
    SAME_POSES,
    WHY_NAME,
    cell_name,
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
from evaluators.pages.images import jpeg
from evaluators.pages.page import as_json, fill
from evaluators.pages.rollouts import clock_zero_us
from evaluators.statistics.cause import Cause, Parting
from evaluators.statistics.opening import Run

JPEG_START = b"\xff\xd8"
BEFORE_US, AFTER_US = 6_000_000, 1_000_000  # of the failure, that are shown
MOST_QUERIES = 48
SCRIPTS = (
    "theme.js",
    "timeline.js",
    "birdseye.js",
    "lens.js",
    "overlay.js",
    "curves.js",
    "cause.js",
)
STYLES = ("theme.css", "report.css", "cause.css")


def log_so_far(run: Run, rollout: Rollout) -> RolloutLog | None:
    """Return the log of a rollout; of one that broke off, the part that was written."""
    path = run.file_of(rollout, LOG_NAME) or run.file_of(rollout, f"{LOG_NAME}.part")
    manifest = run.manifest(rollout)
    if path is None and manifest is not None and manifest.log is not None:
        # As it was named to simrun score, so from the same working directory.
        path = Path(manifest.log) if os.path.isfile(manifest.log) else None
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
    pairs = [(parting, _images_of(parting)) for parting in cause.partings]
    names = dict.fromkeys(name for query in document["queries"] for name in query["seen"])
    html = fill(
        "cause.html.j2",
        SCRIPTS,
        STYLES,
        cause=cause,
        pairs=[(parting, images) for parting, images in pairs if images],
        commands=commands(run, cause),
        document=Markup(as_json(document)),
        renderers=[name for name in names if name != rollout.renderer],
        has_images=bool(names),
        camera_without_lens=_camera_without_lens(cause, document),
        has_drive=document["drive"] is not None,
        run=real(run.folder).name,
        report="../" * len(Path(rollout.path).parts) + "report.html",
    )
    write_text(path, html)
    return path


def _camera_without_lens(cause: Cause, document: JsonObject) -> str:
    """Return the name of the camera that was seen with where its lens projects nothing; else ""."""
    if cause.log is None or document["lens"] is not None:
        return ""
    names = [camera.name for camera in cause.log.info["cameras"]]
    return names[0] if names else ""


def _drive(cause: Cause, log: RolloutLog, place: Place) -> JsonObject:
    """Return what the page draws of the motion: the drive from above, the curves of the seconds
    before the failure, and the span of time that they have in common.
    """
    plans = shown_plans(log, cause.failed_us)
    size = [round(100 * side) for side in (log.ego_box.length_m, log.ego_box.width_m)]
    moments = []
    if cause.failed_us is not None:
        is_contact = cause.failure is not None and cause.failure.contact is not None
        kind = "collision" if is_contact else "event"
        moments = [{"t": place.ms([cause.failed_us])[0], "kind": kind, "text": cause.outcome}]
    curves = curve_data(cause, place)
    ends = [t for curve in curves for line in curve["lines"] for t in line["t"]]
    ends += place.ms([plan.now_us for plan in plans]) or place.ms(log.ego.t_us[[0, -1]])
    return {
        "drive": {
            "renderer": cause.rollout.renderer,
            "ego": place.track(log.ego),
            "size": size,
            "users": list(range(len(log.actors))),
            "plans": [
                {"t": place.ms([plan.now_us])[0], "lines": plan_lines(plan, place)}
                for plan in plans
            ],
            "moments": moments,
        },
        "curves": curves,
        "span": [min(ends), max(max(ends), min(ends) + 1)],
    }


def curve_data(cause: Cause, place: Place) -> list[JsonObject]:
    """Return speed, gap and lateral offset in the seconds before a failure, each with its lines: t
    in milliseconds, v with nulls where there is no value; nothing where nothing was measured.
    """
    failure = cause.failure
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
    if failure.gap_m is not None:
        curves.append(("Gap", "m", [line(f"to {failure.nearest}", "ego", failure.gap_m)]))
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
    texts = []
    for name, text in rows:
        unit = next((unit for end, unit in UNITS.items() if name.endswith(end)), "")
        if not _is_number(text):
            texts.append([name, text])
        elif unit:
            texts.append([name, f"{text} {unit}"])
    return texts


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
    taken = [[image for image in log.images if image.camera == camera.name] for camera in cameras]
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


def _images_of(parting: Parting) -> list[str]:
    """Return the two images where plans part, JPEG in base64; nothing where there are not two of
    one size.
    """
    images = [decode_image(read_bytes(path), str(path)) for path in parting.images]
    if len(images) != 2 or images[0].shape != images[1].shape:
        return []
    return [jpeg(smaller(image, WIDTH_PX)) for image in images]


FORK_S = 3.0  # before a failure, where no plans part: a fork at the failure repeats it


def commands(run: Run, cause: Cause) -> list[tuple[str, str, str]]:
    """Return what can be asked next: a key, what it shows, the command."""
    rollout = cause.rollout
    if not rollout.ok:
        check = f"simrun check policy {shlex.quote(rollout.policy)}"
        return [("c", "test the policy alone", check)]
    cell = shlex.quote(f"{run.folder}/{cell_name(*rollout.cell)}")
    at_s = cause.partings[0].at_s if cause.partings else (cause.failed_s or 0.0) - FORK_S
    others = [parting.name for parting in cause.partings if parting.kind == "renderer"]
    other = [*others, "3dgs" if rollout.renderer == "clean" else "clean"][0]
    fork = f"simrun fork {cell} --at {max(0.0, at_s):.1f} --renderer {shlex.quote(other)}"
    view = f"simrun view {shlex.quote(str(run.folder / rollout.path))}"
    since = f"{max(0.0, at_s):.1f} s"
    return [("f", f"drive on from {since} behind {other}", fork), ("v", "watch the rollout", view)]
