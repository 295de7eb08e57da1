"""Lanes of a Cosmos-Drive-Dreams clip: which way they run, which edge is left."""

from __future__ import annotations

import numpy as np
import shapely

from alpasim_plugin.core.geometry import centre_line, lane_polygon, wrap_angle, yaw_from_quat
from alpasim_plugin.core.types import F64, Lane, Trajectory
from scenarios.cosmos_layers import Label, paint_of
from scenarios.reading import SourceFiles

MPH = 0.44704  # m/s


def oriented_lanes(files: SourceFiles, labels: tuple[Label, ...], ego_log: Trajectory) -> tuple[dict[str, Lane], tuple[str, ...]]:
    """Make lanes with edges in driving direction, left edge left.

    A lane runs towards the lanes named by its ``next_lane_ids``: the end of its edges that lies nearer to them is its end. A lane without
    links takes the direction of the ego that drove in it, else the order of its points. Left and right then follow from the turn of the
    ring.

    Raises:
        InputError: A lane has not exactly two edges, or two lanes share an id.
    """
    raw: dict[str, tuple[F64, F64]] = {}
    for label in labels:
        if len(label.lines) != 2 or min(len(line) for line in label.lines) < 2:
            raise files.fail(label.where, f"{len(label.lines)} edges", "give each lane two edges of at least 2 points")
        if label.feature_id in raw:
            raise files.fail(label.where, f"lane id {label.feature_id} twice", "give each lane its own id")
        one, two = label.lines
        raw[label.feature_id] = (one, _same_order(one, two))
    links = {label.feature_id: tuple(i for i in label.ids("next_lane_ids") if i in raw) for label in labels}
    before: dict[str, list[str]] = {key: [] for key in raw}
    for key, followers in links.items():
        for follower in followers:
            before[follower].append(key)
    turned = swapped = against = 0
    lanes: dict[str, Lane] = {}
    for label in labels:
        key = label.feature_id
        one, two = raw[key]
        vote = sum(_runs_towards(raw[key], raw[n]) for n in links[key]) - sum(_runs_towards(raw[key], raw[p]) for p in before[key])
        if vote == 0 and not links[key] and not before[key]:
            vote = _ego_vote(one, two, ego_log)
        if vote < 0:
            one, two, turned = one[::-1], two[::-1], turned + 1
        styles = [(label.attributes.get(f"{side}_edge_styles"), label.attributes.get(f"{side}_edge_colors")) for side in ("left", "right")]
        if _clockwise(two, one):
            one, two, swapped = two, one, swapped + 1
            # Attributes are named by side, not by order: they stay with their side.
        against += _ego_vote(one, two, ego_log) < 0
        lanes[key] = Lane(
            lane_id=key,
            centre=centre_line(one, two),
            left=one,
            right=two,
            kind="shoulder" if "SHOULDER_LANE" in (label.attributes.get("use_types") or ()) else "vehicle",
            successors=label.ids("next_lane_ids"),
            left_neighbour=label.one_id("left_lane_id"),
            right_neighbour=label.one_id("right_lane_id"),
            left_paint=paint_of(*styles[0]),
            right_paint=paint_of(*styles[1]),
            is_intersection="TURN" in str(label.attributes.get("lane_direction")),
            speed_limit_mps=_speed_limit(label),
        )
    notes = ["speed limits are taken as miles per hour"]
    notes += [f"{turned} lanes were stored against their driving direction and were turned"] if turned else []
    notes += [f"{swapped} lanes had their edges exchanged and were put right"] if swapped else []
    notes += [f"the recorded drive runs against {against} lanes"] if against else []
    return lanes, tuple(notes)


def _same_order(one: F64, two: F64) -> F64:
    """Return the second edge, turned round where its far end lies nearer to the start of the first."""
    straight = np.linalg.norm(one[0] - two[0]) + np.linalg.norm(one[-1] - two[-1])
    crossed = np.linalg.norm(one[0] - two[-1]) + np.linalg.norm(one[-1] - two[0])
    return two[::-1] if straight > crossed else two


def _runs_towards(lane: tuple[F64, F64], other: tuple[F64, F64]) -> int:
    """Return 1 if the lane's last points lie nearer to the other lane than its first ones, else -1."""
    ends = np.stack([(other[0][i] + other[1][i]) / 2 for i in (0, -1)])
    first, last = ((lane[0][i] + lane[1][i]) / 2 for i in (0, -1))
    distance = [float(np.linalg.norm(ends - p, axis=1).min()) for p in (first, last)]
    return 1 if distance[1] <= distance[0] else -1


def _ego_vote(one: F64, two: F64, ego_log: Trajectory) -> int:
    """Return 1 if the ego drove through the lane in the order of its points, -1 if against it, 0 if it was not there or crossed."""
    ring = lane_polygon(Lane("", one, one, two))
    inside = shapely.contains_xy(ring, ego_log.xyz[:, 0], ego_log.xyz[:, 1])
    if not inside.any():
        return 0
    middle = centre_line(one, two)
    chord = middle[-1, :2] - middle[0, :2]
    error = np.abs(wrap_angle(yaw_from_quat(ego_log.quat[inside]) - np.arctan2(chord[1], chord[0])))
    share = float(np.median(error))
    return 1 if share < np.pi / 3 else -1 if share > 2 * np.pi / 3 else 0


def _clockwise(left: F64, right: F64) -> bool:
    x, y = np.concatenate([left[:, :2], right[::-1, :2]]).T
    return bool(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y) < 0)


def _speed_limit(label: Label) -> float | None:
    value = label.attributes.get("speed_limit")
    return float(value) * MPH if isinstance(value, (int, float)) and value > 0 else None
