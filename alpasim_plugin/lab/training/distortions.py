"""Synthetic image distortions, by kind and strength; all random numbers are drawn before the
strength is chosen.

A `Distortion` at two strengths is the same distortion at two severities, in which a perceptual
distance must be monotone. Strength 0 is the identity; 1 is the strongest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from alpasim_plugin.core.types import F32

Draw = np.random.Generator
Apply = Callable[[F32, float, Mapping[str, Any]], F32]
SHIFT_PX, WARP_PX = 4.0, 4.0  # displacement at strength 1


@dataclass(frozen=True)
class Distortion:
    """A distortion: its kind and its random parameters."""

    kind: str
    drawn: Mapping[str, Any]

    def __call__(self, image: F32, strength: float) -> F32:
        """Distort an image ``(H, W, 3)`` float32 in 0 to 1; strength 0 to 1."""
        out = KINDS[self.kind][1](image, strength, self.drawn) if strength > 0 else image
        return np.ascontiguousarray(np.clip(out, 0, 1), dtype=np.float32)

    def displacement_px(self, strength: float) -> float:
        """Return the displacement of pixels for geometric kinds; else 0."""
        return strength * {"shift": SHIFT_PX, "warp": WARP_PX}.get(self.kind, 0.0)


def draw_distortion(rng: Draw, shape: tuple[int, ...], kind: str | None = None) -> Distortion:
    """Draw a distortion for images of shape ``(H, W, 3)``, of a given kind or a random one."""
    chosen = kind if kind is not None else tuple(KINDS)[int(rng.integers(len(KINDS)))]
    return Distortion(chosen, KINDS[chosen][0](rng, shape))


def _blur(image: F32, s: float, drawn: Mapping[str, Any]) -> F32:
    sigma_x, sigma_y = (0.25 + 3.5 * s * drawn[axis] for axis in ("x", "y"))
    return _f32(
        cv2.GaussianBlur(image, (0, 0), sigma_x, sigmaY=sigma_y, borderType=cv2.BORDER_REFLECT_101)
    )


def _draw_blur(rng: Draw, shape: tuple[int, ...]) -> dict[str, Any]:
    squeeze = float(rng.uniform(0.2, 1.0)) if rng.random() < 0.4 else 1.0
    return {"x": 1.0, "y": squeeze} if rng.random() < 0.5 else {"x": squeeze, "y": 1.0}


def _coarse(image: F32, s: float, drawn: Mapping[str, Any]) -> F32:
    h, w = image.shape[:2]
    factor = 1 + 5 * s
    small = cv2.resize(
        image, (max(2, round(w / factor)), max(2, round(h / factor))), interpolation=cv2.INTER_AREA
    )
    return _f32(cv2.resize(small, (w, h), interpolation=drawn["up"]))


def _draw_coarse(rng: Draw, shape: tuple[int, ...]) -> dict[str, Any]:
    return {"up": (cv2.INTER_NEAREST, cv2.INTER_LINEAR, cv2.INTER_CUBIC)[int(rng.integers(3))]}


def _add(image: F32, s: float, drawn: Mapping[str, Any]) -> F32:
    return _f32(image + s * drawn["field"])


def _draw_noise(rng: Draw, shape: tuple[int, ...]) -> dict[str, Any]:
    noise = rng.standard_normal(shape if rng.random() < 0.6 else (*shape[:2], 1), dtype=np.float32)
    if rng.random() < 0.4:  # grain
        noise = cv2.GaussianBlur(noise, (0, 0), float(rng.uniform(0.5, 1.5))).reshape(
            *shape[:2], -1
        )
        noise /= noise.std() + 1e-6
    return {"field": np.float32(0.12) * noise}


def _draw_stain(rng: Draw, shape: tuple[int, ...]) -> dict[str, Any]:
    return {"field": np.float32(0.15) * smooth_field(rng, shape, 3, float(rng.uniform(8, 30)))}


def _move(image: F32, s: float, drawn: Mapping[str, Any]) -> F32:
    rows, columns = np.indices(image.shape[:2], dtype=np.float32)
    flow = drawn["flow"] * np.float32(s)  # (H, W, 2) px
    return _f32(
        cv2.remap(
            image,
            columns + flow[..., 0],
            rows + flow[..., 1],
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REFLECT_101,
        )
    )


def _draw_shift(rng: Draw, shape: tuple[int, ...]) -> dict[str, Any]:
    angle = rng.uniform(0, 2 * np.pi)
    flow = np.array([np.cos(angle), np.sin(angle)], dtype=np.float32) * np.float32(SHIFT_PX)
    return {"flow": np.broadcast_to(flow, (*shape[:2], 2))}


def _draw_warp(rng: Draw, shape: tuple[int, ...]) -> dict[str, Any]:
    return {"flow": np.float32(WARP_PX) * smooth_field(rng, shape, 2, float(rng.uniform(4, 16)))}


def _mix(image: F32, s: float, drawn: Mapping[str, Any]) -> F32:
    share = np.float32(s) * drawn["mask"]
    return _f32(image * (1 - share) + share * drawn["make"](image))


def _draw_ghost(rng: Draw, shape: tuple[int, ...]) -> dict[str, Any]:
    angle, far = rng.uniform(0, 2 * np.pi), rng.uniform(3, 12)
    matrix = np.array([[1, 0, far * np.cos(angle)], [0, 1, far * np.sin(angle)]])

    def make(image: F32) -> Any:
        return cv2.warpAffine(
            image,
            matrix,
            image.shape[1::-1],
            flags=cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REFLECT_101,
        )

    return {"mask": np.float32(0.6) * _patches(rng, shape, 0.6), "make": make}


def _draw_erase(rng: Draw, shape: tuple[int, ...]) -> dict[str, Any]:
    side = int(rng.integers(2, 6)) * 2 + 1

    def make(image: F32) -> Any:
        small = np.rint(image * 255).astype(np.uint8)
        return cv2.medianBlur(small, side).astype(np.float32) / 255

    return {"mask": _patches(rng, shape, 0.5), "make": make}


def _draw_splat(rng: Draw, shape: tuple[int, ...]) -> dict[str, Any]:
    """Soft ellipses in colours from elsewhere in the image: floaters and badly fitted Gaussians."""
    h, w = shape[:2]
    count = int(rng.integers(1, max(2, h * w // 120)))
    mask = np.zeros((h, w), dtype=np.float32)
    source = rng.random((count, 2))
    index = np.zeros((h, w), dtype=np.int32)
    for i in range(count):
        long = float(rng.uniform(1.5, 10))
        axes = (max(1, round(long)), max(1, round(long * rng.uniform(0.2, 1.0))))
        centre = (int(rng.integers(w)), int(rng.integers(h)))
        shape_of = np.zeros((h, w), dtype=np.uint8)
        cv2.ellipse(shape_of, centre, axes, float(rng.uniform(0, 180)), 0, 360, 1, -1)
        index[shape_of > 0] = i
        mask = np.maximum(mask, shape_of.astype(np.float32) * np.float32(rng.uniform(0.4, 1.0)))
    soft = cv2.GaussianBlur(mask, (0, 0), float(rng.uniform(0.5, 2.0)))[..., None]

    def make(image: F32) -> Any:
        rows, columns = (source * image.shape[:2]).astype(int).T
        return cv2.GaussianBlur(image[rows, columns][index], (0, 0), 1.0)

    return {"mask": soft, "make": make}


def _colour(image: F32, s: float, drawn: Mapping[str, Any]) -> F32:
    grey = image.mean(axis=2, keepdims=True)
    out = grey + (image - grey) * (1 + s * drawn["saturation"])
    out = np.clip(out, 0, 1) ** (1 + s * drawn["gamma"])
    return _f32(out * (1 + s * drawn["gain"]) + s * drawn["offset"])


def _draw_colour(rng: Draw, shape: tuple[int, ...]) -> dict[str, Any]:
    return {
        "saturation": float(rng.uniform(-1, 1)),
        "gamma": float(rng.uniform(-0.5, 1)),
        "gain": rng.uniform(-0.3, 0.3, 3),
        "offset": rng.uniform(-0.15, 0.15, 3),
    }


def _jpeg(image: F32, s: float, drawn: Mapping[str, Any]) -> F32:
    quality = round(70 * (1 - s) ** 1.5) + 2
    done, data = cv2.imencode(
        ".jpg", np.rint(image * 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, quality]
    )
    assert done
    share = np.float32(
        min(1.0, 8 * s)
    )  # blended at low strengths, so that strength 0 is the identity
    return image * (1 - share) + share * (
        _f32(cv2.imdecode(data, cv2.IMREAD_COLOR)) / np.float32(255)
    )


def _sharpen(image: F32, s: float, drawn: Mapping[str, Any]) -> F32:
    return _f32(image + 3 * s * (image - cv2.GaussianBlur(image, (0, 0), drawn["sigma"])))


KINDS: Mapping[str, tuple[Callable[[Draw, tuple[int, ...]], Mapping[str, Any]], Apply]] = {
    "blur": (_draw_blur, _blur),
    "coarse": (_draw_coarse, _coarse),
    "noise": (_draw_noise, _add),
    "stain": (_draw_stain, _add),
    "shift": (_draw_shift, _move),
    "warp": (_draw_warp, _move),
    "ghost": (_draw_ghost, _mix),
    "erase": (_draw_erase, _mix),
    "splat": (_draw_splat, _mix),
    "colour": (_draw_colour, _colour),
    "jpeg": (lambda rng, shape: {}, _jpeg),
    "sharpen": (lambda rng, shape: {"sigma": float(rng.uniform(0.7, 2.5))}, _sharpen),
}


def smooth_field(rng: Draw, shape: tuple[int, ...], channels: int, scale_px: float) -> F32:
    """Draw a smooth random field ``(H, W, channels)`` with a scale of ``scale_px`` pixels and unit
    root mean square.
    """
    h, w = shape[:2]
    knots = rng.standard_normal(
        (max(2, round(h / scale_px) + 1), max(2, round(w / scale_px) + 1), channels),
        dtype=np.float32,
    )
    field = cv2.resize(knots, (w, h), interpolation=cv2.INTER_CUBIC).reshape(h, w, channels)
    return _f32(field / (np.sqrt((field**2).mean()) + 1e-6))


def _patches(rng: Draw, shape: tuple[int, ...], everywhere: float) -> F32:
    """Draw a mask ``(H, W, 1)`` of soft patches, or ones with probability ``everywhere``."""
    if rng.random() < everywhere:
        return np.ones((*shape[:2], 1), dtype=np.float32)
    field = smooth_field(rng, shape, 1, float(rng.uniform(10, 30)))
    return _f32(np.clip(2 * field + np.float32(0.5), 0, 1))


def _f32(image: Any) -> F32:
    return np.asarray(image, dtype=np.float32)
