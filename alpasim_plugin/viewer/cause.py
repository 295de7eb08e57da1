"""The page of one drive's cause, offline: what the policy saw, planned and said of itself, what was tried, what to ask next."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from markupsafe import Markup

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import transform_points
from alpasim_plugin.core.types import F64, U8, CameraSpec, Frame, Observation, Plan
from alpasim_plugin.io.atomic import write_text
from alpasim_plugin.run_folder.rows import Rollout
from alpasim_plugin.run_folder.schema import WHY, rollout_folder
from alpasim_plugin.viewer.cells import Wanted, cells_of
from alpasim_plugin.viewer.drive_data import MAX_SAMPLES, PLAN_STEP_US, Place
from alpasim_plugin.viewer.page import as_json, fill
from alpasim_plugin.viewer.page_data import cell_data, lens_data, read_logs
from alpasim_plugin.viewer.pictures import jpeg, smaller
from evaluators.opening import Run

DOING = "writing the page of a cause"
WIDTH_PX = 640
CROP_SHARE = 3  # the crop is a third as wide and as high as the picture
SCRIPTS = ("theme.js", "timeline.js", "overlay.js", "cause.js")
STYLES = ("theme.css", "report.css", "cause.css")


@dataclass(frozen=True)
class Look:
    """One query of the policy.

    Attributes:
        observation: What it saw behind its own renderer.
        plans: Its plan behind each renderer at that pose.
        frames: What each renderer showed it: of its first camera.
    """

    observation: Observation
    plans: Mapping[str, Plan]
    frames: Mapping[str, Frame]


@dataclass(frozen=True)
class Parting:
    """When plans part from those behind another renderer, or of another policy.

    Attributes:
        name: The renderer or the policy.
        kind: ``renderer`` or ``policy``.
        t_us: The first query at which they are apart; None: never.
        gap_m: How far apart they are then, or at most.
        frames: The other's picture and the own one at that query, ``(H, W, 3)`` each; none of a policy, which sees the same.
    """

    name: str
    kind: str
    t_us: int | None
    gap_m: float
    frames: tuple[U8, U8] | None = None


@dataclass(frozen=True)
class Cause:
    """What is known of how a drive ended.

    Attributes:
        outcome: In words.
        failed_us: When it failed first; None where it did not.
        start_us: The first camera frame.
        sentences: What was found, the surest first: how sure ("shown", "seen", "not found"), and what.
        looks: Queries to show, in order of time.
        tried: A row a change: what was changed, how far plans are from the recorded drive with it, how the drive ends with it.
        depends: A row an input: what was done to it, whether the plans changed, by how much.
        partings: When plans part from others'.
        commands: What can be asked next: a key, what it shows, the command.
        notes: What is missing, a sentence each.
    """

    rollout: Rollout
    outcome: str
    failed_us: int | None
    start_us: int
    sentences: Sequence[tuple[str, str]]
    looks: Sequence[Look]
    tried: Sequence[tuple[str, str, str]]
    depends: Sequence[tuple[str, str, str]]
    partings: Sequence[Parting]
    commands: Sequence[tuple[str, str, str]]
    notes: Sequence[str] = ()


def page_of(rollout: Rollout) -> str:
    """Return the path of a rollout's page below its run folder."""
    return Path(WHY, *rollout_folder(*rollout.cell).parts[1:]).with_suffix(".html").as_posix()


def write_cause(run: Run, cause: Cause) -> Path:
    """Write the page of a drive and return its path.

    Raises:
        InputError: The run has no map of the scene.
        InfrastructureError: The disk refuses.
    """
    path = run.folder / page_of(cause.rollout)
    up = "../" * (len(path.relative_to(run.folder).parts) - 1)
    rollout = cause.rollout
    cell = cells_of(run, Wanted((rollout.scene,), (rollout.policy,), (rollout.seed,), (rollout.renderer,)))[0]
    document = cell_data(run, cell, read_logs(run, cell), None)
    place = Place(np.array(document.pop("origin")), document.pop("zero_us"))
    document |= {"failed": None if cause.failed_us is None else place.ms([cause.failed_us])[0], "own": rollout.renderer}
    document |= {"looks": [_look(look, rollout.renderer, place) for look in cause.looks], "index": {"renderers": run.renderers}}
    first = next((look.observation for look in cause.looks if look.frames), None)
    document["lens"] = None if first is None else lens_data(_camera(first), WIDTH_PX)
    html = fill(
        "cause.html.j2",
        SCRIPTS,
        STYLES,
        cause=cause,
        document=Markup(as_json(document)),
        partings=[_parting(one, cause.start_us) for one in cause.partings],
        run=run.folder.resolve().name,
        report=f"{up}report.html" if (run.folder / "report.html").is_file() else "",
        failed_s=None if cause.failed_us is None else (cause.failed_us - cause.start_us) * 1e-6,
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, html, DOING)
    return path


def _camera(observation: Observation) -> CameraSpec:
    return next(iter(observation.cameras.values()))


def _look(look: Look, renderer: str, place: Place) -> dict[str, Any]:
    """Return a query for the page: times in milliseconds, lines in world centimetres, pictures as JPEG."""
    o = look.observation
    T = o.ego.T_world_rig

    def line(xy: F64) -> list[list[int]]:
        """Return rig coordinates ``(N, 2+)`` in world centimetres, without rows of NaN."""
        known = np.asarray(xy, dtype=np.float64)[:, :2]
        known = known[np.isfinite(known).all(axis=1)]
        return place.cm(transform_points(T, np.column_stack([known, np.zeros(len(known))]))[:, :2])

    def plan(given: Plan) -> dict[str, Any]:
        """Return a plan and its samples every half second, which the page counts on."""
        at = np.arange(given.times_us[0], given.times_us[-1] + 1, PLAN_STEP_US)
        lines = (given.xy, *given.samples[:MAX_SAMPLES])
        return {"lines": [line(np.stack([np.interp(at, given.times_us, one[:, k]) for k in (0, 1)], axis=1)) for one in lines]}

    own = look.plans.get(renderer)
    camera = _camera(o) if o.cameras else None
    seen = {name: {"jpeg": jpeg(smaller(f.rgb, WIDTH_PX)), "t": place.ms([f.t_us])[0]} for name, f in look.frames.items()}
    scale = 1.0 if camera is None else min(1.0, WIDTH_PX / camera.width)
    return {
        "t": place.ms([o.t_us])[0],
        "speed": round(o.ego.speed_mps, 2),
        "route": line(o.route_rig),
        "plans": {name: plan(given) for name, given in look.plans.items()},
        "seen": seen,
        "said": said(own.debug if own else {}, scale, line),
    }


def said(debug: Mapping[str, Any], scale: float, line: Any) -> dict[str, Any]:
    """Sort what a policy says of itself in ``Plan.debug`` by what it can be shown as.

    Args:
        debug: By name. Pictures are ``(H, W, 3)`` uint8; heat maps ``(H, W)`` numbers, over the first camera's picture; ``boxes...`` are
            ``(N, 4)`` pixels of it, x0 y0 x1 y1; ``line...`` are ``(N, 2)`` metres, rig frame. Numbers, words and short lists are text;
            anything else is named with its type.
        scale: Of the page's picture against the camera's.
        line: Brings rig coordinates into the page's.
    """
    out: dict[str, Any] = {"text": [], "images": [], "heat": [], "boxes": [], "lines": []}
    for name, value in debug.items():
        array = np.asarray(value) if isinstance(value, (np.ndarray, list, tuple)) else None
        numeric = array is not None and array.dtype.kind in "fiub" and array.size > 0
        if numeric and array is not None:
            if array.dtype == np.uint8 and array.ndim == 3 and array.shape[2] == 3:
                out["images"].append([str(name), jpeg(smaller(array, WIDTH_PX))])
                continue
            if name.startswith("boxes") and array.ndim == 2 and array.shape[1] == 4:
                out["boxes"] += [[str(name), *(round(float(v) * scale, 1) for v in row)] for row in array]
                continue
            if name.startswith("line") and array.ndim == 2 and array.shape[1] >= 2:
                out["lines"].append([str(name), line(array)])
                continue
            if array.ndim == 2 and min(array.shape) >= 4:
                out["heat"].append([str(name), heat_png(array), *(f"{v:.3g}" for v in (np.nanmin(array), np.nanmax(array)))])
                continue
        out["text"].append([str(name), _words(value, array)])
    return out


def _words(value: Any, array: npt.NDArray[Any] | None) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if value is None or isinstance(value, (str, int, bool, np.generic)):
        return str(value)[:300]
    if array is not None and array.dtype.kind in "fiubU" and array.size <= 12:
        return np.array2string(array, precision=3, separator=", ")
    return f"not shown: {type(value).__name__}" + ("" if array is None else f" of shape {array.shape}")


def heat_png(values: npt.NDArray[Any]) -> str:
    """Return a heat map as PNG in base64: yellow where values are high, clear where they are low or missing."""
    known = np.where(np.isfinite(values), values, np.nan).astype(np.float64)
    low, high = np.nanmin(known), np.nanmax(known)
    share = np.nan_to_num((known - low) / (high - low) if high > low else known * 0.0)
    bgra = np.stack([40 * np.ones_like(share), 60 + 170 * share, 250 * np.ones_like(share), 200 * share], axis=2)
    done, png = cv2.imencode(".png", bgra.astype(np.uint8))
    if not done:
        raise InputError(DOING, f"heat map {values.shape}", "the encoder refused", "give a smaller one")
    return base64.b64encode(png.tobytes()).decode()


# --- where plans part -----------------------------------------------------------------------------------------------


def most_different(one: U8, other: U8) -> tuple[int, int, int, int]:
    """Return the part of two pictures that differs most: x, y, width and height in pixels."""
    height, width = one.shape[:2]
    size = (max(1, width // CROP_SHARE), max(1, height // CROP_SHARE))
    apart = np.abs(one.astype(np.float32) - other.astype(np.float32)).mean(axis=2)
    mean = cv2.blur(apart, size, borderType=cv2.BORDER_REPLICATE)
    inside = mean[size[1] // 2 : height - size[1] // 2, size[0] // 2 : width - size[0] // 2]
    y, x = np.unravel_index(int(np.argmax(inside)), inside.shape)
    return int(x), int(y), *size


def _parting(one: Parting, start_us: int) -> dict[str, Any]:
    at = None if one.t_us is None else (one.t_us - start_us) * 1e-6
    entry: dict[str, Any] = {"name": one.name, "kind": one.kind, "at_s": at, "gap_m": one.gap_m, "pictures": []}
    if one.frames is not None:
        x, y, w, h = most_different(*one.frames)
        for rgb in one.frames:
            marked = rgb.copy()
            cv2.rectangle(marked, (x, y), (x + w - 1, y + h - 1), (255, 210, 0), max(1, rgb.shape[1] // 200))
            crop = cv2.resize(rgb[y : y + h, x : x + w], (w * 2, h * 2), interpolation=cv2.INTER_CUBIC)
            entry["pictures"].append([jpeg(smaller(picture, WIDTH_PX)) for picture in (marked, crop)])
        entry["levels"] = float(np.abs(np.subtract(*(f[y : y + h, x : x + w].astype(np.int16) for f in one.frames))).mean())
    return entry
