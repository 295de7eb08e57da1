"""The calibration table of an AlpaSim scene, written: the pinholes that are rendered, as the f-theta lenses that its renderers expect."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from alpasim_plugin.core.types import F64, CameraSpec
from scenarios.usdz_camera import FLU_FROM_CAMERA

DEGREE = 5  # of the polynomial, as in the calibrations of AlpaSim's scenes


def calibration_table(cameras: Mapping[str, CameraSpec], clip_id: str) -> bytes:
    """Return ``calibration_estimate.parquet``: one row with the rig as JSON text.

    Args:
        cameras: By the logical id under which AlpaSim knows them.
        clip_id: Names the clip.
    """
    sensors = [_sensor(name, camera) for name, camera in cameras.items()]
    text = json.dumps({"rig": {"sensors": sensors}})
    own = pa.struct([("rig_json", pa.string())])
    schema = pa.schema([("key", pa.struct([("clip_id", pa.string())])), ("calibration_estimate", own)])
    stream = io.BytesIO()
    pq.write_table(pa.Table.from_pylist([{"key": {"clip_id": clip_id}, "calibration_estimate": {"rig_json": text}}], schema=schema), stream)
    return stream.getvalue()


def pixel_to_angle(camera: CameraSpec) -> F64:
    """Return coefficients ``(6,)`` of the angle (rad) as a polynomial of the distance (pixels) from the principal point.

    A pinhole has theta = atan(r / f). Least squares over the image, with the constant zero; f is the mean of both focal lengths.
    """
    corners = np.array([[0, 0], [camera.width, 0], [0, camera.height], [camera.width, camera.height]]) - camera.K[:2, 2]
    reach = float(np.linalg.norm(corners, axis=1).max())
    radius = np.linspace(0.0, 1.0, 1000)
    powers = np.stack([radius**k for k in range(1, DEGREE + 1)], axis=1)
    angle = np.arctan(radius * reach / float(np.mean(np.diag(camera.K)[:2])))
    scaled = np.linalg.lstsq(powers, angle, rcond=None)[0]
    return np.concatenate([[0.0], scaled / reach ** np.arange(1, DEGREE + 1)])


def _sensor(name: str, camera: CameraSpec) -> dict[str, object]:
    coefficients = " ".join(repr(float(c)) for c in pixel_to_angle(camera))
    properties = {
        "Model": "ftheta",
        "width": str(camera.width),
        "height": str(camera.height),
        "cx": repr(float(camera.K[0, 2])),
        "cy": repr(float(camera.K[1, 2])),
        "polynomial": coefficients,
        "polynomial-type": "pixeldistance-to-angle",
        "linear-c": "1.0",
        "linear-d": "0.0",
        "linear-e": "0.0",
    }
    mount = {
        "roll-pitch-yaw": _roll_pitch_yaw_deg(camera.T_rig_camera[:3, :3] @ FLU_FROM_CAMERA.T),
        "t": camera.T_rig_camera[:3, 3].tolist(),
    }
    return {
        "name": name.replace("camera_", "camera:", 1).replace("_", ":"),
        "properties": properties,
        "nominalSensor2Rig_FLU": mount,
        "correction_sensor_R_FLU": {"roll-pitch-yaw": [0.0, 0.0, 0.0]},
        "correction_rig_T": [0.0, 0.0, 0.0],
    }


def _roll_pitch_yaw_deg(rotation: F64) -> list[float]:
    """Return the angles of Rz(yaw) Ry(pitch) Rx(roll) in degrees."""
    pitch = np.arcsin(np.clip(-rotation[2, 0], -1.0, 1.0))
    roll, yaw = np.arctan2(rotation[2, 1], rotation[2, 2]), np.arctan2(rotation[1, 0], rotation[0, 0])
    return [float(angle) for angle in np.rad2deg([roll, pitch, yaw])]
