"""Drive policies along drawn routes of maps among reactive vehicles, and print how the drives ended
and what happened among the other road users.

Usage: python docs/scripts/map_drives.py FOLDER MAP... [--policies P,P] [--routes N] [--length M]; it
continues when it is interrupted. The seeds of the routes are 0 to N - 1.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import shapely
from pages import table

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.geometry import rectangle_corners, yaw_from_quat
from alpasim_plugin.core.types import Actor, RolloutLog
from alpasim_plugin.log import read_asl
from alpasim_plugin.log.run_folder.reader import Run
from alpasim_plugin.log.run_folder.schema import LOG_NAME
from evaluators.metrics.outcomes import ending_of

POLICIES = "rule-based,pure-pursuit,constant-velocity,log-replay"
SCENE = """version: 1
seed: {seed}
map: {{opendrive: {path}, route: {{length_m: {length_m:g}}}, vehicles: 8}}
"""
LEVEL_M = 2.0  # boxes whose middles are farther apart in height do not touch
JUMP_MPS2 = 12.0  # what no tyre gives
STANDS_MPS = 0.1


@dataclass(frozen=True)
class Traffic:
    """What happened among the other road users of one rollout.

    Attributes:
        vehicles: How many there were.
        contacts: Pairs that touch at some step.
        jumps: Road users whose speed changes at some step by more than tyres can.
        longest_stand_s: The longest time that one stands.
    """

    vehicles: int
    contacts: int
    jumps: int
    longest_stand_s: float

    @classmethod
    def of(cls, log: RolloutLog) -> Traffic:
        """Look at every step of a log."""
        actors = list(log.actors.values())
        pairs = [
            (first, second)
            for number, first in enumerate(actors)
            for second in actors[number + 1 :]
            if touch(first, second)
        ]
        moves = [(actor, speeds(actor)) for actor in actors if len(actor.track) > 2]
        return cls(
            len(actors),
            len(pairs),
            sum(hardest_mps2(actor, speed_mps) > JUMP_MPS2 for actor, speed_mps in moves),
            max((longest_stand_s(actor, speed_mps) for actor, speed_mps in moves), default=0.0),
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


def drive(folder: Path, path: Path, options: argparse.Namespace) -> Run:
    """Drive the routes of one map with every policy."""
    scenes = folder / "scenes" / path.stem
    scenes.mkdir(parents=True, exist_ok=True)
    for seed in range(options.routes):
        text = SCENE.format(seed=seed, path=path.resolve(), length_m=options.length)
        (scenes / f"{path.stem.lower()}_{seed}.yaml").write_text(text, encoding="utf-8")
    out = folder / path.stem
    kept = ["--video", "none", "--images", "none", "--no-report", "-j", "1"]
    variants = ["--renderer", "clean", "--policy", options.policies, "--seeds", "1"]
    run_command([*variants, *kept, str(scenes), "--out", str(out)])
    return Run.read_so_far(out)


def row_of(run: Run, name: str, policy: str) -> list[str]:
    """Return a row of the table: one map, one policy."""
    rollouts = [rollout for rollout in run.rollouts if rollout.policy == policy]
    endings = [ending_of(rollout) for rollout in rollouts]
    lights = [rollout.metrics.get("red_light") for rollout in rollouts]
    files = [run.file_of(rollout, LOG_NAME) for rollout in rollouts]
    traffic = [Traffic.of(read_asl(file)) for file in files if file is not None]
    counted = ", ".join(f"{endings.count(kind)} {kind}" for kind in dict.fromkeys(endings))
    return [
        name,
        f"`{policy}`",
        counted,
        f"{sum(1 for value in lights if value)} of {len(lights)}",
        str(sum(part.vehicles for part in traffic)),
        str(sum(part.contacts for part in traffic)),
        str(sum(part.jumps for part in traffic)),
        f"{max((part.longest_stand_s for part in traffic), default=0.0):.0f}",
    ]


HEAD = ["map", "policy", "ended", "red light", "road users", "contacts", "jumps", "stood, s"]

if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("maps", type=Path, nargs="+")
    parser.add_argument("--policies", default=POLICIES)
    parser.add_argument("--routes", type=int, default=12)
    parser.add_argument("--length", type=float, default=300.0)
    chosen = parser.parse_args()
    lines = []
    for file in chosen.maps:
        driven = drive(chosen.folder, file, chosen)
        lines += [row_of(driven, file.stem, policy) for policy in chosen.policies.split(",")]
    print(table(HEAD, lines))
