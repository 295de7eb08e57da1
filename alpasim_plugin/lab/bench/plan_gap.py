"""How far plans move when a policy sees a renderer's images in place of true ones.

A policy is asked twice at the same places and instants, once with the photographs of a drive (or,
on a built scene, with the images of `clean`) and once with what a renderer shows from there; see
`open_loop`. The plan gap is the distance between the two plans, along and across the first.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from alpasim_plugin.core.parts import PartSpec
from alpasim_plugin.core.types import F64, U8, Plan, Scenario
from alpasim_plugin.lab.bench.open_loop import TrueImage, ego_at, plans_of, roles_of
from evaluators.statistics.intervals import median_interval

Row = dict[str, Any]
HORIZONS_S = (1, 2, 4)
BRAKES_MPS = 0.5  # by which a plan that brakes is slower, one second ahead, than the ego is now
BLOCK_S = 4.0  # plans overlap within it, so that what varies is a block of so long
GAPS = tuple(f"{side}_{horizon_s}s_m" for horizon_s in HORIZONS_S for side in ("lateral", "along"))
RANGE_STEP_M = 0.25  # between offsets at which the range of a built scene is looked for
RANGE_KEYS = ("drive", "policy", "renderer")
NEAR_M = 0.3  # across the plan, two seconds ahead
BIN_M = (0.25, 0.75, 1.5, 3.0)  # rows end at these distances from the recorded path


def gap_of(true_plan: Plan, plan: Plan) -> dict[str, float | None]:
    """Return the distances of a plan from that made of true images, metres, by `GAPS`: across the true
    plan and along it, without sign. None where one of the plans is shorter.

    Args:
        true_plan: The plan made of true images.
        plan: The plan made of a renderer's images, at the same instant and of the same ego.
    """
    gaps: dict[str, float | None] = {}
    for horizon_s in HORIZONS_S:
        true_pose = pose_at(true_plan, float(horizon_s))
        pose = pose_at(plan, float(horizon_s))
        across_m = along_m = None
        if true_pose is not None and pose is not None:
            heading = np.array([np.cos(true_pose[2]), np.sin(true_pose[2])])
            step = pose[:2] - true_pose[:2]
            along_m = abs(float(heading @ step))
            across_m = abs(float(heading[0] * step[1] - heading[1] * step[0]))
        gaps[f"lateral_{horizon_s}s_m"] = across_m
        gaps[f"along_{horizon_s}s_m"] = along_m
    return gaps


def pose_at(plan: Plan, ahead_s: float) -> F64 | None:
    """Return where a plan is after ``ahead_s``: x, y, yaw ``(3,)`` in the rig frame of its query. None
    beyond its end.
    """
    times_s = (plan.times_us - plan.times_us[0]) * 1e-6
    if ahead_s > times_s[-1] + 1e-9:
        return None
    columns = (plan.xy[:, 0], plan.xy[:, 1], np.unwrap(plan.yaw))
    return np.array([np.interp(ahead_s, times_s, column) for column in columns])


def brakes(plan: Plan, speed_mps: float) -> bool | None:
    """Return whether a plan is slower by `BRAKES_MPS` one second ahead than the ego is now; None where
    the plan is shorter than that.

    Args:
        plan: The plan.
        speed_mps: Of the ego when the plan was made.
    """
    before = pose_at(plan, 0.9)
    then = pose_at(plan, 1.0)
    if before is None or then is None:
        return None
    asked_mps = float(np.hypot(*(then[:2] - before[:2]))) / 0.1
    return asked_mps < speed_mps - BRAKES_MPS


def gap_rows(
    drive: str,
    scenario: Scenario,
    spec: PartSpec,
    series: Mapping[str, Sequence[TrueImage]],
    rendered_images: Mapping[str, Mapping[str, Sequence[U8]]],
    seed: int,
) -> tuple[list[Row], list[str]]:
    """Return the rows of a policy, one for each renderer, series, use of the images and distance from
    the path, and what could not be asked. Images that a fit has seen are shown and not counted.

    Args:
        drive: Its name, for the rows.
        scenario: The drive.
        spec: The policy.
        series: True images by camera, in order of time.
        rendered_images: By renderer and camera, what is shown at the same places.
        seed: Of the policy's noise, the same for both plans.

    Raises:
        InputError: No series can be shown to the policy; see `roles_of`.
        PolicyError: The policy raised, or broke its contract.
    """
    roles, notes = roles_of(spec, scenario, series)
    true_images = {name: [image.rgb for image in images] for name, images in series.items()}
    rows = []
    for role in roles:
        images_of_front = series[role.series_by_camera[role.front.name]]
        speeds_mps = [
            ego_at(role.scenario, image, role.front).speed_mps for image in images_of_front
        ]
        true_plans = plans_of(spec, role, series, true_images, seed)
        for renderer, images in rendered_images.items():
            plans = plans_of(spec, role, series, images, seed)
            pairs = _pairs(images_of_front, true_plans, plans, speeds_mps)
            head = {
                "drive": drive,
                "policy": spec.name,
                "renderer": renderer,
                "camera": ", ".join(role.series_by_camera.values()),
            }
            rows += _binned(head, pairs)
    return rows, notes


def _pairs(
    images: Sequence[TrueImage],
    true_plans: Sequence[Plan | None],
    plans: Sequence[Plan | None],
    speeds_mps: Sequence[float],
) -> list[Row]:
    """Return what is compared at each counted instant: its place, gaps, and whether each plan
    brakes.
    """
    pairs = []
    for image, true_plan, plan, speed_mps in zip(
        images, true_plans, plans, speeds_mps, strict=True
    ):
        if image.use == "fitted" or true_plan is None or plan is None:
            continue
        flags = brakes(true_plan, speed_mps), brakes(plan, speed_mps)
        differs = None if None in flags else float(flags[0] != flags[1])
        pairs.append(
            {
                "t_us": image.t_us,
                "set": image.use,
                "distance_m": image.distance_m,
                **gap_of(true_plan, plan),
                "brakes_in_one": differs,
            }
        )
    return pairs


def _binned(head: Row, pairs: Sequence[Row]) -> list[Row]:
    """Return a row for each set and distance of the pairs: means, and the median over blocks of time
    with its interval.
    """
    bins = np.searchsorted(BIN_M, [pair["distance_m"] for pair in pairs])
    keys = [(pair["set"], int(number)) for pair, number in zip(pairs, bins, strict=True)]
    rows = []
    for key in sorted(set(keys)):
        part = [pair for pair, pair_key in zip(pairs, keys, strict=True) if pair_key == key]
        row = {
            **head,
            "set": key[0],
            "distance_m": round(float(np.mean([pair["distance_m"] for pair in part])), 3),
            "n_plans": len(part),
        }
        row |= {name: mean_of(part, name) for name in (*GAPS, "brakes_in_one")}
        rows.append({**row, **_over_blocks(part)})
    return rows


def mean_of(rows: Sequence[Row], name: str) -> float | None:
    """Return the mean of a value over the rows that have it; None where none has."""
    values = [row[name] for row in rows if row[name] is not None]
    return round(float(np.mean(values)), 5) if values else None


def _over_blocks(pairs: Sequence[Row]) -> Row:
    """Return the interval of the median lateral gap two seconds ahead over blocks of `BLOCK_S`, which
    do not share a plan's future; None where there are too few of them.
    """
    blocks: dict[int, list[float]] = {}
    for pair in pairs:
        if pair["lateral_2s_m"] is not None:
            number = int((pair["t_us"] - pairs[0]["t_us"]) // round(BLOCK_S * 1e6))
            blocks.setdefault(number, []).append(pair["lateral_2s_m"])
    means = [float(np.mean(values)) for values in blocks.values()]
    interval = median_interval(means, "blocks") if means else None
    return {
        "n_blocks": len(means),
        "lateral_2s_m_median_ci95": None if interval is None else interval.bounds,
    }


def gap_intervals(rows: Sequence[Row]) -> list[Row]:
    """Return mean, median and the 95 % interval of the median over drives of every gap, by policy,
    renderer and set; none of what one drive alone measured.

    The drives are the sample. Nothing bounds a gap, so that no sample bounds its mean; the median's
    interval takes six drives, and is None before.
    """
    keys = ("policy", "renderer", "set")
    out = []
    for key in dict.fromkeys(tuple(row[name] for name in keys) for row in rows):
        rows_of_key = [row for row in rows if tuple(row[name] for name in keys) == key]
        for gap in (*GAPS, "brakes_in_one"):
            means = _means_of_drives(rows_of_key, gap)
            if len(means) < 2:
                continue
            interval = median_interval(means, "drives")
            values = {
                "gap": gap,
                "drives": len(means),
                "mean": float(np.mean(means)),
                "median": interval.centre,
                "median_ci95": interval.bounds,
            }
            out.append({**dict(zip(keys, key, strict=True)), **values})
    return out


def is_near(row: Row) -> bool:
    """Return whether plans are near those made of true images: their mean distance across, two seconds
    ahead, is at most `NEAR_M`. False where plans are shorter than that.
    """
    gap_m = row["lateral_2s_m"]
    return gap_m is not None and gap_m <= NEAR_M


def gap_ranges(rows: Sequence[Row]) -> list[Row]:
    """Return how far beside the path of a built scene plans are near, by drive, policy and renderer.

    ``near_to_m`` is the largest distance up to which all offsets that were looked at, to either side,
    are near; None where those on the path are not. ``passes_at_m`` is the next one; None where none
    passes.

    Args:
        rows: Of `gap_rows`, with their offsets, from 0 up and down, in ``offset_m``.
    """
    out = []
    for key in dict.fromkeys(tuple(row[name] for name in RANGE_KEYS) for row in rows):
        is_near_at: dict[float, bool] = {}
        for row in rows:
            if tuple(row[name] for name in RANGE_KEYS) == key:
                distance_m = abs(row["offset_m"])
                is_near_at[distance_m] = is_near_at.get(distance_m, True) and is_near(row)
        near_to_m = None
        passes_at_m = None
        for distance_m in sorted(is_near_at):
            if not is_near_at[distance_m]:
                passes_at_m = distance_m
                break
            near_to_m = distance_m
        values = {"near_to_m": near_to_m, "passes_at_m": passes_at_m}
        out.append({**dict(zip(RANGE_KEYS, key, strict=True)), **values})
    return out


def _means_of_drives(rows: Sequence[Row], gap: str) -> list[float]:
    """Return each drive's mean of a gap over its rows, by their plans."""
    means = []
    for drive in dict.fromkeys(row["drive"] for row in rows):
        weighted = [
            (row[gap], row["n_plans"])
            for row in rows
            if row["drive"] == drive and row[gap] is not None
        ]
        if weighted:
            values, weights = zip(*weighted, strict=True)
            means.append(float(np.average(values, weights=weights)))
    return means
