"""OpenDRIVE maps as lane maps: lanes of every section with edges, links and paint, and the border of the drivable surface.

Source: ASAM OpenDRIVE 1.4 to 1.8. `scenarios.opendrive_alpasim` reads the same roads by AlpaSim's rule instead.
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from alpasim_plugin.core.geometry import densify, lane_polygon, transform_points
from alpasim_plugin.core.types import F64, Lane, LaneMap, Paint
from alpasim_plugin.io.limits import ASIDE_M
from scenarios.opendrive_geometry import beside, cubics_at, reference_line
from scenarios.opendrive_links import following
from scenarios.opendrive_road import MAX_ROAD_M, OdrLane, OdrMap, Road, Section, curved, lane_key
from scenarios.reading import SourceFiles
from scenarios.road_edges import border_lines, merge_areas

STEP_M = 0.5  # stations on bends and where widths change
STRAIGHT_STEP_M = 2.0
MAX_ASIDE_M = ASIDE_M.high
MIN_WIDTH_M = 0.1  # lanes that never reach this width are ignored
KINDS = {
    **dict.fromkeys(("driving", "entry", "exit", "onRamp", "offRamp", "connectingRamp", "slipLane", "bidirectional"), "vehicle"),
    **dict.fromkeys(("bus", "taxi", "HOV"), "bus"),
    **dict.fromkeys(("shoulder", "stop"), "shoulder"),
    "biking": "bike",
    "parking": "parking",
}
_SOLID = ("solid", "solid solid", "solid broken", "broken solid")


def lane_map_of(files: SourceFiles, where: Path | str, odr: OdrMap, T_local_map: F64) -> tuple[LaneMap, tuple[str, ...]]:
    """Return the lane map of a parsed file in the local frame, with notes on what was left out.

    Lane ids are ``ROAD.SECTION.LANE``. Edges and centres are sampled every 0.5 m on bends and where a width changes, else every 2 m.

    Raises:
        InputError: No road has a lane for vehicles.
    """
    lanes: dict[str, Lane] = {}
    left_out: Counter[str] = Counter()
    for road in odr.roads:
        for index, section in enumerate(road.sections):
            if road.records and section.end_m - section.s_m > 1e-6:
                found = _section(road, index, section, T_local_map, left_out)
                if found is None:
                    here = f"{where}, road {road.road_id}, section {index}"
                    raise files.fail(here, "points that are not finite or not on a road", "repair its numbers")
                lanes.update({one.lane_id: one for one in found})
    if not any(lane.kind == "vehicle" for lane in lanes.values()):
        raise files.fail(where, "a map without a lane for vehicles", "use a map with lanes of type driving")
    linked = following(odr, lanes)
    surface = merge_areas([lane_polygon(lane) for lane in lanes.values()])
    heights = np.concatenate([e for lane in lanes.values() for e in (lane.left, lane.right) if e is not None])
    notes = [f"lanes of type {kind} left out: {n}" for kind, n in sorted(left_out.items())]
    notes += [f"{odr.n_signals} signals and {odr.n_objects} objects of the map are not used"] if odr.n_signals + odr.n_objects else []
    return LaneMap(linked, border_lines(surface, heights)), tuple(notes)


def _section(road: Road, index: int, section: Section, T_local_map: F64, left_out: Counter[str]) -> list[Lane] | None:
    """Return the lanes of a section; None where its numbers give no road."""
    s = _stations(road, section)
    line = reference_line(road.records, s)
    tilt = np.tan(cubics_at(road.superelevation, s))
    height = cubics_at(road.elevation, s)
    middle = cubics_at(road.lane_offset, s)
    if not (np.abs(line[:, :2] - line[0, :2]).max() <= MAX_ROAD_M and np.abs(height).max() <= MAX_ROAD_M and np.isfinite(tilt).all()):
        return None

    def points(t: F64) -> F64:
        return transform_points(T_local_map, np.column_stack([beside(line, t), height + t * tilt]))

    out: list[Lane] = []
    for sign in (1, -1):
        inner_t, inner_mark = middle, next((one.mark for one in section.lanes if one.lane_id == 0), None)
        along = (sign < 0) != road.left_hand  # runs with s
        side = section.side(sign)
        for k, lane in enumerate(side):
            outer_t = _outer(lane, sign, s, inner_t, middle)
            if not np.abs(outer_t).max() <= MAX_ASIDE_M:
                return None
            kind = KINDS.get(lane.kind)
            wide = float(np.abs(outer_t - inner_t).max()) >= MIN_WIDTH_M
            if kind is None or not wide:
                left_out[lane.kind if kind is None else f"{lane.kind}, nowhere {MIN_WIDTH_M} m wide"] += 1
            else:
                # Seen in driving direction the middle of the road is on the left, with left-hand traffic on the right.
                near, far, turn = points(inner_t), points(outer_t), 1 if along else -1
                edges = (far, near) if road.left_hand else (near, far)
                paints = (_paint(lane.mark), _paint(inner_mark)) if road.left_hand else (_paint(inner_mark), _paint(lane.mark))
                beside_ids = [lane_key(road, index, n.lane_id) if n is not None and n.kind in KINDS else None for n in _neighbours(side, k)]
                if road.left_hand:
                    beside_ids.reverse()
                left, right = (edge[::turn] for edge in edges)
                out.append(Lane(
                    lane_key(road, index, lane.lane_id), densify((left + right) / 2), left, right, kind,
                    left_neighbour=beside_ids[0], right_neighbour=beside_ids[1], left_paint=paints[0], right_paint=paints[1],
                    is_intersection=road.junction != "-1",
                ))  # fmt: skip
            inner_t, inner_mark = outer_t, lane.mark
    return out


def _neighbours(side: tuple[OdrLane, ...], k: int) -> tuple[OdrLane | None, OdrLane | None]:
    """Return the next lane towards the road's middle and the next one outwards, on the same side."""
    return (side[k - 1] if k > 0 else None), (side[k + 1] if k + 1 < len(side) else None)


def _outer(lane: OdrLane, sign: int, s: F64, inner_t: F64, middle: F64) -> F64:
    """Return ``(N,)`` the signed distance of a lane's outer border: by widths, or by borders where it has those instead."""
    if lane.borders and not lane.widths:
        return np.asarray(middle + cubics_at(lane.borders, s))
    return np.asarray(inner_t + sign * np.maximum(cubics_at(lane.widths, s), 0.0))


def _stations(road: Road, section: Section) -> F64:
    """Return the arc lengths of a section's stations: its ends, the start of every record, and no gap above the step."""
    cubics = [*road.lane_offset, *(c for lane in section.lanes for c in (*lane.widths, *lane.borders))]
    bends = curved(road.records) or any(abs(c.b) + abs(c.c) + abs(c.d) > 0 for c in cubics)
    starts = [*(r.s_m for r in road.records), *(c.s_m for c in cubics), *(c.s_m for c in road.elevation)]
    inside = [at for at in starts if section.s_m < at < section.end_m]
    knots = np.unique([section.s_m, *inside, section.end_m])
    step = STEP_M if bends or len(road.elevation) > 1 else STRAIGHT_STEP_M
    pieces = np.maximum(np.ceil(np.diff(knots) / step - 1e-9).astype(np.int64), 1)
    parts = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(knots[:-1], knots[1:], pieces, strict=True)]
    # A section ends where the next one begins: the values just before it count.
    return np.concatenate([*parts, [np.nextafter(section.end_m, section.s_m)]])


def _paint(mark: tuple[str, str] | None) -> Paint:
    """Return the paint of a road mark; colours other than yellow are white."""
    if mark is None or mark[0] == "none":
        return "none"
    kind, colour = mark
    if kind in _SOLID:
        return ("double_yellow" if " " in kind else "solid_yellow") if colour == "yellow" else "solid_white"
    if kind in ("broken", "broken broken"):
        return "dashed_yellow" if colour == "yellow" else "dashed_white"
    return "none" if kind in ("curb", "grass", "edge") else "unknown"
