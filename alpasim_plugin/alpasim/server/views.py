"""What one render request says: where and when a camera looks, and through which lens.

Any lens is rendered by the ideal pinhole that covers it, then resampled. Rays follow the wire's
conventions: camera axes x right, y down, z forward; the centre of pixel (row i, column j) is (j +
0.5, i + 0.5). Where the asked size is not that of the calibration, a pinhole scales per axis; an
f-theta lens scales its principal point per axis and its polynomial by the mean of both factors, as
AlpaSim's own overlay does.
"""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import se3
from alpasim_plugin.core.types import F32, F64, U8, Bool, CameraSpec, Frame
from alpasim_plugin.log.wire import common_pb2, sensorsim_pb2

QUAT_NORM_TOLERANCE = 1e-4  # of the squared norm, as AlpaSim checks it
MAX_SIDE_PX, MAX_PIXELS = 8192, 1 << 24
MAX_TIME_US = 2**62
WIDEST_RAD = np.deg2rad(80.0)  # from the optical axis: beyond it one plane cannot carry the picture
MAX_COVER_PX = (
    6_000_000  # pixels of the covering pinhole; its resolution falls for lenses that need more
)
# a ray whose projection misses its pixel by more lies outside what the lens model describes
CLOSE_PX = 0.05
NEWTON_STEPS, FOUND_PX = 10, 0.5  # of the inverse of a lens, and what it may miss by at the last
TABLE = 4096  # samples of a radius to angle function

_INVERTING = (
    threading.Lock()
)  # one lens at a time: a large picture takes a gigabyte for some seconds


@dataclass(frozen=True)
class View:
    """One requested frame.

    Attributes:
        scene_id, camera: What is looked at, and by which camera (its logical id).
        width, height: Requested pixels.
        start_us, t_us: Shutter start and end.
        T_world_camera: ``(2, 4, 4)`` at shutter start and end.
        objects: Pose of every dynamic object's box centre at shutter start and end, ``(2, 4, 4)``
            by track id.
        lens: Digest of intrinsics and size: frames of one lens share a history.
        key: Digest of the whole request but the image format: equal keys are one frame.
    """

    scene_id: str
    camera: str
    width: int
    height: int
    start_us: int
    t_us: int
    T_world_camera: F64
    objects: Mapping[str, F64]
    lens: bytes
    key: bytes


def read_view(request: sensorsim_pb2.RGBRenderRequest) -> View:
    """Check a request and return its view.

    Raises:
        InputError: No size, one that no camera has, a shutter that ends before it starts, a pose
            that is not finite or whose quaternion is no unit quaternion, or a track twice.
    """
    camera = request.camera_intrinsics.logical_id
    what = f"scene {request.scene_id!r}, camera {camera!r} at {request.frame_end_us} us"
    sides = request.resolution_w, request.resolution_h
    if not (min(sides) > 0 and max(sides) <= MAX_SIDE_PX and sides[0] * sides[1] <= MAX_PIXELS):
        raise InputError(
            f"{what}: {request.resolution_w} x {request.resolution_h} pixels",
            f"ask for 1 to {MAX_SIDE_PX} pixels a side, and {MAX_PIXELS} in all",
        )
    if not request.frame_start_us <= request.frame_end_us < MAX_TIME_US:
        raise InputError(
            f"{what}: a shutter from {request.frame_start_us} to {request.frame_end_us} us",
            "give microseconds that do not fall",
        )
    objects = {
        o.track_id: read_pair(o.pose_pair, f"{what}, track {o.track_id!r}")
        for o in request.dynamic_objects
    }
    if len(objects) != len(request.dynamic_objects):
        raise InputError(f"{what}: a track id twice", "send every dynamic object once")
    content = sensorsim_pb2.RGBRenderRequest()
    content.CopyFrom(request)
    content.ClearField("image_format")
    content.ClearField("image_quality")
    size = f"{request.resolution_w}x{request.resolution_h}".encode()
    return View(
        request.scene_id,
        camera,
        request.resolution_w,
        request.resolution_h,
        request.frame_start_us,
        request.frame_end_us,
        read_pair(request.sensor_pose, what),
        objects,
        _digest(request.camera_intrinsics.SerializeToString(deterministic=True) + size),
        _digest(content.SerializeToString(deterministic=True)),
    )


def read_pair(pair: sensorsim_pb2.PosePair, what: str) -> F64:
    """Return ``(2, 4, 4)`` of a pose pair; see `read_view`."""
    return np.stack([read_pose(pose, what) for pose in (pair.start_pose, pair.end_pose)])


def read_pose(pose: common_pb2.Pose, what: str) -> F64:
    """Return the ``(4, 4)`` matrix of a pose; see `read_view`."""
    v, q = pose.vec, pose.quat
    xyz, quat = (
        np.array([v.x, v.y, v.z], dtype=np.float64),
        np.array([q.w, q.x, q.y, q.z], dtype=np.float64),
    )
    square = float(quat @ quat)
    if not (np.isfinite(xyz).all() and abs(square - 1.0) <= QUAT_NORM_TOLERANCE):
        raise InputError(
            f"{what}: position {xyz.tolist()}, quaternion {quat.tolist()} with |q|^2 = {square:.6g}",
            "give finite positions and unit quaternions (w = 1 where there is no rotation)",
        )
    return se3(xyz, quat / np.sqrt(square))


def _digest(data: bytes) -> bytes:
    return hashlib.blake2b(data, digest_size=16).digest()


@dataclass(frozen=True, eq=False)
class Lens:
    """A lens at the size that is asked for.

    Attributes:
        width, height: Asked pixels.
        K: ``(3, 3)`` the pinhole to render.
        cover: Its width and height.
        resample: ``(height, width, 2)`` float32 place in the pinhole's picture of every pixel; None
            where the lens is that pinhole.
        seen: ``(height, width)`` where the lens sees anything; None: everywhere.
    """

    width: int
    height: int
    K: F64
    cover: tuple[int, int]
    resample: F32 | None = None
    seen: Bool | None = None

    def spec(self, name: str, T_rig_camera: F64, shutter_us: int = 0) -> CameraSpec:
        """Return the covering pinhole as a camera."""
        return CameraSpec(name, *self.cover, self.K, T_rig_camera, shutter_us)

    def frame(self, covering: Frame) -> Frame:
        """Return a covering frame as the lens shows it; where the lens sees nothing it is black and
        opaque.
        """
        alpha = None if covering.alpha is None else self.plane(covering.alpha, 1.0)
        references = tuple(self.image(image) for image in covering.references)
        return replace(
            covering, rgb=self.image(covering.rgb), alpha=alpha, depth=None, references=references
        )

    def image(self, covering: U8) -> U8:
        """Return the lens's picture ``(height, width, 3)`` of a covering one; black where it sees
        nothing.
        """
        out: U8 = self._through(covering, 0)
        return out

    def plane(self, covering: F32, outside: float) -> F32:
        """Return one value a pixel ``(height, width)``, ``outside`` where the lens sees nothing."""
        out: F32 = self._through(covering, outside)
        return out

    def _through(self, covering: Any, outside: float) -> Any:
        if self.resample is None:
            return covering
        out = cv2.remap(
            covering, self.resample, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        if self.seen is not None:
            out[~self.seen] = outside
        return out


def read_lens(spec: sensorsim_pb2.CameraSpec, width: int, height: int) -> Lens:
    """Return the lens of a request.

    Args:
        spec: Intrinsics at the calibrated size.
        width, height: Asked pixels.

    Raises:
        InputError: No intrinsics, values that make no lens, a windshield model, or a view of more
            than 80 degrees from the axis.
    """
    return _read(spec.SerializeToString(deterministic=True), width, height)


@dataclass(frozen=True, eq=False)
class Straight:
    """The pinhole that shows all that a lens sees, in as many columns as the lens's picture has.

    Attributes:
        K: ``(3, 3)``.
        size: Its width and height.
        place: ``(height, width, 2)`` float32 place in the lens's picture of every pixel; None where
            the lens is that pinhole.
    """

    K: F64
    size: tuple[int, int]
    place: F32 | None

    def image(self, seen: U8) -> U8:
        """Return the pinhole's picture of the lens's ``(H, W, 3)``; black where the lens sees
        nothing.
        """
        if self.place is None:
            return seen
        out: Any = cv2.remap(
            seen, self.place, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT
        )
        return out  # type: ignore[no-any-return]


def straight_of(spec: sensorsim_pb2.CameraSpec, width: int, height: int) -> Straight:
    """Return the pinhole for the pictures ``(height, width)`` of a lens; see `read_lens`."""
    return _straight(spec.SerializeToString(deterministic=True), width, height)


@lru_cache(maxsize=32)
def _straight(data: bytes, width: int, height: int) -> Straight:
    lens = _read(data, width, height)
    if lens.resample is None:
        return Straight(lens.K, lens.cover, None)
    size = width, max(round(lens.cover[1] * width / lens.cover[0]), 1)
    shrink = np.array(size) / lens.cover
    with _INVERTING:
        pixels = np.stack(
            np.meshgrid(*(np.arange(n, dtype=np.float32) + np.float32(0.5) for n in size)), axis=-1
        )
        wanted, start = (
            (pixels * by - 0.5).astype(np.float32) for by in (1.0 / shrink, [1.0, height / size[1]])
        )
        place = sought(lens.resample, wanted, start)
    return Straight(np.diag([*shrink, 1.0]) @ lens.K, size, place)


def sought(there: F32, wanted: F32, start: F32) -> F32:
    """Invert a map of pixels by Newton's method, which converges from afar as a lens bends one way
    only.

    Args:
        there: ``(H, W, 2)`` where each pixel (column, row) goes.
        wanted: ``(h, w, 2)`` where to.
        start: ``(h, w, 2)`` first guesses.

    Returns:
        ``(h, w, 2)`` the pixels that go there; far outside of the picture where none does.
    """
    last = np.array([there.shape[1] - 1, there.shape[0] - 1])
    maps = there, np.gradient(there, axis=1), np.gradient(there, axis=0)
    at, missed = start, wanted
    for _ in range(NEWTON_STEPS):
        here, a, b = (
            cv2.remap(values, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            for values in maps
        )
        missed = wanted - here
        (p, q), det = np.moveaxis(missed, -1, 0), a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
        with np.errstate(all="ignore"):
            step = (
                np.stack([p * b[..., 1] - q * b[..., 0], q * a[..., 0] - p * a[..., 1]], axis=-1)
                / det[..., None]
            )
        at = np.clip(at + np.nan_to_num(step, posinf=0.0, neginf=0.0), 0, last).astype(np.float32)
    at[np.linalg.norm(missed, axis=-1) > FOUND_PX] = -1e6
    return at


@lru_cache(maxsize=32)
def _read(data: bytes, width: int, height: int) -> Lens:
    spec = sensorsim_pb2.CameraSpec.FromString(data)
    what = f"camera {spec.logical_id!r}"
    if spec.resolution_w == 0 or spec.resolution_h == 0:
        raise InputError(f"{what}: no calibrated resolution", "fill resolution_w and resolution_h")
    if width * height > MAX_PIXELS:
        raise InputError(
            f"{what}: {width} x {height} pixels", f"ask for at most {MAX_PIXELS} in all"
        )
    if spec.WhichOneof("external_distortion") is not None:
        raise InputError(
            f"{what}: a windshield model",
            "it cannot be rendered here: put a renderer that can behind --upstream",
        )
    scale = width / spec.resolution_w, height / spec.resolution_h
    kind = spec.WhichOneof("camera_param")
    if kind == "opencv_pinhole_param":
        return _pinhole(spec.opencv_pinhole_param, scale, width, height, what)
    if kind == "opencv_fisheye_param":
        return _fisheye(spec.opencv_fisheye_param, scale, width, height, what)
    if kind == "ftheta_param":
        return _ftheta(spec.ftheta_param, scale, width, height, what)
    raise InputError(
        f"{what}: no intrinsics",
        "fill ftheta_param, opencv_pinhole_param or opencv_fisheye_param",
    )


def _pinhole(p: Any, scale: tuple[float, float], width: int, height: int, what: str) -> Lens:
    sx, sy = scale
    K = np.array(
        [
            [p.focal_length_x * sx, 0, p.principal_point_x * sx],
            [0, p.focal_length_y * sy, p.principal_point_y * sy],
            [0, 0, 1.0],
        ]
    )
    _require(
        np.isfinite(K).all() and K[0, 0] > 0 and K[1, 1] > 0,
        what,
        f"focal lengths {K[0, 0]:.4g}, {K[1, 1]:.4g}",
    )
    lengths = (p.radial_coeffs, 6), (p.tangential_coeffs, 2), (p.thin_prism_coeffs, 4)
    k, t, s = (np.array([*given, *[0.0] * (n - len(given))]) for given, n in lengths)
    _require(
        all(len(given) <= n for given, n in lengths),
        what,
        "more coefficients than k1..k6, p1, p2, s1..s4",
    )
    if not (k.any() or t.any() or s.any()):
        return Lens(width, height, K, (width, height))
    _require(
        all(bool(np.isfinite(c).all()) for c in (k, t, s)), what, "coefficients that are not finite"
    )
    given_xy = (_centres(width, height) - K[:2, 2]) / [K[0, 0], K[1, 1]]
    xy = _undistorted(given_xy, k, t, s)
    missed = np.linalg.norm((_distorted(xy, k, t, s) - given_xy) * [K[0, 0], K[1, 1]], axis=1)
    rays = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)
    return _covered(rays, missed < CLOSE_PX, (K[0, 0], K[1, 1]), width, height, what)


def _distorted(xy: F64, k: F64, t: F64, s: F64) -> F64:
    """Distort ideal image points ``(N, 2)`` by OpenCV's rational, tangential and thin prism terms
    (calib3d documentation).
    """
    x, y = xy.T
    r2 = x * x + y * y
    radial = (1 + r2 * (k[0] + r2 * (k[1] + r2 * k[2]))) / (
        1 + r2 * (k[3] + r2 * (k[4] + r2 * k[5]))
    )
    u = x * radial + 2 * t[0] * x * y + t[1] * (r2 + 2 * x * x) + s[0] * r2 + s[1] * r2 * r2
    v = y * radial + t[0] * (r2 + 2 * y * y) + 2 * t[1] * x * y + s[2] * r2 + s[3] * r2 * r2
    return np.stack([u, v], axis=1)


def _undistorted(given: F64, k: F64, t: F64, s: F64) -> F64:
    """Invert `_distorted` by Newton's method with a numerical Jacobian, from the distorted points;
    far points may not converge.
    """
    xy, h = given.copy(), 1e-6
    with np.errstate(all="ignore"):
        for _ in range(8):
            at = _distorted(xy, k, t, s)
            (a, c), (b, d) = (
                ((_distorted(xy + step, k, t, s) - at) / h).T for step in ([h, 0.0], [0.0, h])
            )
            (p, q), det = (given - at).T, a * d - b * c
            xy = xy + np.nan_to_num(
                np.stack([d * p - b * q, a * q - c * p], axis=1) / det[:, None],
                posinf=0.0,
                neginf=0.0,
            ).clip(-0.5, 0.5)
    return xy


def _fisheye(p: Any, scale: tuple[float, float], width: int, height: int, what: str) -> Lens:
    sx, sy = scale
    fx, fy = p.focal_length_x * sx, p.focal_length_y * sy
    fine = fx > 0 and fy > 0 and len(p.radial_coeffs) <= 4
    _require(
        fine, what, f"focal lengths {fx:.4g}, {fy:.4g} and {len(p.radial_coeffs)} coefficients"
    )
    polynomial = np.zeros(2 * len(p.radial_coeffs) + 2)
    polynomial[1], polynomial[3::2] = 1.0, list(p.radial_coeffs)
    plane = (_centres(width, height) - [p.principal_point_x * sx, p.principal_point_y * sy]) / [
        fx,
        fy,
    ]
    limit = p.max_angle if p.max_angle > 0 else WIDEST_RAD
    angle, seen = _inverse(polynomial, np.linalg.norm(plane, axis=1), limit, what)
    return _covered(_rays(plane, angle), seen, (fx, fy), width, height, what)


def _ftheta(p: Any, scale: tuple[float, float], width: int, height: int, what: str) -> Lens:
    forward, backward = np.array(p.angle_to_pixeldist_poly), np.array(p.pixeldist_to_angle_poly)
    _require(bool(len(forward) or len(backward)), what, "no polynomial")
    mean = (scale[0] + scale[1]) / 2
    c, d, e = (
        (p.linear_cde.linear_c, p.linear_cde.linear_d, p.linear_cde.linear_e)
        if p.HasField("linear_cde")
        else (1.0, 0.0, 0.0)
    )
    linear = np.array([[c, d], [e, 1.0]])
    _require(abs(np.linalg.det(linear)) > 1e-6, what, f"linear_cde {c}, {d}, {e}")
    offset = _centres(width, height) - [
        p.principal_point_x * scale[0],
        p.principal_point_y * scale[1],
    ]
    plane = offset / mean @ np.linalg.inv(linear).T
    radius = np.linalg.norm(plane, axis=1)
    limit = p.max_angle if p.max_angle > 0 else np.pi
    if len(backward) and (
        p.reference_poly == sensorsim_pb2.FthetaCameraParam.PIXELDIST_TO_ANGLE or not len(forward)
    ):
        angle = np.polynomial.polynomial.polyval(radius, backward)
        seen = (angle >= 0) & (angle <= limit)
        focal = 1 / backward[1] if len(backward) > 1 and backward[1] > 0 else 0.0
    else:
        angle, seen = _inverse(forward, radius, min(limit, WIDEST_RAD * 1.2), what)
        focal = forward[1] if len(forward) > 1 else 0.0
    _require(
        np.isfinite(focal) and focal > 0, what, "a polynomial that does not grow from the axis"
    )
    return _covered(_rays(plane, angle), seen, (focal * mean, focal * mean), width, height, what)


def _inverse(polynomial: F64, radius: F64, limit: float, what: str) -> tuple[F64, Bool]:
    """Solve ``polynomial(angle) = radius`` on [0, limit], as far as the polynomial grows; the flag
    says where there is a solution.
    """
    angles = np.linspace(0.0, limit, TABLE)
    values = np.polynomial.polynomial.polyval(angles, polynomial)
    falls = np.flatnonzero(np.diff(values) <= 0)
    last = int(falls[0]) if len(falls) else TABLE - 1
    _require(
        last > 0 and bool(np.isfinite(values).all()),
        what,
        "a polynomial that does not grow from the axis",
    )
    angle = np.interp(radius, values[: last + 1], angles[: last + 1])
    polyval, slope = np.polynomial.polynomial.polyval, np.polynomial.polynomial.polyder(polynomial)
    for _ in range(3):  # Newton, from within half a table step
        step = (polyval(angle, polynomial) - radius) / np.maximum(polyval(angle, slope), 1e-9)
        angle = np.clip(angle - step, 0.0, angles[last])
    return angle, (radius >= values[0]) & (radius <= values[last])


def _rays(plane: F64, angle: F64) -> F64:
    radius = np.linalg.norm(plane, axis=1, keepdims=True)
    return np.concatenate(
        [plane / np.maximum(radius, 1e-12) * np.sin(angle)[:, None], np.cos(angle)[:, None]], axis=1
    )


def _covered(
    rays: F64, seen: Bool, focal: tuple[float, float], width: int, height: int, what: str
) -> Lens:
    """Return the lens with a pinhole that covers all rays it sees."""
    _require(bool(seen.any()), what, "a lens that sees nothing at this size")
    widest = float(
        np.arccos(np.clip(rays[seen, 2] / np.linalg.norm(rays[seen], axis=1), -1, 1)).max()
    )
    if widest > WIDEST_RAD:
        raise InputError(
            f"{what}: a view of {np.rad2deg(widest):.0f} degrees from the axis",
            f"set max_angle to at most {np.rad2deg(WIDEST_RAD):.0f} degrees, or use --upstream",
        )
    xy = np.divide(
        rays[:, :2], rays[:, 2:], where=rays[:, 2:] > 0.05, out=np.zeros_like(rays[:, :2])
    )
    low, high = xy[seen].min(0), xy[seen].max(0)
    size = (high - low) * focal
    shrink = min(1.0, float(np.sqrt(MAX_COVER_PX / max(size[0] * size[1], 1.0))))
    fx, fy = focal[0] * shrink, focal[1] * shrink
    cover = int(np.ceil(size[0] * shrink)) + 2, int(np.ceil(size[1] * shrink)) + 2
    K = np.array([[fx, 0.0, 1.0 - low[0] * fx], [0.0, fy, 1.0 - low[1] * fy], [0.0, 0.0, 1.0]])
    place = (xy * [fx, fy] + [K[0, 2], K[1, 2]] - 0.5).astype(
        np.float32
    )  # cv2 counts from the centre of the first pixel
    all_seen = bool(seen.all())
    return Lens(
        width,
        height,
        K,
        cover,
        place.reshape(height, width, 2),
        None if all_seen else seen.reshape(height, width),
    )


def _centres(width: int, height: int) -> F64:
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    return np.stack([x, y], axis=-1).reshape(-1, 2)


def _require(fine: bool, what: str, found: str) -> None:
    if not fine:
        raise InputError(f"{what}: {found}", "send intrinsics that describe a lens")
