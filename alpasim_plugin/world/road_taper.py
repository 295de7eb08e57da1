"""Stretches in which the rightmost forward lane ends or a new one opens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from alpasim_plugin.core.types import F64, Lane
from alpasim_plugin.world.curves import offset_line, smoothstep
from alpasim_plugin.world.road_elements import Profile
from alpasim_plugin.world.road_strip import Joint, MapDraft, Strip, add_sides, build_strip, make_lines, reverse


def build_taper(draft: MapDraft, name: str, curve: F64, profile: Profile, kind: str, joint: Joint | None) -> tuple[Strip, str]:
    """Add a straight stretch with one slanting lane beside (and running into, or out of) the outermost straight one.

    The slanting lane keeps its full width and overlaps its neighbour, as merging lanes do in surveyed maps: its edges meet the
    neighbour's edges exactly at the narrow end.

    Args:
        draft: Map that receives the lanes.
        name: Prefix of the lane ids.
        curve: ``(N, 4)`` reference line, straight.
        profile: Cross-section at the narrow end.
        kind: ``merge`` (wide to narrow) or ``split`` (narrow to wide).
        joint: End points of the strip before.

    Returns:
        The strip with its lines at the far end, and the id of the slanting lane.
    """
    n, w, half = profile.forward, profile.lane_width_m, profile.median_m / 2
    s = np.hypot(curve[:, 0] - curve[0, 0], curve[:, 1] - curve[0, 1])
    share = smoothstep(s / s[-1])
    out = (1.0 - share) if kind == "merge" else share  # 1 where the extra lane stands fully beside the others
    left, centre, right = (offset_line(curve, -half - (n - 1 + shift + out) * w) for shift in (0.0, 0.5, 1.0))
    edge = offset_line(curve, -half - (n + out) * w - profile.strip_m) if profile.strip_m > 0 else right
    lines = make_lines(curve, profile)
    if joint is not None:
        extra = n if kind == "merge" else n - 1
        for key, line in lines.items():
            if key in joint and key != "right":
                line[0] = joint[key]
        left[0], centre[0], right[0] = joint[f"f{extra}"], joint[f"fc{extra}"], joint[f"f{extra + 1}"]
        edge[0] = joint["right"]
    if kind == "merge":  # the narrow end: meet the neighbour exactly
        left[-1], centre[-1], right[-1] = lines[f"f{n - 1}"][-1], lines[f"fc{n - 1}"][-1], lines[f"f{n}"][-1]
    inner = replace(profile, shoulder_m=0.0, parking_m=0.0)
    scratch = MapDraft()
    strip = build_strip(scratch, name, curve, inner)
    turned = reverse(lines)
    for lane_id in (*strip.forward, *strip.backward):
        draft.add(_with_lines(scratch.lanes[lane_id], lane_id, name, lines, turned, n))
    slant = draft.add(
        Lane(f"{name}_{kind}", centre, left, right, left_paint="none", right_paint=profile.edge_paint,
             speed_limit_mps=profile.speed_limit_mps)
    )  # fmt: skip
    add_sides(draft, name, {**lines, f"f{n}": right, "right": edge}, profile)
    end_lines = {**lines, "right": edge}
    if kind == "split":
        end_lines |= {f"fc{n}": centre, f"f{n + 1}": right}
    return Strip(strip.forward, strip.backward, end_lines), slant


def _with_lines(lane: Lane, lane_id: str, name: str, lines: dict[str, F64], turned: dict[str, F64], n: int) -> Lane:
    """Put the shared line arrays into a lane, and dashed paint where the slanting lane crosses."""
    k = int(lane_id.removeprefix(f"{name}_")[1:])
    if lane_id.startswith(f"{name}_f"):
        paint = "dashed_white" if k == n - 1 else lane.right_paint
        return replace(lane, centre=lines[f"fc{k}"], left=lines[f"f{k}"], right=lines[f"f{k + 1}"], right_paint=paint)
    return replace(lane, centre=turned[f"bc{k}"], left=turned[f"b{k}"], right=turned[f"b{k + 1}"])
