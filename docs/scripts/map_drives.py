"""Drive policies along drawn routes of maps among reactive vehicles, and print how the drives ended
and what happened among the other road users.

Usage: python docs/scripts/map_drives.py FOLDER MAP... [--policies P,P] [--routes N] [--length M]
[--lights]; it continues when it is interrupted. The seeds of the routes are 0, 1, ...; with
``--lights`` those whose route passes no traffic light are left out.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import shapely
from pages import table

from alpasim_plugin.core.files import file_sha256
from alpasim_plugin.core.geometry import rectangle_corners, yaw_from_quat
from alpasim_plugin.core.parts.source import package_digest
from alpasim_plugin.core.types import Actor, Frame, RenderRequest, RolloutLog, Scenario
from alpasim_plugin.log.run_folder.rows import Rollout
from alpasim_plugin.runs.renderer import make_renderer
from alpasim_plugin.runs.rollout import run_rollout
from alpasim_plugin.runs.scoring import tabulate
from alpasim_plugin.world.path import smooth_path, thinned
from alpasim_plugin.world.signals import lights_on
from evaluators import score
from evaluators.metrics.outcomes import ending_of
from policies.base import make_policy
from scenarios.load import load_scenario

POLICIES = "rule-based,log-replay,pure-pursuit,constant-velocity,lane-camera,learned"
PRESET = "strict"
SCENE = """version: 1
seed: {seed}
map: {{opendrive: {path}, route: {{length_m: {length_m:g}}}, vehicles: 8}}
"""
LEVEL_M = 2.0  # boxes whose middles are farther apart in height do not touch
JUMP_MPS2 = 12.0  # what no tyre gives
STANDS_MPS = 0.1
AT_LINE_M = 8.0  # from the middle of the ego to the line of a light that it has just passed
TRIES = 20  # routes are drawn for each that shall pass a light
CYCLES = 2  # of a light, for which a road user may stand


class Nothing:
    """The renderer of policies without a camera."""

    def render(self, request: RenderRequest) -> Frame:
        """Refuse to render."""
        raise AssertionError(f"a frame of {request.camera.name} was asked for")


@dataclass(frozen=True)
class Drive:
    """How one drive ended, and what happened around it.

    Attributes:
        ending: In the words of the run's tables.
        drive_s, expert_s: How long the policy and the expert drove, seconds.
        ran_red: Whether it ran a red light.
        false_red: Whether no red light held the lane where it is said to have run one.
        vehicles: How many other road users there were.
        contacts: Pairs of them that touch at some step.
        jumps: Those whose speed changes at some step by more than tyres can.
        hardest_mps2: The greatest change of speed among them, m/s^2.
        longest_stand_s: The longest time that a vehicle among them stands, seconds.
        cycle_s: The longest cycle of the lights, seconds; 0 without lights.
    """

    ending: str
    drive_s: float
    expert_s: float
    ran_red: bool
    false_red: bool
    vehicles: int
    contacts: int
    jumps: int
    hardest_mps2: float
    longest_stand_s: float
    cycle_s: float

    @property
    def stands_too_long(self) -> bool:
        """Tell whether a vehicle stood for longer than `CYCLES` of the lights."""
        return self.cycle_s > 0 and self.longest_stand_s > CYCLES * self.cycle_s


def drive(scenario: Scenario, policy: str) -> Drive:
    """Drive a scene once with a policy, and look at every step of the log."""
    driver = make_policy(policy, scenario)
    renderer = make_renderer("clean", scenario) if driver.sensors else Nothing()
    recorder = run_rollout(scenario, renderer, driver)
    log = recorder.log(images=False)
    _, scores = tabulate(log, score(log, scenario.scene, PRESET), PRESET)
    values = {name: metric.value for name, metric in scores.metrics.items() if metric.valid}
    rollout = Rollout("clean", policy, scenario.scene_id, 0, "ok", metrics=values)
    reds_us = [event.t_us for event in scores.events if event.metric == "red_light"]
    actors = list(log.actors.values())
    pairs = [
        (first, second)
        for number, first in enumerate(actors)
        for second in actors[number + 1 :]
        if touch(first, second)
    ]
    moves = [(actor, speeds(actor)) for actor in actors if len(actor.track) > 2]
    changes = [hardest_mps2(*move) for move in moves]
    signals = scenario.lane_map.signals or ()
    return Drive(
        ending_of(rollout),
        (log.ego.t_us[-1] - log.ego.t_us[0]) * 1e-6,
        (log.ego_log.t_us[-1] - log.ego_log.t_us[0]) * 1e-6,
        len(reds_us) > 0,
        not all(is_held(scenario, log, t_us) for t_us in reds_us),
        len(actors),
        len(pairs),
        sum(change > JUMP_MPS2 for change in changes),
        max(changes, default=0.0),
        max(
            (longest_stand_s(*move) for move in moves if move[0].label != "pedestrian"), default=0.0
        ),
        max((sum(us for _, us in signal.phases) * 1e-6 for signal in signals), default=0.0),
    )


def is_held(scenario: Scenario, log: RolloutLog, t_us: int) -> bool:
    """Return whether a red light at which the ego is holds a lane of its route."""
    row = int(np.searchsorted(log.ego.t_us, t_us))
    place = shapely.Point(log.ego.xyz[row, :2])
    return any(
        signal.colour_at(t_us) == "red"
        and not set(signal.lanes).isdisjoint(scenario.route.lane_ids)
        and shapely.LineString(signal.stop[:, :2]).distance(place) < AT_LINE_M
        for signal in scenario.lane_map.signals or ()
    )


def touch(first: Actor, second: Actor) -> bool:
    """Return whether two boxes touch at a time of both tracks."""
    _, row, other_row = np.intersect1d(first.track.t_us, second.track.t_us, return_indices=True)
    apart = first.track.xyz[row] - second.track.xyz[other_row]
    near = np.hypot(apart[:, 0], apart[:, 1]) < (first.box.length_m + second.box.length_m) / 2 + 2.0
    near &= np.abs(apart[:, 2]) < LEVEL_M
    shapes = [outlines(first, row[near]), outlines(second, other_row[near])]
    return bool(shapely.intersects(*shapes).any())


def outlines(actor: Actor, rows: np.ndarray) -> np.ndarray:
    """Return the boxes of an actor at rows of its track as polygons."""
    size = np.tile([actor.box.length_m, actor.box.width_m], (len(rows), 1))
    yaw = yaw_from_quat(actor.track.quat[rows])
    return shapely.polygons(rectangle_corners(actor.track.xyz[rows, :2], yaw, size))


def speeds(actor: Actor) -> np.ndarray:
    """Return the speed between the poses of a track, m/s."""
    steps = np.hypot(*np.diff(actor.track.xyz[:, :2], axis=0).T)
    return np.asarray(steps / (np.diff(actor.track.t_us) * 1e-6))


def hardest_mps2(actor: Actor, speed_mps: np.ndarray) -> float:
    """Return the greatest change of speed a second between the steps of a track."""
    seconds = np.diff(actor.track.t_us[:-1]) * 1e-6
    return float(np.abs(np.diff(speed_mps) / seconds).max())


def longest_stand_s(actor: Actor, speed_mps: np.ndarray) -> float:
    """Return the longest time for which a track stands, seconds."""
    longest_s = stood_s = 0.0
    for speed, dt_us in zip(speed_mps, np.diff(actor.track.t_us), strict=True):
        stood_s = stood_s + dt_us * 1e-6 if speed < STANDS_MPS else 0.0
        longest_s = max(longest_s, stood_s)
    return longest_s


def scenes_of(folder: Path, path: Path, options: argparse.Namespace) -> Iterator[Path]:
    """Write the scenes of a map, and yield as many as are wanted, by rising seed."""
    scenes = folder / "scenes"
    scenes.mkdir(parents=True, exist_ok=True)
    seed = wanted = 0
    while wanted < options.routes:
        if seed >= TRIES * options.routes:
            raise SystemExit(f"{path}: {wanted} of {seed} routes pass a light; leave --lights out")
        scene = scenes / f"{path.stem.lower()}_{seed}.yaml"
        text = SCENE.format(seed=seed, path=path.resolve(), length_m=options.length)
        scene.write_text(text, encoding="utf-8")
        if not options.lights or passes_light(scene):
            wanted += 1
            yield scene
        seed += 1


@lru_cache(maxsize=1)
def loaded(scene: Path) -> Scenario:
    """Return a scene, which the expert drives once for all policies."""
    return load_scenario(scene)


def passes_light(scene: Path) -> bool:
    """Return whether the route of a scene passes a traffic light before its goal."""
    scenario = loaded(scene)
    lane_map = scenario.lane_map
    line = scenario.ego_log.xyz
    path = smooth_path(line[thinned(line, 1.0)])
    return len(lights_on(path, lane_map.signals, lane_map.lanes)) > 0


def drives_of(folder: Path, path: Path, options: argparse.Namespace) -> dict[str, list[Drive]]:
    """Drive the routes of one map with every policy; drives of before are read back."""
    drives: dict[str, list[Drive]] = {policy: [] for policy in options.policies.split(",")}
    for scene in scenes_of(folder, path, options):
        for policy, done in drives.items():
            record = folder / "drives" / f"{scene.stem}-{policy}.json"
            done.append(driven_once(record, scene, policy, file_sha256(path)))
            print(record.stem, done[-1], flush=True)
    return drives


def driven_once(record: Path, scene: Path, policy: str, map_sha256: str) -> Drive:
    """Return a drive, from its record where the scene, its map and the program are the same."""
    made_by = {
        "scene": file_sha256(scene),
        "map": map_sha256,
        "program": package_digest(),
    }
    if record.exists():
        stored = json.loads(record.read_text(encoding="utf-8"))
        if stored.get("made_by") != made_by:
            raise SystemExit(f"{record}: of another scene, map or program; name another folder")
        return Drive(**stored["drive"])
    result = drive(loaded(scene), policy)
    record.parent.mkdir(exist_ok=True)
    record.write_text(json.dumps({"made_by": made_by, "drive": asdict(result)}), encoding="utf-8")
    return result


def row_of(name: str, policy: str, drives: list[Drive]) -> list[str]:
    """Return a row of the table: one map, one policy."""
    endings = [part.ending for part in drives]
    return [
        name,
        f"`{policy}`",
        ", ".join(f"{endings.count(kind)} {kind}" for kind in dict.fromkeys(endings)),
        f"{sum(part.ran_red for part in drives)} of {len(drives)}",
        str(sum(part.false_red for part in drives)),
        str(sum(part.vehicles for part in drives)),
        str(sum(part.contacts for part in drives)),
        str(sum(part.jumps for part in drives)),
        f"{max(part.hardest_mps2 for part in drives):.1f}",
        f"{max(part.longest_stand_s for part in drives):.0f}",
        str(sum(part.stands_too_long for part in drives)),
    ]


HEAD = [
    "map", "policy", "drives that ended", "`red_light`", "of them false", "other road users",
    "pairs in contact", "jumps", "hardest, m/s²", "longest wait, s", "longer than two cycles",
]  # fmt: skip

if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("maps", type=Path, nargs="+")
    parser.add_argument("--policies", default=POLICIES)
    parser.add_argument("--routes", type=int, default=12)
    parser.add_argument("--length", type=float, default=300.0)
    parser.add_argument("--lights", action="store_true")
    chosen = parser.parse_args()
    lines = []
    for file in chosen.maps:
        driven = drives_of(chosen.folder, file, chosen)
        lines += [row_of(file.stem, policy, drives) for policy, drives in driven.items()]
    print(table(HEAD, lines))
