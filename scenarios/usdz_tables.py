"""The map tables of an AlpaSim scene, written: what `scenarios.clipgt` reads, and what AlpaSim's loader needs to accept them.

AlpaSim passes over a folder of tables, without an error, if one of the six is missing or if one that it indexes by column has no row. So
a table without content gets one row that changes no score: a link of a lane to no sign, a sign without an id, a stop line marked implicit.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import shapely

from alpasim_plugin.core.types import F64, Lane, LaneMap
from scenarios.alpasim_map import NO_LANES_OF_CARS, rails

_XYZ = pa.struct([("x", pa.float64()), ("y", pa.float64()), ("z", pa.float64())])
_LINE = pa.list_(_XYZ)
_KEY = pa.struct(
    [
        ("clip_id", pa.string()),
        ("label_class_id", pa.string()),
        ("map_id", pa.string()),
        ("map_id_version", pa.string()),
        ("kind", pa.string()),
    ]
)
_OWN = {
    "lane": pa.struct([("left_rail", _LINE), ("right_rail", _LINE)]),
    "association": pa.struct([("subjects", pa.string()), ("objects", pa.list_(pa.string()))]),
    "road_boundary": pa.struct([("location", _LINE)]),
    "clip": pa.struct([("label_class_id", pa.string())]),
    "traffic_sign": pa.struct([("center", _XYZ), ("category", pa.string())]),
    "wait_line": pa.struct([("location", _LINE), ("category", pa.string()), ("is_implicit", pa.bool_())]),
}


def map_tables(lane_map: LaneMap, clip_id: str) -> dict[str, bytes]:
    """Return the six tables of a map as parquet files by name, coordinates unrounded.

    Args:
        lane_map: At least one lane that is no sidewalk.
        clip_id: Names the clip in every row.
    """
    lanes = {key: lane for key, lane in lane_map.lanes.items() if lane.kind not in NO_LANES_OF_CARS}
    ids = table_ids(list(lanes))
    rows = {
        "lane": [_row(ids[key], "lane", _rails(lane)) for key, lane in lanes.items()],
        "association": _links(lanes, ids),
        "road_boundary": [
            _row(f"edge{i}", "road_boundary", {"location": _line(e)}) for i, e in enumerate(lane_map.road_edges) if len(e) > 1
        ],
        "clip": [_row("clip", "clip", {"label_class_id": "clip"})],
        "traffic_sign": _signs(lane_map),
        "wait_line": _wait_lines(lane_map, lanes, ids),
    }
    return {f"clipgt/{name}.parquet": _parquet(name, table, clip_id) for name, table in rows.items()}


def table_ids(names: Sequence[str]) -> dict[str, str]:
    """Return the id of each lane in the tables: its name, without the hyphen that parts a stop line's id from its lane's there.

    Example:
        >>> table_ids(["road1/-2", "road1/2"])
        {'road1/-2': 'road1/~2', 'road1/2': 'road1/2'}
    """
    out = {name: name.replace("-", "~") for name in names}
    taken = set(out.values())
    if len(taken) == len(names):
        return out
    return {name: f"lane{i}" for i, name in enumerate(names)}  # two names that differ only in these two characters


def _row(map_id: str | None, label: str, own: Mapping[str, Any], kind: str | None = None) -> dict[str, Any]:
    return {"key": {"label_class_id": label, "map_id": map_id, "map_id_version": "0", "kind": kind}, label: dict(own), "version": 1}


def _rails(lane: Lane) -> dict[str, Any]:
    left, right = rails(lane)
    return {"left_rail": _line(left), "right_rail": _line(right)}


def _links(lanes: Mapping[str, Lane], ids: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return a row per lane and kind of neighbour; AlpaSim's routes follow NEXT_LANE and end where it is missing."""
    before: dict[str, list[str]] = {}
    for key, lane in lanes.items():
        for successor in lane.successors:
            before.setdefault(successor, []).append(key)
    out: list[dict[str, Any]] = []
    for key, lane in lanes.items():
        found: dict[str, tuple[str | None, ...]] = {
            "NEXT_LANE": tuple(lane.successors),
            "PREVIOUS_LANE": tuple(before.get(key, ())),
            "LEFT_LANE": (lane.left_neighbour,),
            "RIGHT_LANE": (lane.right_neighbour,),
        }
        for kind, others in found.items():
            objects = [ids[other] for other in others if other is not None and other in ids]
            if objects:
                out.append(_row(f"a{len(out)}", "association", {"subjects": ids[key], "objects": objects}, kind))
    return out or [_row("a0", "association", {"subjects": next(iter(ids.values())), "objects": []}, "SIGN_TO_LANE")]


def _signs(lane_map: LaneMap) -> list[dict[str, Any]]:
    signs = [
        _row(f"sign{i}", "traffic_sign", {"center": _point(pose[:3, 3]), "category": "UNKNOWN"})
        for i, (pose, _) in enumerate(lane_map.signs)
    ]
    return signs or [_row(None, "traffic_sign", {"center": _point(np.zeros(3)), "category": "UNKNOWN"})]


def _wait_lines(lane_map: LaneMap, lanes: Mapping[str, Lane], ids: Mapping[str, str]) -> list[dict[str, Any]]:
    """Return a row per stop line, with the lane whose end it is nearest to in its id."""
    keys = list(lanes)
    ends = shapely.points(np.array([lane.centre[-1, :2] for lane in lanes.values()]))
    out = []
    for i, line in enumerate(one for one in lane_map.stop_lines if len(one) > 1):
        nearest = keys[int(np.argmin(shapely.distance(ends, shapely.linestrings(line[:, :2]))))]
        own = {"location": _line(line), "category": "STOP", "is_implicit": False}
        out.append(_row(f"wait{i}-{ids[nearest]}", "wait_line", own))
    if out:
        return out
    left, right = rails(lanes[keys[0]])
    own = {"location": _line(np.stack([left[-1], right[-1]])), "category": "STOP", "is_implicit": True}
    return [_row(f"wait0-{ids[keys[0]]}", "wait_line", own)]


def _line(xyz: F64) -> list[dict[str, float]]:
    return [{"x": x, "y": y, "z": z} for x, y, z in xyz.tolist()]


def _point(xyz: F64) -> dict[str, float]:
    return dict(zip("xyz", xyz.tolist(), strict=True))


def _parquet(name: str, rows: Sequence[dict[str, Any]], clip_id: str) -> bytes:
    for row in rows:
        row["key"]["clip_id"] = clip_id
    schema = pa.schema([("key", _KEY), (name, _OWN[name]), ("version", pa.int64())])
    stream = io.BytesIO()
    pq.write_table(pa.Table.from_pylist(list(rows), schema=schema), stream)
    return stream.getvalue()
