"""Photographs without poses, and videos: structure from motion by COLMAP (extra ``sfm``), with settings for a car that drives straight on.

COLMAP's defaults look for a first pair of photographs with much sideways motion, which such a car never makes: forward motion is allowed,
angles and numbers of inliers are lowered.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.drives.colmap import model_folder, read_colmap
from alpasim_plugin.drives.source import FEWEST, SourceDrive
from alpasim_plugin.io.atomic import write_bytes, write_json
from alpasim_plugin.io.reading import read_json
from alpasim_plugin.io.reading.files import check_regular, parsing

DOING = "finding the poses of photographs"
VIDEOS = (".mp4", ".mov", ".avi", ".mkv", ".webm", ".m4v")
PHOTOGRAPHS = (".png", ".jpg", ".jpeg")
MOST, WIDTH_PX = 80, 1600  # photographs that are registered; their greatest width
FOCAL_WIDTHS = 0.8  # focal length that is begun with, in widths: 64 degrees across, as cameras behind windscreens have
FEATURES, OVERLAP = 4000, 5  # of a photograph; the next ones that it is matched with, and then the 8th, 16th, ...
BLACK = 8.0  # mean grey of a frame that shows nothing
LEAST_SHARE = 0.5  # of the photographs that must be registered
PERIOD_US = 100_000
FRAMES, MODEL, TIMES = "images", "sparse/0", "times.json"
Report = Callable[[str, int, int], None]


def is_unposed(path: Path) -> bool:
    """Look for a video, or a folder of photographs."""
    if path.is_file():
        return path.suffix.lower() in VIDEOS
    return path.is_dir() and sum(one.suffix.lower() in PHOTOGRAPHS for one in path.iterdir()) >= 2


def read_unposed(path: Path, work: Path, tell: Report) -> SourceDrive:
    """Find poses and read the drive.

    Args:
        path: The video, or the folder of photographs, in order by name.
        work: Receives frames and model; the same call goes on from what is there.
        tell: Called as the work goes on.

    Raises:
        InputError: The extra is missing, the video is damaged, or fewer than half of the photographs can be registered.
    """
    times, notes = _frames(path, work, tell)
    if model_folder(work) is None:
        _register(path, work, tell)
    drive = read_colmap(work, work / FRAMES, kind="sfm")
    known = drive.of(drive.front)
    if len(known) < max(FEWEST, LEAST_SHARE * len(times)):
        found = f"{len(known)} of {len(times)} photographs could be registered"
        do = "give a part in which the car moves and the world around it stands, in daylight, or photographs with poses"
        raise InputError(DOING, str(path), found, do)
    pictures = tuple(replace(one, t_us=times[one.file.name]) for one in drive.pictures)
    lens = known[0].lens
    across = 2 * np.degrees(np.arctan(0.5 * lens.width / lens.K[0, 0]))
    notes += [
        f"poses and lens found by structure from motion: {len(known)} of {len(times)} photographs, {len(drive.points or ())} points",
        f"the lens was found to see {across:.0f} degrees across; driving straight on leaves that, and lengths along the way, nearly "
        "free: poses of a calibrated camera know it",
    ]
    return replace(drive, scene_id=path.stem, pictures=pictures, notes=tuple(notes))


def _frames(path: Path, work: Path, tell: Report) -> tuple[dict[str, int], list[str]]:
    """Return the time of every photograph by its file's name in ``work / FRAMES``, and notes."""
    if (work / TIMES).is_file():
        kept: dict[str, Any] = read_json(work / TIMES, DOING)
        return kept["times"], kept["notes"]
    (work / FRAMES).mkdir(parents=True, exist_ok=True)
    times, notes = _of_video(path, work, tell) if path.is_file() else _of_folder(path, work)
    write_json(work / TIMES, {"times": times, "notes": notes})
    return times, notes


def _of_video(path: Path, work: Path, tell: Report) -> tuple[dict[str, int], list[str]]:
    check_regular(path, DOING)
    times: dict[str, int] = {}
    black = 0
    with parsing(DOING, path, "give a whole video that ffmpeg reads", "no readable video"), av.open(str(path)) as container:
        stream = container.streams.video[0]
        every = max(1, -(-int(stream.frames or MOST) // MOST))
        for i, frame in enumerate(container.decode(stream)):
            if i % every:
                continue
            image = frame.to_ndarray(format="bgr24")
            if image.mean() < BLACK:
                black += 1
                continue
            tell("reading frames", len(times), MOST)
            scale = min(1.0, WIDTH_PX / image.shape[1])
            image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else image
            write_bytes(work / FRAMES / f"{i:06d}.png", cv2.imencode(".png", image)[1].tobytes(), DOING)
            times[f"{i:06d}.png"] = round(1e6 * float(frame.time or 0.0))
    if len(times) < FEWEST:
        raise InputError(DOING, str(path), f"{len(times)} frames that show something", f"give a video of at least {FEWEST} frames")
    return times, [f"every {every}. frame of the video"] * (every > 1) + [f"{black} black frames were dropped"] * (black > 0)


def _of_folder(path: Path, work: Path) -> tuple[dict[str, int], list[str]]:
    files = sorted(one for one in path.iterdir() if one.suffix.lower() in PHOTOGRAPHS)
    every = max(1, -(-len(files) // MOST))
    for one in files[::every]:
        shutil.copyfile(one, work / FRAMES / one.name)
    notes = [f"no times: {1_000_000 // PERIOD_US} photographs a second are assumed", "no poses"]
    return {one.name: i * every * PERIOD_US for i, one in enumerate(files[::every])}, notes


def _register(path: Path, work: Path, tell: Report) -> None:
    """Run COLMAP's features, sequential matching and incremental mapping; the largest model is kept."""
    try:
        import pycolmap
    except ImportError as error:
        do = "pip install 'alpasim-onefixer[sfm]', or give photographs with poses"
        raise InputError(DOING, str(path), "no poses, and pycolmap is not installed", do) from error
    pycolmap.logging.minloglevel = 2  # errors only: progress is ours
    database, threads = work / "database.db", cv2.getNumberOfCPUs()
    database.unlink(missing_ok=True)
    tell("finding features", 0, 1)
    reading = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL", default_focal_length_factor=FOCAL_WIDTHS)
    extraction = pycolmap.FeatureExtractionOptions(num_threads=threads, max_image_size=WIDTH_PX)
    extraction.sift.max_num_features = FEATURES
    pycolmap.extract_features(
        database, work / FRAMES, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reading, extraction_options=extraction
    )
    tell("matching photographs", 0, 1)
    pycolmap.match_sequential(database, pairing_options=pycolmap.SequentialPairingOptions(overlap=OVERLAP, quadratic_overlap=True))
    tell("registering photographs", 0, 1)
    options = pycolmap.IncrementalPipelineOptions(min_model_size=FEWEST, num_threads=threads)
    mapper = options.mapper
    mapper.init_max_forward_motion, mapper.init_min_tri_angle, mapper.init_min_num_inliers = 1.0, 2.0, 40
    mapper.abs_pose_min_num_inliers, mapper.abs_pose_min_inlier_ratio, mapper.filter_min_tri_angle = 15, 0.15, 0.5
    options.triangulation.min_angle = 0.5
    models = pycolmap.incremental_mapping(database, work / FRAMES, work / "models", options)
    if not models:
        found = "no two photographs from which a model can begin"
        raise InputError(DOING, str(path), found, "give a part in which the car moves and the world stands, in daylight, or poses")
    best = max(models.values(), key=lambda model: model.num_reg_images())
    target = work / "sparse" / "unfinished"
    target.mkdir(parents=True, exist_ok=True)
    best.write_binary(target)
    target.rename(work / MODEL)


def forget(work: Path) -> None:
    """Remove what `read_unposed` kept."""
    shutil.rmtree(work, ignore_errors=True)
