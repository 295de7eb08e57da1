"""AlpaSim's own logs, read into the same type as ours."""

from collections import Counter
from functools import lru_cache

import numpy as np
import pytest

from alpasim_plugin.core.geometry import matrix_from_quat
from alpasim_plugin.core.types import Box
from alpasim_plugin.log import decode_image, read_asl

read_log = lru_cache(maxsize=64)(read_asl)  # several tests look at the same logs


def golden(shared_data):
    return sorted((shared_data / "alpasim-golden").rglob("*.asl"))


def test_every_log_written_by_alpasim_is_read(shared_data):
    totals = Counter()
    logs = golden(shared_data)
    assert len(logs) == 57
    for path in logs:
        log = read_log(path)
        totals.update(log.info["entries"])
        assert log.warnings == ()
        assert (log.session_uuid, log.scene_id) == (path.parent.name, path.parent.parent.name)
        counts = log.info["entries"]
        assert (
            len(log.plans) + log.info["empty_plans"]
            == counts["driver_return"]
            == counts["driver_request"]
        )
        assert len(log.images) == counts["driver_camera_image"]
        assert len(log.ego) == counts["actor_poses"]
        assert log.ego.t_us[0] == log.start_us == log.ego_log.t_us[0] == 1_689_697_803_493_732
        assert log.ego.t_us[1] >= log.render_start_us == log.start_us + 100_000
        # The first logged ego pose is the recorded one moved from rig to box centre.
        expected = log.ego_log.xyz[0] + matrix_from_quat(log.ego_log.quat[0]) @ log.T_rig_box[:3, 3]
        np.testing.assert_allclose(log.ego.xyz[0], expected, atol=3e-3)
        assert all(plan.trajectory.t_us[0] == plan.now_us for plan in log.plans)
        assert all(image.data[:2] == b"\xff\xd8" for image in log.images)
    assert totals == {
        **dict.fromkeys(
            (
                "rollout_metadata",
                "available_cameras_request",
                "available_cameras_return",
                "driver_session_request",
                "traffic_session_request",
                "available_ego_masks_request",
                "available_ego_masks_return",
            ),
            57,
        ),
        "actor_poses": 4087,
        "driver_camera_image": 3754,
        **dict.fromkeys(("driver_ego_trajectory", "driver_request", "driver_return"), 3698),
        "batch_render_request": 1629,
        **dict.fromkeys(("route_request", "controller_request", "controller_return"), 1606),
    }


@pytest.mark.parametrize(
    ("scene", "control_us", "force_gt_us", "n_actors"),
    [
        ("synthetic-front-brake-a", 100_000, 1_700_000, None),
        ("synthetic-cut-in-c", 200_000, 1_800_000, None),
        ("synthetic-stacked-a", 200_000, 1_000_000, 2),
        ("synthetic-vru-offset-a", 100_000, 1_700_000, 4),
    ],
)
def test_golden_headers(shared_data, scene, control_us, force_gt_us, n_actors):
    for path in sorted((shared_data / "alpasim-golden" / "rollouts" / scene).rglob("*.asl")):
        log = read_log(path)
        assert (log.control_us, log.force_gt_us) == (control_us, force_gt_us)
        assert n_actors is None or len(log.actors) == n_actors
        assert decode_image(log.images[0].data).shape == (40, 64, 3)


def test_golden_ego_size_comes_from_the_first_definition(shared_data):
    sizes = {read_asl(p, images=False).ego_box for p in golden(shared_data)}
    assert sizes == {Box(5.393, 2.109, 1.503), Box(5.0, 2.0, 1.6), Box(4.8, 1.95, 1.5)}


def test_golden_plans_rollout_has_empty_and_sampled_answers(shared_data):
    logs = [
        read_asl(p)
        for p in sorted((shared_data / "alpasim-golden/rollouts/synthetic-plans-a").rglob("*.asl"))
    ]
    assert [log.info["empty_plans"] for log in logs] == [0, 11]
    assert {len(plan.samples) for plan in logs[1].plans} == set(range(8))


def test_golden_log_without_actors_has_none(shared_data):
    logs = list((shared_data / "alpasim-golden/cases/no-actors/rollouts").rglob("*.asl"))
    assert len(logs) == 2
    assert all(read_log(path).actors == {} for path in logs)


def test_golden_log_of_a_failed_rollout_is_read(shared_data):
    (path,) = (shared_data / "alpasim-golden/cases/failed-rollout/incomplete").rglob("*.asl")
    log = read_log(path)
    assert (len(log.ego), log.info["empty_plans"], log.info["n_steps"]) == (27, 1, 46)
