"""The frames of the recorded drive that a renderer declares, for a fixer to look at.

A scene that was built has no photographs: its recording is what its cameras would have taken along the log, the built scene itself, twice a
second. The poses are those that the reconstruction believes, with the errors of its registration, so a recorded frame is no better placed
than a user's own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import cv2
import numpy as np

from alpasim_plugin.core.geometry import interpolate, inverse
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F32, F64, U8, CameraSpec, RecordedFrame, Scenario
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.raster.output import RasterOutput
from alpasim_plugin.gaussians.scene.degrade import log_actors
from alpasim_plugin.gaussians.scene.scene_graph import SceneGraph
from alpasim_plugin.renderers.reconstruction_key import ReconstructionRecipe

INTERVAL_US, FIRST_US = 500_000, 50_000  # from the log's start; between the frames of a camera at 10 Hz, of which none is a recorded one
POSE_KNOT_VIEWS = 4  # the error of poses is drawn every so many views and interpolated: registration drifts, it does not jump
TURN_RAD_PER_M = 0.044  # of the error's directions: a quarter degree with 0.1 m

Model = Callable[[PinholeCamera, Mapping[str, F64]], RasterOutput]  # renders a view of the reconstruction


@dataclass(frozen=True, eq=False)
class _Shot:
    """One recorded frame of a built scene: where it was taken, and where the reconstruction believes that it was."""

    scene: SceneGraph
    model: Model
    true: PinholeCamera
    believed: PinholeCamera
    actors: Mapping[str, F64]

    def read(self) -> tuple[U8, F32]:
        """Return the built scene's picture, and the model's depth from the believed pose."""
        return self.scene.render(self.true, self.actors, 1).to_uint8(), self.model(self.believed, self.actors).surface_depth()


def built_recording(scenario: Scenario, scene: SceneGraph, model: Model, recipe: ReconstructionRecipe | None) -> tuple[RecordedFrame, ...]:
    """Return the recording of a built scene; a frame is rendered when it is read.

    Args:
        scenario: Its log, cameras and actors.
        scene: The scene as built.
        model: The reconstruction.
        recipe: How that was fitted: how far aside its views lie, and how wrong their poses are; None: on the log, without error.
    """
    log = scenario.ego_log
    times = range(int(log.t_us[0]) + FIRST_US, int(log.t_us[-1]), INTERVAL_US)
    errors = np.broadcast_to(np.eye(4), (len(times), 4, 4))
    if recipe:
        last_view = max(recipe.splat.views - 1, 1)
        at = (np.array(times) - log.t_us[0]) / (log.t_us[-1] - log.t_us[0]) * last_view
        errors = pose_errors(scenario.scene_id, recipe.splat.seed, recipe.pose_error_m, recipe.splat.views, at)
    aside = np.eye(4)
    aside[1, 3] = recipe.aside_m if recipe else 0.0
    return tuple(
        _frame(scenario, scene, model, spec, t_us, interpolate(log, t_us) @ aside @ spec.T_rig_camera, error)
        for t_us, error in zip(times, errors, strict=True)
        for spec in scenario.cameras
    )


def pose_errors(scene_id: str, seed: int, spread_m: float, views: int, at: F64) -> F64:
    """Return by what registration misplaces views: ``(N, 4, 4)``, from the true camera to the believed one.

    Args:
        scene_id, seed: Key of the random stream.
        spread_m: Along each axis of the camera; directions turn by `TURN_RAD_PER_M` of it about each axis.
        views: How many were registered.
        at: ``(N,)`` places in the order of the views, between 0 and ``views - 1``.
    """
    knots = stream(scene_id, seed, "reconstruction.poses").standard_normal((views // POSE_KNOT_VIEWS + 2, 6))
    errors = spread_m * np.stack([np.interp(at / POSE_KNOT_VIEWS, np.arange(len(knots)), column) for column in knots.T], axis=1)  # (N, 6)
    out = np.broadcast_to(np.eye(4), (len(at), 4, 4)).copy()
    out[:, :3, :3] = [cv2.Rodrigues(TURN_RAD_PER_M * error[3:])[0] for error in errors]
    out[:, :3, 3] = errors[:, :3]
    return out


def _frame(
    scenario: Scenario, scene: SceneGraph, model: Model, spec: CameraSpec, t_us: int, T_world_camera: F64, error: F64
) -> RecordedFrame:
    true = PinholeCamera.from_pose(spec.width, spec.height, spec.K, T_world_camera)
    T_world_believed = inverse(error @ true.T_camera_world)
    believed = PinholeCamera.from_pose(spec.width, spec.height, spec.K, T_world_believed)
    actors = dict(log_actors(scenario, t_us))
    return RecordedFrame(t_us, spec.name, spec.K, T_world_believed, actors, _Shot(scene, model, true, believed, actors).read)
