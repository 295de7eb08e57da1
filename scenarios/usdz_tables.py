"""The map tables of an AlpaSim scene, read from ``map_data``, ``clipgt`` or ``fastmap`` and written
to ``clipgt``.

Layout: structs ``key`` and one named after the table. Lanes have a left and a right rail with the
    same number of points, seen in driving
direction; the centre is halfway, point by point. Vertices are set as AlpaSim's loader sets them
(`scenarios.map_lines`).

AlpaSim passes over a folder of tables, without an error, if one of the six is missing or if one
that it indexes by column has no row. So a table without content gets one row that changes no score:
a link of a lane to no sign, a sign without an id, a stop line marked implicit.
"""

import io
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import shapely

from alpasim_plugin.core.files import parsing
from alpasim_plugin.core.geometry import shifted
from alpasim_plugin.core.json_types import JsonObject, JsonView
from alpasim_plugin.core.types import F64, Box, Lane, LaneMap
from scenarios.map_lines import NO_LANES_OF_CARS, predecessors, rails, with_vertices
from scenarios.recorded import MAX_REACH_M
from scenarios.usdz_archive import TABLE_FOLDERS, Archive

TABLES = ("lane", "association", "road_boundary", "clip", "traffic_sign", "wait_line")
RAILS = ("left_rail", "right_rail")
SIGN = Box(0.1, 0.75, 0.75)  # the table has no size

_XYZ = pa.struct([("x", pa.float64()), ("y", pa.float64()), ("z", pa.float64())])
_LINE = pa.list_(_XYZ)
_KEY = pa.struct(
    [
        (name, pa.string())
        for name in ("clip_id", "label_class_id", "map_id", "map_id_version", "kind")
    ]
)
_OWN = {
    "lane": pa.struct([("left_rail", _LINE), ("right_rail", _LINE)]),
    "association": pa.struct([("subjects", pa.string()), ("objects", pa.list_(pa.string()))]),
    "road_boundary": pa.struct([("location", _LINE)]),
    "clip": pa.struct([("label_class_id", pa.string())]),
    "traffic_sign": pa.struct([("center", _XYZ), ("category", pa.string())]),
    "wait_line": pa.struct(
        [("location", _LINE), ("category", pa.string()), ("is_implicit", pa.bool_())]
    ),
}


def clipgt_map(archive: Archive) -> tuple[LaneMap | None, tuple[str, ...]]:
    """Return the lane map of the first usable folder of tables, with notes; None where there is
    none.

    A folder is usable if it has all six tables and at least one lane.

    Raises:
        InputError: A lane lacks a rail, its rails differ in length, or a coordinate is not finite.
    """
    notes = []
    for folder in TABLE_FOLDERS:
        missing = [table for table in TABLES if f"{folder}/{table}.parquet" not in archive]
        if len(missing) == len(TABLES):
            continue
        if missing:
            notes.append(f"map tables in {folder}/ passed over: no {', '.join(missing)}")
            continue
        lanes = _rows(archive, folder, "lane")
        if not lanes:
            notes.append(f"map tables in {folder}/ passed over: no lane")
            continue
        if folder == "fastmap":
            notes.append("fastmap tables: heights are taken as stored, not from the ground mesh")
        with parsing(f"{archive.path}, {folder}", "write its tables again"):
            return _read(archive, folder, lanes), tuple(notes)
    return None, tuple(notes)


Row = tuple[JsonObject, JsonObject]  # the key and the content; null structs are empty


def _rows(archive: Archive, folder: str, table: str) -> list[Row]:
    rows = archive.table(f"{folder}/{table}.parquet")
    return [(row.get("key") or {}, row.get(table) or {}) for row in rows]


def _read(archive: Archive, folder: str, rows: list[Row]) -> LaneMap:
    links: dict[tuple[str, str], tuple[str, ...]] = {}  # of several rows the first counts
    for key, row in _rows(archive, folder, "association"):
        objects = tuple(str(key) for key in row.get("objects") or ())
        links.setdefault((str(key.get("kind")), str(row.get("subjects"))), objects)
    rails_of = _rails(archive, folder, rows)
    lanes = {}
    for lane_id, (left, right) in rails_of.items():
        neighbours = {
            kind: [key for key in links.get((kind, lane_id), ()) if key in rails_of]
            for kind in ("NEXT_LANE", "LEFT_LANE", "RIGHT_LANE")
        }
        lanes[lane_id] = Lane(
            lane_id,
            with_vertices((left + right) / 2),
            with_vertices(left),
            with_vertices(right),
            successors=tuple(neighbours["NEXT_LANE"]),
            left_neighbour=next(iter(neighbours["LEFT_LANE"]), None),
            right_neighbour=next(iter(neighbours["RIGHT_LANE"]), None),
        )
    return replace(_beside_lanes(archive, folder), lanes=lanes)


def _rails(archive: Archive, folder: str, rows: list[Row]) -> dict[str, tuple[F64, F64]]:
    """Return the left and the right rail ``(N, 3)`` of each lane."""
    rails_of: dict[str, tuple[F64, F64]] = {}
    for key, row in rows:
        lane_id = str(key["map_id"])
        do_this = "give every lane two rails with the same number of points, at least two"
        with parsing(f"{archive.path}, {folder}, lane {lane_id}", do_this):
            left = points(row["left_rail"])
            right = points(row["right_rail"])
            if len(left) != len(right) or len(left) < 2:
                raise ValueError(f"rails of {len(left)} and {len(right)} points")
        rails_of[lane_id] = left, right
    return rails_of


def _beside_lanes(archive: Archive, folder: str) -> LaneMap:
    """Return what a map has beside its lanes: road edges, stop lines and signs."""
    edges: dict[str, F64] = {}
    for key, row in _rows(archive, folder, "road_boundary"):
        edges.setdefault(str(key.get("map_id")), points(row.get("location") or []))
    stop_lines = [
        points(row.get("location") or [])
        for _, row in _rows(archive, folder, "wait_line")
        if row.get("is_implicit") is not True
    ]
    signs = []
    for key, row in _rows(archive, folder, "traffic_sign"):
        if key.get("map_id") is not None and row.get("center"):
            signs.append((shifted(*points([row["center"]])[0]), SIGN))
    return LaneMap(
        {},
        tuple(with_vertices(edge) for edge in edges.values() if len(edge) > 1),
        stop_lines=tuple(line for line in stop_lines if len(line) > 1),
        signs=tuple(signs),
    )


def points(raw: Any) -> F64:
    """Return points ``(N, 3)`` of a list of structs or of a struct of lists."""
    columns = [
        raw[axis] if isinstance(raw, dict) else [point[axis] for point in raw] for axis in "xyz"
    ]
    xyz = np.array(columns, dtype=np.float64).T
    if not np.ptp(xyz, axis=0).max(initial=0.0) <= MAX_REACH_M:
        raise ValueError("points that are not finite or kilometres apart")
    return xyz


def map_tables(lane_map: LaneMap, clip_id: str) -> dict[str, bytes]:
    """Return the six tables of a map as parquet files by name, coordinates unrounded.

    Args:
        lane_map: At least one lane that is no sidewalk.
        clip_id: Names the clip in every row.
    """
    lanes = {key: lane for key, lane in lane_map.lanes.items() if lane.kind not in NO_LANES_OF_CARS}
    # A hyphen parts a stop line's id from its lane's.
    ids = {key: key.replace("-", "~") for key in lanes}
    edges = [edge for edge in lane_map.road_edges if len(edge) > 1]
    rows = {
        "lane": [
            _row(ids[key], "lane", dict(zip(RAILS, map(_line, rails(lane)), strict=True)))
            for key, lane in lanes.items()
        ],
        "association": _links(lanes, ids),
        "road_boundary": [
            _row(f"edge{i}", "road_boundary", {"location": _line(edge)})
            for i, edge in enumerate(edges)
        ],
        "clip": [_row("clip", "clip", {"label_class_id": "clip"})],
        "traffic_sign": [
            _row(f"sign{i}", "traffic_sign", {"center": _point(pose), "category": "UNKNOWN"})
            for i, (pose, _) in enumerate(lane_map.signs)
        ]
        or [
            _row(None, "traffic_sign", {"center": _point(np.zeros((4, 4))), "category": "UNKNOWN"})
        ],
        "wait_line": _wait_lines(lane_map, lanes, ids),
    }
    return {
        f"clipgt/{name}.parquet": _parquet(name, table, clip_id) for name, table in rows.items()
    }


def _row(map_id: str | None, label: str, content: JsonView, kind: str | None = None) -> JsonObject:
    return {
        "key": {"label_class_id": label, "map_id": map_id, "map_id_version": "0", "kind": kind},
        label: dict(content),
        "version": 1,
    }


def _links(lanes: Mapping[str, Lane], ids: Mapping[str, str]) -> list[JsonObject]:
    """Return a row per lane and kind of neighbour; AlpaSim's routes follow NEXT_LANE and end where
    it is missing.
    """
    before = predecessors(lanes)
    out: list[JsonObject] = []

    def add(kind: str, subject: str, objects: list[str]) -> None:
        content = {"subjects": subject, "objects": objects}
        out.append(_row(f"a{len(out)}", "association", content, kind))

    for key, lane in lanes.items():
        neighbours = {
            "NEXT_LANE": lane.successors,
            "PREVIOUS_LANE": before[key],
            "LEFT_LANE": (lane.left_neighbour,),
            "RIGHT_LANE": (lane.right_neighbour,),
        }
        for kind, others in neighbours.items():
            objects = [ids[other] for other in others if other is not None and other in ids]
            if objects:
                add(kind, ids[key], objects)
    if not out:
        add("SIGN_TO_LANE", next(iter(ids.values())), [])
    return out


def _wait_lines(
    lane_map: LaneMap, lanes: Mapping[str, Lane], ids: Mapping[str, str]
) -> list[JsonObject]:
    """Return a row per stop line, with the lane whose end it is nearest to in its id."""
    keys = list(lanes)
    ends = shapely.points(np.array([lane.centre[-1, :2] for lane in lanes.values()]))
    lines = [line for line in lane_map.stop_lines if len(line) > 1]
    is_implicit = not lines
    if is_implicit:
        left, right = rails(lanes[keys[0]])
        lines = [np.stack([left[-1], right[-1]])]
    out = []
    for i, line in enumerate(lines):
        nearest = keys[int(np.argmin(shapely.distance(ends, shapely.linestrings(line[:, :2]))))]
        content = {"location": _line(line), "category": "STOP", "is_implicit": is_implicit}
        out.append(_row(f"wait{i}-{ids[nearest]}", "wait_line", content))
    return out


def _line(xyz: F64) -> list[dict[str, float]]:
    return [{"x": x, "y": y, "z": z} for x, y, z in xyz.tolist()]


def _point(pose: F64) -> dict[str, float]:
    return _line(pose[None, :3, 3])[0]


def _parquet(name: str, rows: Sequence[JsonObject], clip_id: str) -> bytes:
    for row in rows:
        row["key"]["clip_id"] = clip_id
    schema = pa.schema([("key", _KEY), (name, _OWN[name]), ("version", pa.int64())])
    stream = io.BytesIO()
    pq.write_table(pa.Table.from_pylist(list(rows), schema=schema), stream)
    return stream.getvalue()
