"""Numbers on the wire: float32 poses, quaternion norms, and what is refused at writing."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import quat_from_yaw, se2, yaw_from_quat
from alpasim_plugin.core.types import Actor, Box
from alpasim_plugin.log import AslWriter
from alpasim_plugin.log.schema import read_poses, wire_pose, wire_poses
from alpasim_plugin.log.wire import common_pb2
from tests.examples import examples
from tests.log.make_rollout import ACTORS, HEADER, T0_US, straight


@settings(max_examples=examples(200), deadline=None)
@given(
    xyz=st.lists(st.floats(-9e4, 9e4), min_size=3, max_size=3),
    quat=st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(
        lambda q: np.linalg.norm(q) > 1e-3
    ),
)
def test_any_pose_survives_within_float32(xyz, quat):
    messages = wire_poses(np.array([xyz]), np.array([quat]), "a test")
    back_xyz, back_quat = read_poses(messages, "a test")
    assert np.abs(back_xyz[0] - xyz).max() <= np.spacing(np.float32(max(*np.abs(xyz), 1e-30))) / 2
    unit = np.array(quat) / np.linalg.norm(quat)
    assert 2 * np.arccos(min(1.0, abs(float(back_quat[0] @ unit)))) < 1e-6
    assert abs(np.linalg.norm(back_quat[0]) - 1) < 1e-12


def test_one_pose_that_is_not_finite_is_refused():
    for place, value in itertools.product(
        ((0, 3), (1, 3), (2, 3), (0, 0), (1, 2)), (np.nan, np.inf)
    ):
        pose = np.eye(4)
        pose[place] = value
        with pytest.raises(InputError, match="a test"):
            wire_pose(pose, "a test")


def test_coordinates_too_large_for_float32_are_refused_at_writing(tmp_path):
    with (
        AslWriter(tmp_path / "a.asl", HEADER) as log,
        pytest.raises(InputError, match=r"position .*500001\.4") as caught,
    ):
        log.actor_poses(T0_US, se2(500_000, 0, 0), {})
    assert "local origin" in caught.value.hint


def test_nan_pose_is_refused_at_writing(tmp_path):
    with AslWriter(tmp_path / "a.asl", HEADER) as log, pytest.raises(InputError, match="nan"):
        log.actor_poses(T0_US, se2(0, 0, 0), {"7": se2(float("nan"), 0, 0)})


def test_heading_of_half_a_turn_survives():
    quat = quat_from_yaw(np.array([np.pi, -np.pi, np.pi - 1e-9]))
    _, back = read_poses(wire_poses(np.zeros((3, 3)), quat, "a test"), "a test")
    assert_allclose(np.abs(yaw_from_quat(back)), np.pi, atol=1e-6)


@pytest.mark.parametrize(
    ("scale", "fine"),
    [(1.0, True), (1 + 4.9e-5, True), (1 - 4.9e-5, True), (1 + 6e-5, False), (0.0, False)],
)
def test_quaternion_norm_rule(scale, fine):
    pose = common_pb2.Pose(
        vec=common_pb2.Vec3(), quat=common_pb2.Quat(w=0.6 * scale, z=0.8 * scale)
    )
    if fine:
        assert_allclose(read_poses([pose], "a test")[1], [[0.6, 0, 0, 0.8]], atol=1e-7)
    else:
        with pytest.raises(InputError, match=r"\|q\|\^2"):
            read_poses([pose], "a test")


def test_actor_outside_the_header_is_refused(tmp_path):
    with AslWriter(tmp_path / "a.asl", HEADER) as log, pytest.raises(InputError, match="'ghost'"):
        log.actor_poses(T0_US, se2(0, 0, 0), {"ghost": se2(1, 0, 0)})


def test_ids_of_actors_must_be_their_own(tmp_path):
    twin = Actor("7", "automobile", Box(1, 1, 1), straight(2))
    with pytest.raises(InputError, match=r"\['7'\] are taken or repeated"):
        AslWriter(tmp_path / "a.asl", replace(HEADER, actors=(*ACTORS, twin)))
    with pytest.raises(InputError, match=r"\['EGO'\]"):
        AslWriter(tmp_path / "a.asl", replace(HEADER, actors=(replace(twin, actor_id="EGO"),)))
