"""Read and write posed views as a folder of images and a ``transforms.json``.

The file's keys are those of Instant-NGP and nerfstudio, which many tools write (COLMAP's poses through their converters, for example):

    {"axes": "opencv", "w": 256, "h": 144, "fl_x": 210.0, "fl_y": 210.0, "cx": 128.0, "cy": 72.0,
     "ply_file_path": "points.ply",
     "frames": [{"file_path": "images/0000.png", "transform_matrix": [[...], [...], [...], [0, 0, 0, 1]],
                 "t_us": 100000, "sky_path": "sky/0000.png", "mask_path": "masks/0000.png"}]}

``transform_matrix`` maps camera points to the world, metres. ``axes`` says how the camera's axes lie and must be there, because files of
both kinds look alike: ``opencv`` is x right, y down, z forward; ``opengl`` is x right, y up, z back (what Instant-NGP and nerfstudio mean).
Sizes and intrinsics may stand in a frame instead. Lenses must be undistorted. Optional: ``t_us`` places the actors of a scenario;
``sky_path`` is white where the image shows sky; ``mask_path`` is black where pixels do not count; ``ply_file_path`` names points to start
from: a binary PLY with x, y, z and, if coloured, red, green, blue (0..255).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import F64, Bool
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.files.ply_header import read_ply_element, read_ply_header
from alpasim_plugin.gaussians.fit.start import cloud_from_points
from alpasim_plugin.gaussians.fit.views import PosedView
from alpasim_plugin.io.atomic import write_json
from alpasim_plugin.io.limits import SOURCE_BYTES
from alpasim_plugin.io.reading import read_bytes, read_json_object
from alpasim_plugin.io.reading.images import decode_image
from alpasim_plugin.io.reading.json_files import as_shape

FILE = "transforms.json"
DOING = "reading posed views"
AXES = {"opencv": np.eye(4), "opengl": np.diag([1.0, -1.0, -1.0, 1.0])}  # the file's camera axes to ours
_LENS = ("k1", "k2", "k3", "k4", "p1", "p2")

ActorsAt = Callable[[int], Mapping[str, F64]]  # time in microseconds -> actor id to T_world_box


def read_views(folder: Path, actors_at: ActorsAt | None = None) -> tuple[list[PosedView], GaussianCloud | None]:
    """Read a folder of posed images.

    Args:
        folder: Holds ``transforms.json`` and what it names.
        actors_at: Poses of the actors at a frame's ``t_us``; None, or a frame without time, has no actors.

    Returns:
        The views in the file's order; and the start cloud that its points give, None where it names no points.

    Raises:
        InputError: A file or key is missing, or something in them cannot be: names the frame and what was found.
    """
    path = folder / FILE
    document = read_json_object(path, DOING, do_this=f"give a folder with a readable {FILE} (docs/reconstruction.md)")
    axes = document.get("axes")
    if not isinstance(axes, str) or axes not in AXES:
        do = 'write "axes": "opencv" (y down, z forward) or "axes": "opengl" (y up, z back)'
        raise InputError(DOING, f"{path}, key 'axes'", repr(axes), do)
    frames = as_shape(list[dict[str, Any]], document.get("frames") or [], f"{path}, key 'frames'", DOING)
    if not frames:
        raise InputError(DOING, str(path), "no frames", "list at least one frame")
    views = [_view(folder, {**document, **frame}, f"{path}, frame {i}", AXES[axes], actors_at) for i, frame in enumerate(frames)]
    points = document.get("ply_file_path")
    return views, None if points is None else read_points(folder / points)


def write_views(folder: Path, views: Sequence[PosedView]) -> None:
    """Write views in the form that `read_views` reads: images as PNG, axes of OpenCV; depth and actors are not written."""
    frames = []
    for i, view in enumerate(views):
        camera = view.camera
        frame: dict[str, Any] = {
            "file_path": f"images/{i:04d}.png", "transform_matrix": inverse(camera.T_camera_world).tolist(),
            "w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy,
        }  # fmt: skip
        _write_image(folder / frame["file_path"], view.rgb[..., ::-1])
        for key, image in (("sky", view.sky), ("mask", view.mask)):
            if image is not None:
                frame[f"{key}_path"] = f"{key}/{i:04d}.png"
                _write_image(folder / frame[f"{key}_path"], image.astype(np.uint8) * 255)
        frames.append(frame)
    write_json(folder / FILE, {"axes": "opencv", "frames": frames})


def read_points(path: Path) -> GaussianCloud:
    """Read a PLY of points as a start cloud; points without colour are grey.

    Raises:
        InputError: No such file, not a binary PLY of points, or no finite point.
    """
    rows = read_ply_element(read_ply_header(path), "vertex")
    names = rows.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise InputError("reading start points", str(path), f"properties {list(names)}", "give x, y and z")
    points = np.stack([rows[n].astype(np.float64) for n in ("x", "y", "z")], axis=1)
    coloured = {"red", "green", "blue"} <= set(names)
    rgb = np.stack([rows[n] for n in ("red", "green", "blue")], axis=1) / 255.0 if coloured else np.full(points.shape, 0.5)
    good = np.isfinite(points).all(axis=1)
    if not good.any():
        raise InputError("reading start points", str(path), f"{len(points)} points, none finite", "give points in metres")
    return cloud_from_points(points[good], rgb[good])


def _view(folder: Path, frame: Mapping[str, Any], where: str, axes: F64, actors_at: ActorsAt | None) -> PosedView:
    bent = {k: frame[k] for k in _LENS if frame.get(k)}
    if bent:
        raise InputError(DOING, where, f"lens distortion {bent}", "undistort the images first (ns-process-data, colmap image_undistorter)")
    try:
        width, height = int(frame["w"]), int(frame["h"])
        K = np.array([[frame["fl_x"], 0, frame["cx"]], [0, frame["fl_y"], frame["cy"]], [0, 0, 1]], dtype=np.float64)
        T_world_camera = np.array(frame["transform_matrix"], dtype=np.float64) @ axes
        file = folder / frame["file_path"]
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(DOING, where, f"{type(error).__name__}: {error}", "see docs/reconstruction.md for the keys of a frame") from error
    rgb = _read_image(file, where, cv2.IMREAD_COLOR)[..., ::-1]
    camera = PinholeCamera.from_pose(width, height, K, T_world_camera)
    sky, mask = (_flags(folder, frame, key, where) for key in ("sky_path", "mask_path"))
    actors = actors_at(int(frame["t_us"])) if actors_at is not None and "t_us" in frame else {}
    return PosedView(camera, np.ascontiguousarray(rgb), file.stem, sky, mask, actors=actors)


def _flags(folder: Path, frame: Mapping[str, Any], key: str, where: str) -> Bool | None:
    return None if key not in frame else np.asarray(_read_image(folder / frame[key], where, cv2.IMREAD_GRAYSCALE) > 127)


def _read_image(path: Path, where: str, flag: int) -> np.ndarray[Any, np.dtype[np.uint8]]:
    do = "check the path, which is relative to the folder, and the file"
    image = decode_image(read_bytes(path, DOING, SOURCE_BYTES, do), f"{where}, {path}", DOING, do, flag)
    return np.asarray(image, dtype=np.uint8)


def _write_image(path: Path, image: np.ndarray[Any, np.dtype[np.uint8]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), image):
        raise InputError("writing posed views", str(path), "the image could not be written", "check the folder and the space on the disk")
