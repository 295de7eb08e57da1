"""Lenses: which ray each pixel of a camera sees, and the pinholes that cover a lens.

Any lens is rendered by ideal pinholes that cover it, then resampled: by one up to
`WIDEST_OF_ONE_RAD` from the axis, up to `WIDEST_OF_PANELS_RAD` by three that stand side by side, and
beyond by the sides of a cube. Rays are x right, y down, z forward; the centre of pixel (row i,
column j) is (j + 0.5, i + 0.5).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import zip_longest
from typing import Any, NamedTuple

import cv2
import numpy as np

from alpasim_plugin.cameras.shutter import Along, Band, bands, largest_motion_px
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import intrinsics, unit
from alpasim_plugin.core.types import (
    F32,
    F64,
    U8,
    Bool,
    CameraSpec,
    Frame,
    LensModel,
    RenderRequest,
)

WIDEST_RAD = np.deg2rad(80.0)  # from the optical axis: beyond it one plane cannot carry the image
# Of one plane: twice the pixels of the lens. Wider ones have more, and smear what is near.
WIDEST_OF_ONE_RAD = np.deg2rad(50.0)
WIDEST_OF_PANELS_RAD = np.deg2rad(70.0)
WIDEST_OF_CUBE_RAD = np.deg2rad(110.0)  # of several planes
DESCRIBED_RAD = np.deg2rad(135.0)  # as far as a lens is followed beyond what its image shows
BLEND = 0.02  # difference of the cosines to two pinholes' axes within which both are shown
MAX_COVER_PX = 6_000_000  # of a covering pinhole; its resolution falls for lenses that need more
# a ray whose projection misses its pixel by more lies outside what the lens model describes
NEWTON_STEPS = 8
LARGEST_STEP = 0.5  # of one step of Newton's method, at unit focal length
CLOSE_PX = 0.05
# weight of a reference's pixel that does not hold, where 255 is that of one that does
NOT_HELD = np.float32(1)
BEYOND_PX = 24  # a lens goes on so far beyond its image's edges, where resampling looks as well
CHECKED_PX = 192  # across, of the image that a lens is checked with
TABLE = 4096  # samples of a radius to angle function
DO_THIS = "give intrinsics that describe a lens"
# The axes x, y, z of a pinhole on each side of a cube, in the lens's axes.
SIDES = {
    "ahead": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "left": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "right": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "up": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "down": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}


@dataclass(frozen=True, eq=False)
class Lens:
    """A lens as a pinhole that covers it, or a part of it, shows it.

    Attributes:
        width, height: Pixels of the lens.
        K: ``(3, 3)`` the pinhole to render.
        cover: Its width and height.
        resample: ``(height, w, 2)`` float32 place in the pinhole's image of every pixel; None
            where the lens is that pinhole.
        visible: ``(height, w)`` which pixels of the lens this pinhole shows; None: all.
        weight: ``(height, w)`` float32, share of this pinhole among those that cover the
            lens; None: all of it.
        T_lens_pinhole: ``(4, 4)`` where the pinhole looks.
        side: Its name among those that cover the lens; empty where it is the only one.
        first_column: The column of the lens at which its part of the image begins.
    """

    width: int
    height: int
    K: F64
    cover: tuple[int, int]
    resample: F32 | None = None
    visible: Bool | None = None
    weight: F32 | None = None
    T_lens_pinhole: F64 = field(default_factory=lambda: np.eye(4))
    side: str = ""
    first_column: int = 0

    def spec(self, name: str, T_rig_camera: F64, shutter_us: int = 0) -> CameraSpec:
        """Return the covering pinhole of a lens at a mounting, as a camera."""
        T = T_rig_camera @ self.T_lens_pinhole
        return CameraSpec(
            f"{name}.{self.side}" if self.side else name, *self.cover, self.K, T, shutter_us
        )

    @property
    def part(self) -> tuple[slice, slice]:
        """Return the part of the lens's image that this pinhole shows, rows and columns."""
        width = self.width if self.resample is None else self.resample.shape[1]
        return slice(None), slice(self.first_column, self.first_column + width)

    def shown(self, covering: Any) -> Any:
        """Return `part` of the lens's image, of one or several channels, of a covering one."""
        place = self.resample
        if place is None:
            return covering
        return cv2.remap(covering, place, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def lens_camera(pinhole: str) -> str:
    """Return the name of the camera whose lens a pinhole covers, by its name (see `Lens.spec`)."""
    camera, _, side = pinhole.rpartition(".")
    return camera or side


class Rays(NamedTuple):
    """What the pixels of a lens see, row by row.

    Attributes:
        ray: ``(H * W, 3)``.
        visible: ``(H * W,)`` where the lens sees anything.
        focal: Pixels per radian on the axis, in x and y.
    """

    ray: F64
    visible: Bool
    focal: tuple[float, float]

    @property
    def widest_rad(self) -> float:
        """Return the largest angle from the optical axis that is seen."""
        ray = self.ray[self.visible]
        return float(np.arctan2(np.linalg.norm(ray[:, :2], axis=1), ray[:, 2]).max())


def lens_of(camera: CameraSpec) -> Lens:
    """Return a camera's lens covered by one pinhole.

    Raises:
        InputError: Values that make no lens, or a view of more than `WIDEST_RAD` from the axis.
    """
    if camera.lens is None:
        return Lens(camera.width, camera.height, camera.K, (camera.width, camera.height))
    rays = rays_of(camera)
    if rays.widest_rad > WIDEST_RAD:
        raise InputError(
            f"camera {camera.name!r}: a view of {np.rad2deg(rays.widest_rad):.0f} degrees from the axis",
            f"set max_angle to at most {np.rad2deg(WIDEST_RAD):.0f} degrees, or use --upstream",
        )
    return _covered(camera, rays, rays.visible, "")


def sides_of(camera: CameraSpec) -> tuple[Lens, ...]:
    """Return a camera's lens covered by as few pinholes as show all of it well.

    Raises:
        InputError: Values that make no lens, or a view of more than `WIDEST_OF_CUBE_RAD` from the
            axis.
    """
    if camera.lens is None:
        return (lens_of(camera),)
    rays = rays_of(camera)
    require_sight(camera, rays)
    if rays.widest_rad <= WIDEST_OF_ONE_RAD:
        return (_covered(camera, rays, rays.visible, ""),)
    turns = _panels(rays)
    if rays.widest_rad > WIDEST_OF_PANELS_RAD:
        turns = {side: np.array(axes, dtype=np.float64).T for side, axes in SIDES.items()}
    ahead = np.stack([rays.ray @ turn[:, 2] for turn in turns.values()])
    behind_most = np.maximum(ahead - ahead.max(axis=0) + BLEND, 0) * rays.visible
    weights = behind_most / np.maximum(behind_most.sum(axis=0), 1e-12)
    sides = []
    for (side, turn), weight in zip(turns.items(), weights, strict=True):
        if weight.any():
            whole = _covered(camera, rays, weight > 0, side, turn)
            assert whole.resample is not None, "a pinhole that covers a lens"
            share = weight.astype(np.float32).reshape(camera.height, camera.width)
            covered_columns = np.flatnonzero(share.any(axis=0))
            first = int(covered_columns[0])
            end = int(covered_columns[-1]) + 1
            place, share = (
                np.ascontiguousarray(part[:, first:end]) for part in (whole.resample, share)
            )
            part = replace(whole, first_column=first, resample=place, visible=None, weight=share)
            sides.append(part)
    return tuple(sides)


def _panels(rays: Rays) -> dict[str, F64]:
    """Return by name how three pinholes are turned about the lens's upright axis so that each shows
    a third of its width: their axes as columns.
    """
    ray = rays.ray[rays.visible]
    azimuth = np.arctan2(ray[:, 0], ray[:, 2])
    low = float(azimuth.min())
    high = float(azimuth.max())
    middles = low + (high - low) * np.array([1, 3, 5]) / 6
    return {
        name: cv2.Rodrigues(np.array([0.0, angle, 0.0]))[0]
        for name, angle in zip(("left", "ahead", "right"), middles, strict=True)
    }


def part_of(request: RenderRequest, side: Lens, share: F32 | None = None) -> RenderRequest:
    """Return the request of one pinhole of a request's lens, exposed as ``share`` says where the
    lens's shutter rolls.
    """
    camera = request.camera
    exposure = request.exposure
    if exposure is not None and share is not None:
        exposure = replace(exposure, share=share)
    return replace(
        request,
        camera=side.spec(camera.name, camera.T_rig_camera, camera.shutter_us),
        T_world_camera=request.T_world_camera @ side.T_lens_pinhole,
        ahead=[part_of(later, side, share) for later in request.ahead],
        exposure=exposure,
    )


def joined(camera: str, sides: Sequence[Lens], frames: Sequence[Frame]) -> Frame:
    """Return the frame of a camera's lens, with its references, from those of its pinholes, in
    order; where the lens sees nothing it is black and opaque.
    """
    first = frames[0]
    if sides[0].resample is None:
        return first
    events = dict.fromkeys(event for frame in frames for event in frame.events)
    alphas = [frame.alpha for frame in frames]
    return replace(
        first,
        camera=camera,
        rgb=joined_image(sides, [frame.rgb for frame in frames]),
        alpha=None if first.alpha is None else joined_image(sides, alphas, 1),
        depth=None,
        references=joined_references(sides, frames),
        events=tuple(events),
        on_device=None,
    )


def joined_references(sides: Sequence[Lens], frames: Sequence[Frame]) -> tuple[U8, ...]:
    """Return the references of a lens's frame from those of its pinholes."""
    blank = np.zeros((1, 1, 4), dtype=np.uint8)
    of_pinholes = [frame.references_on_host() for frame in frames]
    references = zip_longest(*of_pinholes, fillvalue=blank)
    return tuple(joined_image(sides, images, holds=True) for images in references)


def joined_image(
    sides: Sequence[Lens], images: Sequence[Any], outside: int = 0, holds: bool = False
) -> Any:
    """Return the lens's image ``(height, width, ...)`` of those of its pinholes.

    Args:
        sides: The pinholes.
        images: One of each.
        outside: The value where the lens sees nothing.
        holds: Whether the last of four channels says how well a pixel holds; one that does not hold
            gives way to that of the other pinhole.
    """
    if len(sides) == 1:
        out = sides[0].shown(images[0])
        if sides[0].visible is not None:
            out[~sides[0].visible] = outside
        return out
    shape = sides[0].height, sides[0].width
    out = np.zeros((*shape, *images[0].shape[2:]), dtype=images[0].dtype)
    weight_sum = np.zeros(shape, dtype=np.float32)
    end = 0  # of the columns that a pinhole before has filled
    for lens, image in zip(sides, images, strict=True):
        assert lens.weight is not None, "one of several pinholes"
        part = lens.shown(image)
        weight = lens.weight * (part[..., 3] + NOT_HELD) if holds else lens.weight
        overlap = max(0, end - lens.first_column)
        if overlap:
            operands = out[lens.part], part, weight_sum[lens.part], weight
            mixed = cv2.blendLinear(
                *(np.ascontiguousarray(image[:, :overlap]) for image in operands)
            )
            part[:, :overlap] = mixed
        out[lens.part] = part
        weight_sum[lens.part] += weight
        end = max(end, lens.part[1].stop)
    if cv2.countNonZero(weight_sum) < weight_sum.size:
        out[weight_sum == 0] = outside
    return out


def blind_of(sides: Sequence[Lens]) -> Bool | None:
    """Return where a lens sees nothing ``(height, width)``; None where it sees everywhere."""
    if sides[0].resample is None:
        return None
    white = np.full((1, 1), 255, dtype=np.uint8)
    blind = joined_image(sides, [white] * len(sides)) == 0
    return blind if blind.any() else None


def blackened(image: U8, blind: Bool | None) -> U8:
    """Return an image ``(height, width, C)`` that is 0 where its lens sees nothing."""
    return image if blind is None else np.where(blind[..., None], np.uint8(0), image)


def rays_of(camera: CameraSpec) -> Rays:
    """Return what each pixel of a camera with a lens sees.

    Raises:
        InputError: Values that make no lens, or a lens that sees nothing.
    """
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = rays_at(camera, np.stack([x, y], axis=-1).reshape(-1, 2))
    _require(bool(rays.visible.any()), camera.name, "a lens that sees nothing at this size")
    return rays


def rays_at(camera: CameraSpec, pixels: F64) -> Rays:
    """Return what a camera with a lens sees at places ``(N, 2)`` of its image, column and row; the
    middle of the first pixel is (0.5, 0.5).

    Raises:
        InputError: Values that make no lens.
    """
    lens, K = _checked(camera)
    offset = pixels - K[:2, 2]
    focal = float(K[0, 0]), float(K[1, 1])
    if lens.kind == "opencv":
        plane, visible = _undistorted(offset / focal, lens, focal)
        ray = np.concatenate([plane, np.ones((len(plane), 1))], axis=1)
    else:
        plane = (
            offset / focal if lens.kind == "fisheye" else offset @ np.linalg.inv(_linear(lens)).T
        )
        radius = np.linalg.norm(plane, axis=1)
        if lens.pixel_to_angle:
            angle = _value(lens.pixel_to_angle, radius)
            visible = (angle >= 0) & (angle <= _limit(lens))
        else:
            angle, visible = _inverse(_radius_of_angle(lens), radius, _limit(lens), camera.name)
        across = plane / np.maximum(radius, 1e-12)[:, None] * np.sin(angle)[:, None]
        ray = np.concatenate([across, np.cos(angle)[:, None]], axis=1)
        if lens.kind == "ftheta":
            focal = _ftheta_focal(lens), _ftheta_focal(lens)
    return Rays(ray, visible, focal)


def pixels_of(camera: CameraSpec, ray: F64) -> tuple[F64, Bool]:
    """Return where a camera's lens shows rays ``(N, 3)``: pixels ``(N, 2)``, the middle of the
    first being (0.5, 0.5), and which of them it shows, up to `BEYOND_PX` beyond its image.
    """
    pixel, is_described = projected(camera, ray)
    size = np.array([camera.width, camera.height])
    inside = ((pixel > -BEYOND_PX) & (pixel < size + BEYOND_PX)).all(axis=1)
    return pixel, is_described & inside


def projected(camera: CameraSpec, ray: F64) -> tuple[F64, Bool]:
    """Return where a camera's lens puts rays ``(N, 3)``, inside its image or outside of it: pixels
    ``(N, 2)``, the middle of the first being (0.5, 0.5), and which of them the lens model describes.
    """
    lens, K = _checked(camera)
    across = np.linalg.norm(ray[:, :2], axis=1)
    if lens.kind == "opencv":
        ahead = np.where(ray[:, 2] > 1e-3, ray[:, 2], np.inf)[:, None]
        plane = ray[:, :2] / ahead
        pixel = _distorted(plane, lens) * K[[0, 1], [0, 1]]
        good = (ray[:, 2] > 1e-3) & (np.linalg.norm(plane, axis=1) < _opencv_reach(camera))
    else:
        angle = np.arctan2(across, ray[:, 2])
        if lens.pixel_to_angle:
            reach_px = _farthest_px(camera)
            radius, good = _inverse(np.array(lens.pixel_to_angle), angle, reach_px, camera.name)
        else:
            radius = _value(_radius_of_angle(lens), angle)
            good = angle <= _growing(lens)
        plane = ray[:, :2] / np.maximum(across, 1e-12)[:, None] * radius[:, None]
        pixel = plane * K[[0, 1], [0, 1]] if lens.kind == "fisheye" else plane @ _linear(lens).T
    return pixel + K[:2, 2], good


class Reach(NamedTuple):
    """How far from its axis a lens is described, as `projected` flags rays.

    Attributes:
        slope: Of an OpenCV lens, the distance of a point at unit depth from the axis.
        angle_rad: Of a fisheye or f-theta lens.
        radius_px: Of an f-theta lens by its ``pixel_to_angle``, the distance from the middle that
            shows that angle.
    """

    slope: float = 0.0
    angle_rad: float = 0.0
    radius_px: float = 0.0


def reach_of(camera: CameraSpec) -> Reach:
    """Return how far a camera's lens is described.

    Raises:
        InputError: Values that make no lens.
    """
    lens, _ = _checked(camera)
    if lens.kind == "opencv":
        return Reach(slope=_opencv_reach(camera))
    if not lens.pixel_to_angle:
        return Reach(angle_rad=_growing(lens))
    radii, angles = _growing_table(np.array(lens.pixel_to_angle), _farthest_px(camera), camera.name)
    return Reach(angle_rad=float(angles[-1]), radius_px=float(radii[-1]))


class RadialForm(NamedTuple):
    """A lens as a distance from the middle by the angle from the axis, and what is added to it.

    With the unit vector e across the axis, the pixel is ``linear (radius(angle) e + bent) + middle``.

    Attributes:
        linear: ``(2, 2)``.
        radius: Distances ``(N,)`` of angles ``(N,)``, radians.
        grows_to_rad: Up to which angle the distance grows, as far as the lens is described.
        bent: Of the terms ``2 p1 x y + p2 (r^2 + 2 x^2) + s1 r^2 + s2 r^4`` and their like for y,
            with x, y the tangents: p1, p2, s1, s2, s3, s4.
    """

    linear: F64
    radius: Callable[[F64], F64]
    grows_to_rad: float
    bent: tuple[float, ...]


def radial_form(camera: CameraSpec) -> RadialForm:
    """Return a camera's lens in its radial form.

    Raises:
        InputError: Values that make no lens.
    """
    lens, K = _checked(camera)
    if lens.kind == "opencv":
        terms = np.zeros(12)
        terms[: len(lens.coefficients)] = lens.coefficients
        bent = tuple(float(term) for term in (*terms[2:4], *terms[8:]))
        straight = terms.copy()
        straight[[2, 3, 8, 9, 10, 11]] = 0.0
        radial = replace(lens, coefficients=tuple(straight))

        def radius(angle: F64) -> F64:
            plane = np.column_stack([np.tan(angle), np.zeros_like(angle)])
            return _distorted(plane, radial)[:, 0]

        return RadialForm(K[:2, :2], radius, _grows_to(radius, float(WIDEST_RAD)), bent)
    linear = K[:2, :2] if lens.kind == "fisheye" else _linear(lens)
    if lens.pixel_to_angle:
        polynomial = np.array(lens.pixel_to_angle)
        reach = 2 * float(np.hypot(camera.width, camera.height))

        def radius(angle: F64) -> F64:
            return _inverse(polynomial, angle, reach, camera.name)[0]

        return RadialForm(linear, radius, _grows_to(radius, DESCRIBED_RAD), (0.0,) * 6)
    radius_at = partial(_value, _radius_of_angle(lens))
    return RadialForm(linear, radius_at, _grows_to(radius_at, DESCRIBED_RAD), (0.0,) * 6)


def _grows_to(radius: Callable[[F64], F64], limit: float) -> float:
    """Return up to which angle a radius grows."""
    angles = np.linspace(0.0, limit, TABLE)
    falls = np.flatnonzero(np.diff(radius(angles)) <= 0)
    return float(angles[falls[0]] if len(falls) else angles[-1])


def place_in_lens(camera: CameraSpec, pinhole: Lens) -> tuple[F32, Bool]:
    """Return where a camera's lens shows each pixel of a covering pinhole: ``(h, w, 2)`` column and
    row, counted from the centre of the first pixel; and which it shows, ``(h, w)``.
    """
    width, height = pinhole.cover
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    plane = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3) @ np.linalg.inv(pinhole.K).T
    pixel, is_visible = pixels_of(camera, plane @ pinhole.T_lens_pinhole[:3, :3].T)
    place = (pixel - 0.5).astype(np.float32).reshape(height, width, 2)
    return place, is_visible.reshape(height, width)


def lens_shares(camera: CameraSpec, pinhole: Lens, along: Along, backwards: bool) -> F32:
    """Return when each pixel of a covering pinhole is exposed: the share of the shutter of the
    lens's row (or column) that shows it; NaN where none does. See `shutter.Exposure`.
    """
    place, is_visible = place_in_lens(camera, pinhole)
    count, position = (
        (camera.height, place[..., 1]) if along == "rows" else (camera.width, place[..., 0])
    )
    share = np.clip(position / max(count - 1, 1), 0, 1) if count > 1 else np.ones_like(position)
    near = cv2.dilate(is_visible.astype(np.uint8), np.ones((3, 3), dtype=np.uint8)) > 0
    return np.where(near, 1 - share if backwards else share, np.float32(np.nan)).astype(np.float32)


def exposed_bands(request: RenderRequest) -> list[Band]:
    """Return the bands of a request's frame as `shutter.bands`, through its camera's lens."""
    camera = request.camera
    if camera.lens is None or request.exposure is None:
        return bands(request)
    u, v = np.meshgrid(np.linspace(0, camera.width, 9), np.linspace(0, camera.height, 9))
    rays = rays_at(camera, np.column_stack([u.ravel(), v.ravel()]))
    # The image of a lens that sees less than the distance of these pixels lies about its axis.
    is_any = rays.visible.any()
    sight = unit(rays.ray[rays.visible]) if is_any else np.array([[0.0, 0.0, 1.0]])
    return bands(request, largest_motion_px(request, sight, max(rays.focal)))


def resized(camera: CameraSpec, width: int, height: int) -> CameraSpec:
    """Return a camera whose image has another size: its middle and its focal lengths follow each
    side, the polynomials of an f-theta lens the mean of both.
    """
    scale = width / camera.width, height / camera.height
    lens = camera.lens
    if lens is not None and lens.kind == "ftheta":
        mean = (scale[0] + scale[1]) / 2
        forward = tuple(a * mean for a in lens.coefficients)
        backward = tuple(b / mean**k for k, b in enumerate(lens.pixel_to_angle))
        lens = replace(lens, coefficients=forward, pixel_to_angle=backward)
    K = np.diag([*scale, 1.0]) @ camera.K
    return replace(camera, width=width, height=height, K=K, lens=lens)


def check_lens(camera: CameraSpec) -> None:
    """Refuse a lens that cannot be drawn whole.

    Raises:
        InputError: Values that make no lens, a lens that turns back within its image, or one that
            sees too far from its axis.
    """
    if camera.lens is None:
        return
    small = resized(camera, CHECKED_PX, max(round(CHECKED_PX * camera.height / camera.width), 2))
    rays = rays_of(small)
    lens, K = _checked(small)
    corners = np.array([[x, y] for x in (0, small.width) for y in (0, small.height)]) - K[:2, 2]
    turns = not bool(rays.visible.all())
    if lens.kind != "opencv":
        scale = K[[0, 1], [0, 1]] if lens.kind == "fisheye" else np.ones(2)
        reach = float(np.linalg.norm(corners / scale, axis=1).max())
        if lens.pixel_to_angle:
            angle = _value(lens.pixel_to_angle, np.linspace(0.0, reach, TABLE))
            turns = bool((np.diff(angle[angle < _limit(lens)]) <= 0).any())
        else:
            grows = _growing(lens)
            farthest = float(_value(_radius_of_angle(lens), np.array([grows]))[0])
            turns = grows < _limit(lens) and farthest < reach
    if turns:
        raise InputError(
            f"camera {camera.name!r}: a {lens.kind} lens that turns back within its image",
            "correct the coefficients, or set max_angle_deg below where it turns",
        )
    require_sight(camera, rays)


def require_sight(camera: CameraSpec, rays: Rays) -> None:
    """Refuse a lens that sees more than `WIDEST_OF_CUBE_RAD` from its axis.

    Raises:
        InputError: It does.
    """
    if rays.widest_rad > WIDEST_OF_CUBE_RAD:
        raise InputError(
            f"camera {camera.name!r}: a view of {np.rad2deg(rays.widest_rad):.0f} degrees from the axis",
            f"set max_angle_deg to at most {np.rad2deg(WIDEST_OF_CUBE_RAD):.0f}; the image is black beyond it",
        )


def _checked(camera: CameraSpec) -> tuple[LensModel, F64]:
    lens = camera.lens
    K = camera.K
    assert lens is not None, "a pinhole is its own lens"
    numbers = [*lens.coefficients, *lens.pixel_to_angle, *lens.linear, lens.max_angle_rad]
    _require(
        bool(np.isfinite(K).all()) and K[0, 0] > 0 and K[1, 1] > 0,
        camera.name,
        f"focal lengths {K[0, 0]:.4g}, {K[1, 1]:.4g}",
    )
    _require(bool(np.isfinite(numbers).all()), camera.name, "coefficients that are not finite")
    most = {"opencv": 12, "fisheye": 4, "ftheta": 64}[lens.kind]
    _require(
        len(lens.coefficients) <= most,
        camera.name,
        f"{len(lens.coefficients)} coefficients, where {lens.kind} has at most {most}",
    )
    if lens.kind == "ftheta":
        _require(bool(lens.coefficients or lens.pixel_to_angle), camera.name, "no polynomial")
        _require(abs(np.linalg.det(_linear(lens))) > 1e-6, camera.name, f"linear_cde {lens.linear}")
        focal = _ftheta_focal(lens)
        _require(focal > 0, camera.name, "a polynomial that does not grow from the axis")
    return lens, K


def _ftheta_focal(lens: LensModel) -> float:
    """Return pixels per radian on the axis; 0 where the polynomial does not grow there."""
    polynomial = lens.pixel_to_angle or lens.coefficients
    slope = polynomial[1] if len(polynomial) > 1 else 0.0
    if slope <= 0:
        return 0.0
    return 1 / slope if lens.pixel_to_angle else slope


def focal_px_of(camera: CameraSpec) -> tuple[float, float]:
    """Return a camera's pixels per radian on its axis, to the right and down."""
    lens = camera.lens
    if lens is not None and lens.kind == "ftheta":
        return _ftheta_focal(lens), _ftheta_focal(lens)
    return float(camera.K[0, 0]), float(camera.K[1, 1])


def intrinsics_on_axis(camera: CameraSpec) -> F64:
    """Return the intrinsics ``(3, 3)`` of a pinhole that shows what is on a camera's axis as the
    camera does.
    """
    if camera.lens is None:
        return camera.K
    return intrinsics(*focal_px_of(camera), *camera.K[:2, 2])


def _linear(lens: LensModel) -> F64:
    c, d, e = lens.linear
    return np.array([[c, d], [e, 1.0]])


def _limit(lens: LensModel) -> float:
    return lens.max_angle_rad if lens.max_angle_rad > 0 else float(WIDEST_OF_CUBE_RAD * 1.2)


def _radius_of_angle(lens: LensModel) -> F64:
    """Return the coefficients, from the constant, of the distance from the middle by the angle."""
    if lens.kind == "ftheta":
        return np.array(lens.coefficients)
    polynomial = np.zeros(2 * len(lens.coefficients) + 2)
    polynomial[1], polynomial[3::2] = 1.0, lens.coefficients
    return polynomial


def _growing(lens: LensModel) -> float:
    """Return up to which angle the lens's distance from the middle grows with it."""
    polynomial = _radius_of_angle(lens)
    return _grows_to(lambda angle: _value(polynomial, angle), _limit(lens))


def _farthest_px(camera: CameraSpec) -> float:
    """Return how far from its middle a camera's image is followed: twice the farthest corner."""
    corners = np.array([[x, y] for x in (0, camera.width) for y in (0, camera.height)])
    return 2 * float(np.linalg.norm(corners - camera.K[:2, 2], axis=1).max())


def _value(coefficients: Any, x: F64) -> F64:
    return np.polynomial.polynomial.polyval(x, np.asarray(coefficients))


def _inverse(polynomial: F64, values: F64, limit: float, name: str) -> tuple[F64, Bool]:
    """Solve ``polynomial(x) = value`` on [0, limit], as far as the polynomial grows; the flag says
    where there is a solution.
    """
    table, table_values = _growing_table(polynomial, limit, name)
    x = np.interp(values, table_values, table)
    slope = np.polynomial.polynomial.polyder(polynomial)
    for _ in range(3):  # Newton, from within half a table step
        step = (_value(polynomial, x) - values) / np.maximum(_value(slope, x), 1e-9)
        x = np.clip(x - step, 0.0, table[-1])
    return x, (values >= table_values[0]) & (values <= table_values[-1])


def _growing_table(polynomial: F64, limit: float, name: str) -> tuple[F64, F64]:
    """Return places on [0, limit] and a polynomial's values there, as far as it grows."""
    table = np.linspace(0.0, limit, TABLE)
    table_values = _value(polynomial, table)
    falls = np.flatnonzero(np.diff(table_values) <= 0)
    end = int(falls[0]) + 1 if len(falls) else TABLE
    _require(end > 1, name, "a polynomial that does not grow from the axis")
    return table[:end], table_values[:end]


def _distorted(xy: F64, lens: LensModel) -> F64:
    """Distort ideal image points ``(N, 2)`` by OpenCV's rational, tangential and thin prism terms
    (calib3d documentation).
    """
    coefficients = np.zeros(12)
    coefficients[: len(lens.coefficients)] = lens.coefficients
    k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = coefficients
    x, y = xy.T
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + s1 * r2 + s2 * r2 * r2
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + s3 * r2 + s4 * r2 * r2
    return np.stack([u, v], axis=1)


def _opencv_reach(camera: CameraSpec) -> float:
    """Return how far from the axis, as a slope, the lens model holds, with a margin."""
    assert camera.lens is not None, "a pinhole is its own lens"
    x, y = np.meshgrid(np.linspace(0, camera.width, 65), np.linspace(0, camera.height, 65))
    offset = np.stack([x, y], axis=-1).reshape(-1, 2) - camera.K[:2, 2]
    focal = float(camera.K[0, 0]), float(camera.K[1, 1])
    plane, converged = _undistorted(offset / focal, camera.lens, focal)
    return 1.05 * float(np.linalg.norm(plane[converged], axis=1).max(initial=0.0))


def _undistorted(distorted: F64, lens: LensModel, focal: tuple[float, float]) -> tuple[F64, Bool]:
    """Invert `_distorted` by Newton's method, from the distorted points.

    Args:
        distorted: ``(N, 2)`` image points at unit focal length.
        lens: The lens.
        focal: Focal lengths along x and y, pixels.

    Returns:
        ``(N, 2)`` ideal image points, and a flag ``(N,)`` where they are right within `CLOSE_PX`.
    """
    xy = distorted.copy()
    with np.errstate(all="ignore"):
        for _ in range(NEWTON_STEPS):
            missing = distorted - _distorted(xy, lens)
            step = _solved(_distortion_jacobian(xy, lens), missing)
            xy = xy + step.clip(-LARGEST_STEP, LARGEST_STEP)
        error_px = np.linalg.norm((_distorted(xy, lens) - distorted) * focal, axis=1)
    return xy, error_px < CLOSE_PX


def _distortion_jacobian(xy: F64, lens: LensModel) -> F64:
    """Return the derivatives ``(N, 2, 2)`` of `_distorted` by forward differences: the rows are its
    components, the columns x and y.
    """
    h = 1e-6
    base = _distorted(xy, lens)
    by_x = (_distorted(xy + np.array([h, 0.0]), lens) - base) / h
    by_y = (_distorted(xy + np.array([0.0, h]), lens) - base) / h
    return np.stack([by_x, by_y], axis=2)


def _solved(matrix: F64, value: F64) -> F64:
    """Solve ``matrix @ x = value`` for each of N systems of two equations by Cramer's rule.

    A system without a solution gives 0, where `numpy.linalg.solve` would refuse them all.

    Args:
        matrix: ``(N, 2, 2)``.
        value: ``(N, 2)``.
    """
    determinant = matrix[:, 0, 0] * matrix[:, 1, 1] - matrix[:, 0, 1] * matrix[:, 1, 0]
    x = (matrix[:, 1, 1] * value[:, 0] - matrix[:, 0, 1] * value[:, 1]) / determinant
    y = (matrix[:, 0, 0] * value[:, 1] - matrix[:, 1, 0] * value[:, 0]) / determinant
    return np.nan_to_num(np.stack([x, y], axis=1), posinf=0.0, neginf=0.0)


def _covered(
    camera: CameraSpec, rays: Rays, covered: Bool, side: str, turn: F64 = np.eye(3)
) -> Lens:
    """Return the pinhole that shows some of a lens's pixels; ``turn`` has its axes as columns."""
    local = rays.ray @ turn
    xy = np.divide(
        local[:, :2], local[:, 2:], where=local[:, 2:] > 0.05, out=np.zeros_like(local[:, :2])
    )
    low = xy[covered].min(0)
    high = xy[covered].max(0)
    size = (high - low) * rays.focal
    shrink = min(1.0, float(np.sqrt(MAX_COVER_PX / max(size[0] * size[1], 1.0))))
    fx = rays.focal[0] * shrink
    fy = rays.focal[1] * shrink
    cover = int(np.ceil(size[0] * shrink)) + 2, int(np.ceil(size[1] * shrink)) + 2
    K = np.array([[fx, 0.0, 1.0 - low[0] * fx], [0.0, fy, 1.0 - low[1] * fy], [0.0, 0.0, 1.0]])
    # cv2 counts from the centre of the first pixel
    place = (xy * [fx, fy] + [K[0, 2], K[1, 2]] - 0.5).astype(np.float32)
    T = np.eye(4)
    T[:3, :3] = turn
    shape = camera.height, camera.width
    visible = None if covered.all() else covered.reshape(shape)
    place = place.reshape(*shape, 2)
    size = camera.width, camera.height
    return Lens(*size, K, cover, place, visible, T_lens_pinhole=T, side=side)


def _require(fine: bool, name: str, problem: str) -> None:
    if not fine:
        raise InputError(f"camera {name!r}: {problem}", DO_THIS)
