"""Renderers against the photographs of an imported drive: those held out along its path, and those
of a camera that no fit ever saw.

Every photograph of such a camera is rendered in order of time, as the loop would ask for frames, so
that a fixer has its history; only photographs that the fit did not see are measured. Images are
compared at the size at which the scenario renders the camera.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import interpolate, inverse
from alpasim_plugin.core.image_metrics import psnr_db, ssim
from alpasim_plugin.core.interfaces import Renderer
from alpasim_plugin.core.types import F64, U8, CameraSpec, Photograph, RenderRequest, Scenario
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.scene.log_views import log_actors
from alpasim_plugin.lab.bench.colour_video_vdp import ColourVideoVDP
from alpasim_plugin.lab.bench.lane_paint import PaintCounts, Road, compare_paint, road_of
from alpasim_plugin.lab.bench.open_loop import TrueImage
from alpasim_plugin.lab.bench.photograph import posed_photograph
from alpasim_plugin.lab.video_metrics.image_distance import ImageDistance, image_distances
from alpasim_plugin.lab.video_metrics.warp import warp_l1
from evaluators.statistics.intervals import median_interval

SETS = ("held-out", "never-fitted")
BIN_M = (0.25, 0.75, 1.5, 3.0)  # rows end at these distances from the recorded path
METRICS = (
    "psnr_db",
    "ssim",
    "perceptual_syn",
    "cvvdp_jod",
    "warp_l1",
    "paint_precision",
    "paint_recall",
)
Row = dict[str, str | int | float | None]
Report = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class Shot:
    """A photograph at the size that is measured.

    Attributes:
        photograph: As the drive has it.
        camera: Where it was taken from.
        rgb: ``(H, W, 3)``.
        distance_m: From the path along which the photographs of the fit were taken.
        road: Where it shows the road.
    """

    photograph: Photograph
    camera: PinholeCamera
    rgb: U8
    distance_m: float
    road: Road


@dataclass(frozen=True, eq=False)
class Judges:
    """What is asked besides PSNR and SSIM."""

    perceptual: ImageDistance
    vdp: ColourVideoVDP | None


def unseen_cameras(scenario: Scenario) -> list[str]:
    """Return the cameras that took photographs which the fit never saw.

    Raises:
        InputError: The scenario is no imported drive, or its fit saw every photograph.
    """
    if scenario.model is None:
        raise InputError(
            f"{scenario.scene_id}: no recorded drive: it has no photographs",
            "give a drive that was imported: simrun import drive FOLDER -o OUT",
        )
    cameras = sorted({frame.camera for frame in scenario.recording if frame.use in SETS})
    if not cameras or sum(frame.use == "fitted" for frame in scenario.recording) < 2:
        raise InputError(
            f"{scenario.scene_id}: no photograph that the fit did not see",
            "import it again: every eighth photograph is held out where there are eight",
        )
    return cameras


def shots_of(scenario: Scenario) -> dict[str, list[Shot]]:
    """Return all photographs of every camera of `unseen_cameras`, in order of time."""
    path = np.array(
        [
            photograph.T_world_camera[:3, 3]
            for photograph in scenario.recording
            if photograph.use == "fitted"
        ]
    )
    taken = {
        name: sorted(
            (photograph for photograph in scenario.recording if photograph.camera == name),
            key=lambda photograph: photograph.t_us,
        )
        for name in unseen_cameras(scenario)
    }
    return {
        name: [_shot(scenario, photograph, path) for photograph in photographs]
        for name, photographs in taken.items()
    }


def _shot(scenario: Scenario, photograph: Photograph, path: F64) -> Shot:
    spec = next(
        (camera for camera in scenario.cameras if camera.name == photograph.camera),
        scenario.cameras[0],
    )
    camera, rgb = posed_photograph(photograph, spec.width, spec.height)
    road = road_of(camera, scenario.ground, scenario.ego_log.xyz)
    return Shot(photograph, camera, rgb, _distance(path, photograph.T_world_camera[:3, 3]), road)


def _distance(path: F64, place: F64) -> float:
    """Return the distance of a place from a path ``(N, 3)``, metres."""
    return float(min(_to_segment(a, b, place) for a, b in pairwise(path)))


def _to_segment(a: F64, b: F64, place: F64) -> float:
    along = b - a
    t = float(np.clip((place - a) @ along / max(float(along @ along), 1e-12), 0.0, 1.0))
    return float(np.linalg.norm(a + t * along - place))


def series_of(shots: Mapping[str, Sequence[Shot]]) -> dict[str, list[TrueImage]]:
    """Return photographs as what a policy is asked with."""
    return {
        name: [
            TrueImage(
                shot.photograph.t_us,
                shot.photograph.use,
                shot.photograph.T_world_camera,
                shot.camera.K,
                shot.rgb,
                shot.distance_m,
            )
            for shot in taken
        ]
        for name, taken in shots.items()
    }


def measure_drive(
    name: str,
    scenario: Scenario,
    renderers: Mapping[str, Callable[[], Renderer]],
    judges: Judges,
    report: Report | None = None,
) -> list[Row]:
    """Return a row for each renderer, camera, set of photographs and distance.

    Args:
        name: Of the drive, for its rows.
        scenario: The imported drive.
        renderers: Name to what makes a session of it; every camera gets its own.
        judges: Networks.
        report: Called with renderer and camera, frames done and all.

    Raises:
        InputError: Nothing to measure, or a renderer of blocks of frames.
    """
    shots = shots_of(scenario)
    return image_rows(name, shots, rendered_shots(scenario, renderers, shots, report), judges)


def rendered_shots(
    scenario: Scenario,
    renderers: Mapping[str, Callable[[], Renderer]],
    shots: Mapping[str, Sequence[Shot]],
    report: Report | None = None,
) -> dict[str, dict[str, list[U8]]]:
    """Return by renderer and camera what is shown where each photograph was taken, in order of time.

    Raises:
        InputError: A renderer of blocks of frames.
    """
    requests = {
        camera: [request_of(scenario, shot) for shot in taken] for camera, taken in shots.items()
    }
    return rendered_images(renderers, requests, report)


def rendered_images(
    renderers: Mapping[str, Callable[[], Renderer]],
    requests: Mapping[str, Sequence[RenderRequest]],
    report: Report | None = None,
) -> dict[str, dict[str, list[U8]]]:
    """Return by renderer and camera the images of requests, which are in order of time; every camera
    gets a session of its own.

    Raises:
        InputError: A renderer of blocks of frames.
    """
    tell = report or (lambda subject, done, all: None)
    for make in renderers.values():  # before anything is rendered
        _refuse_blocks(make())
    images: dict[str, dict[str, list[U8]]] = {}
    for renderer, make in renderers.items():
        images[renderer] = {}
        for camera, camera_requests in requests.items():
            session = make()
            frames = []
            for number, request in enumerate(camera_requests, start=1):
                frames.append(session.render(request).rgb)
                tell(f"{renderer}, {camera}", number, len(camera_requests))
            images[renderer][camera] = frames
    return images


def image_rows(
    name: str,
    shots: Mapping[str, Sequence[Shot]],
    images: Mapping[str, Mapping[str, Sequence[U8]]],
    judges: Judges,
) -> list[Row]:
    """Return a row for each renderer, camera, set of photographs and distance.

    Args:
        name: Of the drive, for its rows.
        shots: Photographs by camera.
        images: By renderer and camera, what it shows in the place of each.
        judges: Networks.
    """
    rows = []
    for renderer, images_by_camera in images.items():
        for camera, taken in shots.items():
            for use in SETS:
                rows += _rows(name, renderer, camera, use, taken, images_by_camera[camera], judges)
    return rows


def _refuse_blocks(renderer: Renderer) -> None:
    """Refuse a renderer that makes blocks of frames, or needs to know later ones.

    Raises:
        InputError: It is one.
    """
    if renderer.block is not None or renderer.lookahead:
        raise InputError(
            f"{type(renderer).__name__}: a renderer of blocks of frames",
            "name renderers that make one frame at a time",
        )


def request_of(scenario: Scenario, shot: Shot) -> RenderRequest:
    """Return the request of a frame at a photograph's pose and size."""
    photograph = shot.photograph
    T_rig_camera = (
        inverse(interpolate(scenario.ego_log, photograph.t_us)) @ photograph.T_world_camera
    )
    spec = CameraSpec(
        photograph.camera, shot.camera.width, shot.camera.height, shot.camera.K, T_rig_camera
    )
    return RenderRequest(
        photograph.t_us,
        spec,
        np.stack([photograph.T_world_camera, photograph.T_world_camera]),
        log_actors(scenario, photograph.t_us),
    )


def _rows(
    drive: str,
    renderer: str,
    camera: str,
    use: str,
    taken: Sequence[Shot],
    made: Sequence[U8],
    judges: Judges,
) -> list[Row]:
    chosen = [i for i, shot in enumerate(taken) if shot.photograph.use == use]
    bins = np.searchsorted(BIN_M, [taken[i].distance_m for i in chosen])
    rows: list[Row] = []
    for number in np.unique(bins):
        part = [i for i, b in zip(chosen, bins, strict=True) if b == number]
        distance = float(np.mean([taken[i].distance_m for i in part]))
        head: Row = {
            "drive": drive,
            "renderer": renderer,
            "camera": camera,
            "set": use,
            "distance_m": round(distance, 3),
        }
        rows.append({**head, "n_frames": len(part), **_values(taken, made, part, judges)})
    return rows


def _values(taken: Sequence[Shot], made: Sequence[U8], part: Sequence[int], judges: Judges) -> Row:
    truth = np.stack([taken[i].rgb for i in part])
    images = np.stack([made[i] for i in part])
    pairs = [warp_l1(np.stack([made[i - 1], made[i]]))[0] for i in part if i > 0]
    paint = PaintCounts()
    for i in part:
        paint += compare_paint(made[i], taken[i].rgb, taken[i].road)
    return {
        "psnr_db": _mean([psnr_db(a, b) for a, b in zip(images, truth, strict=True)]),
        "ssim": _mean([ssim(a, b) for a, b in zip(images, truth, strict=True)]),
        "perceptual_syn": _mean(image_distances(judges.perceptual, images, truth)),
        "cvvdp_jod": None if judges.vdp is None else _mean(judges.vdp.jod(images, truth)),
        "warp_l1": _mean(pairs),
        "paint_precision": None if paint.precision is None else round(paint.precision, 4),
        "paint_recall": None if paint.recall is None else round(paint.recall, 4),
    }


def _mean(values: Sequence[float] | F64) -> float | None:
    return round(float(np.mean(values)), 5) if len(values) else None


def intervals(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Return mean, median and the 95 % interval of the median over drives of every metric, by renderer
    and set; none of what one drive alone measured.

    The drives are the sample: frames of one drive are not independent. Nothing bounds these metrics,
    so that no sample bounds their mean; the median's interval takes six drives, and is None before.
    """
    out: list[dict[str, Any]] = []
    for renderer, use in dict.fromkeys((row["renderer"], row["set"]) for row in rows):
        set_rows = [row for row in rows if (row["renderer"], row["set"]) == (renderer, use)]
        for metric in METRICS:
            values = [
                value
                for value in (
                    _of_drive(set_rows, drive, metric)
                    for drive in dict.fromkeys(row["drive"] for row in set_rows)
                )
                if value is not None
            ]
            if len(values) < 2:
                continue
            interval = median_interval(values, "drives")
            out.append(
                {
                    "renderer": renderer,
                    "set": use,
                    "metric": metric,
                    "drives": len(values),
                    "mean": float(np.mean(values)),
                    "median": interval.centre,
                    "median_ci95": interval.bounds,
                }
            )
    return out


def _of_drive(rows: Sequence[Row], drive: object, metric: str) -> float | None:
    """Return a drive's mean of a metric over its rows, by their frames; None where no row has
    it.
    """
    weighted = [
        (float(row[metric]), float(row["n_frames"]))  # type: ignore[arg-type]
        for row in rows
        if row["drive"] == drive and row[metric] is not None
    ]
    return (
        float(np.average([v for v, _ in weighted], weights=[n for _, n in weighted]))
        if weighted
        else None
    )
