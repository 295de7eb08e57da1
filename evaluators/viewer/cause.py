"""The page of evidence for one rollout, a self-contained HTML file: how it ended, what the policy
saw, planned and said of itself, where plans part, and what to ask next.
"""

from __future__ import annotations

import base64
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import numpy.typing as npt
from markupsafe import Markup

from alpasim_plugin.core.atomic import write_text
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import interpolate, inverse, transform_points
from alpasim_plugin.core.types import F64, U8, RolloutLog
from alpasim_plugin.log import decode_image
from alpasim_plugin.log.run_folder.rows import Rollout
from alpasim_plugin.log.run_folder.schema import LOG_NAME, WHY_NAME, cell_name
from evaluators.metrics.outcomes import first_failure, in_words, outcomes_of
from evaluators.opening import Run
from evaluators.viewer.cells import Wanted, cell_data, cells_of, lens_data, read_log, read_logs
from evaluators.viewer.drive_data import MAX_SAMPLES, Place, half_seconds
from evaluators.viewer.page import as_json, fill
from evaluators.viewer.pictures import frame_rows, jpeg, seen_before, smaller

WIDTH_PX = 640
JPEG_START = b"\xff\xd8"
BEFORE_US, AFTER_US = 6_000_000, 1_000_000  # of the failure, that are shown
MOST_LOOKS = 48
SCRIPTS = ("theme.js", "timeline.js", "overlay.js", "cause.js")
STYLES = ("theme.css", "report.css", "cause.css")
# How a value of `Plan.debug` is shown: kind, prefix of its name, dtype, least shape, last size
KINDS: tuple[tuple[str, str, str, tuple[int, ...], int | None], ...] = (
    ("images", "", "uint8", (1, 1, 3), 3),
    ("boxes", "boxes", "", (1, 4), 4),
    ("lines", "line", "", (1, 2), None),
    ("heat", "", "", (4, 4), None),
)
Item = TypeVar("Item")


@dataclass(frozen=True)
class Look:
    """One query of the policy.

    Attributes:
        T_world_rig: ``(4, 4)``: where the ego was.
        speed_mps: Along the rig.
        route: ``(N, 2)`` metres, rig frame, as it was given; empty where that is not known.
        plans: Behind each renderer at that pose: the plan and its samples, each ``(N, 2)`` metres,
            rig frame, every half second.
        frames: What each renderer showed of the first camera: time, and ``(H, W, 3)`` or its JPEG.
        debug: What the policy said of itself, `Plan.debug`.
    """

    t_us: int
    T_world_rig: F64
    speed_mps: float
    route: F64
    plans: Mapping[str, Sequence[F64]]
    frames: Mapping[str, tuple[int, U8 | bytes]]
    debug: Mapping[str, Any]


@dataclass(frozen=True)
class Parting:
    """When plans part from those behind another renderer, or of another policy.

    Attributes:
        name: The renderer or the policy.
        kind: ``renderer`` or ``policy``.
        t_us: The first query at which they are apart.
        gap_m: How far apart they are then.
        frames: The other's picture and the own one at that query, ``(H, W, 3)`` each; none of a
            policy, which sees the same.
    """

    name: str
    kind: str
    t_us: int
    gap_m: float
    frames: tuple[U8, U8] | None = None


@dataclass(frozen=True)
class Cause:
    """What is known of how a drive ended.

    Attributes:
        outcome: In words.
        failed_us: When it failed first; None where it did not.
        start_us: The first camera frame.
        sentences: What the run shows, the most telling first.
        looks: Queries to show, in order of time.
        partings: When plans part from others'.
        commands: What can be asked next: a key, what it shows, the command.
        notes: What is missing, a sentence each.
    """

    rollout: Rollout
    outcome: str
    failed_us: int | None
    start_us: int
    sentences: Sequence[str]
    looks: Sequence[Look]
    partings: Sequence[Parting]
    commands: Sequence[tuple[str, str, str]]
    notes: Sequence[str] = ()


def write_cause(run: Run, cause: Cause) -> Path:
    """Write the page into the folder of the rollout and return its path.

    Raises:
        InputError: The run has no map of the scene.
        InfrastructureError: The disk refuses.
    """
    rollout = cause.rollout
    path = run.folder / rollout.path / WHY_NAME
    report = "../" * len(Path(rollout.path).parts) + "report.html"
    wanted = Wanted((rollout.scene,), (rollout.policy,), (rollout.seed,), (rollout.renderer,))
    cell = cells_of(run, wanted)[0]
    logs = read_logs(run, cell)
    document = cell_data(run, cell, logs, None) | {"own": rollout.renderer, "lens": None}
    place = Place(np.array(document.pop("origin")), document.pop("zero_us"))
    document["failed"] = None if cause.failed_us is None else place.ms([cause.failed_us])[0]
    log, scale = logs[rollout.path], 1.0
    if isinstance(log, RolloutLog) and log.info["cameras"]:
        camera = log.info["cameras"][0]
        scale = min(1.0, WIDTH_PX / camera.width)
        document["lens"] = lens_data(camera, WIDTH_PX)
    document["looks"] = [_look(look, place, scale) for look in cause.looks]
    html = fill(
        "cause.html.j2",
        SCRIPTS,
        STYLES,
        cause=cause,
        document=Markup(as_json(document)),
        partings=[_parting(one, cause.start_us) for one in cause.partings],
        run=run.folder.resolve().name,
        report=report,
        failed_s=None if cause.failed_us is None else (cause.failed_us - cause.start_us) * 1e-6,
    )
    write_text(path, html)
    return path


def _look(look: Look, place: Place, scale: float) -> dict[str, Any]:
    """Return a query for the page: times in milliseconds, lines in world centimetres, pictures as
    JPEG.
    """

    def line(xy: F64) -> list[list[int]]:
        """Return rig coordinates ``(N, 2)`` in world centimetres, without rows of NaN."""
        known = xy[np.isfinite(xy).all(axis=1), :2]
        rig = np.column_stack([known, np.zeros(len(known))])
        return place.cm(transform_points(look.T_world_rig, rig)[:, :2])

    def image(frame: U8 | bytes) -> str:
        if isinstance(frame, bytes):
            if scale == 1.0 and frame.startswith(JPEG_START):
                return base64.b64encode(frame).decode()
            frame = decode_image(frame, "a camera frame")
        return jpeg(smaller(frame, WIDTH_PX))

    return {
        "t": place.ms([look.t_us])[0],
        "speed": round(look.speed_mps, 2),
        "route": line(look.route),
        "plans": {name: {"lines": list(map(line, lines))} for name, lines in look.plans.items()},
        "seen": {
            name: {"jpeg": image(frame), "t": place.ms([t_us])[0]}
            for name, (t_us, frame) in look.frames.items()
        },
        "said": debug_views(look.debug, scale, line),
    }


def kind_of(name: str, value: Any) -> str:
    """Return as what a value of ``Plan.debug`` is shown: the first of `KINDS` that fits, else
    ``text``.
    """
    array = np.asarray(value) if isinstance(value, np.ndarray | list | tuple) else np.empty(0)
    if array.dtype.kind in "fiub" and array.size > 0 and np.isfinite(array).any():
        for kind, prefix, dtype, least, last in KINDS:
            if (
                name.startswith(prefix)
                and dtype in ("", array.dtype.name)
                and array.ndim == len(least)
                and all(np.greater_equal(array.shape, least))
                and last in (None, array.shape[-1])
            ):
                return kind
    return "text"


def debug_views(debug: Mapping[str, Any], scale: float, line: Any) -> dict[str, Any]:
    """Return what a policy says of itself in ``Plan.debug``, by kind.

    Args:
        debug: By name; `KINDS` is the contract. Boxes are x0 y0 x1 y1 in pixels of the first
            camera, lines are metres in the rig frame.
        scale: Of the page's image against the camera's.
        line: Brings rig coordinates into the page's.
    """
    views: dict[str, Any] = {"text": [], "images": [], "heat": [], "boxes": [], "lines": []}
    for name, value in debug.items():
        kind = kind_of(name, value)
        if kind == "text":
            views["text"].append([name, _words(value)])
            continue
        array = np.asarray(value)
        if kind == "images":
            views["images"].append([name, jpeg(smaller(array, WIDTH_PX))])
        elif kind == "boxes":
            corners = np.round(array * scale, 1).tolist()
            views["boxes"] += [[name, *box] for box in corners]
        elif kind == "lines":
            views["lines"].append([name, line(array[:, :2].astype(np.float64))])
        else:
            ends = [f"{value:.3g}" for value in (np.nanmin(array), np.nanmax(array))]
            views["heat"].append([name, heat_png(array), *ends])
    return views


def _words(value: Any) -> str:
    """Write numbers, words and short lists; name anything else with its type."""
    if isinstance(value, float):
        return f"{value:.4g}"
    if value is None or isinstance(value, str | int | np.generic):
        return str(value)[:300]
    if not isinstance(value, np.ndarray | list | tuple):
        return f"not shown: {type(value).__name__}"
    array = np.asarray(value)
    if array.dtype.kind in "fiubU" and array.size <= 12:
        return np.array2string(array, precision=3, separator=", ")
    return f"not shown: {type(value).__name__} of shape {array.shape}"


def heat_png(values: npt.NDArray[Any]) -> str:
    """Return a heat map as PNG in base64: yellow where values are high, clear where they are low or
    missing.
    """
    known = np.where(np.isfinite(values), values, np.nan).astype(np.float64)
    low, high = np.nanmin(known), np.nanmax(known)
    share = np.nan_to_num((known - low) / ((high - low) or 1.0))
    bgra = np.stack(
        [np.full_like(share, 40), 60 + 170 * share, 0 * share + 250, 200 * share], axis=2
    )
    done, png = cv2.imencode(".png", bgra.astype(np.uint8))
    if not done:
        raise InputError(f"heat map {values.shape}: the encoder refused", "give a smaller one")
    return base64.b64encode(png.tobytes()).decode()


def failed_at(manifest: Mapping[str, Any]) -> int | None:
    """Return when a drive failed first, microseconds; None where it did not."""
    first = first_failure(manifest)
    return None if first is None else int(first["t_us"])


def chosen(all_of: Sequence[Item], failed_us: int | None, times_us: Sequence[int]) -> list[Item]:
    """Return at most `MOST_LOOKS` of what has these times: what lies before the failure, or an even
    choice.
    """
    near = [
        one
        for one, t in zip(all_of, times_us, strict=True)
        if failed_us is None or failed_us - BEFORE_US <= t <= failed_us + AFTER_US
    ]
    return near[::-1][:: -(-len(near) // MOST_LOOKS) or 1][::-1]


def looks_of(log: RolloutLog, renderer: str, failed_us: int | None) -> list[Look]:
    """Return the queries of a log that the page shows, with what the log holds of them."""
    camera = next(iter(log.info["cameras"]), None)
    images = [image for image in log.images if camera is not None and image.camera == camera.name]
    ends_us = np.array([image.end_us for image in images])
    seconds = (log.ego.t_us - log.ego.t_us[0]) * 1e-6
    speeds = np.linalg.norm(np.gradient(log.ego.xyz[:, :2], seconds, axis=0), axis=1)
    plans = [plan for plan in log.plans if len(plan.trajectory) > 1]
    looks = []
    for plan in chosen(plans, failed_us, [plan.now_us for plan in plans]):
        pose = interpolate(log.ego, [plan.now_us])[0] @ inverse(log.T_rig_box)
        lines = [
            half_seconds(line.t_us, transform_points(inverse(pose), line.xyz))
            for line in (plan.trajectory, *plan.samples[:MAX_SAMPLES])
        ]
        newest = int(np.searchsorted(ends_us, plan.now_us, "right")) - 1
        seen = {renderer: (images[newest].end_us, images[newest].data)} if newest >= 0 else {}
        speed_mps = float(np.interp(plan.now_us, log.ego.t_us, speeds))
        no_route = np.zeros((0, 2))
        looks.append(Look(plan.now_us, pose, speed_mps, no_route, {renderer: lines}, seen, {}))
    return looks


def cause_of_log(run: Run, rollout: Rollout, entries: Sequence[Mapping[str, Any]]) -> Cause | None:
    """Return what the files of a run say of how a drive failed; None without a log.

    Args:
        run: The run.
        rollout: One that ended with an event.
        entries: Entries of ``flips.json`` about it: when its plans part from those of others.
    """
    path = run.file_of(rollout, LOG_NAME)
    if path is None:
        return None
    log, failed_us = read_log(path), failed_at(run.manifest(rollout))
    partings = [
        _parting_of(run, rollout, entry) for entry in entries if entry.get("t_us") is not None
    ]
    sentences = behind_others(run, rollout)
    for one in partings:
        at_s = (one.t_us - log.render_start_us) * 1e-6
        sentences.append(
            f"Plans part from those of the {one.kind} {one.name} at {at_s:.1f} s, "
            f"by {one.gap_m:.2f} m."
        )
    if failed_us is not None:
        made_up = seen_before(frame_rows(run, rollout), failed_us)
        sentences += [f"{made_up}."] if made_up else []
    return Cause(
        rollout=rollout,
        outcome=in_words(outcomes_of(rollout)),
        failed_us=failed_us,
        start_us=log.render_start_us,
        sentences=sentences,
        looks=looks_of(log, rollout.renderer, failed_us),
        partings=partings,
        commands=commands(run, rollout, log.render_start_us, failed_us, partings),
    )


def _parting_of(run: Run, rollout: Rollout, entry: Mapping[str, Any]) -> Parting:
    """Return where plans part by an entry of ``flips.json``; a policy sees the same images."""
    t_us, gap_m = int(entry["t_us"]), float(entry["gap_m"])
    if entry["baseline"] == rollout.renderer:
        name = str(entry["against"]).removeprefix(rollout.renderer + "/")
        return Parting(name, "policy", t_us, gap_m)
    paths = [run.folder / name for name in (entry.get("frames") or {}).values()]
    frames = [decode_image(path.read_bytes(), str(path)) for path in paths if path.is_file()]
    is_pair = len(frames) == 2 and frames[0].shape == frames[1].shape
    pair = (frames[0], frames[1]) if is_pair else None
    return Parting(str(entry["baseline"]), "renderer", t_us, gap_m, pair)


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
    cell = shlex.quote(f"{run.folder}/{cell_name(*rollout.cell)}")
    folder = shlex.quote(str(run.folder / rollout.path))
    parted_us = partings[0].t_us if partings else failed_us or start_us
    at_s = max(0.0, (parted_us - start_us) * 1e-6)
    others = [one.name for one in partings if one.kind == "renderer"]
    other = [*others, "3dgs" if rollout.renderer == "clean" else "clean"][0]
    shown = "other renderers at the same poses, and the policy's own debug output"
    fork = f"simrun fork {cell} --at {at_s:.1f} --renderer {other}"
    return [
        ("w", f"replay the rollout: {shown}", f"simrun why {folder}"),
        ("f", f"drive on from there behind {other}", fork),
        ("v", "watch the rollout", f"simrun view {folder}"),
    ]


def _parting(one: Parting, start_us: int) -> dict[str, Any]:
    """Return a parting for the template, with the other's image and the own one."""
    images = [jpeg(smaller(frame, WIDTH_PX)) for frame in one.frames or ()]
    at_s = (one.t_us - start_us) * 1e-6
    return {"name": one.name, "at_s": at_s, "gap_m": one.gap_m, "images": images}
