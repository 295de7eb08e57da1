"""COLMAP models, text and binary: cameras, images with poses, points. Read by their published
layout, without COLMAP.

The poses of ``images`` map the world to the camera, ``wxyz`` and a shift; pixels are counted from
the corner of the first one. The unit is arbitrary.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import inverse, se3
from alpasim_plugin.core.limits import SOURCE_BYTES
from alpasim_plugin.core.reading import read_bytes
from alpasim_plugin.core.reading.files import parsing
from alpasim_plugin.core.types import F64
from alpasim_plugin.drives.source import Points, SourceDrive, timed
from alpasim_plugin.gaussians.fit.lens import Lens
from alpasim_plugin.gaussians.fit.photographs import Picture

DO_THIS = "give a whole model: cameras, images and points3D, all .txt or all .bin"
PLACES = ("", "sparse/0", "sparse", "colmap/sparse/0")  # of the model below the folder
PICTURES = (
    "images",
    "",
    "../images",
    "../../images",
)  # of the pictures, from the folder and from the model
PERIOD_US = 100_000
SPREAD = 0.004  # of a point, as a share of its distance from the nearest camera
# Number in a binary file, name, and where parameters stand: focal lengths and middle, then OpenCV's
# coefficients; None is zero.
MODELS: dict[int, tuple[str, int, bool]] = {  # (name, parameters, whether it is a fisheye)
    0: ("SIMPLE_PINHOLE", 3, False),
    1: ("PINHOLE", 4, False),
    2: ("SIMPLE_RADIAL", 4, False),
    3: ("RADIAL", 5, False),
    4: ("OPENCV", 8, False),
    5: ("OPENCV_FISHEYE", 8, True),
    6: ("FULL_OPENCV", 12, False),
    8: ("SIMPLE_RADIAL_FISHEYE", 4, True),
    9: ("RADIAL_FISHEYE", 5, True),
}
ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")


@dataclass(frozen=True)
class _Image:
    name: str
    camera: int
    T_camera_world: F64


def model_folder(folder: Path) -> Path | None:
    """Return where the model lies in or below a folder; None where there is none."""
    places = (folder / place for place in PLACES)
    return next(
        (
            one
            for one in places
            if any((one / f"cameras{end}").is_file() for end in (".bin", ".txt"))
        ),
        None,
    )


def read_colmap(folder: Path, photographs: bool = True) -> SourceDrive:
    """Read a model. Pictures in folders of their own are cameras of their own; they are taken in
    the order of their names.

    Args:
        folder: Holds the model, here or in ``sparse/0``.
        photographs: Whether they must be there.

    Raises:
        InputError: A file is missing, damaged or of a lens that OpenCV does not have; or there are
            no pictures.
    """
    model = model_folder(folder)
    if model is None:
        raise InputError(f"{folder}: no cameras.bin or cameras.txt", DO_THIS)
    binary = (model / "cameras.bin").is_file()
    end = ".bin" if binary else ".txt"
    data = {
        name: read_bytes(model / f"{name}{end}", SOURCE_BYTES, DO_THIS)
        for name in ("cameras", "images", "points3D")
    }
    with parsing(model, DO_THIS, "a damaged model"):
        cameras = dict(_cameras_bin(data["cameras"]) if binary else _cameras_txt(data["cameras"]))
        images = sorted(
            _images_bin(data["images"]) if binary else _images_txt(data["images"]),
            key=lambda one: one.name,
        )
        xyz, rgb = _points_bin(data["points3D"]) if binary else _points_txt(data["points3D"])
    if not images:
        raise InputError(f"{model}: no image with a pose", DO_THIS)
    root = _pictures_root(folder, model, images[0].name, photographs)
    shots = [
        Picture(
            root / one.name,
            cameras[one.camera],
            inverse(one.T_camera_world),
            f"{model}, image {one.name}",
            None,
            _camera(one.name),
            {},
        )
        for one in images
    ]
    names = sorted({str(shot.camera) for shot in shots})
    every = tuple(
        shot
        for name in names
        for shot in timed([one for one in shots if one.camera == name], PERIOD_US)
    )
    front = next((name for name in names if "front" in name), names[0])
    centres = np.array([shot.T_world_camera[:3, 3] for shot in every])
    near = (
        np.linalg.norm(xyz[:, None] - centres[None, :: max(1, len(centres) // 32)], axis=2).min(
            axis=1
        )
        if len(xyz)
        else np.zeros(0)
    )
    points = Points(xyz, rgb, np.eye(3) * ((SPREAD * near) ** 2)[:, None, None])
    notes = (f"no times: {1_000_000 // PERIOD_US} photographs a second are assumed",)
    return SourceDrive("colmap", folder.resolve().name, every, front, points=points, notes=notes)


def _camera(name: str) -> str:
    folder = Path(name).parent.as_posix()
    return "front" if folder == "." else folder.replace("/", "-")


def _pictures_root(folder: Path, model: Path, name: str, needed: bool) -> Path:
    for base in (folder, model):
        for place in PICTURES:
            if (base / place / name).is_file():
                return base / place
    if not needed:
        return folder / PICTURES[0]
    raise InputError(
        f"{folder}: no picture {name}",
        "put the pictures into a folder 'images' beside the model",
    )


def _lens(number: int, width: int, height: int, p: tuple[float, ...]) -> Lens:
    if number not in MODELS:
        raise InputError(
            f"camera model {number}: a lens that OpenCV does not have",
            "undistort the images (colmap image_undistorter)",
        )
    name, count, fisheye = MODELS[number]
    if len(p) != count:
        raise ValueError(f"{len(p)} parameters of a {name}, which has {count}")
    if name in ONE_FOCAL:
        p = (p[0], *p)
    K = np.array([[p[0], 0, p[2]], [0, p[1], p[3]], [0, 0, 1.0]])
    bend = np.array([*p[4:], *[0.0] * 4])[: max(4, len(p) - 4)]
    if fisheye:
        bend = np.array([*p[4:], *[0.0] * 4])[:4]
    return Lens(width, height, K, bend, "fisheye" if fisheye else "opencv").check(
        f"a {name} camera", DO_THIS
    )


def _rows(data: bytes) -> Iterator[list[str]]:
    for line in data.decode("utf-8").splitlines():
        if not line.startswith("#"):
            yield line.split()


def _cameras_txt(data: bytes) -> Iterator[tuple[int, Lens]]:
    numbers = {name: number for number, (name, _, _) in MODELS.items()}
    for words in _rows(data):
        if words:
            yield (
                int(words[0]),
                _lens(
                    numbers.get(words[1], -1),
                    int(words[2]),
                    int(words[3]),
                    tuple(float(w) for w in words[4:]),
                ),
            )


def _images_txt(data: bytes) -> Iterator[_Image]:
    rows = list(_rows(data))
    for words in rows[::2]:  # every other line lists the image's points, and may be empty
        if words:
            yield _image(
                int(words[8]), " ".join(words[9:]), np.array([float(w) for w in words[1:8]])
            )


def _image(camera: int, name: str, pose: F64) -> _Image:
    quat = pose[:4]
    if not np.isfinite(pose).all() or abs(np.linalg.norm(quat) - 1) > 1e-2:
        raise InputError(
            f"image {name}: a pose that is not finite or no rotation",
            "give unit quaternions and finite shifts",
        )
    return _Image(name, camera, se3(pose[4:], quat / np.linalg.norm(quat)))


def _points_txt(data: bytes) -> tuple[F64, F64]:
    table = np.array([[float(w) for w in words[1:7]] for words in _rows(data) if words]).reshape(
        -1, 6
    )
    return table[:, :3], table[:, 3:] / 255.0


class _Reader:
    """Take values off binary data, one after the other."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def take(self, form: str) -> tuple[float, ...]:
        values = struct.unpack_from("<" + form, self.data, self.at)
        self.at += struct.calcsize("<" + form)
        return values

    def skip(self, count: int) -> None:
        if count < 0 or self.at + count > len(self.data):
            raise ValueError(f"it ends {self.at + count - len(self.data)} bytes too early")
        self.at += count

    def name(self) -> str:
        end = self.data.index(b"\0", self.at)
        text = self.data[self.at : end].decode("utf-8")
        self.at = end + 1
        return text


def _cameras_bin(data: bytes) -> Iterator[tuple[int, Lens]]:
    reader = _Reader(data)
    for _ in range(int(reader.take("Q")[0])):
        number, model, width, height = (int(v) for v in reader.take("iiQQ"))
        count = MODELS[model][1] if model in MODELS else 0
        yield number, _lens(model, width, height, reader.take("d" * count))


def _images_bin(data: bytes) -> Iterator[_Image]:
    reader = _Reader(data)
    for _ in range(int(reader.take("Q")[0])):
        values = reader.take("i7di")
        name = reader.name()
        reader.skip(24 * int(reader.take("Q")[0]))
        yield _image(int(values[8]), name, np.array(values[1:8]))


def _points_bin(data: bytes) -> tuple[F64, F64]:
    reader = _Reader(data)
    rows = []
    for _ in range(int(reader.take("Q")[0])):
        values = reader.take("Q3d3BdQ")
        rows.append(values[1:7])
        reader.skip(8 * int(values[8]))
    table = np.array(rows, dtype=np.float64).reshape(-1, 6)
    return table[:, :3], table[:, 3:] / 255.0
