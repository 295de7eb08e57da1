"""Recorded logs without what a reader can do without, and what is named by mistake."""

from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.plan_check import sensors_problem
from alpasim_plugin.core.types import CameraSpec, SensorSpec
from scenarios.argoverse import read_argoverse
from scenarios.commonroad_map import read_lanelets
from scenarios.load import load_scenario
from scenarios.suite import load_suite
from tests.scenarios.make_argoverse import TRACKS, cuboids, write_argoverse
from tests.scenarios.make_commonroad import lanelet


@pytest.mark.parametrize("empty", [False, True])
def test_an_argoverse_log_of_the_test_split_drives_alone(tmp_path, empty):
    none = {key: np.array(value)[:0] for key, value in cuboids(TRACKS).items()}
    folder = write_argoverse(tmp_path / "x", annotations=none)
    if not empty:
        (folder / "annotations.feather").unlink()
    log = read_argoverse(folder)
    assert log.actors == ()
    assert "test split" in str(log.notes)
    assert load_scenario(folder).actors == ()


@pytest.mark.parametrize(
    ("name", "advice"),
    [
        ("street.ply", "import splat"),
        ("street.spz", "import splat"),
        ("film.mp4", "COLMAP"),
        ("a/transforms.json", "import drive"),
        ("a/calib.txt", "import drive"),
        ("a/sparse/0/cameras.bin", "import drive"),
        ("a/cameras.txt", "import drive"),
    ],
)
def test_what_becomes_a_scenario_by_an_import_names_the_command(tmp_path, name, advice):
    file = tmp_path / name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(b"x")
    given = file if "/" not in name else tmp_path / "a"
    with pytest.raises(InputError) as caught:
        load_suite(given)[0] and load_scenario(given)
    assert advice in caught.value.hint


def test_a_policy_that_asks_for_a_camera_instead_of_its_name_is_told_so():
    camera = CameraSpec("front", 8, 8, np.eye(3), np.eye(4))
    assert "CameraSpec" in sensors_problem((SensorSpec(camera),))  # type: ignore[arg-type]
    assert not sensors_problem((SensorSpec("front"),))


def test_lanelets_of_an_unknown_type_are_said(tmp_path):
    types = "".join(f"<laneletType>{name}</laneletType>" for name in ("urban", "restricted"))
    root = ElementTree.fromstring(
        f'<commonRoad timeStepSize="0.1">{lanelet(1, 0, 50, 0, types)}</commonRoad>'
    )
    _, notes = read_lanelets(Path("a.xml"), root, np.zeros(3))
    assert "restricted" in str(notes)
    assert "urban" not in str(notes)
