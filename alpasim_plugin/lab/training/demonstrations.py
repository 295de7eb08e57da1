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

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import read_json_as, read_json_object
from alpasim_plugin.core.files.arrays import open_npy
from alpasim_plugin.core.files.atomic import (
    atomic_folder,
    restore_folder,
    restore_folders,
    write_json,
)
from alpasim_plugin.core.geometry import inverse, quat_from_yaw, se3, wrap_angle
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F64, U8, CameraSpec, RenderRequest, Route, Scenario
from alpasim_plugin.lab.training.perturbed_rollouts import (
    KEPT,
    PerturbedRollout,
    RolloutState,
    perturbed_rollouts,
)
from alpasim_plugin.lab.training.policy_expert import SIGHT_M, expert_path, expert_speeds, leader_on
from alpasim_plugin.renderers import make_renderer
from alpasim_plugin.world.idm import NO_LEADER
from alpasim_plugin.world.route import route_in_rig
from policies.learned_input import COMMANDS, FRONT, SIDES, View, route_command, view_camera
from policies.learned_net import PROXIMITY_M

DEMONSTRATIONS_FILE = "demonstrations.json"
DEMONSTRATIONS_VERSION = 5  # of the format
GIVE = "give a folder that 'simrun train policy-data' wrote"
SKY_SHARE = 0.2  # of a frame's rows: most of the sky, which is cut
MAX_YAW_RAD = np.deg2rad(8.5)
COMES_MPS = 1.5
LETS_PASS_MPS = 1.0


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
    cameras: Mapping[str, Mapping[str, list[list[float]]]]  # of each view: K and T_rig_camera
    recipe: Mapping[str, Any]


# (N,) row of the frame 0.5 s earlier; the frame itself where there is none
_FORMS: dict[str, tuple[int, str]] = {
    "frame": (1, "int32"),  # (N,) row in the frames
    "before": (
        1,
        "int32",
    ),
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
    # (N, V - 1, 2) who comes, in each view to a side: proximity of the nearest, exp(-distance / 20
    # m), and 1 if the expert lets it pass
    "crossing": (3, "float32"),
}


def scene_views(scenario: Scenario) -> tuple[View, ...]:
    """Return the views that a scene's cameras show: the front one, and the sides if both are
    there.
    """
    try:
        for view in SIDES:
            view_camera(scenario, view)
    except InputError:
        return (FRONT,)
    return (FRONT, *SIDES)


def wide_camera(camera: CameraSpec, view: View) -> CameraSpec:
    """Return the camera with the same focal length and an image in which the view can be rotated by
    `MAX_YAW_RAD`; the top rows are cut.
    """
    half_rad = np.arctan(view.width / 2 / view.focal_px) + MAX_YAW_RAD
    half_px = int(np.ceil(camera.K[0, 0] * np.tan(half_rad))) + 1
    top = round(SKY_SHARE * camera.height)
    K = camera.K.copy()
    K[0, 2] = half_px
    K[1, 2] -= top
    return replace(camera, width=2 * half_px, height=camera.height - top, K=K)


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
    restore_folder(folder)
    path = folder / DEMONSTRATIONS_FILE
    if (
        path.exists()
        and {k: v for k, v in read_json_object(path, do_this=GIVE).items() if k in info} == info
    ):
        return False
    cameras = {
        view.name: wide_camera(view_camera(scenario, view), view) for view in scene_views(scenario)
    }
    arrays = _demonstrate(scenario, cameras, recipe, seed, threads)
    geometry = {
        name: {"K": camera.K.tolist(), "T_rig_camera": camera.T_rig_camera.tolist()}
        for name, camera in cameras.items()
    }
    facts = {"cameras": geometry, "samples": len(arrays["frame"])}
    with atomic_folder(folder) as partial:
        for name, array in arrays.items():
            np.save(partial / f"{name}.npy", array)
        write_json(partial / DEMONSTRATIONS_FILE, {**info, **facts})
    return True


def _demonstrate(
    scenario: Scenario,
    cameras: Mapping[str, CameraSpec],
    recipe: DemonstrationRecipe,
    seed: int,
    threads: int,
) -> dict[str, Any]:
    random = stream(scenario.scene_id, seed, "training.policy.lessons")
    renderer = make_renderer(recipe.renderer, scenario, seed=seed, threads=threads)
    rows: dict[str, list[Any]] = {name: [] for name in _FORMS}
    frames: dict[str, list[U8]] = {name: [] for name in cameras}
    taken = 0
    for rollout in perturbed_rollouts(scenario, recipe.drives, recipe.drive_s, seed):
        last: tuple[int, RolloutState] | None = None
        for state in rollout.states:
            if not state.collision_free:
                last = None
                continue
            for name, camera in cameras.items():
                T = state.T_world_rig @ camera.T_rig_camera
                request = RenderRequest(state.t_us, camera, np.stack([T, T]), state.actors)
                frames[name].append(renderer.render(request).rgb)
            speeds = _target_speeds(scenario, rollout, state, tuple(cameras))
            for k in range(recipe.headings):
                yaw = 0.0 if k == 0 else float(random.uniform(-1, 1))
                sample = _sample(
                    cameras[FRONT.name], rollout, state, taken, last, yaw, recipe, random
                )
                for key, value in (sample | speeds).items():
                    rows[key].append(value)
            last = taken, state
            taken += 1
    arrays = {name: np.array(rows[name], dtype=dtype) for name, (_, dtype) in _FORMS.items()}
    return arrays | {frames_file(name): np.array(images) for name, images in frames.items()}


def frames_file(view: str) -> str:
    """Return the name of the array of a view's frames ``(F, H, W, 3)`` uint8."""
    return f"frames_{view}"


def _target_speeds(
    scenario: Scenario, rollout: PerturbedRollout, state: RolloutState, views: Sequence[str]
) -> dict[str, Any]:
    """Return the parts of a sample that do not depend on the rig's heading."""
    half_width_m = scenario.vehicle.box.width_m / 2
    leader = leader_on(rollout.line, state.s_m, rollout.others.front_m, half_width_m, state.bodies)
    crosses = leader.index >= 0 and sorted(state.actors)[leader.index].startswith(KEPT)
    followed = NO_LEADER if crosses else leader  # who crosses is let pass, not followed
    alone = (rollout.line, state.s_m, state.speed_mps, followed, rollout.style)
    speeds = expert_speeds(*alone, rollout.others, state.t_us)
    lets_pass = (expert_speeds(*alone) - speeds).max() > LETS_PASS_MPS
    gap_m = min(leader.gap_m, SIGHT_M)
    sides = [view for view in SIDES if view.name in views]
    comes = crossing_traffic(state, sides, lets_pass)
    return {"speeds": speeds, "gap": gap_m, "leader": leader.speed_mps, "crossing": comes}


def crossing_traffic(state: RolloutState, sides: Sequence[View], lets_pass: bool) -> F64:
    """Return for each view to a side ``(V, 2)`` the proximity of the nearest road user that it shows
    on the way to the car's line, and 1 if that one is the nearest of all and is let pass.
    """
    T = inverse(state.T_world_rig)
    x, y = T[:2, :2] @ state.bodies.xy.T + T[:2, 3:]
    speed_y = T[1, :2] @ state.bodies.velocity.T
    nearest_m = np.full(len(sides), np.inf)
    for k, view in enumerate(sides):
        half_rad = np.arctan(view.width / 2 / view.focal_px)
        apart_rad = np.abs(wrap_angle(np.arctan2(y, x) - np.deg2rad(view.yaw_deg)))
        comes = (apart_rad < half_rad) & (-np.sign(view.yaw_deg) * speed_y > COMES_MPS)
        nearest_m[k] = np.min(np.hypot(x, y)[comes], initial=np.inf)
    first = np.isfinite(nearest_m) & (nearest_m == np.min(nearest_m, initial=np.inf))
    return np.column_stack([np.exp(-nearest_m / PROXIMITY_M), first & lets_pass])


def _sample(
    camera: CameraSpec,
    rollout: PerturbedRollout,
    state: RolloutState,
    now: int,
    last: tuple[int, RolloutState] | None,
    yaw: float,
    recipe: DemonstrationRecipe,
    random: np.random.Generator,
) -> dict[str, Any]:
    """Return one sample, without its speeds: a state with the rig rotated about its front
    camera.
    """
    yaw_rad = MAX_YAW_RAD * yaw
    pose = rotated_about_camera(state.T_world_rig, camera, yaw_rad)
    path = rollout.line.path
    points, headings = expert_path(path, state.s_m, pose, state.speed_mps)
    route = route_in_rig(Route(path.xyz[::4]), pose, about_m=state.s_m)
    earlier = last if last is not None and random.random() > 0.1 else (now, state)
    # The earlier frame has nearly the same yaw perturbation.
    yaw_before = float(np.clip(yaw_rad + random.normal(0.0, 0.02), -MAX_YAW_RAD, MAX_YAW_RAD))
    return {
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
    }


def rotated_about_camera(T_world_rig: F64, camera: CameraSpec, yaw_rad: float) -> F64:
    """Return the rig's pose rotated to the left about its camera."""
    T_rig_pivot = se3(camera.T_rig_camera[:3, 3], [1.0, 0.0, 0.0, 0.0])
    return np.asarray(
        T_world_rig
        @ T_rig_pivot
        @ se3([0.0, 0.0, 0.0], quat_from_yaw(yaw_rad))
        @ inverse(T_rig_pivot)
    )


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
    def views(self) -> tuple[View, ...]:
        """The views that the frames show."""
        return tuple(view for view in (FRONT, *SIDES) if view.name in self.info["cameras"])

    @cached_property
    def cameras(self) -> tuple[CameraSpec, ...]:
        """The camera of each view's frames."""
        out = []
        for view, frames in zip(self.views, self.frames, strict=True):
            camera = self.info["cameras"][view.name]
            K = np.array(camera["K"])
            T_rig_camera = np.array(camera["T_rig_camera"])
            out.append(CameraSpec(view.name, frames.shape[2], frames.shape[1], K, T_rig_camera))
        return tuple(out)

    @cached_property
    def frames(self) -> tuple[Any, ...]:
        """Frames ``(F, H, W, 3)`` uint8 of each view."""
        return tuple(self._array(frames_file(view.name), 4, "uint8") for view in self.views)

    @cached_property
    def arrays(self) -> dict[str, Any]:
        """Arrays of the samples by name."""
        return {name: self._array(name, *form) for name, form in _FORMS.items()}

    def _array(self, name: str, axes: int, dtype: str) -> Any:
        path = self.folder / f"{name}.npy"
        array = open_npy(path, "write the demonstrations again")
        if array.ndim != axes or array.dtype != np.dtype(dtype):
            raise InputError(
                f"{path}: {array.dtype} with {array.ndim} axes",
                f"{dtype} with {axes} axes is needed: write the demonstrations again",
            )
        return array


def demonstrations_digest(demonstrations: Sequence[Demonstrations]) -> str:
    """Return a digest of demonstrations as training data: scene, seed and recipe of each, in
    order.
    """
    return hashlib.blake2b(
        json.dumps(
            [demonstration.info for demonstration in demonstrations], sort_keys=True
        ).encode(),
        digest_size=8,
    ).hexdigest()


def common_views(demonstrations: Sequence[Demonstrations]) -> tuple[View, ...]:
    """Return the views that all demonstrations have.

    Raises:
        InputError: Some have other views than the rest.
    """
    first = demonstrations[0]
    for demonstration in demonstrations:
        if demonstration.views != first.views:
            have, has = ([view.name for view in member.views] for member in (first, demonstration))
            raise InputError(
                f"{first.folder} has the views {have}, and {demonstration.folder} {has}",
                "train on scenes whose cameras show the same views",
            )
    return first.views


def read_demonstrations(root: Path, split: str) -> Sequence[Demonstrations]:
    """Return the complete scenes of a split in order of name.

    Raises:
        InputError: There are none.
    """
    restore_folders(root / split)
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
    return [
        demonstrations for demonstrations in map(Demonstrations, folders) if len(demonstrations)
    ]
