"""COLMAP models, text and binary: cameras, images with poses, points, and rigs with their frames.
Read by their published layout, without COLMAP.

The poses of ``images`` map the world to the camera, ``wxyz`` and a shift; pixels are counted from
the corner of the first one. A frame (COLMAP 3.12) holds the images that the cameras of a rig took
at one time; its pose maps the world to the rig, which is its reference camera, and the rig's poses
lead from there to each camera. The unit is arbitrary.
"""

from __future__ import annotations

import os
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import inverse, se3
from alpasim_plugin.core.limits import SOURCE_BYTES
from alpasim_plugin.core.reading import natural_order, read_bytes, real
from alpasim_plugin.core.reading.files import parsing
from alpasim_plugin.core.types import F64
from alpasim_plugin.drives.source import PERIOD_US, Points, SourceDrive, timed
from alpasim_plugin.gaussians.fit.lens import Lens
from alpasim_plugin.gaussians.fit.photographs import Picture

DO_THIS = "give a whole model: cameras, images and points3D, all .txt or all .bin"
PLACES = ("", "sparse", "colmap/sparse")  # of models below a folder, or of folders of models
PICTURES = (
    "images",
    "",
    "../images",
    "../../images",
)  # of the pictures, from the folder and from the model
CAMERA = 0
SENSORS = {"CAMERA": CAMERA, "IMU": 1}  # kinds of a sensor: names in text, numbers in binary files
POSE = "d" * 7
T = TypeVar("T")
SPREAD = 0.004  # of a point, as a share of its distance from the nearest camera
# Numbers of lens models in a binary file; those without a name in `PARAMETERS` are refused.
_NAMES = """SIMPLE_PINHOLE PINHOLE SIMPLE_RADIAL RADIAL OPENCV OPENCV_FISHEYE FULL_OPENCV FOV
    SIMPLE_RADIAL_FISHEYE RADIAL_FISHEYE THIN_PRISM_FISHEYE RAD_TAN_THIN_PRISM_FISHEYE"""
MODELS = dict(enumerate(_NAMES.split()))
PARAMETERS = {  # focal lengths and middle, then OpenCV's coefficients
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
}
ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")


@dataclass(frozen=True)
class _Image:
    number: int
    name: str
    camera: int
    T_camera_world: F64


@dataclass(frozen=True)
class _Rig:
    """The cameras that are mounted together, the reference first, and their ``T_camera_rig``; None
    where the file has no pose.
    """

    number: int
    cameras: dict[int, F64 | None]


@dataclass(frozen=True)
class _Frame:
    """What the cameras of a rig took at one time: images by camera."""

    rig: int
    T_rig_world: F64
    images: dict[int, int]


def models_in(folder: Path) -> list[Path]:
    """Return the folders in or below a folder that hold models, in natural order."""
    tops = [folder / place for place in PLACES]
    below = [
        one for top in tops if os.path.isdir(top) for one in top.iterdir() if os.path.isdir(one)
    ]
    found = {real(one): one for one in (*tops, *below) if _ending(one) is not None}
    return sorted(found.values(), key=lambda one: natural_order(one.as_posix()))


def _ending(model: Path) -> str | None:
    return next((end for end in (".bin", ".txt") if os.path.isfile(model / f"cameras{end}")), None)


def read_colmap(folder: Path, photographs: bool = True) -> SourceDrive:
    """Read a model. Pictures in folders of their own are cameras of their own; they are taken in
    the natural order of their names.

    Args:
        folder: Holds models, here or in ``sparse``; the one with most images is read.
        photographs: Whether they must be there.

    Raises:
        InputError: A file is missing, damaged or of a lens that OpenCV does not have; or there are
            no pictures.
    """
    models = [(model, _images_of(model)) for model in models_in(folder)]
    if not models:
        raise InputError(f"{folder}: no cameras.bin or cameras.txt", DO_THIS)
    model, images = max(models, key=lambda one: len(one[1]))
    notes = []
    if len(models) > 1:
        sizes = ", ".join(f"{one.relative_to(folder)}: {len(listed)}" for one, listed in models)
        notes.append(
            f"{len(models)} models, of which the one with most images is read: {model.relative_to(folder)} ({sizes} images)"
        )
    images.sort(key=lambda one: natural_order(one.name))
    times_us, front_camera, more = _rig_times(model, images)
    images = [one for one in images if not times_us or one.number in times_us]
    notes += more
    binary = _ending(model) == ".bin"
    data = {name: _data(model, name) for name in ("cameras", "points3D")}
    with parsing(model, DO_THIS, "a damaged model"):
        cameras = dict(_cameras_bin(data["cameras"]) if binary else _cameras_txt(data["cameras"]))
        xyz, rgb = _points_bin(data["points3D"]) if binary else _points_txt(data["points3D"])
    if not images:
        raise InputError(f"{model}: no image with a pose", DO_THIS)
    unknown = sorted({one.camera for one in images} - set(cameras))
    if unknown:
        raise InputError(f"{model}: images of camera {unknown[0]}, which it does not have", DO_THIS)
    root = _pictures_root(folder, model, images[0].name, photographs)
    folders = {_camera(one.name) for one in images}
    shared = times_us and len(folders) < len({one.camera for one in images})
    names_of = {
        one.number: f"camera-{one.camera}" if shared else _camera(one.name) for one in images
    }
    shots = [
        Picture(
            root / one.name,
            cameras[one.camera],
            inverse(one.T_camera_world),
            f"{model}, image {one.name}",
            times_us.get(one.number),
            names_of[one.number],
            {},
        )
        for one in images
    ]
    names = sorted({str(shot.camera) for shot in shots})
    every = (
        sorted(shots, key=lambda one: (str(one.camera), int(one.t_us or 0)))
        if times_us
        else timed([[one for one in shots if one.camera == name] for name in names])
    )
    reference = next((names_of[one.number] for one in images if one.camera == front_camera), None)
    front = next((name for name in names if "front" in name), reference or names[0])
    centres = np.array([shot.T_world_camera[:3, 3] for shot in every])
    near = (
        np.linalg.norm(xyz[:, None] - centres[None, :: max(1, len(centres) // 32)], axis=2).min(
            axis=1
        )
        if len(xyz)
        else np.zeros(0)
    )
    points = Points(xyz, rgb, np.eye(3) * ((SPREAD * near) ** 2)[:, None, None])
    notes.append(
        f"no times: photographs are taken in the order of their names, {1_000_000 // PERIOD_US} a second"
    )
    return SourceDrive(
        "colmap", real(folder).name, tuple(every), front, points=points, notes=tuple(notes)
    )


def _rig_times(
    model: Path, images: Sequence[_Image]
) -> tuple[dict[int, int], int | None, list[str]]:
    """Return when images of a rig of several cameras were taken, by the image's number, the
    reference camera and notes; nothing where there is no such rig.

    Frames are in the natural order of the names of the reference camera's images.

    Raises:
        InputError: An image does not stand where its frame and its rig say.
    """
    rigs = {rig.number: rig for rig in _records(model, "rigs", _rig) if len(rig.cameras) > 1}
    frames = [frame for frame in _records(model, "frames", _frame) if frame.rig in rigs]
    if not frames:
        return {}, None, []
    by_number = {one.number: one for one in images}
    for frame in frames:
        for camera, number in frame.images.items():
            mount, image = rigs[frame.rig].cameras.get(camera), by_number.get(number)
            if mount is None or image is None:
                continue
            stated = mount @ frame.T_rig_world
            if not np.allclose(image.T_camera_world, stated, rtol=1e-3, atol=1e-3):
                raise InputError(
                    f"{model}, image {image.name}: it does not stand where its frame and its rig say",
                    "write the model again with COLMAP, which moves images, frames and rigs together",
                )
    counts = Counter(frame.rig for frame in frames)
    rig = max(sorted(counts), key=lambda number: counts[number])
    reference = next(iter(rigs[rig].cameras))
    ordered = sorted(
        (natural_order(by_number[frame.images[reference]].name), list(frame.images.values()))
        for frame in frames
        if frame.rig == rig and frame.images.get(reference) in by_number
    )
    times_us = {
        number: rank * PERIOD_US for rank, (_, taken) in enumerate(ordered) for number in taken
    }
    notes = [f"a rig of {len(rigs[rig].cameras)} cameras: the images of a frame have one time"]
    left_out = sum(one.number not in times_us for one in images)
    if left_out:
        notes.append(
            f"{left_out} images of other rigs, or of frames without the reference camera, are left out"
        )
    return times_us, reference, notes


def _records(model: Path, name: str, record: Callable[[_Reader | _Words], T]) -> list[T]:
    """Return what stands in a file that a model may lack."""
    if not os.path.isfile(model / f"{name}{_ending(model)}"):
        return []
    data = _data(model, name)
    with parsing(model / f"{name}{_ending(model)}", DO_THIS, "a damaged model"):
        if _ending(model) == ".txt":
            return [record(_Words(words)) for words in _rows(data)]
        reader = _Reader(data)
        return [record(reader) for _ in range(int(reader.take("Q")[0]))]


def _rig(reader: _Reader | _Words) -> _Rig:
    number, count = reader.take("II")
    cameras: dict[int, F64 | None] = {}
    for i in range(int(count)):
        kind, sensor = reader.take("iI")
        mount: F64 | None = np.eye(4)
        if i > 0:
            mount = _pose(reader.take(POSE)) if reader.take("B")[0] else None
        if kind == CAMERA:
            cameras[int(sensor)] = mount
    return _Rig(int(number), cameras)


def _frame(reader: _Reader | _Words) -> _Frame:
    _, rig, *pose, count = reader.take(f"II{POSE}I")
    taken = [reader.take("iIQ") for _ in range(int(count))]
    images = {int(sensor): int(image) for kind, sensor, image in taken if kind == CAMERA}
    return _Frame(int(rig), _pose(pose), images)


def _data(model: Path, name: str) -> bytes:
    return read_bytes(model / f"{name}{_ending(model)}", SOURCE_BYTES, DO_THIS)


def _images_of(model: Path) -> list[_Image]:
    data = _data(model, "images")
    with parsing(model, DO_THIS, "a damaged model"):
        return list(_images_bin(data) if _ending(model) == ".bin" else _images_txt(data))


def _camera(name: str) -> str:
    folder = Path(name).parent.as_posix()
    return "front" if folder == "." else folder.replace("/", "-")


def _pictures_root(folder: Path, model: Path, name: str, needed: bool) -> Path:
    for base in (folder, model):
        for place in PICTURES:
            if os.path.isfile(base / place / name):
                return base / place
    if not needed:
        return folder / PICTURES[0]
    raise InputError(
        f"{folder}: no picture {name}",
        "put the pictures into a folder 'images' beside the model",
    )


def _lens(name: str, width: int, height: int, p: tuple[float, ...]) -> Lens:
    if name not in PARAMETERS:
        raise InputError(
            f"camera model {name}: a lens that is not read, only {', '.join(PARAMETERS)}",
            "undistort the images (colmap image_undistorter)",
        )
    if len(p) != PARAMETERS[name]:
        raise ValueError(f"{len(p)} parameters of a {name}, which has {PARAMETERS[name]}")
    fisheye = "FISHEYE" in name
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
    for line in data.decode("utf-8-sig").splitlines():
        if line.strip() and not line.startswith("#"):
            yield line.split()


def _cameras_txt(data: bytes) -> Iterator[tuple[int, Lens]]:
    for number, name, width, height, *p in _rows(data):
        yield int(number), _lens(name, int(width), int(height), tuple(float(w) for w in p))


def _images_txt(data: bytes) -> Iterator[_Image]:
    """Yield the images. Below each stands a line of points, which may be empty or left out."""
    for line in data.decode("utf-8-sig").splitlines():
        words = line.split()
        if line.startswith("#") or (len(words) % 3 == 0 and all(map(_is_number, words))):
            continue
        if len(words) < 10:
            raise ValueError(f"a line that is neither an image nor its points: {line[:60]!r}")
        name = line.split(maxsplit=9)[9].strip()
        yield _image(int(words[0]), int(words[8]), name, [float(w) for w in words[1:8]])


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


def _image(number: int, camera: int, name: str, pose: Sequence[float]) -> _Image:
    with parsing(f"image {name}", "give unit quaternions and finite shifts", "its pose"):
        return _Image(number, name, camera, _pose(pose))


def _pose(pose: Sequence[float]) -> F64:
    quat = np.array(pose[:4])
    length = np.linalg.norm(quat)
    if not np.isfinite(pose).all() or abs(length - 1) > 1e-2:
        raise ValueError("not finite or no rotation")
    return se3(pose[4:], quat / length)


def _points_txt(data: bytes) -> tuple[F64, F64]:
    table = np.array([[float(w) for w in words[1:7]] for words in _rows(data)]).reshape(-1, 6)
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


class _Words:
    """Take values off the words of a line, as `_Reader` does off binary data."""

    def __init__(self, words: Sequence[str]) -> None:
        self.words, self.at = words, 0

    def take(self, form: str) -> tuple[float, ...]:
        words = self.words[self.at : self.at + len(form)]
        if len(words) < len(form):
            raise ValueError(f"a line that ends too early: {' '.join(self.words)[:60]!r}")
        self.at += len(form)
        return tuple(float(SENSORS.get(word, word)) for word in words)


def _cameras_bin(data: bytes) -> Iterator[tuple[int, Lens]]:
    reader = _Reader(data)
    for _ in range(int(reader.take("Q")[0])):
        number, model, width, height = (int(v) for v in reader.take("iiQQ"))
        name = MODELS.get(model, f"number {model}")
        yield number, _lens(name, width, height, reader.take("d" * PARAMETERS.get(name, 0)))


def _images_bin(data: bytes) -> Iterator[_Image]:
    reader = _Reader(data)
    for _ in range(int(reader.take("Q")[0])):
        values = reader.take("i7di")
        name = reader.name()
        reader.skip(24 * int(reader.take("Q")[0]))
        yield _image(int(values[0]), int(values[8]), name, values[1:8])


def _points_bin(data: bytes) -> tuple[F64, F64]:
    reader = _Reader(data)
    rows = []
    for _ in range(int(reader.take("Q")[0])):
        values = reader.take("Q3d3BdQ")
        rows.append(values[1:7])
        reader.skip(8 * int(values[8]))
    table = np.array(rows, dtype=np.float64).reshape(-1, 6)
    return table[:, :3], table[:, 3:] / 255.0
