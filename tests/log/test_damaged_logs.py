"""Damaged and foreign logs: what is read, what is refused, and in which words."""

import pickle
import struct

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.log import read_asl
from alpasim_plugin.log.asl import AslFile, AslReader
from tests.log.make_rollout import T0_US


def test_cut_log_gives_what_is_whole_and_a_warning(path):
    path.write_bytes(path.read_bytes()[:-40])
    log = read_asl(path)
    assert len(log.images) == 4
    assert len(log.warnings) == 1
    assert "last entry cut" in log.warnings[0]


def test_cut_inside_the_first_entry_is_an_error(path):
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(InputError, match="no rollout_metadata"):
        read_asl(path)


def test_damage_in_the_middle_is_an_error_with_its_place(path):
    data = bytearray(path.read_bytes())
    first = 4 + struct.unpack(">I", data[:4])[0]
    data[first + 4 : first + 12] = b"\xff" * 8
    path.write_bytes(bytes(data))
    with pytest.raises(InputError) as caught:
        read_asl(path)
    assert "entry 1 at byte" in caught.value.message


def edited(path, change):
    """Rewrite a log entry by entry through `change`, which may return None to leave one out."""
    entries = [change(i, e) for i, e in enumerate(AslReader(path))]  # type: ignore[operator]
    with AslFile(path) as file:
        for e in entries:
            if e is not None:
                file.write(e)
    return path


def test_log_of_the_five_scored_kinds_is_enough(path, log):
    needed = {
        "rollout_metadata",
        "actor_poses",
        "driver_request",
        "driver_return",
        "driver_camera_image",
    }
    bare = read_asl(edited(path, lambda i, e: e if e.WhichOneof("log_entry") in needed else None))
    np.testing.assert_array_equal(bare.ego.xyz, log.ego.xyz)
    assert len(bare.plans) == len(log.plans)
    assert len(bare.images) == len(log.images)


def swapped(i, e):
    if i == 0:
        boxes = e.rollout_metadata.actor_definitions.actor_aabb
        boxes[0].actor_id, boxes[1].actor_id = boxes[1].actor_id, boxes[0].actor_id
    return e


def stopped(i, e):
    if e.HasField("actor_poses"):
        e.actor_poses.timestamp_us = T0_US
    return e


def without_quaternion(i, e):
    if e.HasField("actor_poses"):
        e.actor_poses.actor_poses[-1].actor_pose.ClearField("quat")
    return e


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda i, e: None if i == 0 else e, "first entry is available_cameras_request"),
        (swapped, "actor definitions begin with 7"),
        (lambda i, e: None if e.HasField("actor_poses") else e, "no actor_poses of EGO"),
        (stopped, f"time {T0_US} us at index 1 after {T0_US} us"),
        (without_quaternion, r"\|q\|\^2 = 0"),
        (
            lambda i, e: None if e.HasField("driver_request") else e,
            "driver_return without a driver_request",
        ),
    ],
)
def test_a_log_without_what_is_scored_is_refused(path, change, found):
    with pytest.raises(InputError, match=found):
        read_asl(edited(path, change))


def test_poses_of_undefined_actors_are_left_out_and_named(path):
    def rename(i, e):
        for pose in e.actor_poses.actor_poses:
            if pose.actor_id == "7":
                pose.actor_id = "hidden"
        return e

    log = read_asl(edited(path, rename))
    assert set(log.actors) == {"late", "wall"}
    assert log.info["undefined_actors"] == ("hidden",)


class Bomb:
    """Raises when unpickled."""

    def __reduce__(self):
        return (pytest.fail, ("debug bytes were unpickled",))


def test_debug_bytes_are_never_unpickled(path):
    def arm(i, e):
        if e.HasField("driver_return"):
            e.driver_return.debug_info.unstructured_debug_info = pickle.dumps(Bomb())
        return e

    assert len(read_asl(edited(path, arm)).plans) == 3
