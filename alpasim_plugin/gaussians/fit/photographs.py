"""Read and write photographs with poses: a folder of images and a ``transforms.json``.

The file's keys are those of Instant-NGP and nerfstudio, which many tools write (COLMAP's poses through their converters, for example):

    {"axes": "opencv", "w": 256, "h": 144, "fl_x": 210.0, "fl_y": 210.0, "cx": 128.0, "cy": 72.0, "k1": -0.1,
     "ply_file_path": "points.ply",
     "frames": [{"file_path": "images/0000.png", "transform_matrix": [[...], [...], [...], [0, 0, 0, 1]],
                 "t_us": 100000, "sky_path": "sky/0000.png", "mask_path": "masks/0000.png"}]}

``transform_matrix`` maps camera points to the world. ``axes`` says how the camera's axes lie: ``opencv`` is x right, y down, z forward;
``opengl`` is x right, y up, z back (what Instant-NGP and nerfstudio mean). Sizes, intrinsics and OpenCV's distortion (k1, k2, p1, p2, k3)
may stand in a frame instead; pictures are freed of their distortion as they are read. Optional: ``t_us`` places the actors of a scenario;
``sky_path`` is white where the image shows sky; ``mask_path`` is black where pixels do not count; ``ply_file_path`` names points to start
from: a binary PLY with x, y, z and, if coloured, red, green, blue (0..255).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.types import F64, U8, Bool
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.files.ply import read_ply_element, read_ply_header
from alpasim_plugin.gaussians.fit.start import cloud_from_points
from alpasim_plugin.gaussians.fit.views import PosedView
from alpasim_plugin.io.atomic import write_json
from alpasim_plugin.io.limits import SOURCE_BYTES
from alpasim_plugin.io.reading import read_bytes, read_json_object
from alpasim_plugin.io.reading.files import as_shape
from alpasim_plugin.io.reading.images import decode_image

FILE = "transforms.json"
DOING = "reading photographs"
AXES = {"opencv": np.eye(4), "opengl": np.diag([1.0, -1.0, -1.0, 1.0])}  # the file's camera axes to ours
LENS_MODELS = ("OPENCV", "PINHOLE")
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3")  # the order of OpenCV
EXTENT_M = 4.0  # structure from motion has no unit: the camera that is farthest from their middle is put so far from it
SIDE_PX = 16  # sides are multiples of this, as fixers need
RIGID = 1e-12  # a rotation this exact is taken as it is written
_FROM_CORNER = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # OpenCV counts from pixel centres

ActorsAt = Callable[[int], Mapping[str, F64]]  # time in microseconds -> actor id to T_world_box


@dataclass(frozen=True)
class Photographs:
    """Photographs in the order of the file.

    Attributes:
        views: Those that exist, without distortion, of one size.
        missing: Names that the file lists and the folder lacks.
        listed: How many the file lists.
    """

    views: tuple[PosedView, ...]
    missing: tuple[str, ...]
    listed: int


def read_views(folder: Path, actors_at: ActorsAt | None = None) -> tuple[list[PosedView], GaussianCloud | None]:
    """Read a folder of posed images at full size, in metres: ``axes`` must be there, because files of both kinds look alike.

    Args:
        folder: Holds ``transforms.json`` and what it names.
        actors_at: Poses of the actors at a frame's ``t_us``; None, or a frame without time, has no actors.

    Returns:
        The views in the file's order; and the start cloud that its points give, None where it names no points.

    Raises:
        InputError: A file or key is missing, or something in them cannot be: names the frame and what was found.
    """
    path = folder / FILE
    document, frames = _frames(path)
    axes = document.get("axes")
    if not isinstance(axes, str) or axes not in AXES:
        do = 'write "axes": "opencv" (y down, z forward) or "axes": "opengl" (y up, z back)'
        raise InputError(DOING, f"{path}, key 'axes'", repr(axes), do)
    if not frames:
        raise InputError(DOING, str(path), "no frames", "list at least one frame")
    views = []
    for i, frame in enumerate(frames):
        where = f"{path}, frame {i}"
        lens, pose = _lens(frame, where), _pose(frame, where, AXES[axes])
        view = _view(folder, frame, where, lens, pose)
        sky, mask = (_flags(folder, frame, key, where, lens) for key in ("sky_path", "mask_path"))
        actors = actors_at(int(frame["t_us"])) if actors_at is not None and "t_us" in frame else {}
        views.append(replace(view, sky=sky, mask=mask, actors=actors))
    points = document.get("ply_file_path")
    return views, None if points is None else read_points(folder / points)


def read_photographs(folder: Path, width: int = 256) -> Photographs:
    """Read a folder of photographs from structure from motion: axes of OpenGL, an arbitrary unit, and not all images there.

    A picture is freed of its distortion at full size, then reduced by averaging, and its height is cut at the middle to a multiple of 16.

    Args:
        folder: Holds ``transforms.json`` and the images that it names.
        width: Pixels across of the views, a multiple of 16.

    Raises:
        InputError: No such file, a key is missing, another lens model than OpenCV's, or fewer than two images exist.
    """
    path = folder / FILE
    if width < SIDE_PX or width % SIDE_PX:
        raise InputError(DOING, f"width {width}", f"not a multiple of {SIDE_PX}", f"choose for example {16 * SIDE_PX}")
    _, frames = _frames(path)
    there = {f"{path}, frame {i}": frame for i, frame in enumerate(frames) if (folder / str(frame.get("file_path"))).is_file()}
    missing = [str(frame.get("file_path")) for i, frame in enumerate(frames) if f"{path}, frame {i}" not in there]
    if len(there) < 2:
        raise InputError(DOING, str(folder), f"{len(there)} of {len(frames)} listed images exist", "give the images that the file names")
    poses = _scaled(np.array([_pose(frame, where, AXES["opengl"]) for where, frame in there.items()]))
    views = []
    for (where, frame), pose in zip(there.items(), poses, strict=True):
        views.append(_cut(_view(folder, frame, where, _lens(frame, where), pose), width, where))
    return Photographs(tuple(views), tuple(missing), len(frames))


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


def resized(view: PosedView, width: int) -> PosedView:
    """Return a view with another number of pixels, its field of view unchanged; sky, mask and depth are left out."""
    camera = view.camera
    height = round(camera.height * width / camera.width)
    K = np.diag([width / camera.width, height / camera.height, 1.0]) @ camera.K
    rgb = cv2.resize(view.rgb, (width, height), interpolation=cv2.INTER_AREA)
    return PosedView(PinholeCamera(width, height, K, camera.T_camera_world), np.asarray(rgb, dtype=np.uint8), view.name)


class _Lens(NamedTuple):
    """What a frame says of its lens: the picture's size, intrinsics, and OpenCV's coefficients of distortion."""

    width: int
    height: int
    K: F64
    distortion: F64

    def straight_K(self) -> F64:
        """Return the intrinsics without distortion: what they show is all in the photograph."""
        if not self.distortion.any():
            return self.K
        whole, _ = cv2.getOptimalNewCameraMatrix(self.K - _FROM_CORNER, self.distortion, (self.width, self.height), 0.0)
        straight: F64 = np.asarray(whole, dtype=np.float64) + _FROM_CORNER
        return straight

    def straightened(self, image: U8) -> U8:
        """Return an image freed of the distortion."""
        if not self.distortion.any():
            return image
        whole = self.straight_K() - _FROM_CORNER
        return np.asarray(cv2.undistort(image, self.K - _FROM_CORNER, self.distortion, None, whole), dtype=np.uint8)


def _frames(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the document, and its frames with what it says for all of them."""
    document = read_json_object(path, DOING, do_this=f"give a folder with images and their {FILE} (docs/reconstruction.md)")
    frames = as_shape(list[dict[str, Any]], document.get("frames") or [], f"{path}, key 'frames'", DOING)
    return document, [{**document, **frame} for frame in frames]


def _lens(frame: Mapping[str, Any], where: str) -> _Lens:
    model = frame.get("camera_model", LENS_MODELS[0])
    if model not in LENS_MODELS or frame.get("k4"):
        found = f"lens model {model}" if model not in LENS_MODELS else "a coefficient k4"
        do = "give OpenCV's k1, k2, p1, p2, k3, or undistort the images first (ns-process-data, colmap image_undistorter)"
        raise InputError(DOING, where, found, do)
    try:
        width, height = int(frame["w"]), int(frame["h"])
        K = np.array([[frame["fl_x"], 0, frame["cx"]], [0, frame["fl_y"], frame["cy"]], [0, 0, 1]], dtype=np.float64)
        distortion = np.array([float(frame.get(key) or 0.0) for key in COEFFICIENTS])
        if not np.isfinite([*K.ravel(), *distortion]).all() or min(K[0, 0], K[1, 1]) <= 0:
            raise ValueError("intrinsics that are not finite, or no focal length")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        do = "give w, h, fl_x, fl_y, cx and cy in pixels, and k1, k2, p1, p2 where the lens bends lines (docs/reconstruction.md)"
        raise InputError(DOING, where, f"{type(error).__name__}: {error}", do) from error
    return _Lens(width, height, K, distortion)


def _pose(frame: Mapping[str, Any], where: str, axes: F64) -> F64:
    where = f"{where}, transform_matrix"
    T = np.asarray(as_shape(list[list[float]], frame.get("transform_matrix"), where, DOING), dtype=np.float64)
    if T.shape != (4, 4) or not np.isfinite(T).all():
        raise InputError(DOING, where, f"shape {T.shape}", "give a finite matrix of 4 x 4")
    u, _, vt = np.linalg.svd(T[:3, :3])
    rotation = u @ vt
    off = np.abs(T[:3, :3] - rotation).max()
    if off > 1e-3 or np.linalg.det(rotation) < 0:
        raise InputError(DOING, where, "its first three columns are no rotation", "give a rigid transform")
    if off > RIGID:  # what is written with a few digits is not quite a rotation
        T[:3, :3] = rotation
    return np.asarray(T @ axes)


def _scaled(poses: F64) -> F64:
    out = poses.copy()
    middle = out[:, :3, 3].mean(axis=0)
    farthest = float(np.linalg.norm(out[:, :3, 3] - middle, axis=1).max())
    if farthest > 0:
        out[:, :3, 3] = (out[:, :3, 3] - middle) * (EXTENT_M / farthest)
    return out


def _view(folder: Path, frame: Mapping[str, Any], where: str, lens: _Lens, T_world_camera: F64) -> PosedView:
    file = _file(folder, frame, "file_path", where)
    rgb = lens.straightened(_read_image(file, where, lens, cv2.IMREAD_COLOR)[..., ::-1])
    camera = PinholeCamera.from_pose(lens.width, lens.height, lens.straight_K(), T_world_camera)
    return PosedView(camera, np.ascontiguousarray(rgb), file.stem)


def _cut(view: PosedView, width: int, where: str) -> PosedView:
    """Reduce a view to a width, and cut its height at the middle to a multiple of `SIDE_PX`."""
    small = resized(view, width)
    height = small.camera.height
    kept = height // SIDE_PX * SIDE_PX
    if kept < SIDE_PX:
        raise InputError(DOING, where, f"{height} pixels high at {width} across", "choose a larger width")
    top = (height - kept) // 2
    K = small.camera.K.copy()
    K[1, 2] -= top
    camera = PinholeCamera(width, kept, K, small.camera.T_camera_world)
    return PosedView(camera, np.ascontiguousarray(small.rgb[top : top + kept]), view.name)


def _flags(folder: Path, frame: Mapping[str, Any], key: str, where: str, lens: _Lens) -> Bool | None:
    if key not in frame:
        return None
    image = _read_image(_file(folder, frame, key, where), where, lens, cv2.IMREAD_GRAYSCALE)
    return np.asarray(lens.straightened(image) > 127)


def _file(folder: Path, frame: Mapping[str, Any], key: str, where: str) -> Path:
    name = frame.get(key)
    if not isinstance(name, str):
        raise InputError(DOING, f"{where}, {key}", repr(name), "name a file, relative to the folder")
    return folder / name


def _read_image(path: Path, where: str, lens: _Lens, flag: int) -> U8:
    do = "check the path, which is relative to the folder, and the file"
    data = read_bytes(path, DOING, SOURCE_BYTES, do)
    image = np.asarray(decode_image(data, f"{where}, {path}", DOING, do, flag), dtype=np.uint8)
    height, width = image.shape[:2]
    if (width, height) != (lens.width, lens.height):
        found = f"{width}x{height} pixels, the file says {lens.width}x{lens.height}"
        raise InputError(DOING, f"{where}, {path}", found, "give the photographs as they were")
    return image


def _write_image(path: Path, image: U8) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if not cv2.imwrite(str(path), image):
        raise InputError("writing posed views", str(path), "the image could not be written", "check the folder and the space on the disk")
