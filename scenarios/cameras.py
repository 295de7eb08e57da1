"""The cameras that a scenario file lists or names: from a section, a shipped rig or a calibration
to `CameraSpec`, checked before anything is built.
"""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from alpasim_plugin.cameras.lens import check_lens, resized
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import limits as b
from alpasim_plugin.core.files.config import Document, load_yaml, validate
from alpasim_plugin.core.files.reading import contents
from alpasim_plugin.core.geometry import RIG_FROM_LEVEL_CAMERA, intrinsics, rigid, turned
from alpasim_plugin.core.types import CameraSpec, LensModel, Vehicle
from scenarios.schema import CameraModel, CameraSet, Rigs
from scenarios.variation import SceneDraft

RIGS_FILE = Path(__file__).with_name("rigs.yaml")
RIG_PIXELS = b.Bound(
    "pixels of all cameras", "", 1, 1 << 26, "a pixel takes some 60 bytes while it is drawn"
)
DEEPEST_M = 0.5  # below the body's surface: a camera behind the windscreen stands so deep
FARTHEST_M = 0.6  # outside of the body


def given_cameras(draft: SceneDraft) -> tuple[CameraSpec, ...] | None:
    """Return the cameras of a scenario file; None where it leaves them to the log.

    Raises:
        InputError: No such file, a lens that is none, a period that is no multiple of the control
            period, a shutter longer than that, or too many pixels; with the position of its key.
    """
    camera_specs = draft.spec.cameras
    if camera_specs is None:
        return None
    if isinstance(camera_specs, CameraSet):
        cameras = _from_set(draft, camera_specs)
    else:
        cameras = tuple(camera_spec(model) for model in camera_specs)
    control_us = draft.spec.rates.control_us
    names = [camera.name for camera in cameras]
    with draft.at("cameras"):
        RIG_PIXELS.check(sum(camera.width * camera.height for camera in cameras), "cameras")
    for i, camera in enumerate(cameras):
        with draft.at("cameras", i):
            if camera.name in names[:i]:
                raise InputError(f"two cameras named {camera.name!r}", "give one another name")
            if camera.interval_us % control_us or camera.shutter_us > control_us:
                raise InputError(
                    f"interval_us = {camera.interval_us} and shutter_us = {camera.shutter_us} with rates.control_us = {control_us}",
                    "choose a whole multiple as interval_us, and a shutter that is no longer",
                )
            check_lens(camera)
    return cameras


def check_mounts(draft: SceneDraft, cameras: Sequence[CameraSpec], vehicle: Vehicle) -> None:
    """Refuse cameras that stand inside the car's body, or away from it.

    Raises:
        InputError: With the position of the camera's key.
    """
    box = vehicle.box
    centre = np.array([vehicle.rear_axle_to_centre_m, 0.0, box.height_m / 2])
    half = np.array(box.size_m) / 2
    for i, camera in enumerate(cameras):
        outside = np.abs(camera.T_rig_camera[:3, 3] - centre) - half  # along each axis, metres
        deep_m = -float(outside.max())
        far_m = float(np.linalg.norm(np.maximum(outside, 0.0)))
        position = np.round(camera.T_rig_camera[:3, 3], 2).tolist()
        with draft.at("cameras", i):
            if deep_m > DEEPEST_M:
                raise InputError(
                    f"camera {camera.name!r} at {position}: {deep_m:.2f} m inside the car's body",
                    "mount it at the body's surface, or give the vehicle its true size",
                )
            if far_m > FARTHEST_M:
                raise InputError(
                    f"camera {camera.name!r} at {position}: {far_m:.2f} m away from the car's body",
                    "use the calibration of this car, or give the vehicle its true size",
                )


def camera_spec(model: CameraModel | None = None) -> CameraSpec:
    """Return the camera of a section; None gives the default front camera."""
    m = model or CameraModel()
    focal = m.focal_px or (_focal_px(m),) * 2
    middle = m.centre_px or (m.width / 2, m.height / 2)
    K = intrinsics(*focal, *middle)
    turn = turned(np.deg2rad(m.yaw_deg), np.deg2rad(m.pitch_down_deg))
    T = rigid(turn @ RIG_FROM_LEVEL_CAMERA, (m.x_m, m.y_m, m.z_m))
    lens = None
    if m.lens != "pinhole":
        coefficients = m.coefficients or ((0.0, focal[0]) if m.lens == "ftheta" else ())
        limit = 0.0 if m.max_angle_deg is None else float(np.deg2rad(m.max_angle_deg))
        lens = LensModel(m.lens, coefficients, max_angle_rad=limit)
    return CameraSpec(m.name, m.width, m.height, K, T, m.shutter_us, lens, m.interval_us)


def _focal_px(m: CameraModel) -> float:
    """Return the focal length that shows ``hfov_deg`` across the image's width."""
    half = np.deg2rad(m.hfov_deg) / 2
    if m.lens in ("pinhole", "opencv"):
        return 0.5 * m.width / float(np.tan(half))
    powers = half ** (2 * np.arange(len(m.coefficients)) + 2)
    bent = 1.0 if m.lens == "ftheta" else 1.0 + float(powers @ np.array(m.coefficients))
    return 0.5 * m.width / (float(half) * bent)


def _from_calibration(path: Path) -> tuple[CameraSpec, ...]:
    """Read the cameras of a calibration, in the format that its file or folder has."""
    if os.path.isdir(path / "calibration"):
        from scenarios.argoverse import read_calibration

        return read_calibration(path)
    if path.suffix == ".usdz":
        from scenarios.ftheta import rig_cameras

        return rig_cameras(path)
    if path.suffix == ".json":
        from alpasim_plugin.cameras.transforms import read_transforms

        return read_transforms(path)
    raise InputError(
        f"{path}: {contents(path)}, no calibration that is known here",
        "give an Argoverse 2 log, which has a folder calibration, a .usdz of AlpaSim, or a transforms.json",
    )


def _chosen(
    draft: SceneDraft, cameras: Sequence[CameraSpec], names: Sequence[str]
) -> tuple[CameraSpec, ...]:
    """Return the cameras of a calibration that a scenario names, in its order."""
    cameras_by_name = {camera.name: camera for camera in cameras}
    for i, name in enumerate(names):
        if name not in cameras_by_name:
            raise draft.document.error(
                ("cameras", "names", i),
                f"no camera {name!r} in this calibration",
                f"choose from {', '.join(cameras_by_name)}",
            )
    return tuple(cameras_by_name[name] for name in names)


def _from_set(draft: SceneDraft, camera_set: CameraSet) -> tuple[CameraSpec, ...]:
    if camera_set.rig is not None:
        document = load_yaml(RIGS_FILE)
        rigs = validate(Rigs, Document({"rigs": document.data}, {}, str(RIGS_FILE))).rigs
        cameras = tuple(camera_spec(model) for model in rigs[camera_set.rig])
    else:
        assert camera_set.from_ is not None, "a set has a rig or a file"
        path = draft.document.folder_of(("cameras", "from")) / camera_set.from_
        if not os.path.exists(path):
            raise draft.document.error(
                ("cameras", "from"),
                f"{path} does not exist",
                "correct the path; it is relative to the scenario file",
            )
        with draft.at("cameras", "from"):
            cameras = _from_calibration(path)
        if camera_set.names:
            cameras = _chosen(draft, cameras, camera_set.names)
    if camera_set.width is not None:
        width = camera_set.width
        cameras = tuple(
            resized(camera, width, round(camera.height * width / camera.width))
            for camera in cameras
        )
    return tuple(replace(camera, shutter_us=camera_set.shutter_us) for camera in cameras)
