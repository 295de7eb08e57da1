"""Read and write photographs with poses: a folder of images and a ``transforms.json``. A photograph is a
view through its lens, or freed of its distortion.

The file's keys are those of Instant-NGP and nerfstudio, which many tools write (COLMAP's poses
through their converters, for example):

    {"axes": "opencv", "w": 256, "h": 144, "fl_x": 210.0, "fl_y": 210.0, "cx": 128.0, "cy": 72.0,
    "k1": -0.1,
     "ply_file_path": "points.ply",
     "frames": [{"file_path": "images/0000.png", "transform_matrix": [[...], [...], [...], [0, 0, 0,
         1]], "t_us": 100000, "camera": "front"}]}

``transform_matrix`` maps camera points to the world. ``axes`` says how the camera's axes lie:
``opencv`` is x right, y down, z forward; ``opengl`` is x right, y up, z back (what Instant-NGP and
nerfstudio mean). Sizes, intrinsics and OpenCV's distortion (k1, k2, p1, p2, k3; with
``"camera_model": "OPENCV_FISHEYE"`` k1 to k4) may stand in a frame instead; ``camera_angle_x`` and
``camera_angle_y``, radians, or ``x_fov`` and ``y_fov``, degrees, may stand for the focal lengths.
Optional: ``t_us`` places the actors of a scenario; ``camera`` names the camera; ``ply_file_path``
names points to start from: a binary PLY with x, y, z and, if coloured, red, green, blue (0..255).
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from alpasim_plugin.cameras.lens import resized as resized_camera
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import read_bytes, read_json_object
from alpasim_plugin.core.files.fields import Fields, field_name
from alpasim_plugin.core.files.images import AS_STORED, check_image, decode_image, image_fault
from alpasim_plugin.core.files.limits import SOURCE_BYTES
from alpasim_plugin.core.files.reading import as_shape
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.core.types import F64, U8
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.files.ply import read_ply_element, read_ply_header
from alpasim_plugin.gaussians.fit.lens import Lens
from alpasim_plugin.gaussians.fit.start import cloud_from_points
from alpasim_plugin.gaussians.fit.views import PosedView
from alpasim_plugin.gaussians.lens_camera import LensCamera

FILE = "transforms.json"
# The file's camera axes to ours
AXES = {
    "opencv": np.eye(4),
    "opengl": np.diag([1.0, -1.0, -1.0, 1.0]),
}
BENDS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")  # in the order of OpenCV
# Of each lens model, in the order of OpenCV
COEFFICIENTS = {
    "OPENCV": BENDS[:5],
    "PINHOLE": BENDS[:5],
    "SIMPLE_PINHOLE": (),
    "SIMPLE_RADIAL": ("k1",),
    "RADIAL": ("k1", "k2"),
    "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
    "FULL_OPENCV": BENDS,
}
TRANSFORMS = Fields(
    FILE,
    read={
        "frame": """frames axes unit ply_file_path camera_model is_fisheye w h fl_x fl_y cx cy
            camera_angle_x camera_angle_y x_fov y_fov k1 k2 k3 k4 k5 k6 p1 p2 file_path
            transform_matrix t_us camera use"""
    },
    # Settings of viewers and of trainers, and what was done to the poses before they were written.
    harmless={
        "frame": """exposure aabb_scale scale offset render_aabb up sharpness colmap_im_id applied_transform
            applied_scale orientation_override auto_scale_poses_override train_filenames
            val_filenames test_filenames depth_unit_scale_factor integer_depth_scale
            enable_depth_loading enable_ray_loading n_extra_learnable_dims white_transparent
            black_transparent aabb sharpen importance_sampling fix_premult envmap depth_path
            depth_file_path sharpness_discard_threshold"""
    },
    # By these Instant-NGP takes other axes, other lenses, other frames, and cameras that move
    # during an exposure.
    moving={
        "frame": """normal_mts_args ftheta_p# latlong equirectangular n_frames rolling_shutter
            transform_matrix_start transform_matrix_end"""
    },
)
SAME_FOCAL = 0.01  # shares by which two statements of a focal length may differ
WHOLE = "give a whole PNG or JPEG in grey or RGB"
RIGID = 1e-12  # a rotation this exact is taken as it is written


@dataclass(frozen=True, eq=False)
class PosedPhotograph:
    """A photograph in a file, its lens and where it was taken.

    Attributes:
        file: Of the photograph.
        lens: Of its camera.
        T_world_camera: ``(4, 4)``, axes of OpenCV.
        location: The place that names it, for messages.
        t_us: When it was taken; None where that is unknown.
        camera: Name of its camera; None where that is unknown.
        more: What its file says besides.
        data: The encoded image where the file holds more than this one; None reads the file.
    """

    file: Path
    lens: Lens
    T_world_camera: F64
    location: str
    t_us: int | None
    camera: str | None
    more: Mapping[str, Any]
    data: memoryview | None = None

    def encoded(self) -> bytes:
        """Return the encoded image after checking, without decoding it, that it is whole and has
        the size of its lens.

        Raises:
            InputError: The file is missing, cut off, of another size, too large, or not in grey or
                RGB.
        """
        do = "check the path, which is relative to the folder, and the file"
        name = f"{self.location}, {self.file}"
        data = read_bytes(self.file, SOURCE_BYTES, do) if self.data is None else bytes(self.data)
        width, height = check_image(data, name, do)
        if (width, height) != (self.lens.width, self.lens.height):
            raise InputError(
                f"{name}: {width}x{height} pixels, the file says {self.lens.width}x{self.lens.height}",
                "give the photographs as they were",
            )
        fault = image_fault(data)
        if fault:
            raise InputError(f"{name}: {fault}", WHOLE)
        return data

    def rgb(self) -> U8:
        """Return the photograph without distortion, ``(H, W, 3)`` uint8 sRGB.

        Raises:
            InputError: See `encoded`.
        """
        return np.ascontiguousarray(self.lens.straightened(self._as_taken()))

    def _as_taken(self) -> U8:
        bgr = decode_image(self.encoded(), f"{self.location}, {self.file}", WHOLE, AS_STORED)
        return np.asarray(bgr, dtype=np.uint8)[..., ::-1]

    def whole_view(self) -> PosedView:
        """Return it as a view at full size through its lens: all of the photograph, of which those pixels
        count that the lens describes.

        Raises:
            InputError: See `encoded`; or its numbers make no lens.
        """
        if not self.lens.bends:
            return self.view()
        camera = self.lens.camera(self.location, self.T_world_camera)
        return PosedView(
            camera,
            np.ascontiguousarray(self._as_taken()),
            self.file.stem,
            mask=None if camera.visible.all() else camera.visible,
            t_us=int(self.t_us or 0),
        )

    def view(self) -> PosedView:
        """Return it as a view at full size, without distortion."""
        lens = self.lens
        return PosedView(
            PinholeCamera.from_pose(
                lens.width, lens.height, lens.straight_K(), self.T_world_camera
            ),
            self.rgb(),
            self.file.stem,
            t_us=int(self.t_us or 0),
        )


def read_posed_photographs(
    folder: Path, axes: str | None = None
) -> tuple[JsonObject, list[PosedPhotograph]]:
    """Read what a ``transforms.json`` says, without opening its images.

    Args:
        folder: Holds the file.
        axes: How the camera's axes lie where the file's ``axes`` does not say it; None refuses such
            a file.

    Returns:
        The document; its frames as images, in the file's order.

    Raises:
        InputError: The file or a key is missing, or something in it cannot be: names the frame and
            what was found.
    """
    path = folder / FILE
    document = read_json_object(
        path, do_this=f"give a folder with images and their {FILE} (docs/real-drives.md)"
    )
    listed = as_shape(list[JsonObject], document.get("frames") or [], f"{path}, key 'frames'")
    frames = [{**document, **frame} for frame in listed]
    shared = {key: value for key, value in document.items() if key != "frames"}
    met = [
        field_name("frame", key)
        for part in (shared, *listed)
        for key, value in part.items()
        if _is_set(value)
    ]
    TRANSFORMS.check(met, path, "write the poses as they are, without this key")
    meant = document.get("axes", axes)
    if not isinstance(meant, str) or meant not in AXES:
        raise InputError(
            f"{path}, key 'axes': {meant!r}",
            'write "axes": "opencv" (y down, z forward) or "axes": "opengl" (y up, z back)',
        )
    return document, [
        _photograph(folder, frame, f"{path}, frame {i}", AXES[meant])
        for i, frame in enumerate(frames)
    ]


def present(
    folder: Path, photographs: Sequence[PosedPhotograph]
) -> tuple[list[PosedPhotograph], tuple[str, ...]]:
    """Return the images whose files exist, and the names of the others.

    Raises:
        InputError: Fewer than two exist, or one lies outside of the folder.
    """
    existing = [
        photograph
        for photograph in photographs
        if os.path.isfile(photograph.file) and inside(folder, photograph.file, photograph.location)
    ]
    missing = tuple(
        photograph.file.as_posix().removeprefix(f"{folder.as_posix()}/")
        for photograph in photographs
        if not os.path.isfile(photograph.file)
    )
    if len(existing) < 2:
        problem = f"{folder}: {len(existing)} of {len(photographs)} listed images exist"
        if missing and Path(missing[0]).is_absolute():
            raise InputError(
                f"{problem}: the file names paths of another machine, {missing[0]} the first",
                "write the paths relative to the folder",
            )
        raise InputError(
            problem, f"give the images that the file names, {', '.join(missing[:1])} on"
        )
    return existing, missing


def read_points(path: Path) -> GaussianCloud:
    """Read a PLY of points as a start cloud; points without colour are grey.

    Raises:
        InputError: No such file, not a binary PLY of points, or no finite point.
    """
    rows = read_ply_element(read_ply_header(path), "vertex")
    names = rows.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise InputError(f"{path}: properties {list(names)}", "give x, y and z")
    points = np.stack([rows[n].astype(np.float64) for n in ("x", "y", "z")], axis=1)
    coloured = {"red", "green", "blue"} <= set(names)
    rgb = (
        np.stack([rows[n] for n in ("red", "green", "blue")], axis=1) / 255.0
        if coloured
        else np.full(points.shape, 0.5)
    )
    good = np.isfinite(points).all(axis=1)
    if not good.any():
        raise InputError(
            f"{path}: {len(points)} points, none finite",
            "give points in metres",
        )
    return cloud_from_points(points[good], rgb[good])


def resized(view: PosedView, width: int) -> PosedView:
    """Return a view with another number of pixels, its field of view unchanged; without sky, mask
    and depth, which are of single pixels, but for the mask of what a lens describes.
    """
    camera = view.camera
    height = round(camera.height * width / camera.width)
    small: PinholeCamera | LensCamera
    mask = None
    if isinstance(camera, LensCamera):
        small = replace(camera, spec=resized_camera(camera.spec, width, height))
        mask = None if small.visible.all() else small.visible
    else:
        K = np.diag([width / camera.width, height / camera.height, 1.0]) @ camera.K
        small = PinholeCamera(width, height, K, camera.T_camera_world)
    rgb = cv2.resize(view.rgb, (width, height), interpolation=cv2.INTER_AREA)
    return replace(
        view,
        camera=small,
        rgb=np.asarray(rgb, dtype=np.uint8),
        sky=None,
        mask=mask,
        depth=None,
    )


def _photograph(
    folder: Path, frame: Mapping[str, Any], location: str, axes: F64
) -> PosedPhotograph:
    file = _file(folder, frame, "file_path", location)
    camera = frame.get("camera")
    t_us = None if frame.get("t_us") is None else as_shape(int, frame["t_us"], f"{location}, t_us")
    pose = rigid_pose(frame.get("transform_matrix"), f"{location}, transform_matrix") @ axes
    return PosedPhotograph(
        file,
        _lens(frame, file, location),
        pose,
        location,
        t_us,
        None if camera is None else str(camera),
        frame,
    )


def _focal_lengths(frame: Mapping[str, Any], width: int, height: int) -> tuple[float, float]:
    """Return both focal lengths, pixels: as written, else by an angle of view in radians
    (``camera_angle_x``) or degrees (``x_fov``), each axis by its own, as Instant-NGP reads them; an
    axis without any has that of the other one.

    Raises:
        KeyError: Neither axis has one.
        TypeError: One is no number.
    """
    lengths = {}
    for axis, size in (("x", width), ("y", height)):
        if f"fl_{axis}" in frame:
            focal_length = frame[f"fl_{axis}"]
            if focal_length is None:
                raise TypeError(f"the focal length fl_{axis} is null")
            lengths[axis] = float(focal_length)
        elif f"camera_angle_{axis}" in frame:
            lengths[axis] = 0.5 * size / np.tan(0.5 * float(frame[f"camera_angle_{axis}"]))
        elif f"{axis}_fov" in frame:
            lengths[axis] = 0.5 * size / np.tan(0.5 * np.deg2rad(float(frame[f"{axis}_fov"])))
    if not lengths:
        raise KeyError("fl_x")
    return lengths.get("x", lengths.get("y", np.nan)), lengths.get("y", lengths.get("x", np.nan))


def _is_set(value: Any) -> bool:
    """Return whether a value of the file differs from nothing: zero, false, or lists of these."""
    if isinstance(value, list):
        return any(_is_set(part) for part in value)
    return bool(value)


def angle_notes(photographs: Sequence[PosedPhotograph]) -> tuple[str, ...]:
    """Return a note where a file states a focal length and an angle of view that disagree."""
    unlike = []
    for photograph in photographs:
        lens = photograph.lens
        for axis, size, used in (("x", lens.width, lens.K[0, 0]), ("y", lens.height, lens.K[1, 1])):
            for key, unit in ((f"camera_angle_{axis}", 1.0), (f"{axis}_fov", np.pi / 180)):
                stated = photograph.more.get(key)
                if not isinstance(stated, (int, float)) or not 0 < unit * stated < np.pi:
                    continue  # what is no angle of view was not used either
                by_angle = 0.5 * size / np.tan(0.5 * unit * float(stated))
                if abs(by_angle - used) > SAME_FOCAL * used:
                    unlike.append(f"{used:.1f} px is used, {key} says {by_angle:.1f} px")
    if not unlike:
        return ()
    return (f"focal lengths that disagree, in {len(unlike)} places: {unlike[0]}",)


def _lens(frame: Mapping[str, Any], file: Path, location: str) -> Lens:
    model = frame.get("camera_model", "OPENCV_FISHEYE" if frame.get("is_fisheye") else "OPENCV")
    undistort = "undistort the images first (colmap image_undistorter)"
    if model not in COEFFICIENTS:
        raise InputError(
            f"{location}: lens model {model!r}", f"use {', '.join(COEFFICIENTS)}, or {undistort}"
        )
    others = [key for key in BENDS if frame.get(key) and key not in COEFFICIENTS[model]]
    if others or frame.get("distortion_params"):
        raise InputError(
            f"{location}: {others[0] if others else 'distortion_params'} of a lens model {model}",
            f"give it by {', '.join(COEFFICIENTS[model]) or 'none'}, or {undistort}",
        )
    do = "give w, h, fl_x, fl_y, cx and cy in pixels, and k1, k2, p1, p2 where the lens bends lines (docs/real-drives.md)"
    try:
        width, height = _image_size(frame, file)
        fl_x, fl_y = _focal_lengths(frame, width, height)
        if "fl_x" not in frame:  # angles are those of a camera that looks out of its middle
            frame = {"cx": width / 2, "cy": height / 2, **frame}
        K = np.array([[fl_x, 0, frame["cx"]], [0, fl_y, frame["cy"]], [0, 0, 1]], dtype=np.float64)
        distortion = np.array(
            [float(frame.get(key) or 0.0) for key in COEFFICIENTS[model]] or [0.0]
        )
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{location}: {type(error).__name__}: {error}", do) from error
    few = np.zeros(max(0, 4 - len(distortion)))  # OpenCV takes four at least
    fisheye = model == "OPENCV_FISHEYE"
    return Lens(
        width, height, K, np.concatenate([distortion, few]), "fisheye" if fisheye else "opencv"
    ).check(location, do)


def _image_size(frame: Mapping[str, Any], file: Path) -> tuple[int, int]:
    """Return width and height, pixels, as the entry states them, else of the image itself."""
    if "w" in frame or not os.path.isfile(file):
        return int(frame["w"]), int(frame["h"])
    width, height = check_image(read_bytes(file, SOURCE_BYTES), file)
    return int(width), int(height)


def rigid_pose(value: Any, location: str) -> F64:
    """Return a pose ``(4, 4)`` whose rotation is exact, of a matrix written with a few digits.

    Raises:
        InputError: It is no finite matrix of 4 x 4 (or 3 x 4), or no rotation: scaled, sheared or
            left-handed.
    """
    T = np.asarray(as_shape(list[list[float]], value, location), dtype=np.float64)
    if T.shape == (3, 4):
        T = np.vstack([T, [0.0, 0.0, 0.0, 1.0]])
    if T.shape != (4, 4) or not np.isfinite(T).all():
        problem = "a number that is not finite" if T.shape == (4, 4) else f"shape {T.shape}"
        raise InputError(f"{location}: {problem}", "give a finite matrix of 4 x 4")
    u, _, vt = np.linalg.svd(T[:3, :3])
    rotation = u @ vt
    if np.linalg.det(rotation) < 0:
        raise InputError(
            f"{location}: its axes are left-handed (determinant -1)",
            "mirror one axis of the poses, and say in 'axes' how they lie",
        )
    off = np.abs(T[:3, :3] - rotation).max()
    if off > 1e-3:
        raise InputError(
            f"{location}: its first three columns are no rotation (off by {off:.2g})",
            "give a rigid transform",
        )
    if off > RIGID:  # what is written with a few digits is not quite a rotation
        T[:3, :3] = rotation
    return T


def inside(folder: Path, path: Path, location: str) -> Path:
    """Return the path of a file that a folder's document names.

    Raises:
        InputError: It leads out of the folder.
    """
    if not os.path.abspath(path).startswith(os.path.join(os.path.abspath(folder), "")):
        raise InputError(
            f"{location}: {path} lies outside of {folder}",
            "Put the file with the poses into a folder that holds what it names",
        )
    return path


def _file(folder: Path, frame: Mapping[str, Any], key: str, location: str) -> Path:
    name = frame.get(key)
    if not isinstance(name, str):
        raise InputError(f"{location}, {key}: {name!r}", "name a file, relative to the folder")
    name = name.replace("\\", "/")  # of a file that was written under Windows
    path = folder / name
    # NeRF's own scenes leave the ending out
    if not path.suffix and os.path.isfile(folder / f"{name}.png"):
        return folder / f"{name}.png"
    return path
