"""Rolling shutters: an image whose pixels are exposed at different times, as bands that are drawn
at one instant each.

A pixel that is exposed at the share s of the shutter is seen from the camera's pose at s, and shows
the road users where they are at s: linear in position, slerp in rotation between the poses at
shutter start and end. A band holds the pixels whose s lies in one of N equal parts, and is drawn at
the middle of theirs. N follows the motion: what comes apart by so many pixels while the shutter is
open needs as many bands, a vehicle that stands needs one. Who draws bands draws rows: with as many
bands as rows each row has its own pose.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from alpasim_plugin.core.devices import upload
from alpasim_plugin.core.geometry import (
    inverse,
    quat_from_matrix,
    se3,
    slerp,
    transform_points,
    unit,
)
from alpasim_plugin.core.types import F32, F64, Bool, CameraSpec, Exposure, RenderRequest

Along = Literal["rows", "columns"]
# two neighbouring bands show a thing so far apart, so that none is off by more than half of it ...
APART_PX = 1.0
NEAR_M = 8.0  # ... but what is nearer than this: the lowest rows of a street, and a car that passes
USER_M = 2.5  # a road user's side is so much nearer than its middle
MOST_BANDS = 64


@dataclass(frozen=True, eq=False)
class Band:
    """A part of an image that is drawn at one instant.

    Attributes:
        rows, columns: The window that holds its pixels.
        exposed: ``(h, w)`` which pixels of the window are its own; None: all.
        T_world_camera: ``(4, 4)`` at its instant.
        actors: ``T_world_box`` at its instant.
    """

    rows: slice
    columns: slice
    exposed: Bool | None
    T_world_camera: F64
    actors: Mapping[str, F64]

    def put(self, whole: Any, part: Any) -> None:
        """Write the band's pixels of a window's image ``(h, w, ...)`` into the whole one; both are
        arrays, or tensors of a device.
        """
        window = whole[self.rows, self.columns]
        if self.exposed is None:
            window[...] = part
        elif isinstance(whole, np.ndarray):
            window[self.exposed] = part[self.exposed]
        else:
            import torch

            exposed = upload(self.exposed, whole.device)
            exposed = exposed.reshape(*exposed.shape, *[1] * (part.ndim - 2))
            window[...] = torch.where(exposed, part, window)


def rolling_exposure(
    camera: CameraSpec, before: Mapping[str, F64], now: Mapping[str, F64], period_us: int
) -> Exposure | None:
    """Return when the rows of a camera's frame are exposed: the first at shutter start, the last at
    its end; None where its shutter is global.

    Args:
        camera: Its shutter is open no longer than the period.
        before: ``T_world_box`` of the road users one period before the shutter's end; who was not
            there stood still.
        now: At the shutter's end.
        period_us: Between the two.
    """
    if not camera.shutter_us:
        return None
    share = 1 - camera.shutter_us / period_us
    start = {name: between(before.get(name, T)[None], T[None], share)[0] for name, T in now.items()}
    return Exposure(rolling(camera.width, camera.height, "rows", backwards=False), start)


def bands(request: RenderRequest, moves_px: float | None = None) -> list[Band]:
    """Return the bands of a request's frame, in the order of their time; without an exposure one,
    at the shutter's end.

    Args:
        request: The frame.
        moves_px: By how much a thing in the image moves while the shutter is open, at most; None:
            that of the pinhole ``K``.
    """
    height = request.camera.height
    width = request.camera.width
    if request.exposure is None:
        return [
            Band(slice(0, height), slice(0, width), None, request.T_world_camera[1], request.actors)
        ]
    moves_px = motion_px(request) if moves_px is None else moves_px
    count = min(max(int(np.ceil(moves_px / APART_PX)), 1), MOST_BANDS)
    return list(bands_of(request, count))


def joined(request: RenderRequest, exposed: Sequence[Band], parts: Sequence[Any]) -> Any:
    """Return a request's image of the windows of its bands, all arrays or all tensors of a device;
    0 where nobody looks.
    """
    if request.exposure is None:
        return parts[0]
    first = parts[0]
    shape = request.camera.height, request.camera.width, *first.shape[2:]
    on_host = isinstance(first, np.ndarray)
    whole = np.zeros(shape, dtype=first.dtype) if on_host else first.new_zeros(shape)
    for band, part in zip(exposed, parts, strict=True):
        band.put(whole, part)
    return whole


def bands_of(request: RenderRequest, count: int) -> Iterator[Band]:
    """Yield the bands of a frame whose shutter is cut into ``count`` equal parts; those without a
    pixel are left out.
    """
    assert request.exposure is not None, "a frame without exposure is exposed at one instant"
    share = request.exposure.share
    height = request.camera.height
    width = request.camera.width
    part = np.full(share.shape, -1, dtype=np.int32)
    np.minimum(share * count, count - 1, out=part, where=~np.isnan(share), casting="unsafe")
    for index in range(count):
        in_band = part == index
        if not in_band.any():
            continue
        rows = extent(in_band.any(axis=1), height)
        columns = extent(in_band.any(axis=0), width)
        window = np.broadcast_to(in_band, (height, width))[rows, columns]
        within = share[in_band]
        T, actors = at_share(request, (float(within.min()) + float(within.max())) / 2)
        yield Band(rows, columns, None if window.all() else window, T, actors)


def extent(used: Bool, size: int) -> slice:
    """Return the part of an axis between the first and the last place in use; a single place stands
    for the whole axis.
    """
    if len(used) == 1:
        return slice(0, size)
    places = np.flatnonzero(used)
    return slice(int(places[0]), int(places[-1]) + 1)


def at_share(request: RenderRequest, share: float) -> tuple[F64, dict[str, F64]]:
    """Return the camera's pose ``(4, 4)`` and the road users' boxes at a share of the shutter."""
    assert request.exposure is not None, "a frame without exposure is exposed at one instant"
    start = [
        request.T_world_camera[0],
        *(request.exposure.actors_start[name] for name in request.actors),
    ]
    end = [request.T_world_camera[1], *request.actors.values()]
    T = between(np.array(start), np.array(end), share)
    return T[0], dict(zip(request.actors, T[1:], strict=True))


def between(start: F64, end: F64, share: float) -> F64:
    """Return the poses ``(N, 4, 4)`` at a share of the way between two: linear in position, slerp
    in rotation; the ends as given.
    """
    if share <= 0.0 or share >= 1.0:
        return end if share >= 1.0 else start
    turned = slerp(
        quat_from_matrix(start[:, :3, :3]),
        quat_from_matrix(end[:, :3, :3]),
        np.full(len(start), share),
    )
    return se3(start[:, :3, 3] + share * (end[:, :3, 3] - start[:, :3, 3]), turned)


def motion_px(request: RenderRequest) -> float:
    """Return by how many pixels a thing in a pinhole's image moves while the shutter is open, at
    most; see `largest_motion_px`.

    Pixels are those of the image's middle: at the edge of a wide pinhole they are smaller, but those
    of the lens that it stands for are not.
    """
    K = request.camera.K
    width = request.camera.width
    height = request.camera.height
    u, v = np.meshgrid(np.linspace(0, width, 5), np.linspace(0, height, 5))
    rays = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3) @ np.linalg.inv(K).T
    return largest_motion_px(request, unit(rays), float(max(K[0, 0], K[1, 1])))


def largest_motion_px(request: RenderRequest, rays: F64, px_per_rad: float) -> float:
    """Return by how many pixels a thing in the image moves while the shutter is open, at most.

    Of the street that is what is `NEAR_M` away or at infinity, on some rays of the image; of the road
    users in view their near side.

    Args:
        request: With an exposure.
        rays: ``(N, 3)`` unit, in the camera's axes.
        px_per_rad: Of the image's middle.
    """
    assert request.exposure is not None, "a frame without exposure is exposed at one instant"
    start, end = request.T_world_camera
    to_start = inverse(start) @ end
    turned = rays @ to_start[:3, :3].T
    moved = to_start[:3, 3] / NEAR_M
    moves = [angle_between(rays, turned), angle_between(rays, turned + moved)]
    if request.actors:
        first = np.array([request.exposure.actors_start[name][:3, 3] for name in request.actors])
        last = np.array([T[:3, 3] for T in request.actors.values()])
        before, after = (
            transform_points(inverse(T), points) for T, points in ((start, first), (end, last))
        )
        near_m = np.maximum(np.linalg.norm(after, axis=1) - USER_M, NEAR_M)
        # A lens may see what lies behind it.
        is_seen = (after[:, 2] > -USER_M) | (request.camera.lens is not None)
        moves.append(np.where(is_seen, np.linalg.norm(after - before, axis=1) / near_m, 0.0))
    return float(px_per_rad * max(float(np.max(move)) for move in moves))


def angle_between(a: F64, b: F64) -> F64:
    """Return the angles, radians, between directions ``(N, 3)``."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1))


def rolling(width: int, height: int, along: Along, backwards: bool) -> F32:
    """Return the shares of an image exposed row by row (``along`` is ``rows``) or column by
    column, the first at shutter start.

    Example:
        >>> rolling(4, 3, "rows", backwards=False).ravel().tolist()
        [0.0, 0.5, 1.0]
    """
    count = height if along == "rows" else width
    share = (
        np.linspace(0.0, 1.0, count, dtype=np.float32)
        if count > 1
        else np.ones(1, dtype=np.float32)
    )
    share = share[::-1] if backwards else share
    return np.ascontiguousarray(share[:, None] if along == "rows" else share[None, :])
