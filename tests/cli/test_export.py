"""``simrun export``: run folders and scenes in the form that AlpaSim's evaluation takes, and the
same scores from them.
"""

from pathlib import Path

import pyarrow.parquet as pq
import pytest
import yaml

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.types import SensorSpec
from alpasim_plugin.log import read_asl
from alpasim_plugin.log.run_folder.manifests import read_run_json
from alpasim_plugin.log.run_folder.records import RunCounts
from alpasim_plugin.log.run_folder.schema import slug
from evaluators.alpasim import load_settings
from policies.simple import ConstantVelocity

FRONT = "camera_front_wide_120fov"
POLICIES = ("lane-camera", "tests.cli.test_export:Straight")


class Straight(ConstantVelocity):
    """Looks at the front camera and gives no sampled plans."""

    sensors = (SensorSpec("front"),)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Two policies, two seeds, in a scene without other road users: an infinite distance to the
    nearest one.
    """
    root = tmp_path_factory.mktemp("runs") / "own"
    command = [
        "--renderer",
        "clean",
        "--policy",
        ",".join(POLICIES),
        "--seeds",
        "2",
        "--workers",
        "1",
        "--quiet",
        "--no-report",
    ]
    timing = [
        "--set",
        "timing.duration_us=500000",
        "--set",
        "timing.warmup_us=200000",
        "--preset",
        "alpasim",
    ]
    assert run_command([*command, *timing, "--out", str(root), "smoke/straight"]) == 0
    return root


@pytest.fixture(scope="module")
def exported(run):
    out = run.parent / "exported"
    assert run_command(["export", str(run), "--alpasim", str(out)]) == 0
    return out


def test_run_json_says_what_was_asked_and_of_which_commit_and_code(run):
    info = read_run_json(run)
    assert info.asked == ("smoke/straight",)
    assert info.outcome == RunCounts(n_rollouts=4, n_failed=0)
    # The tests may run outside a repository.
    assert (info.project.commit is None) == bool(info.project.reason)
    assert all(len(info.code[name]) == 12 for name in ("loop", "scoring"))


def logs(exported, policy):
    return sorted((exported / "clean" / slug(policy) / "rollouts").glob("*/*/rollout.asl"))


def test_each_renderer_and_policy_has_a_run_folder_of_alpasims_form(exported):
    for policy in POLICIES:
        folder = exported / "clean" / slug(policy)
        found = logs(exported, policy)
        assert len(found) == 2
        assert all((log.parent / "_complete").is_file() for log in found)
        assert {log.parent.parent.name for log in found} == {"smoke-straight"}
        assert set(yaml.safe_load((folder / "run_metadata.yaml").read_text())) == {
            "run_uuid",
            "run_name",
        }
        wizard = yaml.safe_load((folder / "wizard-config.yaml").read_text())
        assert sorted(
            Path(wizard["scenes"]["scene_cache"], wizard["scenes"]["sceneset_path"]).glob(
                "**/*.usdz"
            )
        )
        settings = load_settings(folder / "eval-config.yaml")
        assert settings.parse_unstructured_debug_info is False
    names = {
        yaml.safe_load((exported / "clean" / slug(p) / "run_metadata.yaml").read_text())["run_uuid"]
        for p in POLICIES
    }
    assert len(names) == 2


def test_session_ids_sort_as_seeds_and_cameras_have_alpasims_name(exported):
    for policy in POLICIES:
        read = [read_asl(log) for log in logs(exported, policy)]
        assert [one.seed for one in read] == [0, 1]
        assert [one.session_uuid for one in read] == [
            log.parent.name for log in logs(exported, policy)
        ]
        for one in read:
            assert {image.camera for image in one.images} == {FRONT}
            assert [image.end_us for image in one.images] == [
                int(t) for t in one.ego.t_us[:-1] if t >= one.render_start_us
            ]
            assert [camera.name for camera in one.info["cameras"]] == [FRONT]


def test_scores_of_the_export_are_those_of_the_run(run, exported, tmp_path):
    before = pq.read_table(run / "rollouts.parquet").to_pylist()
    wanted = {(row["policy"], row["seed"]): row for row in before}
    command = ["score", str(exported), "--preset", "alpasim"]
    for scene in ("smoke/straight", str(exported / "scenes")):
        out = tmp_path / Path(scene).name
        assert (
            run_command([*command, "--scene", scene, "--out", str(out)]) == 0
        )  # two policies in one go
        rows = pq.read_table(out / "rollouts.parquet").to_pylist()
        assert len({row["rollout"] for row in rows}) == 4
        for row in rows:
            own = wanted[row["policy"], row["seed"]]
            for name in (
                "min_distance_to_lane_boundary_m",
                "progress_rel",
                "dist_to_gt_trajectory",
                "plan_deviation",
                "offroad",
            ):
                assert row[name] == pytest.approx(own[name], abs=1e-9), name
            assert (
                row["min_distance_to_obstacle_m"]
                == own["min_distance_to_obstacle_m"]
                == float("inf")
            )
        steps = pq.read_table(out / "steps.parquet").to_pylist()
        assert {row["value"] for row in steps if row["metric"] == "min_distance_to_obstacle_m"} == {
            float("inf")
        }
        assert (out / "aggregate" / "results-summary.json").is_file()


def test_refusals_say_what_to_do(run, exported, tmp_path, capsys):
    assert run_command(["export", str(run), "--alpasim", str(exported)]) == 2
    assert "not empty" in capsys.readouterr().err
    assert (
        run_command(["export", str(run), "smoke/straight", "--alpasim", str(tmp_path / "out")]) == 2
    )
    assert "one run at a time" in capsys.readouterr().err
    scored = tmp_path / "scored"
    assert (
        run_command(
            [
                "score",
                str(run),
                "--scene",
                "smoke/straight",
                "--out",
                str(scored),
            ]
        )
        == 0
    )
    assert run_command(["export", str(scored), "--alpasim", str(tmp_path / "out")]) == 2
    assert "without the logs" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
