"""Photographs without poses, and videos: structure from motion by COLMAP (extra ``sfm``), with settings for a car that drives straight on.

COLMAP's defaults look for a first pair of photographs with much sideways motion, which such a car never makes: forward motion is allowed,
angles and numbers of inliers are lowered. The lens model (pinhole or fisheye) is chosen by epipolar inliers between distant photographs.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.drives.colmap import model_folder, read_colmap
from alpasim_plugin.drives.frames import DOING, WIDTH_PX, Report, files_of, write_frames
from alpasim_plugin.drives.source import FEWEST, SourceDrive
from alpasim_plugin.io.atomic import write_json
from alpasim_plugin.io.reading import read_json

PLAIN = "SIMPLE_RADIAL"
LENSES = {PLAIN: 0.8, "SIMPLE_RADIAL_FISHEYE": 0.5}  # tried, and their focal length at first, in widths: 64 and 115 degrees across
FEATURES, OVERLAP = 2500, 5  # of a photograph; the next ones that it is matched with, and then the 8th, 16th, ...
FAR, CLEARLY = 8, 1.05  # photographs between the two of a pair; ratio of inliers from which the fisheye model is chosen
TURNS_RAD = np.radians(3.0)  # of a camera's axis from its mean, by which photographs tell the focal length
LEAST_DEEP = 0.1  # of the pairs of photographs must show depth
LEAST_SHARE = 0.5  # of the photographs that must be registered
FRAMES, MODEL, TIMES, DATABASE = "images", "sparse/0", "times.json", "database.db"


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
        InputError: The extra is missing, the video is damaged, or fewer than half of the photographs can be registered.
    """
    if not (work / TIMES).is_file():
        frames = write_frames(path, work / FRAMES, tell)
        write_json(work / TIMES, {"times": frames.times, "middle": frames.middle, "notes": frames.notes})
    kept: dict[str, Any] = read_json(work / TIMES, DOING)
    times, notes = kept["times"], list(kept["notes"])
    if model_folder(work) is None:
        _register(path, work, tuple(kept["middle"]), tell)
    drive = read_colmap(work, work / FRAMES, kind="sfm")
    known = drive.of(drive.front)
    if len(known) < max(FEWEST, LEAST_SHARE * len(times)):
        found = f"{len(known)} of {len(times)} photographs could be registered"
        do = "give a part in which the car moves and the world around it stands, in daylight, or photographs with poses"
        raise InputError(DOING, str(path), found, do)
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
    """Run COLMAP's features, sequential matching and incremental mapping; the largest model is kept."""
    try:
        import pycolmap
    except ImportError as error:
        do = "pip install 'alpasim-onefixer[sfm]', or give photographs with poses"
        raise InputError(DOING, str(path), "no poses, and pycolmap is not installed", do) from error
    pycolmap.logging.minloglevel = 3  # progress is ours
    database, threads = work / DATABASE, cv2.getNumberOfCPUs()
    database.unlink(missing_ok=True)
    tell("finding features", 0, 1)
    extraction = pycolmap.FeatureExtractionOptions(num_threads=threads, max_image_size=WIDTH_PX)
    extraction.sift.max_num_features = FEATURES
    pycolmap.extract_features(database, work / FRAMES, camera_mode=pycolmap.CameraMode.SINGLE, extraction_options=extraction)
    tell("matching photographs", 0, 1)
    matching = pycolmap.FeatureMatchingOptions(num_threads=threads, skip_geometric_verification=True)
    pairing = pycolmap.SequentialPairingOptions(overlap=OVERLAP, quadratic_overlap=True)
    pycolmap.match_sequential(database, matching_options=matching, pairing_options=pairing)
    tell("registering photographs", 0, 1)
    do = "give a part in which the car moves and the world stands, in daylight, or poses"
    deep = _verified(work, middle, threads)
    if deep < LEAST_DEEP:
        found = f"{100 * deep:.0f} % of the pairs of photographs show depth: the camera only turns, or stands"
        raise InputError(DOING, str(path), found, do)
    models = _mapped(work, threads)
    if not models:
        raise InputError(DOING, str(path), "no two photographs from which a model can begin", do)
    target = work / "sparse" / "unfinished"
    target.mkdir(parents=True, exist_ok=True)
    best = max(models, key=lambda model: model.compute_num_observations())
    _settle(best)
    best.write_binary(target)
    target.rename(work / MODEL)


def _verified(work: Path, middle: tuple[float, float], threads: int) -> float:
    """Choose the lens, verify the matches by it, and return the share of pairs that no turn of the camera explains, nor one plane."""
    import pycolmap

    with pycolmap.Database.open(work / DATABASE) as database:
        camera = database.read_all_cameras()[0]
        if not camera.has_prior_focal_length:  # which a photograph's file may say
            lenses = _lenses(camera, middle)
            fits = {name: _fits(database, lens) for name, lens in lenses.items()}
            best = max(fits, key=lambda name: fits[name])
            chosen = lenses[best if fits[best] > CLEARLY * fits[PLAIN] else PLAIN]
            chosen.has_prior_focal_length = chosen.model.name != PLAIN  # COLMAP asks for it of a lens that bends lines
            chosen.camera_id = camera.camera_id
            database.update_camera(chosen)
    pycolmap.geometric_verification(work / DATABASE, pycolmap.GeometricVerifierOptions(num_threads=threads))
    with pycolmap.Database.open(work / DATABASE) as database:
        kinds = [int(pair.config) for pair in database.read_two_view_geometries()[1]]
    deep = [int(kind) for kind in (pycolmap.TwoViewGeometryConfiguration.CALIBRATED, pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED)]
    return float(np.isin(kinds, deep).mean()) if kinds else 0.0


def _mapped(work: Path, threads: int) -> list[Any]:
    """Return the models that COLMAP finds."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions(min_model_size=FEWEST, num_threads=threads, max_num_models=4)
    mapper = options.mapper
    mapper.init_max_forward_motion, mapper.init_min_tri_angle, mapper.init_min_num_inliers = 1.0, 2.0, 40
    mapper.abs_pose_min_num_inliers, mapper.abs_pose_min_inlier_ratio, mapper.filter_min_tri_angle = 15, 0.15, 0.5
    options.triangulation.min_angle = 0.5
    options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.3  # all together less often: a short film needs no more
    shutil.rmtree(work / "models", ignore_errors=True)
    return list(pycolmap.incremental_mapping(work / DATABASE, work / FRAMES, work / "models", options).values())


def _lenses(camera: Any, middle: tuple[float, float]) -> dict[str, Any]:
    import pycolmap

    width, height = camera.width, camera.height
    return {
        name: pycolmap.Camera(model=name, width=width, height=height, params=[focal * width, *middle, 0.0])
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
            count += len(pycolmap.estimate_calibrated_two_view_geometry(lens, at[one], lens, at[other], found, options).inlier_matches)
    return count


def _settle(model: Any) -> None:
    """Give a camera that never turned the usual lens: a longer one and a way stretched along its axis fit such photographs alike."""
    import pycolmap

    axes = np.array([image.cam_from_world().inverse().rotation.matrix()[:, 2] for image in model.images.values() if image.has_pose])
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
