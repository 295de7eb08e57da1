"""Plan-view footprints: the ego's and all actors' rectangles at any set of times, as arrays.

Corners run front-left, front-right, rear-right, rear-left; the front bumper is the side between the
first two, the rear bumper the one between the last two. All coordinates are metres relative to an
origin near the drive, so that UTM-sized worlds cost no precision.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from alpasim_plugin.core.geometry import UNIT_CORNERS, rectangle_corners, slerp, yaw_from_quat
from alpasim_plugin.core.types import F64, I64, Bool, RolloutLog, Trajectory
from evaluators.metrics.presets import Preset

Geometries = npt.NDArray[Any]  # of shapely geometries
LEVEL_SLOPE = 0.05  # a hill may lift somebody on the ego's road by so much a metre of distance


def origin_of(track: Trajectory, preset: Preset) -> F64:
    """Return the point ``(3,)`` that geometry is relative to: whole metres near the start of a
    track; zero for float32 presets.
    """
    return np.zeros(3) if preset.float32 else np.round(track.xyz[0])


def held(values: F64, preset: Preset) -> F64:
    """Return coordinates as the preset holds them: float64, or rounded to float32."""
    return values.astype(np.float32).astype(np.float64) if preset.float32 else values


@dataclass(frozen=True)
class Footprints:
    """Boxes of one body at N instants."""

    xy: F64  # (N, 2) centre, metres from the origin
    yaw: F64  # (N,)
    size: F64  # (N, 2) length, width after shrinking
    roundness: float = 0.0
    float32: bool = False  # corners are worked out in float32

    @property
    def radius_m(self) -> F64:
        """Radius ``(N,)`` of the circle around each box."""
        return np.hypot(self.size[:, 0], self.size[:, 1]) / 2

    @property
    def inner_radius_m(self) -> F64:
        """Radius ``(N,)`` of a circle around the centre inside each footprint."""
        return np.minimum(self.size[:, 0], self.size[:, 1]) / 2

    def take(self, index: I64) -> Footprints:
        """Return the boxes at some rows."""
        return Footprints(
            self.xy[index], self.yaw[index], self.size[index], self.roundness, self.float32
        )

    def corners(self) -> F64:
        """Return the corners ``(N, 4, 2)``."""
        if self.float32:
            # Rounded after each step, the centre first, as AlpaSim does.
            x, y = (self.xy.astype(np.float32)[:, [axis]] for axis in (0, 1))  # (N, 1)
            c = np.cos(self.yaw.astype(np.float32))[:, None]
            s = np.sin(self.yaw.astype(np.float32))[:, None]
            along, across = (
                (UNIT_CORNERS[:, axis] * self.size[:, [axis]]).astype(np.float32) for axis in (0, 1)
            )  # (N, 4)
            return np.stack(
                [(x + along * c) - across * s, (y + along * s) + across * c], axis=-1
            ).astype(np.float64)
        return rectangle_corners(self.xy, self.yaw, self.size)

    def centres(self) -> F64:
        """Return the reference point ``(N, 2)`` of the body: the box centre, or for float32 presets
        the rounded shape's centroid.
        """
        return shapely.get_coordinates(shapely.centroid(self.shapes())) if self.float32 else self.xy

    def shapes(self) -> Geometries:
        """Return the footprints ``(N,)`` as shapely polygons."""
        boxes = shapely.polygons(self.corners())
        r = self._corner_radius_m()
        return (
            boxes
            if r is None
            else shapely.buffer(shapely.buffer(boxes, -r, quad_segs=16), r, quad_segs=16)
        )

    def bumpers(self) -> tuple[Geometries, Geometries]:
        """Return front and rear bumpers ``(N,)``: segments; with rounded corners the footprint's
        part within a corner radius of them.
        """
        corners = self.corners()
        front = shapely.linestrings(corners[:, 0:2])
        rear = shapely.linestrings(corners[:, 2:4])
        r = self._corner_radius_m()
        if r is None:
            return front, rear
        body = self.shapes()
        return shapely.intersection(
            shapely.buffer(front, r, quad_segs=16), body
        ), shapely.intersection(shapely.buffer(rear, r, quad_segs=16), body)

    def _corner_radius_m(self) -> F64 | None:
        return self.roundness * self.size.min(axis=1) / 2 if self.roundness > 0 else None


def ego_footprints(rollout: RolloutLog, preset: Preset, origin: F64) -> Footprints:
    """Return the ego's footprint at every logged time, centred at the box centre."""
    return ego_footprints_at(
        rollout.ego.xyz[:, :2] - origin[:2], yaw_from_quat(rollout.ego.quat), rollout, preset
    )


def ego_footprints_at(xy: F64, yaw: F64, rollout: RolloutLog, preset: Preset) -> Footprints:
    """Return the ego's footprint at given box centres ``(N, 2)`` and headings ``(N,)``."""
    length_m, width_m = preset.ego_size_m or (rollout.ego_box.length_m, rollout.ego_box.width_m)
    size = np.broadcast_to(
        held(np.array([length_m, width_m]), preset) * (1.0 - preset.shrink), (len(xy), 2)
    )
    return Footprints(np.asarray(xy), np.asarray(yaw), size, preset.roundness, preset.float32)


class ActorTable:
    """Tracks of all actors of a rollout, laid end to end, so that many times are looked up at once.

    An actor exists from its first to its last logged time, both included; between logged times its
    pose is interpolated (position linearly, rotation by slerp). Who is on another level than the ego,
    on a bridge above it or on a road below, is not there for it: their heights do not overlap, not
    even with `LEVEL_SLOPE` per metre between them. Presets without ``levels`` know no heights.
    """

    def __init__(
        self, rollout: RolloutLog, preset: Preset, origin: F64, centre: Trajectory | None = None
    ) -> None:
        """Lay out the tracks.

        Args:
            rollout: The log.
            preset: Sizes, rounding and levels.
            origin: ``(3,)`` world point that positions are relative to.
            centre: Of the ego's box, whose level counts; None: as it drove.
        """
        actors = list(rollout.actors.values())
        ego = rollout.ego if centre is None else centre
        self._ego_t_us = ego.t_us
        self._ego_xyz = ego.xyz - origin
        self._ego_height_m = rollout.ego_box.height_m
        self._z = np.concatenate(
            [np.zeros(0), *(actor.track.xyz[:, 2] - origin[2] for actor in actors)]
        )
        self._height_m = np.array([actor.box.height_m for actor in actors])
        self.ids = tuple(actor.actor_id for actor in actors)
        self._t = [actor.track.t_us for actor in actors]
        self._start = np.concatenate([[0], np.cumsum([len(t) for t in self._t])]).astype(np.int64)
        self._xy = np.concatenate(
            [np.zeros((0, 2)), *(actor.track.xyz[:, :2] - origin[:2] for actor in actors)]
        )
        self._quat = np.concatenate([np.zeros((0, 4)), *(actor.track.quat for actor in actors)])
        size = np.array([[actor.box.length_m, actor.box.width_m] for actor in actors]).reshape(
            -1, 2
        )
        self.size = held(size, preset) * (1.0 - preset.shrink)
        self.preset = preset
        self.radius_m = np.hypot(self.size[:, 0], self.size[:, 1]) / 2  # (A,)
        self.inner_radius_m = self.size.min(axis=1, initial=np.inf) / 2

    def __len__(self) -> int:
        return len(self.ids)

    def at(self, t_us: I64) -> ActorsAt:
        """Locate every actor at times ``(Q,)``, in any order."""
        shape = (len(self), len(t_us))
        row = np.zeros(shape, dtype=np.int64)
        fraction = np.zeros(shape)
        present = np.zeros(shape, dtype=np.bool_)
        for a in range(len(self)):
            row[a], fraction[a], present[a] = self._locate(a, t_us)
        if self.preset.levels:
            actor, query = np.nonzero(present)
            pairs = row[actor, query], fraction[actor, query]
            present[actor, query] = self._on_level(actor, t_us[query], *pairs)
        return ActorsAt(self, row, fraction, present)

    def on_level(self, actor: I64, t_us: I64) -> Bool:
        """Return which actors ``(M,)`` are on the ego's level at times ``(M,)`` at which they are
        present.
        """
        if not self.preset.levels:
            return np.ones(len(actor), dtype=np.bool_)
        row, fraction = self._located(actor, t_us)
        return self._on_level(actor, t_us, row, fraction)

    def _on_level(self, actor: I64, t_us: I64, row: I64, fraction: F64) -> Bool:
        follows = np.where(fraction > 0, row + 1, row)
        xy = self._xy[row] * (1 - fraction)[:, None] + self._xy[follows] * fraction[:, None]
        z = self._z[row] * (1 - fraction) + self._z[follows] * fraction
        x_m, y_m, z_m = (np.interp(t_us, self._ego_t_us, column) for column in self._ego_xyz.T)
        apart_m = np.hypot(xy[:, 0] - x_m, xy[:, 1] - y_m)
        reach_m = (self._height_m[actor] + self._ego_height_m) / 2
        return np.abs(z - z_m) <= reach_m + LEVEL_SLOPE * apart_m

    def boxes(self, actor: I64, t_us: I64) -> Footprints:
        """Return the boxes ``(M,)`` of actors at times ``(M,)`` at which they are present."""
        return self.boxes_at(actor, *self._located(actor, t_us))

    def _located(self, actor: I64, t_us: I64) -> tuple[I64, F64]:
        """Return the logged rows ``(M,)`` of actors before or at times ``(M,)``, and the shares of
        the way to the next ones.
        """
        row = np.zeros(len(actor), dtype=np.int64)
        fraction = np.zeros(len(actor))
        for a in np.unique(actor):
            rows = np.flatnonzero(actor == a)
            row[rows], fraction[rows], _ = self._locate(int(a), t_us[rows])
        return row, fraction

    def boxes_at(self, actor: I64, row: I64, fraction: F64) -> Footprints:
        """Return the boxes ``(M,)`` of actors at a share ``(M,)`` of the way from logged rows
        ``(M,)`` to the rows after them.
        """
        follows = np.where(fraction > 0, row + 1, row)
        xy = self._xy[row] * (1 - fraction)[:, None] + self._xy[follows] * fraction[:, None]
        yaw = yaw_from_quat(self._quat[row])
        between = np.flatnonzero(fraction)
        if len(between):
            yaw[between] = yaw_from_quat(
                slerp(self._quat[row[between]], self._quat[follows[between]], fraction[between])
            )
        return Footprints(
            held(xy, self.preset), yaw, self.size[actor], self.preset.roundness, self.preset.float32
        )

    def times_of(self, actor: int) -> I64:
        """Return the logged times of one actor."""
        return self._t[actor]

    def _locate(self, actor: int, t_us: I64) -> tuple[I64, F64, Bool]:
        """Return per time ``(Q,)`` the logged row before or at it, the share of the way to the next
        row, and whether the actor is there.
        """
        track_t = self._t[actor]
        i = np.searchsorted(track_t, t_us, side="right") - 1
        present = (i >= 0) & (t_us <= track_t[-1])
        i = np.clip(i, 0, len(track_t) - 1)
        follows = np.minimum(i + 1, len(track_t) - 1)
        span = (track_t[follows] - track_t[i]).astype(np.float64)
        passed = np.where(present, t_us - track_t[i], 0).astype(np.float64)
        fraction = np.divide(passed, span, out=np.zeros_like(span), where=span > 0)
        return self._start[actor] + i, fraction, present


@dataclass(frozen=True)
class ActorsAt:
    """All A actors at Q times."""

    table: ActorTable
    row: I64  # (A, Q) logged row before or at the time
    fraction: F64  # (A, Q) of the way to the next row, 0 at a logged time
    present: Bool  # (A, Q)

    def centres(self) -> F64:
        """Return box centres ``(A, Q, 2)``; meaningless where not present."""
        f = self.fraction[..., None]
        follows = np.where(self.fraction > 0, self.row + 1, self.row)
        return self.table._xy[self.row] * (1 - f) + self.table._xy[follows] * f

    def centre_distance_m(self, xy: F64) -> F64:
        """Return distances ``(A, Q)`` from points ``(Q, 2)`` to the centres; inf where an actor is
        absent.
        """
        delta = self.centres() - xy[None]
        return np.where(self.present, np.hypot(delta[..., 0], delta[..., 1]), np.inf)

    def footprints(self, actor: I64, query: I64) -> Footprints:
        """Return the boxes of pairs ``(M,)`` of actor and time."""
        return self.table.boxes_at(actor, self.row[actor, query], self.fraction[actor, query])
