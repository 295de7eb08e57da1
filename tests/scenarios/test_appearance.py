"""An actor of a built road that looks like a Gaussian file, and files that are no such actor."""

import numpy as np
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.gaussians.files.ply import write_ply
from alpasim_plugin.gaussians.fit.start import cloud_from_points
from alpasim_plugin.streets.build_actors import build_actors
from scenarios.load import load_scenario

ROAD = """version: 1
road: {segments: [{kind: straight, length_m: 200}]}
actors:
  - {id: lead, kind: drive, s_m: 20, speeds: [[0, 10]]%s}
"""


def written(folder, half, more=", appearance: car.ply"):
    rng = np.random.default_rng(0)
    points = rng.uniform(-1.0, 1.0, (200, 3)) * half
    write_ply(folder / "car.ply", cloud_from_points(points, np.full((200, 3), 0.5)))
    (folder / "scene.yaml").write_text(ROAD % more)
    return load_scenario(folder / "scene.yaml")


def test_an_actor_looks_like_its_file_and_the_scene_is_another_one(tmp_path):
    built = written(tmp_path, (2.2, 0.9, 0.7), "")
    made = written(tmp_path, (2.2, 0.9, 0.7))
    plain, own = (build_actors(scenario)[0] for scenario in (built, made))
    assert (len(plain.levels), len(own.levels)) == (3, 1)
    assert 200 < len(own.levels[0].cloud) < 210
    other = written(tmp_path, (2.1, 0.9, 0.7))
    assert len({one.content_hash for one in (built, made, other)}) == 3


def test_a_file_without_gaussians_and_one_for_a_row_of_vehicles_are_refused(tmp_path):
    written(tmp_path, (2.2, 0.9, 0.7))
    scene = tmp_path / "scene.yaml"
    file = tmp_path / "car.ply"
    write_ply(file, cloud_from_points(np.zeros((0, 3)), np.zeros((0, 3))))
    with pytest.raises(InputError):
        build_actors(load_scenario(scene))
    scene.write_text(
        scene.read_text().replace("drive, s_m: 20, speeds: [[0, 10]]", "parked, s_m: 20, count: 2")
    )
    with pytest.raises(InputError):
        load_scenario(scene)


def test_a_run_refuses_an_appearance_that_is_larger_than_what_is_hit(tmp_path):
    written(tmp_path, (4.0, 0.9, 0.7))
    assert run_command(["--renderer", "clean", "--dry-run", str(tmp_path / "scene.yaml")]) == 2


@pytest.mark.parametrize(
    ("half", "file"), [((4.0, 0.9, 0.7), "car.ply"), ((2, 0.9, 0.7), "no.ply")]
)
def test_a_file_that_is_larger_than_the_actor_or_missing_is_named(tmp_path, half, file):
    with pytest.raises(InputError) as caught:
        build_actors(written(tmp_path, half, f", appearance: {file}"))
    assert file in caught.value.message
