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

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import shapely

from alpasim_plugin.core.json_types import JsonObject, JsonView
from alpasim_plugin.core.types import F64, Box, Lane, LaneMap
from scenarios.map_lines import NO_LANES_OF_CARS, predecessors, rails, with_vertices
from scenarios.recorded import MAX_REACH_M
from scenarios.usdz_archive import Archive

FOLDERS = ("map_data", "clipgt", "fastmap")  # the first usable one counts
TABLES = ("lane", "association", "road_boundary", "clip", "traffic_sign", "wait_line")
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
    notes: list[str] = []
    for folder in FOLDERS:
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
        notes += (
            ["fastmap tables: heights are taken as stored, not from the ground mesh"]
            if folder == "fastmap"
            else []
        )
        return _read(archive, folder, lanes), tuple(notes)
    return None, tuple(notes)


@dataclass(frozen=True)
class _Row:
    """One row of a table: where it stands, its key and its content; null structs are empty."""

    where: str
    key: JsonObject
    own: JsonObject

    @property
    def map_id(self) -> str | None:
        """Give the element's id; None in the placeholder row of an empty table."""
        return None if self.key.get("map_id") is None else str(self.key["map_id"])


def _rows(archive: Archive, folder: str, table: str) -> list[_Row]:
    where = f"{archive.path}, {folder}/{table}.parquet"
    out = []
    for i, row in enumerate(archive.table(f"{folder}/{table}.parquet")):
        key, own = ({} if row.get(name) is None else row[name] for name in ("key", table))
        if not isinstance(key, dict) or not isinstance(own, dict):
            raise archive.files.fail(
                f"{where}, row {i}",
                f"columns key and {table} that are not structs",
                "write the table again",
            )
        out.append(_Row(f"{where}, {key.get('map_id', f'row {i}')}", key, own))
    return out


def _read(archive: Archive, folder: str, rows: list[_Row]) -> LaneMap:
    links = _link_table(archive, folder)
    lanes: dict[str, Lane] = {}
    for row in rows:
        key, fields = row.map_id, row.own
        absent = [side for side in ("left_rail", "right_rail") if not fields.get(side)]
        if key is None or absent:
            lacks = f"{absent[0]}, only {', '.join(fields) or 'nothing'}" if absent else "an id"
            raise archive.files.fail(
                row.where,
                f"lane {key} without {lacks}",
                "give every lane both rails; AlpaSim refuses this scene too",
            )
        left, right = (
            points(archive, row.where, fields[side]) for side in ("left_rail", "right_rail")
        )
        if len(left) != len(right) or len(left) < 2:
            found = f"lane {key} with rails of {len(left)} and {len(right)} points"
            raise archive.files.fail(
                row.where, found, "give both rails the same number of points, at least two"
            )
        lanes[key] = Lane(
            key,
            with_vertices((left + right) / 2),
            with_vertices(left),
            with_vertices(right),
            successors=links.get(("NEXT_LANE", key), ()),
            left_neighbour=next(iter(links.get(("LEFT_LANE", key), ())), None),
            right_neighbour=next(iter(links.get(("RIGHT_LANE", key), ())), None),
        )
    edges: dict[str, F64] = {}
    for row in _rows(archive, folder, "road_boundary"):
        edges.setdefault(str(row.map_id), _location(archive, row))  # the first of an id counts
    stops = [
        row for row in _rows(archive, folder, "wait_line") if row.own.get("is_implicit") is not True
    ]
    return LaneMap(
        {key: _known(lane, lanes) for key, lane in lanes.items()},
        tuple(with_vertices(edge) for edge in edges.values() if len(edge) > 1),
        stop_lines=tuple(
            line for line in (_location(archive, row) for row in stops) if len(line) > 1
        ),
        signs=tuple(
            sign
            for row in _rows(archive, folder, "traffic_sign")
            if (sign := _sign(archive, row)) is not None
        ),
    )


def without_rails(lane_map: LaneMap) -> LaneMap:
    """Return a map whose lanes have only their centres, so that scorers widen those by 1.85 m."""
    return replace(
        lane_map,
        lanes={key: replace(lane, left=None, right=None) for key, lane in lane_map.lanes.items()},
    )


def points(archive: Archive, where: str, raw: Any) -> F64:
    """Return points ``(N, 3)`` of a list of structs or of a struct of lists."""
    try:
        if isinstance(raw, dict):
            xyz = np.stack([np.asarray(raw[axis], dtype=np.float64) for axis in "xyz"], axis=1)
        else:
            xyz = np.array([[p["x"], p["y"], p["z"]] for p in raw], dtype=np.float64).reshape(-1, 3)
    except (KeyError, TypeError, ValueError) as error:
        raise archive.files.fail(
            where, f"points that are not x, y, z: {error}", "write the table again"
        ) from error
    if len(xyz) and not np.abs(xyz - xyz[0]).max() <= MAX_REACH_M:
        raise archive.files.fail(
            where,
            "points that are not finite or kilometres apart",
            "repair the coordinates of this table",
        )
    return xyz


def _location(archive: Archive, row: _Row) -> F64:
    return points(archive, row.where, row.own.get("location") or [])


def _link_table(archive: Archive, folder: str) -> dict[tuple[str, str], tuple[str, ...]]:
    """Return (kind, lane) -> lanes; of several rows for a lane and kind the first counts."""
    out: dict[tuple[str, str], tuple[str, ...]] = {}
    for row in _rows(archive, folder, "association"):
        kind = row.key.get("kind")
        subject = row.own.get("subjects")
        objects = row.own.get("objects") or []
        if not isinstance(objects, list):
            raise archive.files.fail(row.where, f"objects {objects!r}", "give a list of ids")
        if kind and subject is not None:
            out.setdefault((str(kind), str(subject)), tuple(str(one) for one in objects))
    return out


def _known(lane: Lane, lanes: dict[str, Lane]) -> Lane:
    left, right = (n if n in lanes else None for n in (lane.left_neighbour, lane.right_neighbour))
    return replace(
        lane,
        successors=tuple(s for s in lane.successors if s in lanes),
        left_neighbour=left,
        right_neighbour=right,
    )


def _sign(archive: Archive, row: _Row) -> tuple[F64, Box] | None:
    centre = row.own.get("center")
    if (
        row.map_id is None
        or not centre
        or not isinstance(centre, dict)
        or any(centre.get(axis) is None for axis in "xyz")
    ):
        return None
    pose = np.eye(4)
    pose[:3, 3] = points(archive, row.where, [centre])[0]
    return pose, SIGN


def map_tables(lane_map: LaneMap, clip_id: str) -> dict[str, bytes]:
    """Return the six tables of a map as parquet files by name, coordinates unrounded.

    Args:
        lane_map: At least one lane that is no sidewalk.
        clip_id: Names the clip in every row.
    """
    lanes = {key: lane for key, lane in lane_map.lanes.items() if lane.kind not in NO_LANES_OF_CARS}
    ids = table_ids(list(lanes))
    own = {
        key: dict(zip(("left_rail", "right_rail"), map(_line, rails(lane)), strict=True))
        for key, lane in lanes.items()
    }
    rows = {
        "lane": [_row(ids[key], "lane", fields) for key, fields in own.items()],
        "association": _links(lanes, ids),
        "road_boundary": [
            _row(f"edge{i}", "road_boundary", {"location": _line(e)})
            for i, e in enumerate(lane_map.road_edges)
            if len(e) > 1
        ],
        "clip": [_row("clip", "clip", {"label_class_id": "clip"})],
        "traffic_sign": _signs(lane_map),
        "wait_line": _wait_lines(lane_map, lanes, ids),
    }
    return {
        f"clipgt/{name}.parquet": _parquet(name, table, clip_id) for name, table in rows.items()
    }


def table_ids(names: Sequence[str]) -> dict[str, str]:
    """Return the id of each lane in the tables: its name, without the hyphen that parts a stop
    line's id from its lane's there.

    Example:
        >>> table_ids(["road1/-2", "road1/2"])
        {'road1/-2': 'road1/~2', 'road1/2': 'road1/2'}
    """
    out = {name: name.replace("-", "~") for name in names}
    taken = set(out.values())
    if len(taken) == len(names):
        return out
    return {
        name: f"lane{i}" for i, name in enumerate(names)
    }  # two names that differ only in these two characters


def _row(map_id: str | None, label: str, own: JsonView, kind: str | None = None) -> JsonObject:
    return {
        "key": {"label_class_id": label, "map_id": map_id, "map_id_version": "0", "kind": kind},
        label: dict(own),
        "version": 1,
    }


def _links(lanes: Mapping[str, Lane], ids: Mapping[str, str]) -> list[JsonObject]:
    """Return a row per lane and kind of neighbour; AlpaSim's routes follow NEXT_LANE and end where
    it is missing.
    """
    before = predecessors(lanes)
    out: list[JsonObject] = []
    for key, lane in lanes.items():
        found: dict[str, tuple[str | None, ...]] = {
            "NEXT_LANE": tuple(lane.successors),
            "PREVIOUS_LANE": tuple(before[key]),
            "LEFT_LANE": (lane.left_neighbour,),
            "RIGHT_LANE": (lane.right_neighbour,),
        }
        for kind, others in found.items():
            objects = [ids[other] for other in others if other is not None and other in ids]
            if objects:
                out.append(
                    _row(
                        f"a{len(out)}",
                        "association",
                        {"subjects": ids[key], "objects": objects},
                        kind,
                    )
                )
    return out or [
        _row(
            "a0",
            "association",
            {"subjects": next(iter(ids.values())), "objects": []},
            "SIGN_TO_LANE",
        )
    ]


def _signs(lane_map: LaneMap) -> list[JsonObject]:
    signs = [
        _row(f"sign{i}", "traffic_sign", {"center": _point(pose[:3, 3]), "category": "UNKNOWN"})
        for i, (pose, _) in enumerate(lane_map.signs)
    ]
    return signs or [
        _row(None, "traffic_sign", {"center": _point(np.zeros(3)), "category": "UNKNOWN"})
    ]


def _wait_lines(
    lane_map: LaneMap, lanes: Mapping[str, Lane], ids: Mapping[str, str]
) -> list[JsonObject]:
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
    own = {
        "location": _line(np.stack([left[-1], right[-1]])),
        "category": "STOP",
        "is_implicit": True,
    }
    return [_row(f"wait0-{ids[keys[0]]}", "wait_line", own)]


def _line(xyz: F64) -> list[dict[str, float]]:
    return [{"x": x, "y": y, "z": z} for x, y, z in xyz.tolist()]


def _point(xyz: F64) -> dict[str, float]:
    return dict(zip("xyz", xyz.tolist(), strict=True))


def _parquet(name: str, rows: Sequence[JsonObject], clip_id: str) -> bytes:
    for row in rows:
        row["key"]["clip_id"] = clip_id
    schema = pa.schema([("key", _KEY), (name, _OWN[name]), ("version", pa.int64())])
    stream = io.BytesIO()
    pq.write_table(pa.Table.from_pylist(list(rows), schema=schema), stream)
    return stream.getvalue()
