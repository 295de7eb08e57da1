"""Make run folders by the runtime's own writers, with drives and pictures made up from a seed, so
that the report can be tested alone.
"""

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.interpolate import CubicSpline

from alpasim_plugin.log.run_folder.manifests import write_manifest, write_run_json
from alpasim_plugin.log.run_folder.schema import rollout_folder, slug
from alpasim_plugin.log.run_folder.writer import write_steps
from alpasim_plugin.runs.summary import write_summary
from evaluators.pages.flips import find_flips
from evaluators.statistics.opening import read_run
from tests import run_records
from tests.run_records import run_info

METRICS = (
    "collision_any",
    "collision_at_fault",
    "collision_front",
    "collision_lateral",
    "collision_rear",
    "offroad",
    "offroad_or_collision_at_fault",
    "lateral_distance_m",
    "progress",
    "dist_to_gt_location",
    "min_distance_to_obstacle_m",
    "plan_deviation",
    "dist_traveled_m",
    "min_ade@1.0s(gt)",
)
STAGES = {"render": 0.62, "policy": 0.2, "fixer": 0.0, "log": 0.1, "control": 0.01, "actors": 0.03}
DT_US = 100_000


@dataclass
class Plan:
    """What to make."""

    renderers: Sequence[str] = ("clean", "3dgs", "onefixer")
    policies: Sequence[str] = ("lane-camera",)
    scenes: Sequence[str] = (
        "smoke/straight",
        "urban/left-turn",
        "hard/narrow-gap-with-parked-cars",
        "USA_US101-3_3_T-1",
    )
    seeds: Sequence[int] = (0, 1, 2)
    steps: int = 120
    fail: Sequence[tuple[str, str, int]] = ()  # (renderer, scene, seed)
    failure: str = "1204 NaN pixels <b>&\nat t = 3.400000 s"
    invalid: Sequence[str] = (
        "min_distance_to_obstacle_m",
    )  # metrics that are invalid in the first scene
    clips: bool = True
    flip_frames: bool = False
    picture_px: tuple[int, int] = (256, 144)
    harm: dict[str, float] = field(
        default_factory=lambda: {"clean": 0.15, "3dgs": 2.6, "onefixer": 0.45}
    )
    rng_seed: int = 7


def make_run(folder, plan=None):
    """Write a run folder and return it."""
    plan = plan or Plan()
    rng = np.random.default_rng(plan.rng_seed)
    folder.mkdir(parents=True, exist_ok=True)
    maps = {scene: _scene(scene, index, plan) for index, scene in enumerate(plan.scenes)}
    for scene, content in maps.items():
        _json(folder / "scenes" / f"{slug(scene)}.json", content)
    manifests = []
    for scene, content in maps.items():
        for seed in plan.seeds:
            wander = _smooth(rng, plan.steps) * 0.3  # shared by the renderers: pairs are sharp
            for renderer in plan.renderers:
                for policy in plan.policies:
                    manifest, steps = _rollout(
                        renderer, policy, scene, seed, content, wander, plan, rng
                    )
                    manifests.append(_written(folder, manifest, steps, plan))
    info = _run_json(plan, maps, manifests)
    write_run_json(folder, info)
    write_summary(folder, info, manifests, folder)
    if plan.flip_frames:
        _write_flips(folder, plan)
    return folder


def _write_flips(folder, plan):
    """Write when plans parted for every flip, as the runtime does from the logs; the second one has
    no answer.
    """
    flips, compared = find_flips(read_run(folder))
    cells = []
    for number, flip in enumerate(flips):
        key = dict(
            zip(("renderer", "policy", "scene", "seed", "log", "against"), flip.key, strict=True)
        ) | {"baseline": flip.base.renderer}
        if number == 1:
            cells.append(
                key | {"t_us": None, "reason": "the plans never diverge by more than 0.5 m"}
            )
            continue
        frames = {}
        for side, (name, rollout) in enumerate(
            zip(flip.sides, (flip.base, flip.other), strict=True)
        ):
            frames[name] = f"flips/{number:03d}-{side}.jpg"
            (folder / "flips").mkdir(exist_ok=True)
            cv2.imwrite(str(folder / frames[name]), _picture(rollout.renderer, 2, *plan.picture_px))
        part_us = 1_000_000 + 100_000 * number
        cells.append(
            key
            | {
                "t_us": part_us,
                "after_us": part_us,
                "gap_m": 0.5 + 0.01 * number,
                "source": "logs",
                "frames": frames,
            }
        )
    _json(
        folder / "flips.json",
        {
            "threshold_m": 0.5,
            "horizon_s": 3.0,
            "n_flips": len(flips),
            "n_pairs": compared,
            "cells": cells,
        },
    )


def _json(path, value):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value, indent=1, allow_nan=False))


def _scene(scene, index, plan):
    length_m = 8.0 * plan.steps * 0.1
    s = np.linspace(-15, length_m + 30, 160)
    bend = (0.0, 0.014, -0.006, 0.003)[index % 4]
    yaw = bend * np.clip(s - 30, 0, 90)
    ds = np.diff(s, prepend=s[0])
    centre = np.stack(
        [np.cumsum(np.cos(yaw) * ds) + 1000.0 * index, np.cumsum(np.sin(yaw) * ds) - 400.0], 1
    )
    normal = np.stack([-np.sin(yaw), np.cos(yaw)], 1)
    lanes = []
    for lane in range(3):
        mid = centre + normal * 3.6 * (lane - 0.5 if index % 2 else lane)
        lanes.append(
            {
                "id": f"lane-{lane}",
                "kind": "vehicle",
                "centre": np.round(mid, 2).tolist(),
                "left": np.round(mid + normal * 1.8, 2).tolist(),
                "right": np.round(mid - normal * 1.8, 2).tolist() if lane or index != 2 else None,
                "markings": ["dashed_white", "solid_white"],
            }
        )
    mid = np.array(lanes[0]["centre"])
    edges = [np.round(mid - normal * 2.1, 2).tolist(), np.round(mid + normal * 9.4, 2).tolist()]
    at = mid[60]
    ahead = np.array([math.cos(yaw[60]), math.sin(yaw[60])])
    ring = [
        (at + normal[60] * a + ahead * b).tolist() for a, b in ((-2, 0), (9, 0), (9, 3), (-2, 3))
    ]
    drive = np.stack(
        [np.interp(np.linspace(0, length_m, plan.steps), s, mid[:, k]) for k in (0, 1)], 1
    )
    return {
        "scene_id": scene,
        "source": "commonroad" if scene.startswith("USA") else "yaml",
        "content_hash": f"{index:02d}" * 32,
        "notes": ["2 signs without a shape left out"],
        "start_us": 0,
        "end_us": plan.steps * DT_US,
        "warmup_us": 500_000,
        "lanes": lanes,
        "road_edges": edges,
        "crosswalks": [ring] if index == 1 else [],
        "ego_log": {
            "t_us": [k * DT_US for k in range(plan.steps)],
            "x_m": np.round(drive[:, 0], 3).tolist(),
            "y_m": np.round(drive[:, 1], 3).tolist(),
        },
        "vehicle": {"length_m": 4.855, "width_m": 1.88, "rear_axle_to_centre_m": 1.4},
    }


def _smooth(rng, n):
    """Make a wandering curve of about unit size."""
    knots = rng.normal(0, 1, 9)
    return np.interp(np.linspace(0, 8, n), np.arange(9), knots) if n < 4 else _cubic(knots, n)


def _cubic(knots, n):
    return np.asarray(CubicSpline(np.arange(len(knots)), knots)(np.linspace(0, len(knots) - 1, n)))


def _rollout(renderer, policy, scene, seed, content, wander, plan, rng):  # type: ignore[no-untyped-def]
    key = {"renderer": renderer, "policy": policy, "scene": scene, "seed": seed}
    manifest = key | {
        "path": rollout_folder(renderer, policy, scene, seed).as_posix(),
        "wall_s": round(float(rng.uniform(2.0, 6.0)), 3),
        "frames": plan.steps,
        "steps": plan.steps,
        "status": "ok",
        "events": [],
        "metrics": {},
    }
    if (renderer, scene, seed) in plan.fail:
        error = {
            "message": plan.failure,
            "hint": "run with --set guard=off",
            "failure_class": "renderer",
        }
        return manifest | {"status": "failed", "error": error, "frames": 34, "steps": 34}, []
    harm = plan.harm.get(renderer, 0.8) * (1.6 if "hard" in scene else 1.0)
    t = np.arange(plan.steps)
    offset = (wander * (0.6 + harm) + _smooth(rng, plan.steps) * 0.12 * harm) * np.clip(
        (t - 5) / 25, 0, 1
    )
    xy = np.stack([content["ego_log"]["x_m"], content["ego_log"]["y_m"]], 1)
    tangent = np.gradient(xy, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    ego = xy + offset[:, None] * np.stack([-tangent[:, 1], tangent[:, 0]], 1)
    off = offset < -1.1
    hit = offset > 1.6
    end = min([plan.steps, *(int(np.argmax(flag)) + 1 for flag in (off, hit) if flag.any())])
    series = {
        "ego_x_m": ego[:, 0],
        "ego_y_m": ego[:, 1],
        "ego_yaw_rad": np.arctan2(tangent[:, 1], tangent[:, 0]),
        "ego_speed_mps": np.full(plan.steps, 8.0),
        "lateral_bias_m": offset,
        "opacity_mean": np.clip(0.995 - 0.04 * harm * np.abs(offset), 0, 1),
        "plan_deviation": 0.05 + 0.04 * harm * np.abs(offset),
        "collision_any": hit.astype(float),
        "collision_at_fault": hit.astype(float),
        "offroad": off.astype(float),
        "offroad_or_collision_at_fault": (hit | off).astype(float),
    }
    steps = [
        key | {"t_us": k * DT_US, "metric": m, "value": float(v[k]), "valid": True, "reason": ""}
        for m, v in series.items()
        for k in range(plan.steps)
    ]
    collided = bool(hit[:end].any())
    values = {
        "collision_any": float(collided),
        "collision_at_fault": float(collided),
        "collision_front": 0.0,
        "collision_lateral": float(collided),
        "collision_rear": 0.0,
        "offroad": float(off[:end].any()),
        "offroad_or_collision_at_fault": float(collided or off[:end].any()),
        "lateral_distance_m": float(np.abs(offset[:end]).mean()),
        "progress": end / plan.steps,
        "dist_to_gt_location": float(np.abs(offset[:end]).mean() + 0.4),
        "min_distance_to_obstacle_m": float(max(0.0, 1.6 - np.abs(offset[:end]).max())),
        "plan_deviation": float(0.05 + 0.04 * harm + rng.uniform(0, 0.02)),
        "dist_traveled_m": 0.8 * end,
        "min_ade@1.0s(gt)": None,
    }
    if scene == plan.scenes[0]:
        values |= dict.fromkeys(plan.invalid)
        steps += [
            key
            | {
                "t_us": 0,
                "metric": m,
                "value": None,
                "valid": False,
                "reason": "no other road user within 50 m",
            }
            for m in plan.invalid
        ]
    steps += [
        key
        | {
            "t_us": 0,
            "metric": m,
            "value": None,
            "valid": False,
            "reason": "the policy gives no plan of 1.0 s",
        }
        for m in ("min_ade@1.0s(gt)",)
        if values[m] is None
    ]
    slow = 14.0 + 9.0 * plan.renderers.index(renderer)
    manifest |= {
        "censored": {
            "dropped": "",
            "steps_total": plan.steps,
            "steps_warmup": 5,
            "steps_after_event": plan.steps - end,
            "steps_after_drift": 0,
            "steps_scored": end - 5,
        },
        "stage_ms": {
            stage: (slow * share * np.linspace(0.9, 1.2, plan.steps)).tolist()
            for stage, share in STAGES.items()
        },
    }
    reasons = dict.fromkeys(plan.invalid, "no other road user within 50 m")
    reasons["min_ade@1.0s(gt)"] = "the policy gives no plan of 1.0 s"
    manifest["metrics"] = {
        name: {
            "value": value,
            "valid": value is not None,
            "reason": reasons[name] if value is None else "",
        }
        for name, value in values.items()
    }
    return manifest, steps


def _written(folder, manifest, steps, plan):
    """Write a rollout's folder as the runtime does, and return its manifest."""
    record = run_records.manifest(manifest)
    place = folder / record.path
    place.mkdir(parents=True, exist_ok=True)
    if record.ok:
        write_steps(place, steps)
        if plan.clips and record.seed == plan.seeds[0]:
            (place / "front.mp4").write_bytes(b"\x00\x00\x00\x18ftypmp42")
    write_manifest(place, record)
    return record


def _picture(renderer, k, width, height):
    image = np.full((height, width, 3), (98, 96, 94), dtype=np.uint8)
    horizon, middle, car = int(height * 0.45), width // 2, width // 14 + k * width // 60
    image[:horizon] = (230, 205, 175)
    for x in (0.0, 0.62, 1.3):
        cv2.line(image, (middle, horizon), (int(x * width), height), (235, 235, 235), 2)
    image[horizon : horizon + car, middle - car : middle + car] = (60, 40, 130)
    if renderer == "3dgs":
        image = cv2.GaussianBlur(image, (0, 0), 1.5 + 1.2 * k)
    elif renderer == "onefixer":
        image = cv2.GaussianBlur(image, (0, 0), 0.7)
    return image


def _run_json(plan, maps, manifests):
    content = {
        "key": "made",
        "bases": {"onefixer": "3dgs"} if "onefixer" in plan.renderers else {},
        "pool": {
            "workers": 2,
            "threads_per_worker": 1,
            "frames": sum(manifest.frames for manifest in manifests),
            "frames_per_s_total": 41.2,
            "wall_s": sum(manifest.wall_s for manifest in manifests) / 2,
        },
        "schema_version": 1,
        "command": [
            "simrun",
            "run",
            "--renderer",
            ",".join(plan.renderers),
            "--policy",
            ",".join(plan.policies),
            "--seeds",
            "3",
            "smoke.yaml",
        ],
        "version": "0.1.0",
        "started_at": "2025-03-04T09:12:44+00:00",
        "preset": "paper",
        "config": {"preset": "paper", "images": "jpeg", "video": "none", "workers": 2},
        "scenes": {
            s: {"source": m["source"], "content_hash": m["content_hash"], "notes": m["notes"]}
            for s, m in maps.items()
        },
        "renderers": list(plan.renderers),
        "policies": list(plan.policies),
        "seeds": list(plan.seeds),
        "hardware": {"cpu": "Example CPU @ 2.6 GHz", "cores": 2, "memory_gib": 16.0, "gpu": None},
        "versions": {"python": "3.11.9", "numpy": "2.1.0", "torch": "2.11.0"},
        "left_out": [
            "cameras: side-left, side-right (no policy takes them)",
            "actors: 14 never seen by a camera",
        ],
    }
    return run_info(content)
