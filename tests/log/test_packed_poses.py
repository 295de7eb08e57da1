"""Trajectories that are serialised by array operations are those of protobuf's own objects, byte
by byte.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import quat_from_matrix, rigid
from alpasim_plugin.core.types import Trajectory
from alpasim_plugin.log import schema
from alpasim_plugin.log.packed_poses import unpacked_trajectory
from alpasim_plugin.log.schema import (
    read_trajectory,
    trajectory_bytes,
    wire_pose,
    wire_poses,
    wire_trajectory,
)
from alpasim_plugin.log.wire import common_pb2


def trajectory(length, seed=0):
    rng = np.random.default_rng(seed)
    t_us = 1_689_697_803_493_732 + np.cumsum(rng.integers(1, 200_000, length))
    return Trajectory(
        t_us, 1e3 * rng.standard_normal((length, 3)), rng.standard_normal((length, 4))
    )


def built_one_by_one(one):
    """Return the message as its objects are put together, the reference."""
    poses = wire_poses(one.xyz, one.quat, "a trajectory")
    at_time = common_pb2.PoseAtTime
    times = one.t_us.tolist()
    return common_pb2.Trajectory(
        poses=[at_time(pose=p, timestamp_us=t) for p, t in zip(poses, times, strict=True)]
    )


@pytest.mark.parametrize("length", [0, 1, 2, 65])
def test_a_trajectory_has_the_bytes_of_its_objects(length):
    one = trajectory(length)
    built = built_one_by_one(one)
    assert wire_trajectory(one, "a trajectory") == built
    assert wire_trajectory(one, "a trajectory").SerializeToString() == built.SerializeToString()


def test_zeros_of_both_signs_have_the_bytes_of_objects():
    xyz = np.array([[0.0, -0.0, 1.0], [-0.0, 0.0, 0.0]])
    one = Trajectory(np.array([0, 1]), xyz, np.array([[1.0, 0, 0, 0], [-0.0, 0, 0, 2.0]]))
    built = built_one_by_one(one).SerializeToString()
    assert wire_trajectory(one, "zeros").SerializeToString() == built


def test_several_trajectories_are_cut_where_each_ends():
    several = [trajectory(n, seed=n) for n in (3, 0, 7, 1)]
    messages = [
        common_pb2.Trajectory.FromString(data) for data in trajectory_bytes(several, "some")
    ]
    assert messages == [built_one_by_one(one) for one in several]


def test_a_pose_that_cannot_be_stored_is_named_by_its_place_among_all():
    usual = trajectory(4)
    xyz = usual.xyz.copy()
    xyz[2, 1] = np.nan
    late = Trajectory(usual.t_us, xyz, usual.quat)
    with pytest.raises(InputError, match="pose 7: position"):
        trajectory_bytes([trajectory(5), late], "plans")


def test_one_pose_has_the_numbers_of_many():
    for rotation in Rotation.random(50, random_state=3).as_matrix():
        T = rigid(rotation, [1.5, -2.5, 1e4])
        many = wire_poses(T[None, :3, 3], quat_from_matrix(T[None, :3, :3]), "poses")
        assert wire_pose(T, "a pose") == many[0]


def test_a_time_before_zero_is_refused():
    one = trajectory(3)
    early = Trajectory(np.array([-5, 0, 3], dtype=np.int64), one.xyz, one.quat)
    with pytest.raises(InputError, match="-5 us"):
        trajectory_bytes([early], "a plan")


def flat(length):
    """Return a trajectory on a plane: protobuf leaves its zeros out."""
    one = trajectory(length)
    yaw = np.linspace(0.1, 2.0, length)
    quat = np.stack([np.cos(yaw), 0 * yaw, 0 * yaw, np.sin(yaw)], axis=1)
    return Trajectory(one.t_us, one.xyz * [1, 1, 0] + 0.0, quat)


def with_numbers(one, xyz):
    changed = one.xyz.copy()
    changed[:] = xyz(changed)
    return Trajectory(one.t_us, changed, one.quat)


@pytest.mark.parametrize(
    ("one", "is_fast"),
    [
        (trajectory(65), True),
        (flat(65), True),
        (flat(1), True),
        (with_numbers(flat(9), np.zeros_like), True),
        (with_numbers(flat(9), lambda xyz: xyz * (np.arange(9) > 0)[:, None] + 0.0), False),
        # as many bytes in each pose, of other numbers
        (with_numbers(flat(2), lambda xyz: xyz * [[0, 1, 1], [1, 0, 1]] + 0.0), False),
        (with_numbers(flat(9), lambda xyz: np.full_like(xyz, -0.0)), False),
        (trajectory(0), False),
    ],
)
def test_a_trajectory_is_read_as_its_objects_one_by_one(one, is_fast, monkeypatch):
    message = common_pb2.Trajectory.FromString(built_one_by_one(one).SerializeToString())
    assert (unpacked_trajectory(message) is not None) == is_fast
    fast = read_trajectory(message, "a trajectory")
    monkeypatch.setattr(schema, "unpacked_trajectory", lambda message: None)
    plain = read_trajectory(message, "a trajectory")
    for name in ("t_us", "xyz", "quat"):
        assert getattr(fast, name).dtype == getattr(plain, name).dtype
        np.testing.assert_array_equal(getattr(fast, name), getattr(plain, name))


@pytest.mark.parametrize("times", [[5, 5], [7, 3], [1, 2**63 + 1]])
def test_times_that_do_not_increase_are_refused_in_both_ways(times):
    message = built_one_by_one(flat(2))
    for pose, t_us in zip(message.poses, times, strict=True):
        pose.timestamp_us = t_us
    assert unpacked_trajectory(message) is not None
    with pytest.raises(InputError, match=f"time {times[1]} us at index 1 after {times[0]} us"):
        read_trajectory(message, "a plan")


def test_a_pose_without_rotation_is_refused_in_both_ways():
    message = built_one_by_one(flat(3))
    for pose in message.poses:
        pose.pose.quat.Clear()
    with pytest.raises(InputError, match="pose 0: position"):
        read_trajectory(message, "a plan")
