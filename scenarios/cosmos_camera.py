"""Cameras of a Cosmos-Drive-Dreams clip: f-theta lenses, and the pinhole inside the front wide one that is rendered."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from alpasim_plugin.core.types import F64, CameraSpec, FTheta
from scenarios.reading import SourceFiles

FRONT_WIDE = "camera_front_wide_120fov"
WIDTH, HEIGHT = 512, 288  # rendered size; the recorded frames are 1920 x 1080
HORIZONTAL_FOV_RAD = np.pi / 2
# Nominal mount of the front wide camera (camera to rig). The clip has no extrinsics. This is the calibration of another car of the same
# fleet; with it the clip's own map falls on the publisher's renders of this clip.
T_RIG_FRONT_WIDE = np.array(
    [
        [-0.0110549, -0.0181034, 0.9997750, 1.849283],
        [-0.9999387, 0.0007966, -0.0110423, -0.0541688],
        [-0.0005965, -0.9998358, -0.0181111, 1.3234164],
        [0.0, 0.0, 0.0, 1.0],
    ]
)


@dataclass(frozen=True)
class RecordedLens:
    """An f-theta lens as calibrated: principal point and size in pixels of the recorded image, and both polynomials."""

    cx: float
    cy: float
    width: int
    height: int
    lens: FTheta
    backward_given: bool  # the file's polynomial maps pixels to angle; the other direction is fitted


def read_lenses(files: SourceFiles, folder: Path) -> dict[str, RecordedLens]:
    """Read ``ftheta_intrinsic``: one array of 11 numbers a camera.

    Layout: cx, cy, width, height, six coefficients from the constant upwards, and a flag: 1 where they map pixel radius to angle, 0 where
    they map angle to radius.

    Raises:
        InputError: The tar is missing or damaged, or an array is not a lens.
    """
    path = files.only(folder / "ftheta_intrinsic", ("*.tar",), "the f-theta intrinsics")
    lenses: dict[str, RecordedLens] = {}
    for name, data in files.read_tar(path).items():
        if not name.endswith(".npy"):
            continue
        where = f"{path}, {name}"
        values = np.asarray(files.parse_npy(data, where), dtype=np.float64)
        if values.shape != (11,) or not np.isfinite(values).all() or values[2] < 1 or values[3] < 1 or values[10] not in (0.0, 1.0):
            found = f"an array of shape {values.shape} that is not an f-theta lens"
            raise files.fail(where, found, "give cx, cy, width, height, 6 coefficients, flag")
        lenses[name.rsplit(".", 2)[-2]] = lens_of(values)
    return lenses


def lens_of(values: F64) -> RecordedLens:
    """Make a lens of the 11 numbers ``(11,)`` of `read_lenses`; the direction that is not given is fitted over the image's reach."""
    cx, cy, width, height = values[:4]
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]]) - (cx, cy)
    reach_px = float(np.linalg.norm(corners, axis=1).max())
    given = values[4:10]
    backward = bool(values[10] == 1.0)
    if backward:
        radius = np.linspace(0.0, reach_px, 2000)
        angle = _polynomial(radius, given)
        top = int(np.argmax(angle))  # a polynomial may turn over beyond the image's corners
        radius, angle = radius[: top + 1], angle[: top + 1]
        lens = FTheta(tuple(given.tolist()), tuple(_fit(angle, radius).tolist()), float(angle[-1]))
    else:
        angle = np.linspace(0.0, np.pi / 2, 4000)
        radius = _polynomial(angle, given)
        inside = np.nonzero(np.maximum.accumulate(radius) > reach_px)[0]
        rising = np.nonzero(np.diff(radius) <= 0)[0]
        end = int(min([len(angle), *inside[:1] + 1, *rising[:1] + 1]))
        angle, radius = angle[:end], radius[:end]
        lens = FTheta(tuple(_fit(radius, angle).tolist()), tuple(given.tolist()), float(angle[-1]))
    return RecordedLens(float(cx), float(cy), int(width), int(height), lens, backward)


def _polynomial(x: F64, coefficients: F64) -> F64:
    return np.asarray(np.polynomial.polynomial.polyval(x, coefficients), dtype=np.float64)


def _fit(x: F64, y: F64) -> F64:
    """Return six coefficients of the least-squares inverse through the origin (constant term zero)."""
    scale = x[-1]
    powers = np.stack([(x / scale) ** k for k in range(1, 6)], axis=1)
    coefficients = np.linalg.lstsq(powers, y, rcond=None)[0]
    return np.concatenate([[0.0], coefficients / scale ** np.arange(1, 6)])


def front_camera(lens: RecordedLens, T_rig_camera: F64 = T_RIG_FRONT_WIDE) -> CameraSpec:
    """Return the pinhole of 90 degrees width inside the front wide lens.

    Its principal point is the recorded one scaled to the rendered size, so every rendered pixel lies inside the recorded image.

    Args:
        lens: The calibrated lens.
        T_rig_camera: ``(4, 4)`` mount; by default that of another car of the fleet.
    """
    focal = WIDTH / 2 / np.tan(HORIZONTAL_FOV_RAD / 2)
    cx, cy = lens.cx * WIDTH / lens.width, lens.cy * HEIGHT / lens.height
    K = np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
    return CameraSpec(FRONT_WIDE, WIDTH, HEIGHT, K, orthonormal(T_rig_camera), ftheta=lens.lens)


def orthonormal(transform: F64) -> F64:
    """Return the nearest rigid transform ``(4, 4)`` of one whose rotation was rounded."""
    u, _, vt = np.linalg.svd(transform[:3, :3])
    out = transform.copy()
    out[:3, :3] = u @ vt
    return out
