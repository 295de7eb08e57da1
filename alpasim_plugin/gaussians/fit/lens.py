"""What the camera did to a photograph: its lens (OpenCV's models, the pinhole image without
distortion, and the way back from it), exposure and balance.

A camera that meters for itself changes its gain by a tenth from one street corner to the next. A
surface keeps its brightness, so the logarithm of what a photograph shows of a track's point is the
point's plus the photograph's: linear, solved with robust weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import cv2
import numpy as np
import scipy

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import intrinsics
from alpasim_plugin.core.types import F32, F64, I64, U8, CameraSpec, LensModel
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.fit.tracks import Tracks
from alpasim_plugin.gaussians.fit.views import PosedView
from alpasim_plugin.gaussians.lens_camera import LensCamera

# Of a fisheye's pinhole image, from its middle to a side: beyond, pixels are only stretched
FISHEYE_HALF_VIEW_RAD = np.radians(50.0)
FROM_CORNER = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # OpenCV counts from pixel centres


@dataclass(frozen=True, eq=False)
class Lens:
    """What a photograph's lens does.

    Attributes:
        width, height: Of the photograph, pixels.
        K: ``(3, 3)`` pixels; the middle of the first pixel is (0.5, 0.5).
        distortion: OpenCV's coefficients: k1, k2, p1, p2, k3 and on of ``opencv``, k1 to k4 of
            ``fisheye``; all zero bends nothing.
        model: ``opencv`` is radial and tangential, ``fisheye`` equidistant.
    """

    width: int
    height: int
    K: F64
    distortion: F64 = field(default_factory=lambda: np.zeros(5))
    model: Literal["opencv", "fisheye"] = "opencv"

    def check(self, location: str, do_this: str) -> Lens:
        """Return it, or refuse numbers that are no lens.

        Raises:
            InputError: Something is not finite, or there is no focal length or no pixel.
        """
        finite = np.isfinite([*self.K.ravel(), *self.distortion]).all()
        if not finite or min(self.K[0, 0], self.K[1, 1]) <= 0 or min(self.width, self.height) < 1:
            sizes = f"{self.width} x {self.height} pixels, focal lengths {self.K[0, 0]:g} and {self.K[1, 1]:g}"
            raise InputError(
                f"{location}: {sizes if finite else 'intrinsics that are not finite, or no focal length'}",
                do_this,
            )
        return self

    @property
    def bends(self) -> bool:
        """Return whether straight lines are bent."""
        return self.model == "fisheye" or bool(self.distortion.any())

    def straight_K(self) -> F64:
        """Return the intrinsics of the image without distortion, of the same size: the
        photograph covers all its pixels.
        """
        if not self.bends:
            return self.K
        if self.model == "fisheye":
            # A pinhole with the lens's middle whose sides look at most `FISHEYE_HALF_VIEW_RAD` apart
            # and stay in the photograph.
            x, y = self.K[:2, 2] - 0.5
            ends = [(0.0, y), (self.width - 1.0, y), (x, 0.0), (x, self.height - 1.0)]
            tangents = cv2.fisheye.undistortPoints(
                np.array([ends]), self.K - FROM_CORNER, self.distortion
            )[0]
            most = np.tan(FISHEYE_HALF_VIEW_RAD)
            sides = np.minimum(np.where(np.isfinite(tangents), np.abs(tangents), most), most)
            half = np.minimum(self.K[:2, 2], [self.width, self.height] - self.K[:2, 2])
            focal = float(
                max(
                    half[0] / min(sides[0, 0], sides[1, 0]), half[1] / min(sides[2, 1], sides[3, 1])
                )
            )
            return intrinsics(focal, focal, *self.K[:2, 2])
        whole, _ = cv2.getOptimalNewCameraMatrix(
            self.K - FROM_CORNER, self.distortion, (self.width, self.height), 0.0
        )
        return whole + FROM_CORNER

    def straightened(self, image: U8) -> U8:
        """Return an image ``(H, W[, 3])`` freed of the distortion."""
        if not self.bends:
            return image
        x, y = (cv2.fisheye if self.model == "fisheye" else cv2).initUndistortRectifyMap(
            self.K - FROM_CORNER,
            self.distortion,
            np.eye(3),
            self.straight_K() - FROM_CORNER,
            (self.width, self.height),
            cv2.CV_32FC1,
        )
        return cv2.remap(image, x, y, cv2.INTER_LINEAR)

    def camera(self, name: str, T_world_camera: F64) -> LensCamera:
        """Return the camera of the photograph as it is, with its distortion.

        Raises:
            InputError: Values that make no lens.
        """
        coefficients = tuple(float(value) for value in self.distortion)
        model = LensModel(self.model, coefficients)
        spec = CameraSpec(name, self.width, self.height, self.K, np.eye(4), 0, model)
        return LensCamera.from_pose(spec, T_world_camera)

    @classmethod
    def of(cls, spec: CameraSpec) -> Lens:
        """Return the lens of a camera.

        Raises:
            InputError: An f-theta lens, which is none of OpenCV's.
        """
        lens = spec.lens
        assert lens is not None, "a pinhole has no lens"
        if lens.kind == "ftheta":
            raise InputError(
                f"camera {spec.name!r}: photographs through an f-theta lens",
                "give an opencv or a fisheye lens that is close to it",
            )
        few = np.zeros(max(0, 4 - len(lens.coefficients)))  # OpenCV takes four at least
        distortion = np.concatenate([np.array(lens.coefficients, dtype=np.float64), few])
        return cls(spec.width, spec.height, spec.K, distortion, lens.kind)

    def resized(self, width: int) -> Lens:
        """Return the lens of the same photograph at another width, pixels."""
        height = round(self.height * width / self.width)
        return replace(
            self,
            width=width,
            height=height,
            K=np.diag([width / self.width, height / self.height, 1.0]) @ self.K,
        )


def without_distortion(view: PosedView) -> PosedView:
    """Return the pinhole image of a view through a lens, which shows a part of it, without depth and sky;
    a view of a pinhole is returned as it is.

    Raises:
        InputError: An f-theta lens.
    """
    camera = view.camera
    if isinstance(camera, PinholeCamera):
        return view
    lens = Lens.of(camera.spec)
    pinhole = PinholeCamera(lens.width, lens.height, lens.straight_K(), camera.T_camera_world)
    rgb = np.ascontiguousarray(lens.straightened(view.rgb))
    mask = None
    if view.mask is not None:
        mask = lens.straightened(np.where(view.mask, np.uint8(255), np.uint8(0))) == 255
    return replace(view, camera=pinhole, rgb=rgb, mask=mask, depth=None, sky=None)


def through_lens(camera: LensCamera, pinhole: PinholeCamera, image: F32) -> F32:
    """Return what an image ``(H, W)`` of `without_distortion` says of the pixels of the lens's image, the
    nearest pixel's value as it is; 0 where it does not reach.
    """
    ray = camera.rays()
    is_ahead = (ray[..., 2] > 1e-3) & camera.visible
    slope = ray[..., :2] / np.where(is_ahead, ray[..., 2], 1.0)[..., None]
    place = slope * [pinhole.fx, pinhole.fy] + [pinhole.cx, pinhole.cy] - 0.5
    place = np.where(is_ahead[..., None], place, -2.0).astype(np.float32)
    carried = cv2.remap(  # type: ignore[call-overload,unused-ignore]
        image, place, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT
    )
    return np.asarray(carried, dtype=np.float32)


def distances_through_lens(camera: LensCamera, pinhole: PinholeCamera, depth: F32) -> F32:
    """Return distances from the camera's centre ``(H, W)``, metres, of the pixels of the lens's image, from
    depths of a pinhole's; 0 where they are unknown.
    """
    ahead = np.maximum(camera.rays()[..., 2], 1e-3)
    return np.asarray(through_lens(camera, pinhole, depth) / ahead, dtype=np.float32)


PATCH_PX = 7
# Levels of a patch's mean that is neither too dark nor too bright to measure.
DARKEST = 12.0
BRIGHTEST = 245.0
ROUNDS = 5  # of robust weights
SPREAD = 0.05  # of a logarithm that counts fully
PULL = 1.0  # towards a gain of 1, in observations


def balances(views: Sequence[PosedView], tracks: Tracks) -> F64:
    """Return the gain ``(V, 3)`` of each view's red, green and blue over the drive's; their
    geometric mean is 1.

    A view without points keeps 1.
    """
    patch_colours = np.array(
        [
            _patch(views[view].rgb, pixel)
            for view, pixel in zip(tracks.view.tolist(), tracks.pixel, strict=True)
        ]
    ).reshape(-1, 3)
    out = np.ones((len(views), 3))
    for channel in range(3):
        value = patch_colours[:, channel]
        good = (value > DARKEST) & (value < BRIGHTEST)
        if good.any():
            out[:, channel] = np.exp(
                _solved(
                    np.log(value[good]),
                    tracks.view[good],
                    tracks.point[good],
                    len(views),
                    tracks.count,
                )
            )
    return out


def gain_near(camera: str, place: F64, cameras: Sequence[str], centres: F64, gains: F64) -> F32:
    """Return the gain ``(3,)`` that a camera has at a place: of its two photographs that were taken
    nearest, by inverse distance.

    Cameras of a rig meter for themselves, so a photograph of another one says nothing, however near;
    of a camera that took none, those of all cameras count. Without any the gain is 1.

    Args:
        camera: Whose gain.
        place: ``(3,)`` metres, world.
        cameras: Which camera took each photograph.
        centres: ``(N, 3)`` metres, world: where they were taken.
        gains: ``(N, 3)`` of their red, green and blue.
    """
    centres = np.asarray(centres, dtype=np.float64).reshape(-1, 3)
    gains = np.asarray(gains, dtype=np.float64).reshape(-1, 3)
    if not len(centres):
        return np.ones(3, dtype=np.float32)
    is_own = np.array([name == camera for name in cameras])
    if is_own.any():
        centres = centres[is_own]
        gains = gains[is_own]
    distance = np.linalg.norm(centres - place, axis=1)
    nearest = np.argsort(distance, kind="stable")[:2]
    weight = 1 / (distance[nearest] + 1e-3)
    return np.asarray(weight @ gains[nearest] / weight.sum(), dtype=np.float32)


def _patch(rgb: U8, pixel: F64) -> F64:
    patch = cv2.getRectSubPix(
        rgb, (PATCH_PX, PATCH_PX), (float(pixel[0] - 0.5), float(pixel[1] - 0.5))
    )
    return patch.reshape(-1, 3).mean(axis=0)


def _solved(value: F64, view: I64, point: I64, views: int, points: int) -> F64:
    """Solve value = gain[view] + surface[point] for the gains: surfaces are means of what is left,
    so only V unknowns remain.
    """
    gain = np.zeros(views)
    weight = np.ones(len(value))
    for _ in range(ROUNDS):
        total = np.maximum(np.bincount(point, weight, points), 1e-12)
        observations = scipy.sparse.csr_matrix((weight, (view, point)), shape=(views, points))
        shared = observations @ scipy.sparse.diags(1 / total)
        A = np.diag(np.bincount(view, weight, views) + PULL) - (shared @ observations.T).toarray()
        b = np.bincount(view, weight * value, views) - shared @ np.bincount(
            point, weight * value, points
        )
        gain = np.linalg.solve(A, b)
        gain -= gain.mean()
        surface = np.bincount(point, weight * (value - gain[view]), points) / total
        off = np.abs(value - gain[view] - surface[point])
        weight = SPREAD / np.maximum(off, SPREAD)
    return gain
