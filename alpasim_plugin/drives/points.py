"""What photographs with known poses say of the world: points of surfaces, points of the road, and
where the poses themselves are off.

The road has too little contrast for features. The next photographs are warped onto a photograph by
the plane of the road ahead; what is left is a shift of a few pixels, which optical flow finds on
asphalt too; undoing the warp gives rays, and the rays give points.
"""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import scipy

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import (
    interpolate,
    inverse,
    left_of,
    trajectory_from_poses,
    transform_points,
)
from alpasim_plugin.core.types import F32, F64, I64, U8, Bool, Trajectory
from alpasim_plugin.drives.ground import GroundStrip
from alpasim_plugin.drives.held_out import fitted_part
from alpasim_plugin.drives.source import Points, SourceDrive
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.fit.photographs import PosedPhotograph, resized
from alpasim_plugin.gaussians.fit.start import matches
from alpasim_plugin.gaussians.fit.tracks import (
    Tracks,
    corrected,
    follow,
    place,
    pose_arrays,
    residuals,
)
from alpasim_plugin.gaussians.fit.views import PosedView

WIDTH_PX = 1280  # following and matching need no more
ERROR_PX = 1.2  # largest error of a point in each photograph that places it
PIXEL_SPREAD = 0.3  # usual error of a point in such a photograph
FEWEST_VIEWS = 3  # that place a point
LEAST_ANGLE_RAD = np.radians(0.7)  # between the outermost rays of a point
FEWEST_POINTS = 60


def small_view(photograph: PosedPhotograph, width: int = WIDTH_PX) -> PosedView:
    """Return a photograph without distortion, at most ``width`` pixels wide."""
    view = photograph.view()
    return resized(view, width) if view.camera.width > width else view


def triangulated(photographs: Sequence[PosedPhotograph], folder: str) -> Points:
    """Return the points that at least three photographs place alike.

    Corners are followed from photograph to photograph; photographs too far apart for that are
    matched.

    Args:
        photographs: Of one camera, in order along the way.
        folder: For messages.

    Raises:
        InputError: Fewer than `FEWEST_POINTS` points: the photographs do not overlap, or their
            poses are not theirs.
    """
    views = [small_view(photograph) for photograph in photographs]
    points = placed(follow(views), views)
    if len(points) < 4 * FEWEST_POINTS:
        points = max(points, placed(_matched(views), views), key=len)
    if len(points) < FEWEST_POINTS:
        raise InputError(
            f"{folder}: {len(points)} points that {FEWEST_VIEWS} of {len(photographs)} photographs place alike",
            "give photographs that overlap, in order along the way, with their own poses and lens",
        )
    return points


def placed(tracks: Tracks, views: Sequence[PosedView]) -> Points:
    """Place tracks, and return the points that at least three views place alike, with how well each
    is known.
    """
    cameras = [view.pinhole for view in views]
    if tracks.count:  # observations that do not fit are left out once
        tracks = tracks.only(place(tracks, cameras).error_px < 3 * ERROR_PX)
    if not tracks.count:
        return Points(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)))
    placement = place(tracks, cameras)
    worst = np.zeros(tracks.count)
    count = np.bincount(tracks.point, minlength=tracks.count)
    np.maximum.at(worst, tracks.point, placement.error_px)
    good = (
        (count >= FEWEST_VIEWS)
        & (worst < ERROR_PX)
        & (placement.angle_rad > LEAST_ANGLE_RAD)
        & np.isfinite(placement.xyz).all(axis=1)
    )
    begins = np.searchsorted(tracks.point, np.arange(tracks.count))
    colours = np.array([_colour(views[tracks.view[i]], tracks.pixel[i]) for i in begins]).reshape(
        -1, 3
    )
    R, t, K = pose_arrays(cameras)
    _, slope, _ = residuals(placement.xyz, tracks, R, t, K)
    J = slope @ R[tracks.view]
    H = np.zeros((tracks.count, 3, 3))
    np.add.at(H, tracks.point, J.transpose(0, 2, 1) @ J)
    return Points(
        placement.xyz,
        colours,
        np.asarray(np.linalg.pinv(H, hermitian=True) * PIXEL_SPREAD**2, dtype=np.float64),
    ).chosen(good)


def _colour(view: PosedView, pixel: F64) -> F64:
    row = min(int(pixel[1]), view.camera.height - 1)
    column = min(int(pixel[0]), view.camera.width - 1)
    return view.rgb[row, column] / 255.0


def _matched(views: Sequence[PosedView]) -> Tracks:
    """Return tracks of features that were matched between near photographs; one that meets a
    photograph twice is left out.
    """
    pairs = matches(views)
    if not pairs:
        return Tracks(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64), np.zeros((0, 2)), 0)
    ends = np.array(
        [[match.first, *match.at_first] for match in pairs]
        + [[match.second, *match.at_second] for match in pairs]
    )
    features, number = np.unique(ends, axis=0, return_inverse=True)
    number = number.ravel()
    n = len(pairs)
    graph = scipy.sparse.coo_matrix(
        (np.ones(n), (number[:n], number[n:])), shape=(len(features), len(features))
    )
    _, label = scipy.sparse.csgraph.connected_components(graph, directed=False)
    view = features[:, 0].astype(np.int64)
    _, index, times = np.unique(
        np.stack([label, view], axis=1), axis=0, return_inverse=True, return_counts=True
    )
    twice = np.unique(label[times[index.ravel()] > 1])
    keep = ~np.isin(label, twice)
    order = np.argsort(label[keep], kind="stable")
    _, point = np.unique(label[keep][order], return_inverse=True)
    return Tracks(
        view[keep][order],
        point.astype(np.int64),
        features[keep][order, 1:],
        int(point.max(initial=-1)) + 1,
    )


def agreeing(first: PosedPhotograph, second: PosedPhotograph, turns: Sequence[F64]) -> list[int]:
    """Return for each turn of the camera's axes how many matches of two photographs lie before
    both, where both see them.

    Args:
        first, second: Photographs.
        turns: ``(4, 4)`` each, applied to the poses on the camera's side.
    """
    views = [small_view(photograph) for photograph in (first, second)]
    views = [resized(view, 640) if view.camera.width > 640 else view for view in views]
    pairs = matches(views)
    n = len(pairs)
    if not n:
        return [0 for _ in turns]
    pixels = np.array([[match.at_first, match.at_second] for match in pairs]).reshape(-1, 2)
    tracks = Tracks(np.tile([0, 1], n), np.repeat(np.arange(n), 2), pixels, n)
    counts = []
    for turn in turns:
        turned = [
            PinholeCamera(
                camera.width, camera.height, camera.K, inverse(turn) @ camera.T_camera_world
            )
            for camera in (view.pinhole for view in views)
        ]
        error = place(tracks, turned).error_px.reshape(-1, 2)
        counts.append(int((error < ERROR_PX).all(axis=1).sum()))
    return counts


# Begin and end of the piece of road that is looked at, in camera heights.
NEAR = 2.0
FAR = 9.0
# To both sides: under the wheels, where there is least to see, and beside them.
LATERAL = (0.75, 1.5)
CORNERS = (250, 60)  # in each of the two
CORNER_CONTRAST = 0.01  # relative: asphalt is faint
APART_PX = 6.0  # between corners
NEXT = (1, 2, 3)  # photographs
WINDOW_PX = 21  # of the flow
BACK_PX = 0.25  # how near a point must come back to where it was
MOST_PX = 12.0  # more than this and the plane was no prediction


def road_points(photographs: Sequence[PosedPhotograph], poses: F64, strip: GroundStrip) -> Points:
    """Return points of the road ahead of each photograph.

    Args:
        photographs: Of the front camera, in order.
        poses: ``(N, 4, 4)`` camera to the strip's frame.
        strip: A first idea of the ground.

    Returns:
        Points in the strip's frame.
    """
    views = [
        small_view(replace(photograph, T_world_camera=pose))
        for photograph, pose in zip(photographs, poses, strict=True)
    ]
    shots = [(view.pinhole, cv2.cvtColor(view.rgb, cv2.COLOR_RGB2GRAY)) for view in views]
    rows = [np.zeros((0, 4))]
    count = 0
    for i in range(len(shots) - 1):
        observations = _tracked(i, shots, strip)
        if len(observations):
            observations[:, 0] += count
            count = int(observations[-1, 0]) + 1
            rows.append(observations)
    table = np.concatenate(rows)
    tracks = Tracks(table[:, 1].astype(np.int64), table[:, 0].astype(np.int64), table[:, 2:], count)
    return placed(tracks, views)


def _tracked(i: int, shots: Sequence[tuple[PinholeCamera, U8]], strip: GroundStrip) -> F64:
    """Return observations of the road seen in photograph ``i``: rows of track, view and pixel,
    sorted by track.
    """
    camera, image = shots[i]
    pieces = [_piece_ahead(strip, camera.centre_world, lateral) for lateral in LATERAL]
    masks = [_mask(camera, piece) for piece in pieces]
    masks[1] = masks[1] & ~masks[0]
    corners = [
        cv2.goodFeaturesToTrack(image, n, CORNER_CONTRAST, APART_PX, mask=mask)
        for n, mask in zip(CORNERS, masks, strict=True)
        if mask.any()
    ]
    corners_px = np.concatenate(
        [np.zeros((0, 2)), *(points.reshape(-1, 2) for points in corners if points is not None)]
    ).astype(np.float32)
    if not len(corners_px):
        return np.zeros((0, 4))
    local = transform_points(camera.T_camera_world, pieces[0])
    middle = local.mean(axis=0)
    normal = np.linalg.svd(local - middle)[2][2]
    away = float(normal @ middle)
    rows = [_rows(np.arange(len(corners_px)), i, corners_px.astype(np.float64))]
    for j in (i + k for k in NEXT if i + k < len(shots)):
        other, other_image = shots[j]
        move = other.T_camera_world @ inverse(camera.T_camera_world)
        H = (
            other.K
            @ (move[:3, :3] + np.outer(move[:3, 3], normal) / away)
            @ np.linalg.inv(camera.K)
        )
        from_corner = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
        H = np.linalg.inv(from_corner) @ H @ from_corner  # OpenCV counts from pixel centres
        warped = cv2.warpPerspective(
            other_image,
            H,
            (camera.width, camera.height),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        )
        moved, good = _flow(image, warped, corners_px)
        pixels = cv2.perspectiveTransform(moved[:, None].astype(np.float64), H).reshape(-1, 2)
        good &= ((pixels >= 0) & (pixels < [other.width, other.height])).all(axis=1)
        which = np.nonzero(good)[0]
        rows.append(_rows(which, j, pixels[which]))
    observations = np.concatenate(rows)
    return observations[np.argsort(observations[:, 0], kind="stable")]


def _rows(track: I64, view: int, pixels: F64) -> F64:
    return np.column_stack([track, np.full(len(pixels), view), pixels + 0.5])


def _flow(image: U8, warped: U8, corners_px: F32) -> tuple[F32, Bool]:
    """Return where points moved to, and which came back to where they were."""
    options = {
        "winSize": (WINDOW_PX, WINDOW_PX),
        "maxLevel": 2,
        "flags": cv2.OPTFLOW_USE_INITIAL_FLOW,
    }
    moved, has_flow, _ = cv2.calcOpticalFlowPyrLK(  # type: ignore[call-overload]
        image, warped, corners_px, corners_px.copy(), **options
    )
    back, has_return, _ = cv2.calcOpticalFlowPyrLK(  # type: ignore[call-overload]
        warped, image, moved, corners_px.copy(), **options
    )
    good = (
        (has_flow.ravel() > 0)
        & (has_return.ravel() > 0)
        & (np.linalg.norm(back - corners_px, axis=1) < BACK_PX)
    )
    return moved, good & (np.linalg.norm(moved - corners_px, axis=1) < MOST_PX)


def _piece_ahead(strip: GroundStrip, centre: F64, lateral: float) -> F64:
    """Return corners ``(8, 3)`` of the piece of road ahead of a camera, on the strip, to ``lateral``
    camera heights of lateral offset.
    """
    station = strip.frame.place(centre[None])[0][0]
    out = []
    for ahead in np.linspace(NEAR, FAR, 4) * strip.height:
        k = int(np.clip(np.searchsorted(strip.frame.s, station + ahead), 0, len(strip.frame.s) - 1))
        along = strip.frame.along[k]
        left = lateral * strip.height * left_of(along)
        out += [strip.frame.line[k, :2] + left, strip.frame.line[k, :2] - left]
    xy = np.array(out)
    return np.column_stack([xy, strip.z(xy)])


def _mask(camera: PinholeCamera, piece: F64) -> U8:
    """Return where a photograph shows the piece, ``(H, W)``: 255 inside."""
    local = transform_points(camera.T_camera_world, piece)
    mask = np.zeros((camera.height, camera.width), dtype=np.uint8)
    if (local[:, 2] > 1e-3).all():
        pixel = local @ camera.K.T
        hull = cv2.convexHull((pixel[:, :2] / pixel[:, 2:]).clip(-1e4, 1e4).astype(np.int32))
        cv2.fillConvexPoly(mask, hull, 255)
    return mask


CORRECTING_PX = 640  # corners are followed at a tenth of a pixel: more is not needed
LEAST_GAIN = 0.9  # the error must fall below this share of what it was
# Largest correction of a pose: more is another fault than a recorder's noise.
FARTHEST_M = 0.5
FARTHEST_RAD = 0.05


def with_corrected_poses(drive: SourceDrive, stride: int) -> SourceDrive:
    """Return the drive with the front camera's poses adjusted to its photographs, and every other
    photograph moved as the rig was at its time.

    Poses in metres are held to what they were; a drive that has points of its own keeps its poses.

    Args:
        drive: As its files say it.
        stride: One photograph of so many is held out, whose pixels say nothing.
    """
    if drive.metric is None or drive.points is not None or drive.kind == "colmap":
        return drive
    front = fitted_part(drive, stride).of(drive.front)
    correction = corrected([small_view(photograph, CORRECTING_PX) for photograph in front])
    # Negated: where nothing was measured the errors are NaN, and the poses stay.
    if not correction.after_px < LEAST_GAIN * correction.before_px:
        return drive
    old = np.array([photograph.T_world_camera for photograph in front])
    new = np.array([inverse(camera.T_camera_world) for camera in correction.cameras])
    corrections = np.array([inverse(T) for T in old]) @ new  # in the camera's axes
    traces = np.trace(corrections[:, :3, :3], axis1=1, axis2=2)
    turned_rad = float(np.arccos(np.clip((traces - 1) / 2, -1, 1)).max())
    shifted_m = float(np.linalg.norm(corrections[:, :3, 3], axis=1).max())
    if shifted_m > FARTHEST_M or turned_rad > FARTHEST_RAD:
        return drive
    note = (
        f"poses were corrected by the photographs, by up to {100 * shifted_m:.0f} cm and {np.degrees(turned_rad):.2f} degrees: "
        f"points are met to {correction.after_px:.2f} instead of {correction.before_px:.2f} pixels"
    )
    times = np.array([int(photograph.t_us or 0) for photograph in front])
    moved = moved_rig(drive, trajectory_from_poses(times, corrections))
    return replace(moved, notes=(*drive.notes, note))


def moved_rig(drive: SourceDrive, corrections: Trajectory) -> SourceDrive:
    """Return the drive with its rig moved; a rig is rigid, so all its cameras move with the front
    one.

    Args:
        drive: Its front camera's poses, with their times, are the rig's path.
        corrections: The front camera's correction over time, in its own axes: from where it is
            corrected to, to where it was. Between its times it is interpolated, beyond them it
            stays as it is at its end.
    """
    front = drive.of(drive.front)
    path = trajectory_from_poses(
        [int(photograph.t_us or 0) for photograph in front],
        [photograph.T_world_camera for photograph in front],
    )
    times = np.array([int(photograph.t_us or 0) for photograph in drive.photographs])
    T_world_front = interpolate(path, times.clip(path.t_us[0], path.t_us[-1]))
    corrected_at = interpolate(corrections, times.clip(corrections.t_us[0], corrections.t_us[-1]))
    return replace(
        drive,
        photographs=tuple(
            replace(photograph, T_world_camera=T @ C @ inverse(T) @ photograph.T_world_camera)
            for photograph, T, C in zip(drive.photographs, T_world_front, corrected_at, strict=True)
        ),
    )
