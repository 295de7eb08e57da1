"""The frames of the recorded drive that a renderer declares, for a fixer to look at; each is read
when it is first needed.

Of an imported drive they are the photographs that its model was fitted to. A scene that was built
has no photographs: its recording is what its cameras would have taken along the log, the built
scene itself, twice a second. The poses are those that the reconstruction believes, with the errors
of its registration, so a recorded frame is no better placed than a user's own.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from pathlib import Path

import cv2
import numpy as np

from alpasim_plugin.cameras.lens import lens_camera
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.images import AS_STORED, read_image
from alpasim_plugin.core.geometry import interpolate, inverse, rigid, shifted
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F32, F64, U8, CameraSpec, Photograph, RecordedFrame, Scenario
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.raster.output import RasterOutput
from alpasim_plugin.gaussians.scene.log_views import log_actors
from alpasim_plugin.gaussians.scene.scene_graph import Camera, SceneGraph, posed
from alpasim_plugin.renderers.reconstruction_key import ReconstructionRecipe

INTERVAL_US = 500_000  # from the log's start
FIRST_US = 50_000  # between the frames of a camera at 10 Hz, of which none is a recorded one
# the error of poses is drawn this often and interpolated: registration drifts, it does not jump
POSE_KNOT_US = 700_000
# of rendered images and depths that a built scene's recording keeps: 48 of 512x288, three of
# 1920x1080
KEPT_BYTES = 50_000_000
TURN_RAD_PER_M = 0.044  # of the error's directions: a quarter degree with 0.1 m

BYTES_PER_PX = 7  # three of colour, four of depth
# Renders a view of the reconstruction
Model = Callable[[Camera, Mapping[str, F64]], RasterOutput]
# Camera, actor poses -> depth (H, W) metres, 0 where there is none
DepthFrom = Callable[[PinholeCamera, Mapping[str, F64]], F32]


def built_recording(
    scenario: Scenario,
    scene: SceneGraph,
    model: Model,
    recipe: ReconstructionRecipe | None,
    cameras: Sequence[CameraSpec],
) -> tuple[RecordedFrame, ...]:
    """Return the recording of a built scene; a frame is rendered when it is first read, and kept as
    a file would be.

    Args:
        scenario: Its log and actors, and the cameras that the model was fitted to.
        scene: The scene as built.
        model: The reconstruction.
        recipe: How that was fitted: how far to the left its views lie, and how wrong their poses are;
            None: on the log, without error.
        cameras: Those of the recording: the scenario's, or cameras with lenses that these cover.
    """
    log = scenario.ego_log
    times = range(int(log.t_us[0]) + FIRST_US, int(log.t_us[-1]), INTERVAL_US)
    T_rig_offset = shifted(0.0, recipe.lateral_offset_m if recipe else 0.0)
    largest = max((spec.width * spec.height for spec in cameras), default=1)
    firsts: dict[str, F64] = {}  # mounting of the first pinhole of each camera
    for spec in scenario.cameras:
        firsts.setdefault(lens_camera(spec.name), spec.T_rig_camera)
    shots: list[tuple[Camera, Camera, Mapping[str, F64]]] = []

    @lru_cache(maxsize=max(1, KEPT_BYTES // (largest * BYTES_PER_PX)))
    def read(number: int) -> tuple[U8, F32]:
        """Return the built scene's image, and the model's depth from the believed pose."""
        true, believed, actors = shots[number]
        return scene.render(true, actors, 1).to_uint8(), model(believed, actors).surface().depth

    frames = []
    for t_us in times:
        actors = log_actors(scenario, t_us)
        T_world_rig = interpolate(log, t_us) @ T_rig_offset
        for spec in cameras:
            T_world_camera = T_world_rig @ spec.T_rig_camera
            true = posed(spec, T_world_camera)
            T_world_believed = T_world_camera
            if recipe:
                first = inverse(T_world_rig @ firsts[lens_camera(spec.name)])
                key = scenario.scene_id, recipe.splat.seed, recipe.pose_error_m, spec.name, t_us
                T_world_believed = inverse(believed_pose(true.T_camera_world, first, *key))
            believed = posed(spec, T_world_believed)
            once = partial(read, len(shots))
            shots.append((true, believed, actors))
            content = spec.K, T_world_believed, actors, once, spec.lens
            frames.append(RecordedFrame(t_us, spec.name, *content))
    return tuple(frames)


def believed_pose(
    T_camera_world: F64,
    first: F64,
    scene_id: str,
    seed: int,
    spread_m: float,
    camera: str,
    t_us: int,
) -> F64:
    """Return where registration believes a view ``(4, 4)``; the pinholes of a lens move as one.

    Args:
        T_camera_world: Its true pose.
        first: That of the first pinhole of its lens at that time; of a camera without a lens its
            own.
        scene_id, seed: Key of the random streams, with the camera's name and the time.
        spread_m: Along each axis of the camera; directions turn by `TURN_RAD_PER_M` of it about
            each axis.
        camera: Its name; that of a lens, or of a pinhole of it.
        t_us: When it was taken.
    """
    knot, after_us = divmod(t_us, POSE_KNOT_US)
    before, after = (
        stream(
            scene_id, seed, f"reconstruction.poses.{lens_camera(camera)}", number
        ).standard_normal(6)
        for number in (knot, knot + 1)
    )
    error = spread_m * (before + (after - before) * after_us / POSE_KNOT_US)
    moved = rigid(cv2.Rodrigues(TURN_RAD_PER_M * error[3:])[0], error[:3])
    return T_camera_world @ inverse(first) @ moved @ first


def photograph_recording(scenario: Scenario, depth_from: DepthFrom) -> tuple[RecordedFrame, ...]:
    """Return the photographs that the model was fitted to; those held out or of another camera stay
    unseen, for evaluation.

    Args:
        scenario: Of an imported drive.
        depth_from: What the renderer sees from a camera.

    Returns:
        In order of time, each at the size at which the scenario renders its camera, where that is
        smaller, with its field of view. Reading one raises `InputError` where its file is missing
        or damaged.
    """
    widths = {camera.name: camera.width for camera in scenario.cameras}
    frames = []
    for photograph in sorted(
        scenario.recording, key=lambda photograph: (photograph.t_us, photograph.camera)
    ):
        if photograph.use != "fitted":
            continue
        camera = photograph_camera(photograph, widths.get(photograph.camera, photograph.width))
        actors = log_actors(scenario, photograph.t_us)
        read = partial(_read, photograph, camera, partial(depth_from, camera, actors))
        frames.append(
            RecordedFrame(
                photograph.t_us,
                photograph.camera,
                camera.K,
                photograph.T_world_camera,
                actors,
                read,
            )
        )
    return tuple(frames)


def photograph_camera(photograph: Photograph, width: int) -> PinholeCamera:
    """Return a photograph's camera with so many pixels across, never more than it has."""
    w = min(width, photograph.width)
    h = max(1, round(photograph.height * w / photograph.width))
    return PinholeCamera.from_pose(
        w,
        h,
        np.diag([w / photograph.width, h / photograph.height, 1.0]) @ photograph.K,
        photograph.T_world_camera,
    )


def photograph_image(photograph: Photograph, camera: PinholeCamera) -> U8:
    """Read a photograph at the size of its camera ``(H, W, 3)``.

    Raises:
        InputError: The file is missing, damaged or of another size.
    """
    rgb = read_image(Path(photograph.path), AS_STORED)[..., ::-1]
    if rgb.shape[:2] != (photograph.height, photograph.width):
        raise InputError(
            f"{photograph.path}: {rgb.shape[1]}x{rgb.shape[0]} pixels, the scenario says {photograph.width}x{photograph.height}",
            "give the photograph as it was imported",
        )
    size = camera.width, camera.height
    small = cv2.resize(rgb, size, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(small, dtype=np.uint8)


def _read(
    photograph: Photograph, camera: PinholeCamera, depth: Callable[[], F32]
) -> tuple[U8, F32]:
    return photograph_image(photograph, camera), depth()
