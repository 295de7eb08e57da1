"""F-theta lenses of AlpaSim scenes, and the pinhole cameras that are rendered inside them.

What is written to the calibration table of an AlpaSim scene are the pinholes that are rendered, as
the f-theta lenses that AlpaSim's renderers expect.
"""

import io
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import scipy  # its submodules load on first use

from alpasim_plugin.cameras.lens import rays_of
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import parse_json, parsing
from alpasim_plugin.core.files.fields import Fields, met_in
from alpasim_plugin.core.geometry import RIG_FROM_LEVEL_CAMERA, intrinsics, rigid
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.core.types import F64, CameraSpec, LensModel
from scenarios.recorded import SourceFiles
from scenarios.usdz_archive import Archive

FRONT_WIDE = "camera_front_wide_120fov"
# Rendered size; the recorded frames are 1920 x 1080.
WIDTH = 512
HEIGHT = 288
HORIZONTAL_FOV_RAD = np.pi / 2

TABLES = tuple(f"{folder}/calibration_estimate.parquet" for folder in ("clipgt", "map_data"))
MOUNTS = ("nominalSensor2Rig_FLU", "correction_sensor_R_FLU")
LENS = Fields(
    "f-theta camera",
    read={
        "sensor": f"name properties {' '.join(MOUNTS)} correction_rig_T",
        "properties": """Model cx cy width height polynomial polynomial-type linear-c linear-d
            linear-e""",
        **dict.fromkeys(MOUNTS, "roll-pitch-yaw"),
        MOUNTS[0]: "roll-pitch-yaw t",
    },
    harmless={"sensor": "car-mask parameter protocol"},
    others="refused",
)
# Whether a polynomial of this type goes from pixels to the angle.
GOES_BACK = {"pixeldistance-to-angle": True, "angle-to-pixeldistance": False}
GIVE = "give an f-theta calibration"
DEGREE = 5  # of the polynomial, as in the calibrations of AlpaSim's scenes


def front_camera(calibrated: F64, T_rig_camera: F64) -> CameraSpec:
    """Return the pinhole of 90 degrees width inside the front wide lens.

    Its principal point is the recorded one scaled to the rendered size, so every rendered pixel
    lies inside the recorded image.

    Args:
        calibrated: ``(4,)`` principal point (x, y) and size of the lens, pixels.
        T_rig_camera: ``(4, 4)`` mount, camera to rig.
    """
    focal = WIDTH / 2 / np.tan(HORIZONTAL_FOV_RAD / 2)
    cx, cy = calibrated[:2] * [WIDTH, HEIGHT] / calibrated[2:4]
    K = intrinsics(focal, focal, cx, cy)
    return CameraSpec(FRONT_WIDE, WIDTH, HEIGHT, K, orthonormal(T_rig_camera))


def orthonormal(transform: F64) -> F64:
    """Return the nearest rigid transform ``(4, 4)`` of one whose rotation was rounded."""
    u, _, vt = np.linalg.svd(transform[:3, :3])
    out = transform.copy()
    out[:3, :3] = u @ vt
    return out


def rig_cameras(path: Path) -> tuple[CameraSpec, ...]:
    """Return the f-theta cameras of a scene as they were calibrated.

    Raises:
        InputError: The scene has no calibration, it is damaged, or a camera has fields that are
            not read.
    """
    with Archive(SourceFiles(), path) as archive:
        sensors = _sensors(archive)
    cameras = []
    for name, sensor in sensors.items():
        if not (sensor.get("properties") or {}).get("Model"):
            continue  # a radar or a lidar
        check_fields(sensor, f"{path}, {name}")
        with parsing(f"{path}, {name}", GIVE):
            cx, cy, width, height = _lens_numbers(sensor["properties"])[0]
            lens = sensor_lens(sensor["properties"])
            T_rig_camera = orthonormal(mount(sensor))
            focal = 1 / lens.pixel_to_angle[1] if lens.pixel_to_angle else lens.coefficients[1]
        K = intrinsics(focal, focal, cx, cy)
        cameras.append(CameraSpec(name, int(width), int(height), K, T_rig_camera, lens=lens))
    if not cameras:
        raise InputError(f"{path}: no calibrated camera", "use a scene with its calibration")
    return tuple(cameras)


def _sensors(archive: Archive) -> JsonObject:
    """Return the sensors of a scene's calibration by name; none where it has none."""
    member = next((name for name in TABLES if name in archive), None)
    if member is None:
        return {}
    rows = archive.table(member)
    with parsing(f"{archive.path}, {member}", "give one row with rig_json"):
        text = rows[0]["calibration_estimate"]["rig_json"]
        rig = parse_json(text, f"{archive.path}, {member}, rig_json")
        return {str(s["name"]).replace(":", "_"): s for s in rig["rig"]["sensors"]}


def front_wide(archive: Archive) -> tuple[tuple[CameraSpec, ...], tuple[str, ...]]:
    """Return the front wide camera where the scene holds its calibration, with notes.

    Raises:
        InputError: The table is there, but damaged, or its front wide camera is not an f-theta
            camera or has fields that are not read.
    """
    sensor = _sensors(archive).get(FRONT_WIDE)
    if sensor is None:
        return (), (
            f"no calibration of {FRONT_WIDE} in this scene: the default front camera is used",
        )
    check_fields(sensor, f"{archive.path}, {FRONT_WIDE}")
    with parsing(f"{archive.path}, {FRONT_WIDE}", GIVE):
        camera = front_camera(np.array(_lens_numbers(sensor["properties"])[0]), mount(sensor))
    return (camera,), (
        "rendered through a pinhole of 90 degrees width inside the calibrated 120 degree f-theta lens",
    )


def check_fields(sensor: JsonObject, location: str) -> None:
    """Refuse a calibrated camera that has fields which are not read: each may bend or move it.

    Raises:
        InputError: Names them.
    """
    met = met_in("sensor", sensor)
    for holder in ("properties", *MOUNTS):
        met += met_in(holder, sensor.get(holder) or ())
    LENS.check(met, location, "leave out what the camera does not need")


def _lens_numbers(properties: JsonObject) -> tuple[list[float], list[float], bool]:
    """Return a lens's middle and size, its polynomial, and whether that goes from pixels to the
    angle.
    """
    if properties.get("Model") != "ftheta":
        raise ValueError(f"camera model {properties.get('Model')!r}")
    polynomial = [float(word) for word in properties["polynomial"].split()]
    if not 1 <= len(polynomial) <= DEGREE + 1:
        raise ValueError(f"a polynomial of {len(polynomial)} coefficients")
    size = [float(properties[name]) for name in ("cx", "cy", "width", "height")]
    kind = properties.get("polynomial-type", next(iter(GOES_BACK)))
    if kind not in GOES_BACK:
        raise ValueError(f"a polynomial of type {kind!r}, only {' or '.join(GOES_BACK)} are read")
    return size, polynomial, GOES_BACK[kind]


def sensor_lens(properties: JsonObject) -> LensModel:
    """Return the lens of a calibration's properties.

    Raises:
        ValueError, KeyError: They are no f-theta lens.
    """
    _, polynomial, goes_back = _lens_numbers(properties)
    coefficients = (*polynomial, *[0.0] * (DEGREE + 1 - len(polynomial)))
    c, d, e = (
        float(properties.get(f"linear-{name}", usual))
        for name, usual in zip("cde", LensModel.linear, strict=True)
    )
    forward, backward = ((), coefficients) if goes_back else (coefficients, ())
    return LensModel("ftheta", forward, backward, (c, d, e))


def mount(sensor: JsonObject) -> F64:
    """Return the ``(4, 4)`` pose of a camera in the rig: the nominal mount, turned and shifted by
    the estimated corrections.
    """
    nominal = sensor["nominalSensor2Rig_FLU"]
    turn = (sensor.get("correction_sensor_R_FLU") or {}).get("roll-pitch-yaw", (0.0, 0.0, 0.0))
    shift = sensor.get("correction_rig_T") or (0.0, 0.0, 0.0)
    turns = scipy.spatial.transform.Rotation.from_euler(
        "xyz", [nominal["roll-pitch-yaw"], turn], degrees=True
    ).as_matrix()
    return rigid(turns[0] @ turns[1] @ RIG_FROM_LEVEL_CAMERA, np.add(nominal["t"], shift))


def calibration_table(cameras: Mapping[str, CameraSpec], clip_id: str) -> bytes:
    """Return ``calibration_estimate.parquet``: one row with the rig as JSON text.

    Args:
        cameras: By the logical id under which AlpaSim knows them.
        clip_id: Names the clip.
    """
    sensors = [_sensor(name, camera) for name, camera in cameras.items()]
    text = json.dumps({"rig": {"sensors": sensors}})
    rig_type = pa.struct([("rig_json", pa.string())])
    schema = pa.schema(
        [("key", pa.struct([("clip_id", pa.string())])), ("calibration_estimate", rig_type)]
    )
    stream = io.BytesIO()
    pq.write_table(
        pa.Table.from_pylist(
            [{"key": {"clip_id": clip_id}, "calibration_estimate": {"rig_json": text}}],
            schema=schema,
        ),
        stream,
    )
    return stream.getvalue()


def pixel_to_angle(camera: CameraSpec) -> F64:
    """Return coefficients ``(6,)`` of the angle (rad) as a polynomial of the distance (pixels) from
    the principal point; of an f-theta lens before its matrix of c, d and e.

    A pinhole has theta = atan(r / f). Least squares over the image, with the constant zero; f is
    the mean of both focal lengths.

    Raises:
        InputError: Its lens is not the same in all directions.
    """
    if camera.lens is not None and camera.lens.kind == "opencv":
        raise InputError(
            f"camera {camera.name!r}: an opencv lens, which AlpaSim's calibration cannot hold",
            "export a scene of pinhole, fisheye or ftheta cameras",
        )
    corners = (
        np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]])
        - camera.K[:2, 2]
    )
    reach = float(np.linalg.norm(corners, axis=1).max())
    radius = np.linspace(0.0, 1.0, 1000)
    angle = np.arctan(radius * reach / float(np.mean(np.diag(camera.K)[:2])))
    if camera.lens is not None:
        rays = rays_of(camera)
        x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        offset = np.stack([x - camera.K[0, 2], y - camera.K[1, 2]], axis=-1).reshape(-1, 2)
        c, d, e = camera.lens.linear
        plane = offset @ np.linalg.inv([[c, d], [e, 1.0]]).T
        away = np.linalg.norm(plane, axis=1) / reach
        radius = away[rays.visible]
        across = np.linalg.norm(rays.ray[rays.visible, :2], axis=1)
        angle = np.arctan2(across, rays.ray[rays.visible, 2])
    powers = np.stack([radius**k for k in range(1, DEGREE + 1)], axis=1)
    scaled = np.linalg.lstsq(powers, angle, rcond=None)[0]
    return np.concatenate([[0.0], scaled / reach ** np.arange(1, DEGREE + 1)])


def _sensor(name: str, camera: CameraSpec) -> dict[str, object]:
    coefficients = " ".join(repr(float(coefficient)) for coefficient in pixel_to_angle(camera))
    linear = LensModel.linear if camera.lens is None else camera.lens.linear
    properties = {
        "Model": "ftheta",
        "width": str(camera.width),
        "height": str(camera.height),
        "cx": repr(float(camera.K[0, 2])),
        "cy": repr(float(camera.K[1, 2])),
        "polynomial": coefficients,
        "polynomial-type": "pixeldistance-to-angle",
        **{f"linear-{name}": repr(float(x)) for name, x in zip("cde", linear, strict=True)},
    }
    turn = scipy.spatial.transform.Rotation.from_matrix(
        camera.T_rig_camera[:3, :3] @ RIG_FROM_LEVEL_CAMERA.T
    )
    mount = {
        "roll-pitch-yaw": turn.as_euler("xyz", degrees=True).tolist(),
        "t": camera.T_rig_camera[:3, 3].tolist(),
    }
    return {
        "name": name.replace("camera_", "camera:", 1).replace("_", ":"),
        "properties": properties,
        "nominalSensor2Rig_FLU": mount,
        "correction_sensor_R_FLU": {"roll-pitch-yaw": [0.0, 0.0, 0.0]},
        "correction_rig_T": [0.0, 0.0, 0.0],
    }
