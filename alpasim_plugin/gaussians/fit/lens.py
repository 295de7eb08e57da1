"""The lens of a photograph: OpenCV's models, and the pinhole picture that is left when the distortion is taken out."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import cv2
import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F64, U8

FISHEYE_HALF_VIEW_RAD = np.radians(50.0)  # of a fisheye's pinhole picture, from its middle to a side: beyond, pixels are only stretched
_FROM_CORNER = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])  # OpenCV counts from pixel centres


@dataclass(frozen=True, eq=False)
class Lens:
    """What a photograph's lens does.

    Attributes:
        width, height: Of the photograph, pixels.
        K: ``(3, 3)`` pixels; the middle of the first pixel is (0.5, 0.5).
        distortion: OpenCV's coefficients: k1, k2, p1, p2, k3 and on of ``opencv``, k1 to k4 of ``fisheye``; all zero bends nothing.
        model: ``opencv`` is radial and tangential, ``fisheye`` equidistant.
    """

    width: int
    height: int
    K: F64
    distortion: F64 = field(default_factory=lambda: np.zeros(5))
    model: Literal["opencv", "fisheye"] = "opencv"

    def check(self, doing: str, where: str, do_this: str) -> Lens:
        """Return it, or refuse numbers that are no lens.

        Raises:
            InputError: Something is not finite, or there is no focal length or no pixel.
        """
        finite = np.isfinite([*self.K.ravel(), *self.distortion]).all()
        if not finite or min(self.K[0, 0], self.K[1, 1]) <= 0 or min(self.width, self.height) < 1:
            found = f"{self.width} x {self.height} pixels, focal lengths {self.K[0, 0]:g} and {self.K[1, 1]:g}"
            raise InputError(doing, where, found if finite else "intrinsics that are not finite, or no focal length", do_this)
        return self

    @property
    def bends(self) -> bool:
        """Return whether straight lines are bent."""
        return self.model == "fisheye" or bool(self.distortion.any())

    def straight_K(self) -> F64:
        """Return the intrinsics of the picture without distortion, of the same size: what it shows is all in the photograph."""
        if not self.bends:
            return self.K
        if self.model == "fisheye":
            return self._fisheye_K()
        whole, _ = cv2.getOptimalNewCameraMatrix(self.K - _FROM_CORNER, self.distortion, (self.width, self.height), 0.0)
        straight: F64 = np.asarray(whole, dtype=np.float64) + _FROM_CORNER
        return straight

    def straightened(self, image: U8) -> U8:
        """Return an image ``(H, W[, 3])`` freed of the distortion."""
        if not self.bends:
            return image
        x, y = (cv2.fisheye if self.model == "fisheye" else cv2).initUndistortRectifyMap(
            self.K - _FROM_CORNER, self.distortion, np.eye(3), self.straight_K() - _FROM_CORNER, (self.width, self.height), cv2.CV_32FC1
        )
        return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR), dtype=np.uint8)

    def resized(self, width: int) -> Lens:
        """Return the lens of the same photograph at another width, pixels."""
        height = round(self.height * width / self.width)
        return replace(self, width=width, height=height, K=np.diag([width / self.width, height / self.height, 1.0]) @ self.K)

    def _fisheye_K(self) -> F64:
        """Return a pinhole with the lens's middle whose sides look at most `FISHEYE_HALF_VIEW_RAD` aside and stay in the photograph."""
        middle = np.array([[[self.K[0, 2] - 0.5, self.K[1, 2] - 0.5]]])
        ends = [(0.0, middle[0, 0, 1]), (self.width - 1.0, middle[0, 0, 1]), (middle[0, 0, 0], 0.0), (middle[0, 0, 0], self.height - 1.0)]
        seen = cv2.fisheye.undistortPoints(np.array([ends]), self.K - _FROM_CORNER, self.distortion)[0]  # tangents
        most = np.tan(FISHEYE_HALF_VIEW_RAD)
        sides = np.minimum(np.where(np.isfinite(seen), np.abs(seen), most), most)
        half = np.array([min(self.K[0, 2], self.width - self.K[0, 2]), min(self.K[1, 2], self.height - self.K[1, 2])])
        focal = float(max(half[0] / min(sides[0, 0], sides[1, 0]), half[1] / min(sides[2, 1], sides[3, 1])))
        return np.array([[focal, 0.0, self.K[0, 2]], [0.0, focal, self.K[1, 2]], [0.0, 0.0, 1.0]])
