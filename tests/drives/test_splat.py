"""A trained model of the user's own drives: in a unit of its own, without harmonics, with broken
Gaussians; and not in another frame.
"""

import json

import numpy as np
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.drives.splat import import_splat
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.files.ply import write_ply
from alpasim_plugin.world.ground import height_at
from scenarios.load import load_scenario
from tests.drives.splat_model import poses_of, street_cloud
from tests.drives.street import COUNT, STEP_M, write_colmap
from tests.gaussians.packed_writers import write_splat

pytestmark = pytest.mark.slow


def assert_drives(out):
    scenario = load_scenario(out / "scenario.yaml")
    ego = scenario.ego_log.xyz
    assert np.linalg.norm(ego[-1] - ego[0]) == pytest.approx((COUNT - 1) * STEP_M, rel=0.05)
    assert np.abs(ego[:, 2] - height_at(scenario.ground, ego)).max() < 0.08
    assert scenario.model


def test_a_model_in_a_unit_of_its_own_and_upside_down(tmp_path):
    turn = np.diag([1.0, -1.0, -1.0])
    write_ply(tmp_path / "street.ply", street_cloud(turn=turn))
    quality = import_splat(
        tmp_path / "street.ply", poses_of(tmp_path / "poses", turn=turn), tmp_path / "out"
    )
    assert_drives(tmp_path / "out")
    assert any("no photographs" in note for note in quality["notes"])
    assert any(
        "assumed; `simrun import drive` takes --camera-height" in note for note in quality["notes"]
    )
    assert (
        run_command(
            [
                "view",
                str(tmp_path / "out" / "scenario.yaml"),
                "--out",
                str(tmp_path / "street.png"),
            ]
        )
        == 0
    )
    assert (tmp_path / "street.png").stat().st_size > 10_000
    assert quality["photographs"] == {}
    assert load_scenario(tmp_path / "out/scenario.yaml").recording == ()
    assert quality["coverage"][0]["share"] > 0.5


def test_a_splat_without_harmonics_with_photographs_is_measured(tmp_path, capsys):
    write_splat(tmp_path / "street.splat", street_cloud())
    poses = poses_of(tmp_path / "poses", photographs=True)
    command = [
        "import",
        "splat",
        str(tmp_path / "street.splat"),
        "--poses",
        str(poses),
        "--out",
        str(tmp_path / "out"),
        "--json",
    ]
    assert run_command(command) == 0
    told = json.loads(capsys.readouterr().out)
    assert "held-out" in told
    assert_drives(tmp_path / "out")


def test_broken_gaussians_are_left_out_and_said(tmp_path):
    cloud = street_cloud(0.5)
    means = np.array(cloud.means)
    broken = GaussianCloud(means, cloud.quats, cloud.scales, cloud.opacities, cloud.sh)
    write_ply(tmp_path / "street.ply", broken)
    data = bytearray((tmp_path / "street.ply").read_bytes())
    body = data.index(b"end_header\n") + len(b"end_header\n")
    data[body : body + 4] = np.float32(np.nan).tobytes()
    (tmp_path / "street.ply").write_bytes(bytes(data))
    quality = import_splat(
        tmp_path / "street.ply", write_colmap(tmp_path / "poses", True), tmp_path / "out"
    )
    assert any("1 " in note and "17999" in note.replace(",", "") for note in quality["notes"])
    assert_drives(tmp_path / "out")


def test_poses_of_another_frame_are_refused_and_nothing_is_left(tmp_path):
    write_ply(tmp_path / "street.ply", street_cloud())
    poses = poses_of(tmp_path / "poses", scale=30.0)
    before = sorted(path.name for path in tmp_path.iterdir())
    with pytest.raises(InputError) as caught:
        import_splat(tmp_path / "street.ply", poses, tmp_path / "out")
    assert "0.0 %" in caught.value.message
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_a_model_that_hangs_below_its_road_is_refused(tmp_path):
    cloud = street_cloud()
    flipped = GaussianCloud(
        cloud.means * [1, 1, -1], cloud.quats, cloud.scales, cloud.opacities, cloud.sh
    )
    write_ply(tmp_path / "street.ply", flipped)
    with pytest.raises(InputError):
        import_splat(tmp_path / "street.ply", poses_of(tmp_path / "poses"), tmp_path / "out")
    assert not (tmp_path / "out").exists()
