"""Photographs without poses, and videos: structure from motion by COLMAP (extra ``sfm``), with
settings for a car that drives straight on.

COLMAP's defaults look for a first pair of photographs with much sideways motion, which such a car
never makes: forward motion is allowed, angles and numbers of inliers are lowered. The lens model
(pinhole or fisheye) is chosen by epipolar inliers between distant photographs.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from alpasim_plugin.core.atomic import write_bytes, write_json
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.limits import SOURCE_BYTES
from alpasim_plugin.core.reading import read_json
from alpasim_plugin.core.reading.files import check_regular, parsing, read_bytes
from alpasim_plugin.core.reading.images import check_image, decode_image, picture_fault
from alpasim_plugin.core.types import F32, U8
from alpasim_plugin.drives.colmap import model_folder, read_colmap
from alpasim_plugin.drives.source import FEWEST, SourceDrive

DOING = "finding the poses of photographs"
VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")
PHOTOGRAPHS = (".png", ".jpg", ".jpeg")
MOST, WIDTH_PX = 80, 1280  # pictures that are kept; their greatest width
SMALL_PX = 320  # width at which pictures are compared
BLACK = 8.0  # mean grey of a picture that shows nothing
MOVED_PX = (
    0.6  # at `SMALL_PX`, by which four of ten corners must have moved since the picture before
)
PERIOD_US = 100_000
KEPT_EDGE, WINDOW_PX = (
    0.8,
    9,
)  # share of its contrast that an edge of the own car keeps in the mean of all pictures; where it is looked for
CAR_SHARE, ROW_SHARE = (
    0.25,
    0.03,
)  # of the width that the own car covers where it is widest, and in its uppermost row
LOWEST = 0.5  # of the height: the own car ends below
Report = Callable[[str, int, int], None]


@dataclass(frozen=True, eq=False)
class Frames:
    """Pictures that were written.

    Attributes:
        times: File name to microseconds.
        middle: ``(x, y)`` of the whole picture, pixels of the written ones: where a lens has its
            axis.
        notes: What was left out or assumed.
    """

    times: dict[str, int]
    middle: tuple[float, float]
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Shot:
    """A picture, small and grey, and what it is called."""

    number: int
    t_us: int
    small: U8


def files_of(path: Path) -> tuple[list[Path], bool]:
    """Return the videos, or else the photographs, that a path names, in order by name, and whether
    they are videos.
    """
    inside = sorted(path.iterdir()) if path.is_dir() else [path]
    videos = [one for one in inside if one.suffix.lower() in VIDEOS]
    return videos or [
        one for one in inside if path.is_dir() and one.suffix.lower() in PHOTOGRAPHS
    ], bool(videos)


def write_frames(path: Path, out: Path, tell: Report) -> Frames:
    """Write the pictures that a way can be found from: at most `MOST`, in which the world moves,
    cut above the own car.

    Args:
        path: A video, or a folder of videos that follow each other, or of photographs.
        out: Receives the pictures.
        tell: Called as the work goes on.

    Raises:
        InputError: A file is damaged, photographs differ in size, or fewer than `FEWEST` pictures
            are left.
    """
    files, films = files_of(path)
    chosen, notes = _moving(files, films, tell)
    if len(chosen) < FEWEST:
        raise InputError(
            f"{path}: {len(chosen)} pictures that show something and in which the world moves",
            f"give at least {FEWEST}, of a car that drives: depth comes from moving",
        )
    share = car_begins([one.small for one in chosen])
    if share < 1:
        notes.append(
            f"pictures are cut at {100 * share:.0f} % of their height: below is the own car, which moves with the camera"
        )
    if not films:
        notes.append(f"no times: {1_000_000 // PERIOD_US} photographs a second are assumed")
    elif len(files) > 1:
        notes.append(
            f"{len(files)} videos in order by name, each taken to begin where the one before ends"
        )
    times = {one.number: one.t_us for one in chosen}
    out.mkdir(parents=True, exist_ok=True)
    names: dict[str, int] = {}
    middle = (0.0, 0.0)
    for number, _, file, image in _pictures(files, films):
        if number in times:
            tell("writing frames", len(names), len(times))
            scale = min(1.0, WIDTH_PX / image.shape[1])
            middle = (scale * image.shape[1] / 2, scale * image.shape[0] / 2)
            names[_write(out, number, None if films else file, image, scale, share)] = times[number]
    return Frames(names, middle, tuple(notes))


def _write(out: Path, number: int, file: Path | None, image: U8, scale: float, share: float) -> str:
    """Write a picture, and return its name; a photograph that stays as it is keeps its file, which
    may say what lens took it.
    """
    if file is not None and scale == share == 1:
        shutil.copyfile(file, out / file.name)
        return file.name
    cut = image[: round(image.shape[0] * share)]
    small = (
        cv2.resize(cut, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        if scale < 1
        else cut
    )
    name = f"{number:06d}.png" if file is None else f"{file.stem}.png"
    write_bytes(out / name, cv2.imencode(".png", small)[1].tobytes())
    return name


def _moving(files: Sequence[Path], films: bool, tell: Report) -> tuple[list[_Shot], list[str]]:
    """Return at most `MOST` pictures between which the world moves, and what was left out."""
    chosen: list[_Shot] = []
    last: U8 | None = None
    black = 0
    standing = 0
    moving = 0
    every = 1
    for number, t_us, _, image in _pictures(files, films):
        tell("reading frames", number, 0)
        small = np.asarray(cv2.cvtColor(_reduced(image), cv2.COLOR_BGR2GRAY), dtype=np.uint8)
        if small.mean() < BLACK:
            black += 1
        elif last is not None and moved_px(last, small) < MOVED_PX:
            standing += 1
        else:
            last = small
            if moving % every == 0:
                chosen.append(_Shot(number, t_us, small))
            moving += 1
            if (
                len(chosen) > 2 * MOST
            ):  # a long film is thinned as it goes by, so that memory is bounded
                chosen, every = chosen[::2], 2 * every
    if len(chosen) > MOST:
        chosen, every = chosen[::2], 2 * every
    left_out = {"that are black": black, "in which the world hardly moves": standing}
    notes = [
        f"{count} pictures {which} were left out" for which, count in left_out.items() if count
    ]
    return chosen, notes + [f"every {every}. picture of {moving} is used"] * (every > 1)


def _reduced(image: U8) -> U8:
    height = max(1, round(image.shape[0] * SMALL_PX / image.shape[1]))
    return np.asarray(
        cv2.resize(image, (SMALL_PX, height), interpolation=cv2.INTER_AREA), dtype=np.uint8
    )


def moved_px(before: U8, after: U8) -> float:
    """Return how far, pixels, all but the four tenths of the corners that moved most have moved;
    far where none is found again.
    """
    corners = cv2.goodFeaturesToTrack(before, 200, 0.01, 6)
    if before.shape != after.shape or corners is None:
        return np.inf
    there, found, _ = cv2.calcOpticalFlowPyrLK(before, after, corners, corners.copy())
    steps = np.linalg.norm(there - corners, axis=2)[found > 0]
    return float(np.percentile(steps, 60)) if len(steps) else np.inf


def car_begins(shots: Sequence[U8]) -> float:
    """Return the share of the height above the own car: its edges stay where they are while the
    world moves; 1 where there is none.

    Args:
        shots: Grey pictures ``(H, W)`` of one size, between which the world moves.
    """
    stack = np.array(shots, dtype=np.float32)
    each = np.mean([_contrast(one) for one in stack], axis=0)
    kept = (_contrast(stack.mean(axis=0)) > KEPT_EDGE * each) & (each > BLACK)
    dense = cv2.boxFilter(kept.astype(np.float32), -1, (WINDOW_PX, WINDOW_PX)) > 0.5
    rows = dense.mean(axis=1)
    first = int(LOWEST * len(rows))
    if rows[first:].max() < CAR_SHARE:
        return 1.0
    top = first + int(np.argmax(rows[first:] > CAR_SHARE))
    while top > first and rows[top - 1] > ROW_SHARE:
        top -= 1
    return max(top - WINDOW_PX // 2, first) / len(rows)


def _contrast(image: F32) -> F32:
    return np.asarray(
        np.hypot(cv2.Sobel(image, cv2.CV_32F, 1, 0), cv2.Sobel(image, cv2.CV_32F, 0, 1)),
        dtype=np.float32,
    )


def _pictures(files: Sequence[Path], films: bool) -> Iterator[tuple[int, int, Path, U8]]:
    """Yield number, microseconds, file and pixels (BGR) of all pictures."""
    if films:
        yield from _filmed(files)
        return
    first: tuple[int, int] | None = None
    for number, file in enumerate(files):
        data = read_bytes(file, SOURCE_BYTES)
        size = check_image(data, file)
        first = first or size
        fault = picture_fault(data) or (
            f"{size[0]}x{size[1]} pixels, others have {first[0]}x{first[1]}"
            if size != first
            else None
        )
        if fault:
            raise InputError(
                f"{file}: {fault}",
                "give whole photographs of one camera, PNG or JPEG in grey or RGB, as they were",
            )
        yield (
            number,
            number * PERIOD_US,
            file,
            decode_image(data, file, flag=cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION),
        )


def _filmed(files: Sequence[Path]) -> Iterator[tuple[int, int, Path, U8]]:
    number = 0
    start_us = 0
    last_us = 0
    step_us = 0
    for file in files:
        check_regular(file)
        with (
            parsing(file, "give a whole video that ffmpeg reads", "no readable video"),
            av.open(str(file)) as container,
        ):
            begins: float | None = None
            for frame in container.decode(container.streams.video[0]):
                begins = float(frame.time or 0.0) if begins is None else begins
                t_us = start_us + round(1e6 * (float(frame.time or 0.0) - begins))
                step_us, last_us = t_us - last_us, t_us
                yield (
                    number,
                    t_us,
                    file,
                    np.asarray(frame.to_ndarray(format="bgr24"), dtype=np.uint8),
                )
                number += 1
        start_us = last_us + step_us


PLAIN = "SIMPLE_RADIAL"
LENSES = {
    PLAIN: 0.8,
    "SIMPLE_RADIAL_FISHEYE": 0.5,
}  # tried, and their focal length at first, in widths: 64 and 115 degrees across
FEATURES, OVERLAP = (
    2500,
    5,
)  # of a photograph; the next ones that it is matched with, and then the 8th, 16th, ...
FAR, CLEARLY = (
    8,
    1.05,
)  # photographs between the two of a pair; ratio of inliers from which the fisheye model is chosen
TURNS_RAD = np.radians(
    3.0
)  # of a camera's axis from its mean, by which photographs tell the focal length
LEAST_DEEP = 0.1  # of the pairs of photographs must show depth
LEAST_SHARE = 0.5  # of the photographs that must be registered
FRAMES = "images"
MODEL = "sparse/0"
TIMES = "times.json"
DATABASE = "database.db"


def is_unposed(path: Path) -> bool:
    """Look for a video, or a folder of videos or of photographs."""
    files, films = files_of(path)
    return len(files) >= (1 if films else 2)


def read_unposed(path: Path, work: Path, tell: Report) -> SourceDrive:
    """Find poses and read the drive.

    Args:
        path: The video, or the folder of photographs, in order by name.
        work: Receives frames and model; the same call goes on from what is there.
        tell: Called as the work goes on.

    Raises:
        InputError: The extra is missing, the video is damaged, or fewer than half of the
            photographs can be registered.
    """
    if not (work / TIMES).is_file():
        frames = write_frames(path, work / FRAMES, tell)
        write_json(
            work / TIMES, {"times": frames.times, "middle": frames.middle, "notes": frames.notes}
        )
    kept: dict[str, Any] = read_json(work / TIMES)
    times, notes = kept["times"], list(kept["notes"])
    if model_folder(work) is None:
        _register(path, work, tuple(kept["middle"]), tell)
    drive = read_colmap(work, work / FRAMES, kind="sfm")
    known = drive.of(drive.front)
    if len(known) < max(FEWEST, LEAST_SHARE * len(times)):
        raise InputError(
            f"{path}: {len(known)} of {len(times)} photographs could be registered",
            "give a part in which the car moves and the world around it stands, in daylight, or photographs with poses",
        )
    pictures = tuple(replace(one, t_us=times[one.file.name]) for one in drive.pictures)
    lens = known[0].lens
    half = 0.5 * lens.width / lens.K[0, 0]
    across = 2 * np.degrees(half if lens.model == "fisheye" else np.arctan(half))
    notes += [
        f"poses and lens found by structure from motion: {len(known)} of {len(times)} photographs, {len(drive.points or ())} points",
        f"the lens sees {across:.0f} degrees across: found where the camera turns, else assumed, as driving straight on leaves that and "
        "lengths along the way free; poses of a calibrated camera know it",
    ]
    return replace(drive, scene_id=path.stem, pictures=pictures, notes=tuple(notes))


def _register(path: Path, work: Path, middle: tuple[float, float], tell: Report) -> None:
    """Run COLMAP's features, sequential matching and incremental mapping; the largest model is
    kept.
    """
    try:
        import pycolmap
    except ImportError as error:
        raise InputError(
            f"{path}: no poses, and pycolmap is not installed",
            "pip install 'alpasim-onefixer[sfm]', or give photographs with poses",
        ) from error
    pycolmap.logging.minloglevel = 3  # progress is ours
    database, threads = work / DATABASE, cv2.getNumberOfCPUs()
    database.unlink(missing_ok=True)
    tell("finding features", 0, 1)
    extraction = pycolmap.FeatureExtractionOptions(num_threads=threads, max_image_size=WIDTH_PX)
    extraction.sift.max_num_features = FEATURES
    pycolmap.extract_features(
        database,
        work / FRAMES,
        camera_mode=pycolmap.CameraMode.SINGLE,
        extraction_options=extraction,
    )
    tell("matching photographs", 0, 1)
    matching = pycolmap.FeatureMatchingOptions(
        num_threads=threads, skip_geometric_verification=True
    )
    pairing = pycolmap.SequentialPairingOptions(overlap=OVERLAP, quadratic_overlap=True)
    pycolmap.match_sequential(database, matching_options=matching, pairing_options=pairing)
    tell("registering photographs", 0, 1)
    do = "give a part in which the car moves and the world stands, in daylight, or poses"
    deep = _verified(work, middle, threads)
    if deep < LEAST_DEEP:
        raise InputError(
            f"{path}: {100 * deep:.0f} % of the pairs of photographs show depth: the camera only turns, or stands",
            do,
        )
    models = _mapped(work, threads)
    if not models:
        raise InputError(f"{path}: no two photographs from which a model can begin", do)
    target = work / "sparse" / "unfinished"
    target.mkdir(parents=True, exist_ok=True)
    best = max(models, key=lambda model: model.compute_num_observations())
    _settle(best)
    best.write_binary(target)
    target.rename(work / MODEL)


def _verified(work: Path, middle: tuple[float, float], threads: int) -> float:
    """Choose the lens, verify the matches by it, and return the share of pairs that no turn of the
    camera explains, nor one plane.
    """
    import pycolmap

    with pycolmap.Database.open(work / DATABASE) as database:
        camera = database.read_all_cameras()[0]
        if not camera.has_prior_focal_length:  # which a photograph's file may say
            lenses = _lenses(camera, middle)
            fits = {name: _fits(database, lens) for name, lens in lenses.items()}
            best = max(fits, key=lambda name: fits[name])
            chosen = lenses[best if fits[best] > CLEARLY * fits[PLAIN] else PLAIN]
            chosen.has_prior_focal_length = (
                chosen.model.name != PLAIN
            )  # COLMAP asks for it of a lens that bends lines
            chosen.camera_id = camera.camera_id
            database.update_camera(chosen)
    pycolmap.geometric_verification(
        work / DATABASE, pycolmap.GeometricVerifierOptions(num_threads=threads)
    )
    with pycolmap.Database.open(work / DATABASE) as database:
        kinds = [int(pair.config) for pair in database.read_two_view_geometries()[1]]
    deep = [
        int(kind)
        for kind in (
            pycolmap.TwoViewGeometryConfiguration.CALIBRATED,
            pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED,
        )
    ]
    return float(np.isin(kinds, deep).mean()) if kinds else 0.0


def _mapped(work: Path, threads: int) -> list[Any]:
    """Return the models that COLMAP finds."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions(
        min_model_size=FEWEST, num_threads=threads, max_num_models=4
    )
    mapper = options.mapper
    mapper.init_max_forward_motion, mapper.init_min_tri_angle, mapper.init_min_num_inliers = (
        1.0,
        2.0,
        40,
    )
    (
        mapper.abs_pose_min_num_inliers,
        mapper.abs_pose_min_inlier_ratio,
        mapper.filter_min_tri_angle,
    ) = 15, 0.15, 0.5
    options.triangulation.min_angle = 0.5
    options.ba_global_frames_ratio = options.ba_global_points_ratio = (
        1.3  # all together less often: a short film needs no more
    )
    shutil.rmtree(work / "models", ignore_errors=True)
    return list(
        pycolmap.incremental_mapping(
            work / DATABASE, work / FRAMES, work / "models", options
        ).values()
    )


def _lenses(camera: Any, middle: tuple[float, float]) -> dict[str, Any]:
    import pycolmap

    width, height = camera.width, camera.height
    return {
        name: pycolmap.Camera(
            model=name, width=width, height=height, params=[focal * width, *middle, 0.0]
        )
        for name, focal in LENSES.items()
    }


def _fits(database: Any, lens: Any) -> int:
    """Return how many matches of photographs far apart meet their epipolar lines with a lens."""
    import pycolmap

    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.max_error, options.ransac.random_seed = 1.0, 0
    names = sorted((image.name, image.image_id) for image in database.read_all_images())
    at = {number: database.read_keypoints(number)[:, :2].astype(np.float64) for _, number in names}
    count = 0
    for (_, one), (_, other) in zip(names[: -FAR : FAR // 4], names[FAR :: FAR // 4], strict=False):
        if database.exists_matches(one, other):
            found = database.read_matches(one, other)
            count += len(
                pycolmap.estimate_calibrated_two_view_geometry(
                    lens, at[one], lens, at[other], found, options
                ).inlier_matches
            )
    return count


def _settle(model: Any) -> None:
    """Give a camera that never turned the usual lens: a longer one and a way stretched along its
    axis fit such photographs alike.
    """
    import pycolmap

    axes = np.array(
        [
            image.cam_from_world().inverse().rotation.matrix()[:, 2]
            for image in model.images.values()
            if image.has_pose
        ]
    )
    axis = axes.mean(axis=0) / np.linalg.norm(axes.mean(axis=0))
    (camera,) = model.cameras.values()
    usual = LENSES[camera.model.name] * camera.width
    told = camera.model.name == PLAIN and camera.has_prior_focal_length  # by the photographs' files
    if told or np.arccos(np.clip(axes @ axis, -1, 1)).max() > TURNS_RAD:
        return
    longer = usual / camera.params[0]
    stretch = np.eye(3) + (longer - 1) * np.outer(axis, axis)
    for point in model.points3D.values():
        point.xyz = stretch @ point.xyz
    for frame in model.frames.values():
        pose = frame.rig_from_world.inverse()
        frame.rig_from_world = pycolmap.Rigid3d(pose.rotation, stretch @ pose.translation).inverse()
    camera.params = [usual, *camera.params[1:3], camera.params[3] * longer**2]
    options = pycolmap.BundleAdjustmentOptions(refine_focal_length=False, print_summary=False)
    pycolmap.bundle_adjustment(model, options)


def forget(work: Path) -> None:
    """Remove what `read_unposed` kept."""
    shutil.rmtree(work, ignore_errors=True)
