"""The distance between plans made of true images and of a renderer's: what is compared, in which
frame, and what is refused.
"""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.interfaces import Policy
from alpasim_plugin.core.parts import resolve, resolve_renderer
from alpasim_plugin.core.parts.spec import short_digest
from alpasim_plugin.core.types import CameraSpec, Plan, PlanRange, SensorSpec
from alpasim_plugin.lab.bench.drawn_series import drawn_series, offset_requests
from alpasim_plugin.lab.bench.open_loop import TrueImage, plans_of, roles_of
from alpasim_plugin.lab.bench.plan_gap import (
    BLOCK_S,
    GAPS,
    brakes,
    gap_intervals,
    gap_of,
    gap_ranges,
    gap_rows,
    is_near,
    pose_at,
)
from alpasim_plugin.lab.bench.real import series_of, shots_of
from alpasim_plugin.lab.cli import bench_real
from alpasim_plugin.lab.cli.range_file import check_target, write_ranges
from scenarios.load import load_scenario
from tests.renderers.recorded_drive import recorded_drive

HERE = "tests.lab.bench.test_plan_gap"


class Steers(Policy):
    """Plan 10 m/s along an arc whose end lies a metre to the left for each 100 levels of the upper
    half, after two seconds; remember what was seen.
    """

    sensors = (SensorSpec("front"),)

    def __init__(self, scenario):
        self.cameras = {camera.name: camera for camera in scenario.cameras}
        self.seen = []
        SEEN.append(self.seen)

    def reset(self, seed, route):
        self.seed = seed

    def act(self, observation):
        self.seen.append(observation)
        image = observation.frames["front"].rgb
        level = float(image[: len(image) // 2].mean())
        times_us = observation.t_us + 100_000 * np.arange(51)
        t_s = 0.1 * np.arange(51)
        return Plan(
            observation.t_us,
            times_us,
            np.stack([10.0 * t_s, level / 100 * (t_s / 2) ** 2], axis=1),
            np.zeros(51),
        )


class Blind(Steers):
    sensors = ()


SEEN: list[list] = []


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    return recorded_drive(tmp_path_factory.mktemp("drive"))


@pytest.fixture
def seen():
    SEEN.clear()
    return SEEN


def plan(xy, yaw=None, step_us=100_000):
    xy = np.asarray(xy, dtype=np.float64)
    yaw = np.zeros(len(xy)) if yaw is None else yaw
    return Plan(5, 5 + step_us * np.arange(len(xy)), xy, yaw)


def straight_plan(speed_mps, left_m=0.0, seconds=5.0):
    t_s = np.arange(0.0, seconds + 1e-9, 0.1)
    return plan(np.stack([speed_mps * t_s, np.full(len(t_s), left_m)], axis=1))


def test_gaps_lie_across_and_along_the_true_plan():
    turned = np.pi / 2
    truth = plan(
        np.stack([np.zeros(51), np.linspace(0.0, 50.0, 51)], axis=1), np.full(51, turned)
    )  # to the left
    shown = plan(np.stack([np.full(51, 0.3), np.linspace(0.0, 45.0, 51)], axis=1))
    gaps = gap_of(truth, shown)
    assert gaps["lateral_2s_m"] == pytest.approx(0.3)
    assert gaps["along_2s_m"] == pytest.approx(2.0)
    assert gaps["along_4s_m"] == pytest.approx(4.0)
    assert set(gap_of(truth, truth).values()) == {0.0}


def test_a_plan_that_is_shorter_than_the_horizon_has_no_gap_there():
    gaps = gap_of(straight_plan(10.0), straight_plan(10.0, 1.0, seconds=2.0))
    assert gaps["lateral_2s_m"] == pytest.approx(1.0)
    assert gaps["lateral_4s_m"] is None
    assert pose_at(straight_plan(10.0, seconds=0.5), 1.0) is None
    assert brakes(straight_plan(10.0, seconds=0.5), 10.0) is None


def test_headings_are_taken_across_the_half_turn():
    yaw = np.deg2rad(np.array([179.0, -179.0]))
    assert np.rad2deg(pose_at(plan(np.zeros((2, 2)), yaw, 1_000_000), 0.5)[2]) == pytest.approx(180)


@pytest.mark.parametrize(("asked_mps", "is_braking"), [(10.0, False), (9.6, False), (9.4, True)])
def test_a_plan_brakes_from_half_a_metre_a_second_on(asked_mps, is_braking):
    assert brakes(straight_plan(asked_mps), 10.0) is is_braking


def test_the_same_images_make_the_same_plans_and_others_move_them_by_what_they_show(drive, seen):
    shots = shots_of(drive)
    series = series_of(shots)
    same = {camera: [shot.rgb for shot in taken] for camera, taken in shots.items()}
    darker = {
        camera: [(shot.rgb.astype(int) - 50).astype(np.uint8) for shot in taken]
        for camera, taken in shots.items()
    }
    rows, notes = gap_rows(
        "d", drive, resolve("policy", f"{HERE}:Steers"), series, {"same": same, "dark": darker}, 0
    )
    assert notes == []
    assert [(row["renderer"], row["camera"], row["set"], row["n_plans"]) for row in rows] == [
        ("same", "front", "held-out", 1),
        ("dark", "front", "held-out", 1),
        ("same", "right", "never-fitted", 9),
        ("dark", "right", "never-fitted", 9),
    ]
    assert all(row["lateral_2s_m"] == 0.0 == row["along_4s_m"] for row in rows[::2])
    assert all(row["lateral_2s_m"] == pytest.approx(0.5) for row in rows[1::2])
    assert rows[3]["lateral_4s_m"] == pytest.approx(2.0)
    assert rows[3]["distance_m"] == pytest.approx(0.5, abs=0.02)
    assert all(row["along_1s_m"] == 0.0 == row["brakes_in_one"] for row in rows)


def test_a_camera_beside_the_path_is_shown_as_the_policys_own_from_a_car_beside_the_path(
    drive, seen
):
    series = series_of(shots_of(drive))
    spec = resolve("policy", f"{HERE}:Steers")
    own, moved = roles_of(spec, drive, series)[0]
    assert (own.is_moved, moved.is_moved) == (False, True)
    images = {name: [image.rgb for image in taken] for name, taken in series.items()}
    plans_of(spec, moved, series, images, seed=7)
    observations = seen[-1]
    assert len(observations) == 9
    front = next(camera for camera in drive.cameras if camera.name == "front")
    for image, observation in zip(series["right"], observations, strict=True):
        assert observation.t_us == image.t_us
        assert np.allclose(
            observation.ego.T_world_rig @ front.T_rig_camera, image.T_world_camera, atol=1e-9
        )
        assert np.allclose(observation.history.xyz[-1], observation.ego.T_world_rig[:3, 3])
        assert observation.history.t_us[-1] == image.t_us
        assert np.allclose(observation.cameras["front"].T_rig_camera, front.T_rig_camera)
        # The car stands half a metre to the right of its route.
        assert observation.route_rig[0, 1] == pytest.approx(0.5, abs=1e-6)
    assert observations[-1].ego.speed_mps == pytest.approx(
        float(np.linalg.norm(np.diff(drive.ego_log.xyz, axis=0)[0]))
        / float(np.diff(drive.ego_log.t_us)[0] * 1e-6),
        rel=1e-3,
    )


def test_a_policy_with_two_cameras_waits_for_both_and_sees_the_newest_of_each(drive, seen):
    series = series_of(shots_of(drive))["right"]
    late = [replace(image, t_us=image.t_us + 50_000) for image in series[:-1]]
    mount = drive.cameras[0]
    both = replace(drive, cameras=(mount, replace(mount, name="second")))
    spec = resolve("policy", f"{HERE}:TwoCameras")
    all_series = {"front": series, "second": late}
    (role,), notes = roles_of(spec, both, all_series)
    assert notes == []
    images = {name: [image.rgb for image in taken] for name, taken in all_series.items()}
    plans = plans_of(spec, role, all_series, images, seed=0)
    assert plans[0] is None, "the second camera has shown nothing yet"
    assert None not in plans[1:]
    assert [observation.frames["second"].t_us for observation in seen[-1]] == [
        image.t_us for image in late
    ]


class TwoCameras(Steers):
    sensors = (SensorSpec("front"), SensorSpec("second"))


def test_what_cannot_be_asked_is_refused_or_said(drive):
    series = series_of(shots_of(drive))
    with pytest.raises(InputError, match="has no camera"):
        roles_of(resolve("policy", "log-replay"), drive, series)
    turn = np.eye(4)
    turn[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]  # to the right, in the camera's frame
    facing_right = [
        replace(image, T_world_camera=image.T_world_camera @ turn) for image in series["right"]
    ]
    spec = resolve("policy", f"{HERE}:Steers")
    roles, notes = roles_of(spec, drive, {"front": series["front"], "right": facing_right})
    assert [role.is_moved for role in roles] == [False]
    assert notes == [f"{spec.name}: camera right looks 90 degrees away from front"]
    with pytest.raises(InputError, match="90 degrees away"):
        roles_of(spec, drive, {"right": facing_right})
    other_lens = replace(series["right"][3], K=series["right"][3].K * 1.1)
    mixed = [*series["right"][:3], other_lens]
    with pytest.raises(InputError, match="several calibrations"):
        roles_of(spec, drive, {"right": mixed})


def test_an_interval_takes_six_blocks_of_time_or_six_drives(drive):
    image = series_of(shots_of(drive))["right"][0]
    step_us = round(BLOCK_S * 1e6)

    rows = []
    for count in (5, 6):
        images = [replace(image, t_us=image.t_us + step_us * n) for n in range(count)]
        long = replace(
            drive,
            ego_log=replace(
                drive.ego_log,
                t_us=drive.ego_log.t_us[:1]
                + np.linspace(0, step_us * 8, len(drive.ego_log)).astype(np.int64),
            ),
        )
        dark = [(image.rgb // (n + 1)) for n in range(count)]
        part, _ = gap_rows(
            "d",
            long,
            resolve("policy", f"{HERE}:Steers"),
            {"right": images},
            {"r": {"right": dark}},
            0,
        )
        rows += part
    assert [row["n_blocks"] for row in rows] == [5, 6]
    assert rows[0]["lateral_2s_m_median_ci95"] is None
    low, high = rows[1]["lateral_2s_m_median_ci95"]
    assert low == pytest.approx(0.0)
    assert high > 1.5
    over = gap_intervals([{**rows[0], "drive": str(n), "lateral_1s_m": n / 10} for n in range(6)])
    lateral = next(row for row in over if row["gap"] == "lateral_1s_m")
    assert (lateral["drives"], lateral["median"]) == (6, pytest.approx(0.25))
    assert lateral["median_ci95"] == [0.0, 0.5]
    assert gap_intervals(rows) == [], "one drive has none"


def test_images_of_a_built_scene_are_taken_beside_its_path(drive):
    camera = CameraSpec("front", 16, 16, np.eye(3), drive.cameras[0].T_rig_camera)
    requests = offset_requests(drive, camera, 0.5)
    assert requests[0].t_us == drive.start_us
    assert requests[-1].t_us <= drive.end_us
    on_path = offset_requests(drive, camera, 0.0)
    step = requests[3].T_world_camera[1, :3, 3] - on_path[3].T_world_camera[1, :3, 3]
    assert np.linalg.norm(step) == pytest.approx(0.5)
    (series,) = drawn_series(
        {"front": requests}, {"front": [np.zeros((16, 16, 3), dtype=np.uint8)] * len(requests)}, 0.5
    ).values()
    assert isinstance(series[0], TrueImage)
    assert {image.distance_m for image in series} == {0.5}


def test_the_command_prints_both_kinds_of_rows(drive, monkeypatch, capsys):
    monkeypatch.setattr(bench_real, "_loaded", lambda drives: {"d": drive})
    monkeypatch.setattr(bench_real, "_judges", lambda console: None)
    monkeypatch.setattr(bench_real, "image_rows", lambda *parts: [])
    policy = f"{HERE}:Steers"
    assert (
        run_command(["bench", "real", "d", "--renderer", "3dgs", "--policy", policy, "--json"]) == 0
    )
    document = json.loads(capsys.readouterr().out)
    rows = document["plan_gap"]
    assert [row["camera"] for row in rows] == ["front", "right"]
    assert all(row["policy"] == policy and row["lateral_2s_m"] is not None for row in rows)
    for arguments in (
        ["--policy", "log-replay"],
        ["--policy", policy, "--offsets", "0.5"],
        ["--policy", f"{policy},{policy}"],
    ):
        assert run_command(["bench", "real", "d", "--renderer", "3dgs", *arguments]) == 2


def test_a_policy_that_cannot_be_asked_is_refused_before_anything_is_rendered(
    drive, monkeypatch, capsys
):
    monkeypatch.setattr(bench_real, "_loaded", lambda drives: {"d": drive})
    monkeypatch.setattr(bench_real, "_judges", lambda console: pytest.fail("it goes on"))
    policies = f"{HERE}:Steers,learned-three"
    assert run_command(["bench", "real", "d", "--renderer", "3dgs", "--policy", policies]) == 2
    assert "no pinhole for the view 'left'" in capsys.readouterr().err


@pytest.mark.parametrize("offsets", ["a", "0,0", "11", "nan", ","])
def test_offsets_that_are_none_are_refused(offsets, capsys):
    command = [
        "bench",
        "real",
        "hard/sharp_s_curve",
        "--policy",
        "lane-camera",
        "--offsets",
        offsets,
    ]
    assert run_command(command) == 2
    assert offsets in capsys.readouterr().err


def test_a_built_scene_needs_a_policy(capsys):
    assert run_command(["bench", "real", "hard/sharp_s_curve"]) == 2
    assert "no photographs" in capsys.readouterr().err


def offset_row(offset_m, gap_m, renderer="3dgs", drive="d"):
    return {
        "drive": drive,
        "policy": "p",
        "renderer": renderer,
        "set": "drawn",
        "n_plans": 1,
        "offset_m": offset_m,
        **dict.fromkeys((*GAPS, "brakes_in_one")),
        "lateral_2s_m": gap_m,
    }


def test_a_range_ends_before_the_first_offset_whose_plans_are_not_near():
    rows = [offset_row(0.25 * number, gap_m) for number, gap_m in enumerate([0.1, 0.3, 0.31, 0.1])]
    assert gap_ranges(rows[::-1]) == [
        {"drive": "d", "policy": "p", "renderer": "3dgs", "near_to_m": 0.25, "passes_at_m": 0.5}
    ]


@pytest.mark.parametrize(
    ("gaps_m", "near_to_m", "passes_at_m"),
    [([0.5, 0.1], None, 0.0), ([0.1, 0.2], 0.25, None), ([0.1, None], 0.0, 0.25)],
)
def test_a_range_may_not_begin_and_may_not_end(gaps_m, near_to_m, passes_at_m):
    rows = [offset_row(0.25 * number, gap_m) for number, gap_m in enumerate(gaps_m)]
    (row,) = gap_ranges(rows)
    assert (row["near_to_m"], row["passes_at_m"]) == (near_to_m, passes_at_m)
    assert not is_near(offset_row(0.0, None))


def test_a_range_ends_where_plans_on_one_side_are_not_near():
    rows = [offset_row(0.0, 0.1), offset_row(0.25, 0.1), offset_row(-0.25, 0.4)]
    (row,) = gap_ranges(rows)
    assert (row["near_to_m"], row["passes_at_m"]) == (0.0, 0.25)


def test_a_range_is_written_into_a_scene_and_holds_for_this_scene_alone(tmp_path):
    scene = Path("smoke/curve")
    scenario = load_scenario(str(scene))
    out = tmp_path / "street.yaml"
    ranges = [{"renderer": "3dgs", "policy": "lane-camera", "near_to_m": 0.5}]
    renderers = {"3dgs": resolve_renderer("3dgs")}
    policies = [resolve("policy", "lane-camera")]
    write_ranges(out, scene, scenario, ranges, [], renderers, policies)
    written = load_scenario(str(out))
    assert written.scene_id == scenario.scene_id
    looked_with = [short_digest(spec.digest) for spec in (renderers["3dgs"], policies[0])]
    entry = PlanRange("3dgs", "lane-camera", 0.5, True, *looked_with)
    assert written.scene.plan_ranges == (entry,)
    assert written.content_hash != scenario.content_hash, "scores of before are not taken for its"
    (other,) = load_scenario(str(out), overrides=["degradation.share=0.07"]).plan_ranges
    assert not other.is_current
    gaps = [offset_row(0.0, None)]
    with pytest.raises(InputError, match="end before two seconds"):
        write_ranges(tmp_path / "b.yaml", scene, scenario, ranges, gaps, renderers, policies)
    for arguments in ((out, [scene], True), (tmp_path / "c.yaml", [scene], False)):
        with pytest.raises(InputError):
            check_target(*arguments)


def test_a_range_of_a_pair_is_given_once(tmp_path):
    digests = "renderer_digest: null, policy_digest: null, scene: sha256-0123456789012345"
    entry = f"{{renderer: 3dgs, policy: p, near_to_m: 0.5, {digests}}}"
    with pytest.raises(InputError, match="twice"):
        load_scenario("smoke/curve", overrides=[f"plan_ranges=[{entry}, {entry}]"])


def test_every_drive_and_renderer_has_a_range_of_its_own():
    rows = [offset_row(0.0, 0.1), offset_row(0.0, 0.4, "onefixer"), offset_row(0.0, 0.4, drive="e")]
    assert [row["near_to_m"] for row in gap_ranges(rows)] == [0.0, None, None]


def test_a_range_is_looked_for_until_no_renderer_is_near(drive, monkeypatch, capsys):
    built = replace(drive, model=None)
    monkeypatch.setattr(bench_real, "_loaded", lambda drives: {"d": built})
    looked_at = []

    def rows_at(bench, name, scenario, offset_m):
        looked_at.append(offset_m)
        beside_m = abs(offset_m)
        return [offset_row(offset_m, 0.2 + beside_m), offset_row(offset_m, 0.39 * beside_m, "x")]

    monkeypatch.setattr(bench_real._Bench, "_at_offset", rows_at)
    command = ["bench", "real", "d", "--renderer", "3dgs", "--policy", f"{HERE}:Steers"]
    assert run_command([*command, "--range", "--json"]) == 0
    assert looked_at == [0.0, 0.25, -0.25, 0.5, -0.5, 0.75, -0.75, 1.0, -1.0]
    ranges = json.loads(capsys.readouterr().out)["plan_gap_range"]
    assert [row["near_to_m"] for row in ranges] == [0.0, 0.75]
    assert run_command([*command, "--range", "--offsets", "0,1"]) == 2
    assert "chooses its own offsets" in capsys.readouterr().err
    monkeypatch.setattr(bench_real, "_loaded", lambda drives: {"d": drive})
    assert run_command([*command, "--range"]) == 2
    assert "recorded drive" in capsys.readouterr().err


def test_a_log_is_named_by_its_folder_as_a_scene_to_drive_is(tmp_path, monkeypatch):
    loaded = []
    monkeypatch.setattr(
        bench_real,
        "load_scenario",
        lambda name, overrides: loaded.append(name) or SimpleNamespace(scene_id="s", model=None),
    )
    (tmp_path / "log").mkdir()
    (tmp_path / "street").mkdir()
    (tmp_path / "street" / "scenario.yaml").touch()
    bench_real._loaded([tmp_path / "log"])
    bench_real._loaded([tmp_path / "street"])
    assert loaded == [str(tmp_path / "log"), str(tmp_path / "street" / "scenario.yaml")]
