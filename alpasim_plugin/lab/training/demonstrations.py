"""Demonstrations on disk for the learned policy: clean frames of perturbed rollouts, with the
expert's path and speeds.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from typing_extensions import TypedDict

from alpasim_plugin.core.atomic import atomic_folder, write_json
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import inverse, quat_from_yaw, se3
from alpasim_plugin.core.reading import read_json_as, read_json_object
from alpasim_plugin.core.reading.arrays import open_npy
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F64, CameraSpec, RenderRequest, Route, Scenario
from alpasim_plugin.lab.training.perturbed_rollouts import (
    PerturbedRollout,
    RolloutState,
    perturbed_rollouts,
)
from alpasim_plugin.lab.training.policy_expert import SIGHT_M, expert_path, expert_speeds, leader_on
from alpasim_plugin.renderers import make_renderer
from alpasim_plugin.world.route import route_in_rig
from policies.base import front_camera
from policies.learned_input import COMMANDS, route_command

DEMONSTRATIONS_FILE = "demonstrations.json"
DEMONSTRATIONS_VERSION = 3  # of the format
READING = "reading demonstrations for the learned policy"
GIVE = "give a folder that 'simrun train policy-data' wrote"
WIDE_PX, TOP_ROW = (
    352,
    30,
)  # frames are wider than the policy's input, so that it can be rotated; most of the sky is cut
MAX_YAW_RAD = np.deg2rad(8.5)


@dataclass(frozen=True)
class DemonstrationRecipe:
    """Demonstrations of one scene.

    Args:
        renderer: Renderer of the frames.
        drives: Perturbed rollouts of a scene.
        drive_s: Length of each, seconds; a frame every `FRAME_INTERVAL_S`.
        headings: Yaw perturbations of every state; the first is none.
        announcement_sigma_m: Standard deviation of the distance at which navigation announces a
            turn.
    """

    renderer: str = "clean"
    drives: int = 3
    drive_s: float = 10.0
    headings: int = 5
    announcement_sigma_m: float = 2.5


class DemonstrationFacts(TypedDict):
    """What ``demonstrations.json`` holds besides the key that made it."""

    samples: int
    K: list[list[float]]
    T_rig_camera: list[list[float]]
    recipe: Mapping[str, Any]


_FORMS: dict[str, tuple[int, str]] = {
    "frames": (4, "uint8"),  # (F, 114, 352, 3)
    "frame": (1, "int32"),  # (N,) row in frames
    "before": (
        1,
        "int32",
    ),  # (N,) row of the frame 0.5 s earlier; the frame itself where there is none
    "yaw": (1, "float32"),  # (N,) radians, yaw perturbation of the view, left positive
    "yaw_before": (1, "float32"),  # (N,)
    "speed": (1, "float32"),  # (N,) metres per second
    "desired_speed": (1, "float32"),  # (N,) metres per second
    "command": (1, "int64"),  # (N,) index in COMMANDS
    "points": (3, "float32"),  # (N, 9, 2) metres
    "headings": (2, "float32"),  # (N, 9) radians
    "speeds": (2, "float32"),  # (N, 8) metres per second
    "gap": (1, "float32"),  # (N,) metres to the leader, at most SIGHT_M
    "leader": (1, "float32"),  # (N,) its speed, metres per second
}


def wide_camera(camera: CameraSpec) -> CameraSpec:
    """Return the camera with the same focal length and a wider, lower image."""
    K = camera.K.copy()
    K[0, 2] = WIDE_PX / 2
    K[1, 2] -= TOP_ROW
    return replace(camera, width=WIDE_PX, height=camera.height - TOP_ROW, K=K)


def write_demonstrations(
    scenario: Scenario, folder: Path, recipe: DemonstrationRecipe, seed: int, threads: int = 1
) -> bool:
    """Write the demonstrations of one scene unless equal ones exist.

    Returns:
        Whether they were written now.

    Raises:
        InputError: The scene has no front camera.
        InfrastructureError: The disk refuses.
    """
    info = {
        "scene_id": scenario.scene_id,
        "scene_hash": scenario.content_hash,
        "seed": seed,
        "recipe": asdict(recipe),
    }
    info["version"] = DEMONSTRATIONS_VERSION
    path = folder / DEMONSTRATIONS_FILE
    if (
        path.exists()
        and {k: v for k, v in read_json_object(path, do_this=GIVE).items() if k in info} == info
    ):
        return False
    camera = wide_camera(front_camera(scenario))
    arrays = _demonstrate(scenario, camera, recipe, seed, threads)
    facts = {
        "K": camera.K.tolist(),
        "T_rig_camera": camera.T_rig_camera.tolist(),
        "samples": len(arrays["frame"]),
    }
    with atomic_folder(folder) as partial:
        for name, array in arrays.items():
            np.save(partial / f"{name}.npy", array)
        write_json(partial / DEMONSTRATIONS_FILE, {**info, **facts})
    return True


def _demonstrate(
    scenario: Scenario, camera: CameraSpec, recipe: DemonstrationRecipe, seed: int, threads: int
) -> dict[str, Any]:
    random = stream(scenario.scene_id, seed, "training.policy.lessons")
    renderer = make_renderer(recipe.renderer, scenario, seed=seed, threads=threads)
    rows: dict[str, list[Any]] = {name: [] for name in _FORMS}
    for rollout in perturbed_rollouts(scenario, recipe.drives, recipe.drive_s, seed):
        last: tuple[int, RolloutState] | None = None
        for state in rollout.states:
            if not state.collision_free:
                last = None
                continue
            T = state.T_world_rig @ camera.T_rig_camera
            rows["frames"].append(
                renderer.render(
                    RenderRequest(state.t_us, camera, np.stack([T, T]), state.actors)
                ).rgb
            )
            now = len(rows["frames"]) - 1
            for k in range(recipe.headings):
                _append_sample(
                    rows,
                    scenario,
                    camera,
                    rollout,
                    state,
                    now,
                    last,
                    0.0 if k == 0 else float(random.uniform(-1, 1)),
                    recipe,
                    random,
                )
            last = now, state
    return {name: np.array(rows[name], dtype=dtype) for name, (_, dtype) in _FORMS.items()}


def _append_sample(
    rows: dict[str, list[Any]],
    scenario: Scenario,
    camera: CameraSpec,
    rollout: PerturbedRollout,
    state: RolloutState,
    now: int,
    last: tuple[int, RolloutState] | None,
    yaw: float,
    recipe: DemonstrationRecipe,
    random: np.random.Generator,
) -> None:
    """Append one sample: a state with the rig rotated about its camera."""
    yaw_rad = MAX_YAW_RAD * yaw
    pose = rotated_about_camera(state.T_world_rig, camera, yaw_rad)
    path = rollout.line.path
    points, headings = expert_path(path, state.s_m, pose, state.speed_mps)
    box, axle_m = scenario.vehicle.box, scenario.vehicle.rear_axle_to_centre_m
    leader = leader_on(
        rollout.line, state.s_m, axle_m + box.length_m / 2, box.width_m / 2, state.bodies
    )
    route = route_in_rig(Route(path.xyz[::4]), pose)
    earlier = last if last is not None and random.random() > 0.1 else (now, state)
    # The earlier frame has nearly the same yaw perturbation.
    yaw_before = float(np.clip(yaw_rad + random.normal(0.0, 0.02), -MAX_YAW_RAD, MAX_YAW_RAD))
    sample = {
        "frame": now,
        "before": earlier[0],
        "yaw": yaw_rad,
        "yaw_before": yaw_rad if earlier[0] == now else yaw_before,
        "speed": state.speed_mps,
        "desired_speed": rollout.style.desired_mps,
        "command": COMMANDS.index(
            route_command(route, float(random.normal(0.0, recipe.announcement_sigma_m)))
        ),
        "points": points,
        "headings": headings,
        "speeds": expert_speeds(rollout.line, state.s_m, state.speed_mps, leader, rollout.style),
        "gap": min(leader.gap_m, SIGHT_M),
        "leader": leader.speed_mps,
    }
    for name, value in sample.items():
        rows[name].append(value)


def rotated_about_camera(T_world_rig: F64, camera: CameraSpec, yaw_rad: float) -> F64:
    """Return the rig's pose rotated to the left about its camera."""
    at = se3(camera.T_rig_camera[:3, 3], [1.0, 0.0, 0.0, 0.0])
    return np.asarray(T_world_rig @ at @ se3([0.0, 0.0, 0.0], quat_from_yaw(yaw_rad)) @ inverse(at))


class Demonstrations:
    """The demonstrations of one scene, memory-mapped.

    Raises:
        InputError: The folder is incomplete, or an array has another dtype or rank.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.info = read_json_as(DemonstrationFacts, folder / DEMONSTRATIONS_FILE, do_this=GIVE)

    def __len__(self) -> int:
        return self.info["samples"]

    @cached_property
    def camera(self) -> CameraSpec:
        """Camera of the frames."""
        shape = self.arrays["frames"].shape
        return CameraSpec(
            "front",
            shape[2],
            shape[1],
            np.array(self.info["K"]),
            np.array(self.info["T_rig_camera"]),
        )

    @cached_property
    def arrays(self) -> dict[str, Any]:
        """Arrays by name."""
        out = {}
        for name, (axes, dtype) in _FORMS.items():
            path = self.folder / f"{name}.npy"
            out[name] = open_npy(path, "write the demonstrations again")
            if out[name].ndim != axes or out[name].dtype != np.dtype(dtype):
                raise InputError(
                    f"{path}: {out[name].dtype} with {out[name].ndim} axes",
                    f"{dtype} with {axes} axes is needed: write the demonstrations again",
                )
        return out


def demonstrations_digest(demonstrations: Sequence[Demonstrations]) -> str:
    """Return a digest of demonstrations as training data: scene, seed and recipe of each, in
    order.
    """
    return hashlib.blake2b(
        json.dumps([one.info for one in demonstrations], sort_keys=True).encode(), digest_size=8
    ).hexdigest()


def read_demonstrations(root: Path, split: str) -> Sequence[Demonstrations]:
    """Return the complete scenes of a split in order of name.

    Raises:
        InputError: There are none.
    """
    folders = sorted(
        p.parent
        for p in (root / split).glob(f"*/{DEMONSTRATIONS_FILE}")
        if not p.parent.name.startswith(".")
    )
    if not folders:
        raise InputError(
            f"{root / split}: no complete scene",
            "write some with 'simrun train policy-data'",
        )
    return [one for one in map(Demonstrations, folders) if len(one)]
