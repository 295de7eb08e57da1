"""A calibration written as a ``transforms.json``: one frame for each camera, whose
``transform_matrix`` maps camera points to the rig.

Keys are those of Instant-NGP and nerfstudio, as in `gaussians.fit.photographs`, and may stand once
for all frames.
"""

from pathlib import Path
from typing import Literal, NotRequired

import numpy as np
from typing_extensions import TypedDict

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import read_json_object
from alpasim_plugin.core.files.fields import Fields, met_in
from alpasim_plugin.core.files.reading import as_shape
from alpasim_plugin.core.geometry import intrinsics
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.core.types import CameraSpec, LensModel

DO_THIS = "give a calibration with one frame for each camera (docs/cameras.md)"
FLIPS = {"opencv": [1.0, 1.0, 1.0, 1.0], "opengl": [1.0, -1.0, -1.0, 1.0]}  # y and z of the camera
COEFFICIENTS = {
    "opencv": ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "fisheye": ("k1", "k2", "k3", "k4"),
}
RIG = Fields(
    "transforms.json of a rig",
    read={
        "frame": f"""frames camera camera_model axes w h fl_x fl_y cx cy transform_matrix
            {" ".join(COEFFICIENTS["opencv"])}"""
    },
    # A focal length is stated beside an angle, and no photograph is read.
    harmless={"frame": "aabb_scale camera_angle_x camera_angle_y file_path"},
    others="refused",
)
ROTATION_ERROR = 1e-3


class _Frame(TypedDict):
    """What is relied on in a frame, with what the file says for all of them."""

    camera: str
    camera_model: NotRequired[Literal["OPENCV", "OPENCV_FISHEYE"]]
    axes: Literal["opencv", "opengl"]
    w: int
    h: int
    fl_x: float
    fl_y: float
    cx: float
    cy: float
    transform_matrix: list[list[float]]


def read_transforms(path: Path) -> tuple[CameraSpec, ...]:
    """Read the cameras of a calibration.

    Raises:
        InputError: A key is missing, cannot be or is not read, or a camera has two frames.
    """
    document = read_json_object(path, do_this=DO_THIS)
    frames = as_shape(list[JsonObject], document.get("frames"), f"{path}, frames", DO_THIS)
    cameras: dict[str, CameraSpec] = {}
    for i, frame in enumerate(frames):
        together = {**document, **frame}
        met = met_in("frame", (key for key, value in together.items() if value))
        RIG.check(met, f"{path}, frame {i}", "write the rig without these keys")
        camera = _camera(together, f"{path}, frame {i}")
        if camera.name in cameras:
            raise InputError(
                f"{path}, frame {i}: a second frame of camera {camera.name!r}",
                "give one frame for each camera, with its pose on the rig; simrun import drive reads a recorded drive",
            )
        cameras[camera.name] = camera
    return tuple(cameras.values())


def _camera(document: JsonObject, location: str) -> CameraSpec:
    frame = as_shape(_Frame, document, location, DO_THIS)
    kind: Literal["opencv", "fisheye"] = (
        "fisheye" if frame.get("camera_model") == "OPENCV_FISHEYE" else "opencv"
    )
    others = set(COEFFICIENTS["opencv"]) - set(COEFFICIENTS[kind])
    lacking = sorted(key for key in others if document.get(key))
    if lacking:
        raise InputError(
            f"{location}: {', '.join(lacking)}, which a {kind} lens does not have",
            "name the lens that has them by camera_model",
        )
    coefficients = [document.get(key, 0.0) for key in COEFFICIENTS[kind]]
    bent = tuple(as_shape(list[float], coefficients, f"{location}, coefficients", DO_THIS))
    pose = frame["transform_matrix"]
    if [len(row) for row in pose] != [4, 4, 4, 4]:
        raise InputError(f"{location}, transform_matrix: not 4 x 4", DO_THIS)
    T_rig_camera = np.array(pose, dtype=np.float64) * FLIPS[frame["axes"]]
    rotation = T_rig_camera[:3, :3]
    off = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if not (off < ROTATION_ERROR and np.linalg.det(rotation) > 0):
        raise InputError(
            f"{location}, transform_matrix: its first three columns are no rotation (off by {off:.2g})",
            "give a rigid transform from the camera to the rig",
        )
    K = intrinsics(*(frame[name] for name in ("fl_x", "fl_y", "cx", "cy")))
    lens = LensModel(kind, bent) if any(bent) or kind == "fisheye" else None
    return CameraSpec(frame["camera"], frame["w"], frame["h"], K, T_rig_camera, lens=lens)
