"""`constant-velocity`, which never brakes, on the command line: it hits a leader that brakes,
however hard and to whatever speed, and no drive ends before it does.
"""

import json

import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.log.run_folder.schema import SUMMARY
from tests.examples import first_of

BRAKES = {
    "actors.leader.speed_mps": 11,
    "actors.leader.s_m": 24,
    "actors.leader.brake_at_us": 1_500_000,
    "ego.speed_mps": 11,
    "ego.cruise_mps": 11,
}
DRIVE = ["--renderer", "clean", "--policy", "constant-velocity", "--images", "none"]
ALONE = ["--workers", "1", "--quiet", "--no-report", "--video", "none"]
ENDS_MPS = (0, 4)


def settings(values):
    return [word for key, value in values.items() for word in ("--set", f"{key}={value}")]


def drive(root, *words):
    """Run a command, and return its summary."""
    assert run_command([*DRIVE, *ALONE, *words, "--out", str(root)]) == 0
    return json.loads((root / SUMMARY).read_text())


def endings(summary):
    (outcomes,) = summary["outcomes"].values()
    return {name: count for name, count in outcomes["endings"].items() if count}


def entry(scene, scene_id, values):
    return {"path": scene, "set": {**values, "scene_id": scene_id}}


def braking(decel_mps2, end_mps):
    values = {
        **BRAKES,
        "actors.leader.decel_mps2": decel_mps2,
        "actors.leader.end_speed_mps": end_mps,
    }
    return entry("hard/hard_brake", f"by-{decel_mps2:g}-to-{end_mps:g}", values)


GRID = [braking(decel_mps2, end_mps) for decel_mps2 in (1.5, 2, 3, 4, 5, 6) for end_mps in (0, 4)]
OTHERS = [
    entry("hard/hard_brake", "adversary", {"actors.leader.role": "adversary"}),
    entry("hard/crossing_pedestrian", "pedestrian", {}),
    entry("hard/cut_in_brake", "truck", {}),
]


@pytest.mark.parametrize(
    "scenes",
    first_of([[GRID[0], GRID[-1], OTHERS[0]], [*GRID[1:-1], *OTHERS[1:]]]),
    ids=["some", "others"],
)
def test_it_hits_whoever_brakes_or_steps_in_its_way(scenes, tmp_path):
    suite = tmp_path / "suite.yaml"
    suite.write_text(json.dumps({"version": 1, "scenarios": scenes}))
    assert endings(drive(tmp_path / "run", str(suite))) == {"collision": len(scenes)}


@pytest.mark.parametrize("values", first_of(["1..10/9", "1..10"], count=0))
def test_it_fails_over_the_whole_range_of_decelerations(values, tmp_path):
    # A leader that brakes with 1 m/s2 is reached after nine seconds.
    fixed = settings({**BRAKES, "timing.duration_us": 11_000_000})
    vary = ["--vary", f"actors.leader.decel_mps2={values}"]
    boundary = drive(tmp_path / "run", *fixed, *vary, "hard/hard_brake")["boundary"]
    (facts,) = boundary["variants"].values()
    (stretch,) = facts["stretches"]
    assert (stretch["low"], stretch["high"], stretch["least"]) == (1, 10, 1)
