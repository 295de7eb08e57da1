"""The frames of an imported drive that its renderer declares: its photographs, where the reconstruction believes that they were taken."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import cv2
import numpy as np

from alpasim_plugin.core.types import F32, F64, U8, Photograph, RecordedFrame, Scenario
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.scene.degrade import log_actors
from alpasim_plugin.io.reading.images import read_image

DOING = "reading a recorded photograph"
DepthFrom = Callable[[PinholeCamera, Mapping[str, F64]], F32]  # camera, actor poses -> depth (H, W) metres, 0 where there is none


def recorded_frames(scenario: Scenario, depth_from: DepthFrom) -> tuple[RecordedFrame, ...]:
    """Return the photographs that the model was fitted to; those held out or of another camera stay unseen, so that they can judge.

    Args:
        scenario: Of an imported drive.
        depth_from: What the renderer sees from a camera.

    Returns:
        In order of time, each at the size at which the scenario renders its camera, where that is smaller, with its field of view.

    Raises:
        InputError: A photograph is missing or damaged.
    """
    widths = {camera.name: camera.width for camera in scenario.cameras}
    fitted = sorted((one for one in scenario.recording if one.use == "fitted"), key=lambda one: (one.t_us, one.camera))
    frames = []
    for one in fitted:
        camera, rgb = posed_photograph(one, widths.get(one.camera, one.width))
        actors = log_actors(scenario, one.t_us)
        frames.append(RecordedFrame(one.t_us, one.camera, camera.K, one.T_world_camera, rgb, depth_from(camera, actors), actors))
    return tuple(frames)


def posed_photograph(one: Photograph, width: int) -> tuple[PinholeCamera, U8]:
    """Read a photograph at a width in pixels, never larger than it is, and return its camera and picture ``(H, W, 3)``.

    Raises:
        InputError: The file is missing or damaged.
    """
    w = min(width, one.width)
    h = max(1, round(one.height * w / one.width))
    K = np.diag([w / one.width, h / one.height, 1.0]) @ one.K
    rgb = np.asarray(read_image(Path(one.path), DOING)[..., ::-1], np.uint8)
    small = rgb if (w, h) == (one.width, one.height) else cv2.resize(rgb, (w, h), interpolation=cv2.INTER_AREA)
    return PinholeCamera.from_pose(w, h, K, one.T_world_camera), np.ascontiguousarray(small, dtype=np.uint8)


def of_use(scenario: Scenario, use: str) -> Sequence[Photograph]:
    """Return the drive's photographs of one use, in order of time."""
    return sorted((one for one in scenario.recording if one.use == use), key=lambda one: (one.t_us, one.camera))
