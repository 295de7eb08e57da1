"""Make a run folder with real logs that can be watched: made-up drives whose camera frames carry
their own time.
"""

import json
import operator
from dataclasses import replace
from functools import reduce

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq

from alpasim_plugin.core.geometry import quat_from_yaw, se3
from alpasim_plugin.core.types import Actor, Box, CameraSpec, EgoState, Frame, Trajectory, Vehicle
from alpasim_plugin.log import AslWriter, RolloutHeader, write_facts
from alpasim_plugin.log.run_folder.manifests import write_manifest, write_run_json
from evaluators.statistics.opening import read_run
from tests import run_records
from tests.pages.make_run import DT_US, Plan, make_run
from tests.run_records import run_info

CAMERA = CameraSpec("front", 64, 36, np.array([[40.0, 0, 32], [0, 40, 18], [0, 0, 1]]), np.eye(4))
BARS = 8  # a frame's index is written as eight bars, black or white, the highest bit on the left
KINDS = ("car", "truck", "pedestrian", "cyclist")
HARM = {"clean": 0.15, "3dgs": 6.0, "onefixer": 0.3}
WATCHED = Plan(
    scenes=("urban-left_turn", "smoke-straight"),
    seeds=(0, 1),
    steps=24,
    flip_frames=True,
    harm=HARM,
)
POSES = ("ego_x_m", "ego_y_m", "ego_yaw_rad")


def make_watched(folder, plan=WATCHED, actors=6, cameras=("front",)):
    """Write a run folder whose finished rollouts have logs, and return it.

    Args:
        folder: Where.
        plan: What drives there are; with `WATCHED`, outcomes change between renderers.
        actors: Road users in every scene; every third one goes elsewhere behind every renderer.
        cameras: Whose frames the logs keep; frames of the second one are numbered from 100 on.
    """
    make_run(folder, replace(plan, clips=False))
    run = read_run(folder)
    steps = pq.read_table(folder / "steps.parquet")
    for rollout in run.rollouts:
        if rollout.ok:
            place = folder / rollout.path
            content = run.scene_data(rollout.scene)
            assert content is not None
            keys = zip(("renderer", "policy", "scene", "seed"), rollout.cell, strict=True)
            own = steps.filter(
                reduce(operator.and_, (pc.field(name) == value for name, value in keys))
            )
            pq.write_table(own, place / "steps.parquet")
            write_log(place, rollout, content, ego_of(own), actors, cameras)
    return folder


def ego_of(steps):
    """Return the rig poses in a rollout's table of steps."""
    rows = steps.to_pylist()
    x, y, yaw = (
        np.array([row["value"] for row in rows if row["metric"] == name]) for name in POSES
    )
    t_us = np.array([row["t_us"] for row in rows if row["metric"] == POSES[0]], dtype=np.int64)
    return Trajectory(t_us, np.column_stack([x, y, np.zeros_like(x)]), quat_from_yaw(yaw))


def write_log(
    place,
    rollout,
    content,
    ego,
    actors,
    cameras,
):
    """Write ``rollout.asl`` and ``frames.jsonl``."""
    header = RolloutHeader(
        scene_id=rollout.scene,
        session_uuid="00000000-0000-5000-8000-000000000001",
        vehicle=Vehicle(),
        actors=tuple(road_users(content, ego.t_us, actors, sum(map(ord, rollout.renderer)))),
        ego_log=ego,
        render_start_us=int(ego.t_us[0]),
        force_gt_us=5 * DT_US,
        control_us=DT_US,
        n_steps=len(ego) - 1,
    )
    with AslWriter(place / "rollout.asl", header) as log:
        log.begin([replace(CAMERA, name=name) for name in cameras])
        for k, t_us in enumerate(ego.t_us.tolist()):
            pose = se3(ego.xyz[k], ego.quat[k])
            log.actor_poses(
                t_us,
                pose,
                {
                    actor.actor_id: se3(actor.track.xyz[k], actor.track.quat[k])
                    for actor in header.actors
                },
            )
            for number, name in enumerate(cameras):
                log.camera_image(Frame(t_us, name, picture(k + 100 * number)), "png")
            if k + 1 < len(ego):
                log.ego_trajectory([EgoState(t_us, pose, 8.0)])
                log.driver_request(t_us, t_us + DT_US)
                ahead = slice(k, k + 11)
                plan = Trajectory(ego.t_us[ahead], ego.xyz[ahead], ego.quat[ahead])
                log.driver_return(
                    plan,
                    [
                        Trajectory(plan.t_us, plan.xyz + np.array([0.0, side, 0.0]), plan.quat)
                        for side in (-1.0, 1.0)
                    ],
                )
    events = {len(ego) // 3: "replaced"}
    write_facts(
        place / "frames.jsonl",
        [
            {"t_us": t, "camera": CAMERA.name, "events": events.get(k, "")}
            for k, t in enumerate(ego.t_us.tolist())
        ],
    )


def road_users(content, t_us, count, salt):
    """Make road users beside the recorded drive; every third one goes its own way behind every
    renderer.
    """
    log = np.column_stack([content["ego_log"]["x_m"], content["ego_log"]["y_m"]])
    out = []
    for i in range(count):
        own = 0.02 * (salt % 7) if i % 3 == 0 else 0.0
        at = log[(7 * i) % len(log)] + [0.0, 4.0 + (i % 5)]
        seconds = (t_us - t_us[0]) * 1e-6
        speed = 0.0 if i % 4 == 3 else 2.0 + i % 3 + own
        xyz = np.column_stack(
            [at[0] + speed * seconds, np.full(len(t_us), at[1]), np.zeros(len(t_us))]
        )
        kind = KINDS[i % len(KINDS)]
        box = Box(0.6, 0.6, 1.7) if kind == "pedestrian" else Box(4.5, 1.9, 1.6)
        out.append(
            Actor(
                f"user-{i}",
                kind,
                box,
                Trajectory(t_us, xyz, np.tile(quat_from_yaw(0.1), (len(t_us), 1))),
            )
        )
    return out


def picture(k):
    """Paint a frame that says which it is."""
    bits = [255 if k >> (BARS - 1 - bit) & 1 else 0 for bit in range(BARS)]
    row = np.repeat(np.array(bits, dtype=np.uint8), CAMERA.width // BARS)
    return np.repeat(np.tile(row, (CAMERA.height, 1))[..., None], 3, axis=2)


def write_manifests(folder):
    """Give every rollout the manifest that a run writes, as far as readers of a running run need
    it.
    """
    run = read_run(folder)
    for rollout in run.rollouts:
        place = folder / rollout.path
        metrics = {
            name: {"value": value, "valid": value is not None, "reason": "", "unit": ""}
            for name, value in rollout.metrics.items()
        }
        error = {"failure_class": rollout.failure_class, "message": rollout.failure}
        manifest = {
            key: getattr(rollout, key)
            for key in ("renderer", "policy", "scene", "seed", "path", "status", "frames", "steps")
        }
        manifest |= {"wall_s": 1.0, "metrics": metrics, "contacts": []} | (
            {} if rollout.ok else {"error": error}
        )
        write_manifest(place, run_records.manifest(manifest))


def unfinished(folder, without):
    """Turn a run folder into one that is still written: no tables, and these rollouts have no
    manifest yet.

    Returns:
        Path of such a rollout -> the manifest that it gets when it finishes.
    """
    write_manifests(folder)
    info = json.loads((folder / "run.json").read_text())
    write_run_json(folder, run_info({"key": "k", "content": "c"} | info))
    for name in ("summary.json", "rollouts.parquet", "steps.parquet", "flips.json"):
        (folder / name).unlink(missing_ok=True)
    later = {}
    for path in without:
        manifest = folder / path / "manifest.json"
        later[path] = manifest.read_bytes()
        manifest.unlink()
    return later
