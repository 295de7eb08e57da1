"""COLMAP models, text and binary: cameras, images with poses, points, and rigs with their frames.
Read by their published layout, without COLMAP.

The poses of ``images`` map the world to the camera, ``wxyz`` and a shift; pixels are counted from
the corner of the first one. A frame (COLMAP 3.12) holds the images that the cameras of a rig took
at one time. The unit is arbitrary.
"""

from __future__ import annotations

import os
import struct
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import natural_order, read_bytes, real
from alpasim_plugin.core.files.fields import Fields, field_name
from alpasim_plugin.core.files.limits import SOURCE_BYTES
from alpasim_plugin.core.files.reading import parsing
from alpasim_plugin.core.geometry import inverse, se3
from alpasim_plugin.core.types import F64
from alpasim_plugin.drives.source import PERIOD_US, Points, SourceDrive, front_camera, timed
from alpasim_plugin.gaussians.fit.lens import Lens
from alpasim_plugin.gaussians.fit.photographs import PosedPhotograph

DO_THIS = "give a whole model: cameras, images and points3D, all .txt or all .bin"
PLACES = ("", "sparse", "colmap/sparse")  # of models below a folder, or of folders of models
# Where images lie, from the folder and from the model.
IMAGES = ("images", "", "../images", "../../images")
CAMERA = 0  # the kind of a sensor that takes images
T = TypeVar("T")
UNIT = 1e-2  # how far from 1 the length of a quaternion may be
# Lens models in the order of their numbers; those without a count in `PARAMETERS` are refused.
_NAMES = """SIMPLE_PINHOLE PINHOLE SIMPLE_RADIAL RADIAL OPENCV OPENCV_FISHEYE FULL_OPENCV FOV
    SIMPLE_RADIAL_FISHEYE RADIAL_FISHEYE THIN_PRISM_FISHEYE RAD_TAN_THIN_PRISM_FISHEYE"""
MODELS = _NAMES.split()
NUMBERS = {"CAMERA": CAMERA, "IMU": 1}  # of kinds of sensors
# Focal lengths and middle, then OpenCV's coefficients.
PARAMETERS = {
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

COLMAP = Fields(
    "COLMAP",
    read={
        "model": "cameras images points3D rigs frames",
        "cameras": "CAMERA_ID MODEL WIDTH HEIGHT PARAMS",
        "images": "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME",
        "points3D": "X Y Z R G B",
        "rigs": "RIG_ID SENSORS POSES",
        "frames": "RIG_ID RIG_FROM_WORLD DATA_IDS",
    },
    harmless={
        "model": "project",
        "images": "POINTS2D",
        "points3D": "POINT3D_ID ERROR TRACK",
        "frames": "FRAME_ID",
    },
)
RIG_TURN = 1e-3  # radians; rotations of an image and of its rig that differ by more do not agree
RIG_SHIFT = 1e-3  # the same of shifts, as a share of the larger one, or in the model's unit


@dataclass(frozen=True)
class _Image:
    number: int
    name: str
    camera: int
    T_world_camera: F64


@dataclass(frozen=True)
class _Frame:
    """Images that the cameras of a rig took at one time.

    Attributes:
        rig: Number of the rig.
        T_rig_world: ``(4, 4)``.
        images: Number of a camera to the number of its image.
    """

    rig: int
    T_rig_world: F64
    images: Mapping[int, int]


def models_in(folder: Path) -> list[Path]:
    """Return the folders in or below a folder that hold models, in natural order."""
    tops = [folder / place for place in PLACES]
    below = [candidate for top in tops if os.path.isdir(top) for candidate in top.iterdir()]
    models = {
        real(candidate): candidate
        for candidate in (*tops, *below)
        if _ending(candidate) is not None
    }
    return sorted(models.values(), key=lambda candidate: natural_order(candidate.as_posix()))


def _ending(model: Path) -> str | None:
    return next((end for end in (".bin", ".txt") if os.path.isfile(model / f"cameras{end}")), None)


def read_colmap(folder: Path, need_files: bool = True) -> SourceDrive:
    """Read a model. Images in folders of their own are cameras of their own; they are taken in the
    natural order of their names.

    Args:
        folder: Holds models, here or in ``sparse``; the one with most images is read.
        need_files: Whether the photographs must be there.

    Raises:
        InputError: A file is missing, damaged or of a lens that OpenCV does not have; or there are
            no images.
    """
    model, images, notes = _largest_model(folder)
    times_us, reference, rig_notes = _rig_times(model, images)
    if times_us:
        images = [record for record in images if record.number in times_us]
    if not images:
        raise InputError(f"{model}: no image with a pose", DO_THIS)
    root = _images_root(folder, model, images[0].name, need_files)
    shots = _shots(model, root, images, times_us)
    names_of_reference = [
        name
        for record, name in zip(images, _camera_names(images, times_us), strict=True)
        if record.camera == reference
    ]
    names = sorted(shots)
    usual = [*names_of_reference, *names][0]
    front = front_camera({name: shots[name] for name in (usual, *names)})
    cameras = [shots[name] for name in names]
    photographs = [shot for camera in cameras for shot in camera] if times_us else timed(cameras)
    points = _points(model, photographs)
    notes += rig_notes
    notes += COLMAP.notes(
        field_name("model", path.stem) for path in model.iterdir() if path.suffix == _ending(model)
    )
    notes.append(
        f"no times: photographs are taken in the order of their names, {1_000_000 // PERIOD_US} a second"
    )
    return SourceDrive(
        "colmap",
        real(folder).name,
        tuple(photographs),
        front,
        points=points if len(points) else None,
        notes=tuple(notes),
    )


def _camera_names(images: Sequence[_Image], times_us: Mapping[int, int]) -> list[str]:
    """Return the name of each image's camera: its folder, or its number where cameras of a rig share
    a folder.
    """
    folders = {_folder(record.name) for record in images}
    if times_us and len(folders) < len({record.camera for record in images}):
        return [f"camera-{record.camera}" for record in images]
    return [_folder(record.name) for record in images]


def _shots(
    model: Path, root: Path, images: Sequence[_Image], times_us: Mapping[int, int]
) -> dict[str, list[PosedPhotograph]]:
    """Return the photographs by the name of their camera.

    Raises:
        InputError: The model lacks the camera of an image.
    """
    lenses = dict(_records(model, "cameras", _camera))
    shots: dict[str, list[PosedPhotograph]] = {}
    for record, name in zip(images, _camera_names(images, times_us), strict=True):
        if record.camera not in lenses:
            raise InputError(f"{model}: images of camera {record.camera}, which it lacks", DO_THIS)
        shot = PosedPhotograph(
            root / record.name,
            lenses[record.camera],
            record.T_world_camera,
            f"{model}, image {record.name}",
            times_us.get(record.number),
            name,
            {},
        )
        shots.setdefault(name, []).append(shot)
    if (
        times_us
    ):  # by the names of the reference camera's images: those of another may run otherwise
        for camera in shots.values():
            camera.sort(key=lambda shot: int(shot.t_us or 0))
    return shots


def _largest_model(folder: Path) -> tuple[Path, list[_Image], list[str]]:
    """Return the model with most images, its images in the natural order of their names, and a note
    where there are several models.
    """
    models = [(model, _records(model, "images", _image)) for model in models_in(folder)]
    model, images = max(models, key=lambda model_images: len(model_images[1]))
    notes = []
    if len(models) > 1:
        sizes = ", ".join(f"{path.relative_to(folder)}: {len(records)}" for path, records in models)
        notes.append(
            f"{len(models)} models, of which the one with most images is read: {model.relative_to(folder)} ({sizes} images)"
        )
    images.sort(key=lambda record: natural_order(record.name))
    return model, images, notes


def _points(model: Path, photographs: Sequence[PosedPhotograph]) -> Points:
    """Return the points of a model; their errors in pixels say nothing of their distance."""
    table = np.array(_records(model, "points3D", _point)).reshape(-1, 6)
    return Points.of_unstated_error(table[:, :3], table[:, 3:] / 255.0, photographs)


def _rig_times(
    model: Path, images: Sequence[_Image]
) -> tuple[dict[int, int], int | None, list[str]]:
    """Return when images of a rig of several cameras were taken, by the image's number, the
    reference camera and notes; nothing where there is no such rig.

    Frames are in the natural order of the names of the reference camera's images.
    """
    mounts = {number: sensors for number, sensors in _records(model, "rigs", _rig) if sensors}
    rigs = {number: list(sensors) for number, sensors in mounts.items() if len(sensors) > 1}
    all_frames = _records(model, "frames", _frame)
    _check_rigs(model, images, mounts, all_frames)
    frames = [(frame.rig, frame.images) for frame in all_frames if frame.rig in rigs]
    if not frames:
        return {}, None, []
    counts = Counter(rig for rig, _ in frames)
    largest = max(sorted(counts), key=lambda number: counts[number])
    reference = rigs[largest][0]
    shots = [image_of for rig, image_of in frames if rig == largest]
    times_us = _times_of_shots(shots, images, reference)
    notes = [f"a rig of {len(rigs[largest])} cameras: the images of a frame have one time"]
    left_out = sum(image.number not in times_us for image in images)
    if left_out:
        notes.append(
            f"{left_out} images of other rigs, or of frames without the reference camera, are left out"
        )
    return times_us, reference, notes


def _times_of_shots(
    shots: Sequence[Mapping[int, int]], images: Sequence[_Image], reference: int
) -> dict[int, int]:
    """Return the time of each image, microseconds, by its number.

    Args:
        shots: For each frame of the rig the number of a camera to that of its image; those without an
            image of the reference camera have no time.
        images: Images of the model.
        reference: Number of the reference camera, the names of whose images order the frames.
    """
    names = {image.number: image.name for image in images}
    ordered = sorted(
        (natural_order(names[image_of[reference]]), list(image_of.values()))
        for image_of in shots
        if image_of.get(reference) in names
    )
    return {
        number: rank * PERIOD_US for rank, (_, numbers) in enumerate(ordered) for number in numbers
    }


def _check_rigs(
    model: Path,
    images: Sequence[_Image],
    mounts: Mapping[int, Mapping[int, F64 | None]],
    frames: Sequence[_Frame],
) -> None:
    """Refuse a model whose images do not stand where their frame and their rig say.

    Raises:
        InputError: Names the first such image.
    """
    T_world_camera = {image.number: image.T_world_camera for image in images}
    names = {image.number: image.name for image in images}
    for frame in frames:
        for camera, number in frame.images.items():
            T_camera_rig = mounts.get(frame.rig, {}).get(camera)
            if number not in T_world_camera or T_camera_rig is None:
                continue
            away = T_camera_rig @ frame.T_rig_world @ T_world_camera[number]
            turn = float(np.arccos(np.clip((np.trace(away[:3, :3]) - 1) / 2, -1.0, 1.0)))
            largest = max(1.0, float(np.abs(T_world_camera[number][:3, 3]).max()))
            shift = float(np.abs(away[:3, 3]).max())
            if turn > RIG_TURN or shift > RIG_SHIFT * largest:
                raise InputError(
                    f"{model}, image {names[number]}: its pose is {shift:.3g} units and {np.degrees(turn):.2f} degrees from where its frame and rig say",
                    "write the whole model again with COLMAP",
                )


def _folder(name: str) -> str:
    folder = Path(name).parent.as_posix()
    return "front" if folder == "." else folder.replace("/", "-")


def _images_root(folder: Path, model: Path, name: str, needed: bool) -> Path:
    for base in (folder, model):
        for place in IMAGES:
            if os.path.isfile(base / place / name):
                return base / place
    if not needed:
        return folder / IMAGES[0]
    raise InputError(
        f"{folder}: no image {name}", "put the images into a folder 'images' beside the model"
    )


def _records(model: Path, name: str, record: Callable[[_Binary | _Words], T]) -> list[T]:
    """Return the records of a file of a model; of ``rigs`` and ``frames``, which a model may lack,
    none.
    """
    path = model / f"{name}{_ending(model)}"
    if name in ("rigs", "frames") and not os.path.isfile(path):
        return []
    data = read_bytes(path, SOURCE_BYTES, DO_THIS)
    with parsing(path, DO_THIS, "a damaged model"):
        if path.suffix == ".txt":
            lines = data.decode("utf-8-sig").splitlines()
            lines = [line for line in lines if line.strip() and not line.startswith("#")]
            if name == "images":  # below each stands a line of its points, unless they are left out
                lines = [line for line in lines if not _are_points(line.split())]
            most = 9 if name == "images" else -1  # a name may have spaces
            return [_of_line(record, line.split(maxsplit=most)) for line in lines]
        reader = _Binary(data)
        records = [record(reader) for _ in range(reader.take("Q")[0])]
        if reader.at != len(data):
            raise ValueError(f"{len(data) - reader.at} bytes after the last record")
        return records


def _of_line(record: Callable[[_Binary | _Words], T], words: Sequence[str]) -> T:
    """Return the record of a line of a text file, which must be used up by it."""
    reader = _Words(words)
    value = record(reader)
    reader.check_end()
    return value


def _are_points(words: Sequence[str]) -> bool:
    try:
        return len(words) % 3 == 0 and np.array(words, dtype=np.float64).size > 0
    except ValueError:
        return False


class _Binary:
    """Take values off binary data, one after the other."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.at = 0

    def take(self, form: str) -> tuple[Any, ...]:
        values = struct.unpack_from("<" + form, self.data, self.at)
        self.at += struct.calcsize("<" + form)
        return values

    def name(self) -> str:
        end = self.data.index(b"\0", self.at)
        text = self.data[self.at : end].decode("utf-8")
        self.at = end + 1
        return text

    def model(self) -> str:
        """Return the name of a lens model, or its number where it is a new one."""
        number = self.take("i")[0]
        return MODELS[number] if 0 <= number < len(MODELS) else f"number {number}"

    def skip(self, size: int) -> None:
        """Skip a list of things of a size, which begins with their number."""
        count = self.take("Q")[0]
        self.at += size * count
        if self.at > len(self.data):
            raise ValueError("it ends too early")


class _Words:
    """Take values off the words of a line, as `_Binary` does off binary data."""

    def __init__(self, words: Sequence[str]) -> None:
        self.words = iter(words)

    def take(self, form: str) -> tuple[Any, ...]:
        words = [next(self.words, "") for _ in form]
        pairs = zip(form, words, strict=True)
        return tuple(float(w) if kind == "d" else int(NUMBERS.get(w, w)) for kind, w in pairs)

    def model(self) -> str:
        """Return the name of a lens model."""
        return next(self.words)

    def name(self) -> str:
        return next(self.words).strip()

    def skip(self, size: int) -> None:
        """Leave the rest of the line."""
        self.words = iter(())

    def check_end(self) -> None:
        """Refuse words that nothing was read of.

        Raises:
            ValueError: A line goes on.
        """
        more = next(self.words, None)
        if more is not None:
            raise ValueError(f"a line goes on with {more!r}")


def _camera(reader: _Binary | _Words) -> tuple[int, Lens]:
    number = reader.take("i")[0]
    name = reader.model()
    if name not in PARAMETERS:
        raise InputError(
            f"camera model {name}: a lens that is not read, only {', '.join(PARAMETERS)}",
            "undistort the images (colmap image_undistorter)",
        )
    width, height = reader.take("QQ")
    p = reader.take("d" * PARAMETERS[name])
    if name in ONE_FOCAL:
        p = (p[0], *p)
    K = np.array([[p[0], 0, p[2]], [0, p[1], p[3]], [0, 0, 1.0]])
    fisheye = "FISHEYE" in name
    bend = np.zeros(4 if fisheye else max(4, len(p) - 4))
    bend[: len(p) - 4] = p[4:]
    lens = Lens(width, height, K, bend, "fisheye" if fisheye else "opencv")
    return number, lens.check(f"a {name} camera", DO_THIS)


def _image(reader: _Binary | _Words) -> _Image:
    number, *pose, camera = reader.take("idddddddi")
    name = reader.name()
    reader.skip(24)  # points: x, y and a number
    length = np.linalg.norm(pose[:4])
    if not np.isfinite(pose).all() or abs(length - 1) > UNIT:
        raise ValueError(f"image {name}: its pose {pose} is not finite or no rotation")
    return _Image(number, name, camera, inverse(se3(pose[4:], np.array(pose[:4]) / length)))


def _point(reader: _Binary | _Words) -> tuple[float, ...]:
    number, *values, _error = reader.take("QdddBBBd")
    reader.skip(8)  # the images that show it
    if not np.isfinite(values[:3]).all():
        raise ValueError(f"point {number}: its position {values[:3]} is not finite")
    return tuple(values)


def _rig(reader: _Binary | _Words) -> tuple[int, dict[int, F64 | None]]:
    """Return a rig's number, and its cameras, the reference first, with what maps the rig to them
    ``(4, 4)``; None where that is not stated.
    """
    number, count = reader.take("II")
    mounts: dict[int, F64 | None] = {}
    for i in range(count):
        kind, sensor = reader.take("iI")
        mount: F64 | None = None if i else np.eye(4)
        if i > 0 and reader.take("B")[0]:
            mount = _pose(reader.take("ddddddd"))
        if kind == CAMERA:
            mounts[sensor] = mount
    return number, mounts


def _frame(reader: _Binary | _Words) -> _Frame:
    _, rig, *pose, count = reader.take("IIdddddddI")
    taken = [reader.take("iIQ") for _ in range(count)]
    images = {sensor: image for kind, sensor, image in taken if kind == CAMERA}
    return _Frame(rig, _pose(pose), images)


def _pose(numbers: Sequence[float]) -> F64:
    """Return the transform ``(4, 4)`` of ``wxyz`` and a shift."""
    length = np.linalg.norm(numbers[:4])
    if not np.isfinite(numbers).all() or abs(length - 1) > UNIT:
        raise ValueError(f"the pose {list(numbers)} is not finite or no rotation")
    return se3(numbers[4:], np.array(numbers[:4]) / length)
