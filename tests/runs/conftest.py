"""A scene small enough for tests of the loop: a straight two-lane road, one car ahead, one on the
shoulder.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from alpasim_plugin.core.geometry import quat_from_yaw
from alpasim_plugin.core.types import (
    Actor,
    Box,
    CameraSpec,
    Degradation,
    Environment,
    Lane,
    LaneMap,
    Latency,
    Rates,
    Route,
    Scenario,
    Trajectory,
    Vehicle,
)
from alpasim_plugin.log import read_asl
from alpasim_plugin.log.run_folder.rows import series_by_rollout
from alpasim_plugin.world.ground import flat
from evaluators.statistics.opening import Run, read_run
from tests.camera_builders import ahead
from tests.core.checksum_files import vouch_for
from tests.pages.make_run import Plan
from tests.pages.make_watched import make_watched

SMALL = Plan(
    renderers=("clean", "3dgs"),
    scenes=("urban-left_turn",),
    seeds=(0, 1),
    steps=8,
    fail=[("3dgs", "urban-left_turn", 1)],
)


def straight_track(
    x0_m,
    y_m,
    z_m,
    speed_mps,
    duration_s,
):
    """Return a track along x at constant speed."""
    t_us = np.arange(0, int(duration_s * 1e6) + 1, 10_000, dtype=np.int64)
    x = x0_m + speed_mps * t_us * 1e-6
    xyz = np.stack([x, np.full_like(x, y_m), np.full_like(x, z_m)], axis=1)
    return Trajectory(t_us, xyz, quat_from_yaw(np.zeros(len(t_us))))


@pytest.fixture
def straight_road():
    """Give 3 s at 10 m/s in the right lane of a straight road; 1 s of it is warm-up."""
    x = np.linspace(-50.0, 250.0, 151)

    def line(y_m):
        return np.stack([x, np.full_like(x, y_m), np.zeros_like(x)], axis=1)

    lanes = {
        "right": Lane(
            "right",
            line(0.0),
            line(1.75),
            line(-1.75),
            left_neighbour="left",
            left_mark_type="dashed_white",
        ),
        "left": Lane(
            "left",
            line(3.5),
            line(5.25),
            line(1.75),
            right_neighbour="right",
            left_mark_type="solid_white",
        ),
    }
    camera = CameraSpec(
        "front",
        96,
        64,
        np.array([[60.0, 0, 48], [0, 60.0, 32], [0, 0, 1]]),
        ahead(x_m=1.5),
    )
    return Scenario(
        scene_id="straight-road",
        source="yaml",
        seed=0,
        lane_map=LaneMap(lanes, road_edges=(line(5.25), line(-1.75))),
        ground=flat(),
        ego_log=straight_track(0.0, 0.0, 0.0, 10.0, 3.0),
        vehicle=Vehicle(),
        route=Route(line(0.0), ("right",)),
        actors=(
            Actor("ahead", "car", Box(4.5, 1.8, 1.5), straight_track(30.0, 0.0, 0.75, 10.0, 3.0)),
            Actor(
                "parked",
                "car",
                Box(4.5, 1.8, 1.5),
                straight_track(20.0, 3.5, 0.75, 0.0, 3.0),
                is_static=True,
            ),
        ),
        cameras=(camera,),
        rates=Rates(),
        start_us=0,
        end_us=3_000_000,
        warmup_us=1_000_000,
        latency=Latency(),
        environment=Environment(buildings=0.0, trees_per_100m=0.0, poles_spacing_m=0.0),
        degradation=Degradation("none"),
        content_hash="straight-road-test",
    )


@dataclass
class Watched:
    """A small run with logs: two renderers, one scene, two seeds (3dgs failed in the second), eight
    steps, two cameras.
    """

    folder: Path
    run: Run

    def log(self, renderer):
        return read_asl(
            self.folder
            / "rollouts"
            / renderer
            / "lane-camera"
            / "urban-left_turn"
            / "0"
            / "rollout.asl"
        )

    def metrics(self, renderer):
        (rollout,) = (r for r in self.run.rollouts if (r.renderer, r.seed) == (renderer, 0))
        (own,) = series_by_rollout(self.run.steps_of(rollout)).values()
        return {
            name: list(zip(t.tolist(), v.tolist(), strict=True)) for name, (t, v) in own.items()
        }


@pytest.fixture(scope="session")
def watched(tmp_path_factory):
    folder = make_watched(
        tmp_path_factory.mktemp("recorded"), SMALL, actors=4, cameras=("front", "side")
    )
    return Watched(vouch_for(folder), read_run(folder))
