"""Serialise trajectories by array operations.

Plans with their alternatives are most of the poses in a log. A message object a pose and a number
takes twenty times as long as laying the numbers out in the bytes that protobuf itself makes of one
pose: in its encoding numbers of a fixed width lie at fixed places behind their tags
(https://protobuf.dev/programming-guides/encoding/).
"""

import struct
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from alpasim_plugin.core.types import F64, I64
from alpasim_plugin.log.wire import common_pb2

NUMBERS = ("x", "y", "z", "qw", "qx", "qy", "qz")
# What stands for the numbers in the sample; no part of its bytes is like another.
SAMPLE_NUMBERS = (1.1377, 2.2491, 3.3719, 4.4837, 5.5973, 6.6139, 7.7251)
SAMPLE_TIME = 0x0123456789ABCDEF


def _sample() -> bytes:
    """Return the bytes that protobuf makes of a trajectory of one pose."""
    x, y, z, qw, qx, qy, qz = SAMPLE_NUMBERS
    pose = common_pb2.Pose(
        vec=common_pb2.Vec3(x=x, y=y, z=z), quat=common_pb2.Quat(w=qw, x=qx, y=qy, z=qz)
    )
    at_time = common_pb2.PoseAtTime(pose=pose, timestamp_us=SAMPLE_TIME)
    return bytes(common_pb2.Trajectory(poses=[at_time]).SerializeToString())


def _layout(sample: bytes) -> np.dtype[np.void]:
    """Return the record of one pose: where each number lies in the sample."""
    numbers = [struct.pack("<f", number) for number in SAMPLE_NUMBERS]
    encoded = [*numbers, struct.pack("<Q", SAMPLE_TIME)]
    for data in encoded:
        assert sample.count(data) == 1, "a number of the sample lies at one place"
    return np.dtype(
        {
            "names": [*NUMBERS, "t_us"],
            "formats": [*["<f4"] * len(NUMBERS), "<u8"],
            "offsets": [sample.index(data) for data in encoded],
            "itemsize": len(sample),
        }
    )


SAMPLE = _sample()
LAYOUT = _layout(SAMPLE)


def packed_trajectories(xyz: F64, unit_quat: F64, t_us: I64, lengths: Sequence[int]) -> list[bytes]:
    """Return the bytes of one `Trajectory` message a trajectory, for ``MergeFromString``.

    Args:
        xyz: ``(N, 3)`` metres, of all trajectories one after the other.
        unit_quat: ``(N, 4)`` wxyz, of length 1.
        t_us: ``(N,)``.
        lengths: How many of the N poses each trajectory has.
    """
    data = bytearray(SAMPLE * len(t_us))
    table = np.frombuffer(data, dtype=LAYOUT)
    for name, column in zip(NUMBERS, (*xyz.T, *unit_quat.T), strict=True):
        table[name] = column
    table["t_us"] = t_us
    ends = [len(SAMPLE) * int(end) for end in np.cumsum([0, *lengths])]
    return [bytes(data[first:end]) for first, end in pairwise(ends)]
