"""Which lanes follow which in an OpenDRIVE map: along sections, from road to road, and through junctions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from alpasim_plugin.core.types import Lane
from scenarios.opendrive_road import OdrLane, OdrMap, Road, RoadLink, lane_key


def following(odr: OdrMap, lanes: Mapping[str, Lane]) -> dict[str, Lane]:
    """Return the lanes with their successors in driving direction; links to lanes that are not in ``lanes`` are left out."""
    roads = {road.road_id: road for road in odr.roads}
    turns: dict[tuple[str, int], list[tuple[str, bool, int]]] = {}
    for connection in odr.connections:
        for here, there in connection.lanes:
            turns.setdefault((connection.incoming, here), []).append((connection.connecting, connection.at_start, there))
    out = dict(lanes)
    for road in odr.roads:
        for index, section in enumerate(road.sections):
            for lane in section.lanes:
                key = lane_key(road, index, lane.lane_id)
                if key in out:
                    ahead = _ahead(road, index, lane, roads, turns)
                    out[key] = replace(out[key], successors=tuple(dict.fromkeys(k for k in ahead if k in lanes)))
    return out


def _ahead(
    road: Road, index: int, lane: OdrLane, roads: Mapping[str, Road], turns: Mapping[tuple[str, int], list[tuple[str, bool, int]]]
) -> list[str]:
    along = (lane.lane_id < 0) != road.left_hand
    linked = lane.successors if along else lane.predecessors
    next_section = index + (1 if along else -1)
    if 0 <= next_section < len(road.sections):
        return [lane_key(road, next_section, i) for i in linked or (lane.lane_id,)]
    link: RoadLink | None = road.successor if along else road.predecessor
    if link is None:
        return []
    if link.kind == "junction":
        found = [(roads[r], at_start, i) for r, at_start, i in turns.get((road.road_id, lane.lane_id), ()) if r in roads]
        return [lane_key(r, 0 if at_start else len(r.sections) - 1, i) for r, at_start, i in found]
    target = roads.get(link.target)
    if target is None:
        return []
    return [lane_key(target, 0 if link.at_start else len(target.sections) - 1, i) for i in linked]
