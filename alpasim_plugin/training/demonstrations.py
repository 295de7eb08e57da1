"""Lessons on disk for the learned policy: clean frames of practice drives, and what the teacher does there."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.atomic import atomic_folder, write_json
from alpasim_plugin.errors import InputError
from alpasim_plugin.geometry import inverse, quat_from_yaw, se3
from alpasim_plugin.renderers import make_renderer
from alpasim_plugin.seeding import stream
from alpasim_plugin.training.perturbed_rollouts import Moment, Practice, practice_drives
from alpasim_plugin.training.policy_expert import SIGHT_M, leader_on, taught_path, taught_speeds
from alpasim_plugin.types import F64, CameraSpec, RenderRequest, Route, Scenario
from alpasim_plugin.world.route import route_in_rig
from policies.lane_camera import front_camera
from policies.learned_command import COMMANDS, route_command

LESSONS_FILE = "lessons.json"
LESSONS_VERSION = 2  # 1 drew all drives of a scene from one stream
READING = "reading lessons for the learned policy"
WIDE_PX, TOP_ROW = 352, 30  # frames are rendered wider than the policy looks, so that it can be turned; without most of the sky
MAX_TURN_RAD = np.deg2rad(8.5)


@dataclass(frozen=True)
class LessonRecipe:
    """What is made of a scene.

    Args:
        renderer: Whose frames.
        drives: Practice drives a scene.
        drive_s: Length of each, seconds; a frame every `MOMENT_S`.
        headings: In how many directions the car stands at each place; the first is along its drive.
        late_m: Standard deviation of where the navigation announces a turn.
    """

    renderer: str = "clean"
    drives: int = 3
    drive_s: float = 10.0
    headings: int = 5
    late_m: float = 2.5


_FORMS: dict[str, tuple[int, str]] = {
    "frames": (4, "uint8"),  # (F, 114, 352, 3)
    "frame": (1, "int32"),  # (N,) row in frames
    "before": (1, "int32"),  # (N,) row of the frame 0.5 s earlier; the frame itself where there is none
    "turn": (1, "float32"),  # (N,) radians by which the view is turned to the left
    "turn_before": (1, "float32"),  # (N,)
    "speed": (1, "float32"),  # (N,) metres per second
    "wanted": (1, "float32"),  # (N,) metres per second
    "command": (1, "int64"),  # (N,) index in COMMANDS
    "points": (3, "float32"),  # (N, 9, 2) metres
    "headings": (2, "float32"),  # (N, 9) radians
    "speeds": (2, "float32"),  # (N, 8) metres per second
    "gap": (1, "float32"),  # (N,) metres to whoever is ahead, at most SIGHT_M
    "leader": (1, "float32"),  # (N,) their speed, metres per second
}


def wide_camera(camera: CameraSpec) -> CameraSpec:
    """Return the camera with the same pixels on a wider, lower image."""
    K = camera.K.copy()
    K[0, 2] = WIDE_PX / 2
    K[1, 2] -= TOP_ROW
    return replace(camera, width=WIDE_PX, height=camera.height - TOP_ROW, K=K)


def make_lessons(scenario: Scenario, folder: Path, recipe: LessonRecipe, seed: int, threads: int = 1) -> bool:
    """Make the lessons of one scene unless the same ones are there already.

    Returns:
        Whether they were made now.

    Raises:
        InputError: The scene has no front camera.
        InfrastructureError: The disk refuses.
    """
    info = {"scene_id": scenario.scene_id, "scene_hash": scenario.content_hash, "seed": seed, "recipe": asdict(recipe)}
    info["version"] = LESSONS_VERSION
    path = folder / LESSONS_FILE
    if path.exists() and {k: v for k, v in json.loads(path.read_text(encoding="utf-8")).items() if k in info} == info:
        return False
    camera = wide_camera(front_camera(scenario))
    arrays = _lessons(scenario, camera, recipe, seed, threads)
    facts = {"K": camera.K.tolist(), "T_rig_camera": camera.T_rig_camera.tolist(), "lessons": len(arrays["frame"])}
    with atomic_folder(folder, "writing lessons") as partial:
        for name, array in arrays.items():
            np.save(partial / f"{name}.npy", array)
        write_json(partial / LESSONS_FILE, {**info, **facts})
    return True


def _lessons(scenario: Scenario, camera: CameraSpec, recipe: LessonRecipe, seed: int, threads: int) -> dict[str, Any]:
    random = stream(scenario.scene_id, seed, "training.policy.lessons")
    renderer = make_renderer(recipe.renderer, scenario, seed=seed, threads=threads)
    rows: dict[str, list[Any]] = {name: [] for name in _FORMS}
    for practice in practice_drives(scenario, recipe.drives, recipe.drive_s, seed):
        last: tuple[int, Moment] | None = None
        for moment in practice.moments:
            if not moment.free:
                last = None
                continue
            T = moment.T_world_rig @ camera.T_rig_camera
            rows["frames"].append(renderer.render(RenderRequest(moment.t_us, camera, np.stack([T, T]), moment.actors)).rgb)
            now = len(rows["frames"]) - 1
            for k in range(recipe.headings):
                _teach(rows, scenario, camera, practice, moment, now, last, 0.0 if k == 0 else float(random.uniform(-1, 1)), recipe, random)
            last = now, moment
    return {name: np.array(rows[name], dtype=dtype) for name, (_, dtype) in _FORMS.items()}


def _teach(
    rows: dict[str, list[Any]], scenario: Scenario, camera: CameraSpec, practice: Practice, moment: Moment, now: int,
    last: tuple[int, Moment] | None, turn: float, recipe: LessonRecipe, random: np.random.Generator,
) -> None:  # fmt: skip
    """Add one lesson: the car at a moment, standing turned about its camera."""
    turn_rad = MAX_TURN_RAD * turn
    pose = turned(moment.T_world_rig, camera, turn_rad)
    path = practice.line.path
    points, headings = taught_path(path, moment.s_m, pose, moment.speed_mps)
    box, axle_m = scenario.vehicle.box, scenario.vehicle.rear_axle_to_centre_m
    leader = leader_on(practice.line, moment.s_m, axle_m + box.length_m / 2, box.width_m / 2, moment.bodies)
    route = route_in_rig(Route(path.xyz[::4]), pose)
    earlier = last if last is not None and random.random() > 0.1 else (now, moment)
    # The earlier frame was taken on the way here, at nearly the same angle to the road.
    turn_before = float(np.clip(turn_rad + random.normal(0.0, 0.02), -MAX_TURN_RAD, MAX_TURN_RAD))
    lesson = {
        "frame": now, "before": earlier[0], "turn": turn_rad, "turn_before": turn_rad if earlier[0] == now else turn_before,
        "speed": moment.speed_mps, "wanted": practice.habit.wanted_mps,
        "command": COMMANDS.index(route_command(route, float(random.normal(0.0, recipe.late_m)))),
        "points": points, "headings": headings,
        "speeds": taught_speeds(practice.line, moment.s_m, moment.speed_mps, leader, practice.habit),
        "gap": min(leader.gap_m, SIGHT_M), "leader": leader.speed_mps,
    }  # fmt: skip
    for name, value in lesson.items():
        rows[name].append(value)


def turned(T_world_rig: F64, camera: CameraSpec, turn_rad: float) -> F64:
    """Return the rig's pose turned to the left about its camera, which stays where it is."""
    at = se3(camera.T_rig_camera[:3, 3], [1.0, 0.0, 0.0, 0.0])
    return np.asarray(T_world_rig @ at @ se3([0.0, 0.0, 0.0], quat_from_yaw(turn_rad)) @ inverse(at))


class Lessons:
    """The lessons of one scene, memory-mapped.

    Raises:
        InputError: The folder is not finished, or an array is of another form.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        try:
            self.info: dict[str, Any] = json.loads((folder / LESSONS_FILE).read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise InputError(READING, str(folder), str(error), "give a folder that 'simrun train policy-data' wrote") from error

    def __len__(self) -> int:
        return int(self.info["lessons"])

    @cached_property
    def camera(self) -> CameraSpec:
        """Give the camera of the frames."""
        shape = self.arrays["frames"].shape
        return CameraSpec("front", shape[2], shape[1], np.array(self.info["K"]), np.array(self.info["T_rig_camera"]))

    @cached_property
    def arrays(self) -> dict[str, Any]:
        """Give the arrays by name."""
        out = {}
        for name, (axes, dtype) in _FORMS.items():
            path = self.folder / f"{name}.npy"
            try:
                out[name] = np.load(path, mmap_mode="r", allow_pickle=False)
            except (OSError, ValueError) as error:
                raise InputError(READING, str(path), str(error), "make the lessons again") from error
            if out[name].ndim != axes or out[name].dtype != np.dtype(dtype):
                found = f"{out[name].dtype} with {out[name].ndim} axes"
                raise InputError(READING, str(path), found, f"{dtype} with {axes} axes is needed: make the lessons again")
        return out


def lessons_digest(lessons: Sequence[Lessons]) -> str:
    """Return what identifies some lessons as training data: scene, seed and recipe of each, in order."""
    return hashlib.blake2b(json.dumps([one.info for one in lessons], sort_keys=True).encode(), digest_size=8).hexdigest()


def read_lessons(root: Path, split: str) -> Sequence[Lessons]:
    """Return the finished scenes of a split in order of name.

    Raises:
        InputError: There is none.
    """
    folders = sorted(p.parent for p in (root / split).glob(f"*/{LESSONS_FILE}") if not p.parent.name.startswith("."))
    if not folders:
        raise InputError(READING, str(root / split), "no finished scene", "make some with 'simrun train policy-data'")
    return [lessons for lessons in map(Lessons, folders) if len(lessons)]
