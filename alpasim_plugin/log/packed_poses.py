"""Serialise trajectories by array operations, and read them.

Plans with their alternatives are most of the poses in a log. A message object a pose and a number
takes twenty times as long as laying the numbers out in the bytes that protobuf itself makes of one
pose: in its encoding numbers of a fixed width lie at fixed places behind their tags
(https://protobuf.dev/programming-guides/encoding/).
"""

import struct
from collections.abc import Sequence
from functools import lru_cache
from itertools import compress, pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from alpasim_plugin.core.types import F64, I64, Bool
from alpasim_plugin.log.wire import common_pb2

NUMBERS = ("x", "y", "z", "qw", "qx", "qy", "qz")
TIME = "t_us"
U64 = npt.NDArray[np.uint64]
# What stands for the numbers in the sample; no part of its bytes is like another.
SAMPLE_NUMBERS = (1.1377, 2.2491, 3.3719, 4.4837, 5.5973, 6.6139, 7.7251)
SAMPLE_TIME = 0x0123456789ABCDEF


class Record(NamedTuple):
    """The bytes of one pose."""

    sample: bytes
    layout: np.dtype[np.void]  # where each number that is not zero lies in the sample
    is_between: Bool  # (len(sample),) which bytes are no number's


@lru_cache(maxsize=256)
def _record(stated: tuple[bool, ...]) -> Record:
    """Return what protobuf makes of a pose, where ``stated`` says which of its `NUMBERS` and its
    time are not zero: it leaves zeros out.
    """
    values = [
        number if is_stated else 0.0
        for number, is_stated in zip(SAMPLE_NUMBERS, stated[:-1], strict=True)
    ]
    x, y, z, qw, qx, qy, qz = values
    pose = common_pb2.Pose(
        vec=common_pb2.Vec3(x=x, y=y, z=z), quat=common_pb2.Quat(w=qw, x=qx, y=qy, z=qz)
    )
    at_time = common_pb2.PoseAtTime(pose=pose, timestamp_us=SAMPLE_TIME if stated[-1] else 0)
    sample = bytes(common_pb2.Trajectory(poses=[at_time]).SerializeToString())
    layout = _layout(sample, stated)
    is_between = np.ones(len(sample), dtype=bool)
    for number, offset in (field[:2] for field in (layout.fields or {}).values()):
        is_between[offset : offset + number.itemsize] = False
    return Record(sample, layout, is_between)


def _layout(sample: bytes, stated: Sequence[bool]) -> np.dtype[np.void]:
    """Return the record of one pose: where each stated number lies in the sample."""
    names = list(compress([*NUMBERS, TIME], stated))
    formats = list(compress([*["<f4"] * len(NUMBERS), "<u8"], stated))
    numbers = [struct.pack("<f", number) for number in SAMPLE_NUMBERS]
    encoded = list(compress([*numbers, struct.pack("<Q", SAMPLE_TIME)], stated))
    for data in encoded:
        assert sample.count(data) == 1, "a number of the sample lies at one place"
    return np.dtype(
        {
            "names": names,
            "formats": formats,
            "offsets": [sample.index(data) for data in encoded],
            "itemsize": len(sample),
        }
    )


SAMPLE, LAYOUT, _ = _record((True,) * (len(NUMBERS) + 1))


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
    table[TIME] = t_us
    ends = [len(SAMPLE) * int(end) for end in np.cumsum([0, *lengths])]
    return [bytes(data[first:end]) for first, end in pairwise(ends)]


def unpacked_trajectory(message: common_pb2.Trajectory) -> tuple[F64, U64] | None:
    """Return the `NUMBERS` of a trajectory's N poses by array operations.

    Returns:
        ``(N, 7)`` as they stand there, and ``(N,)`` times, microseconds; None where its poses are
        not laid out alike, as where a number is zero in some of them, or where there is none.
    """
    count = len(message.poses)
    data = np.frombuffer(message.SerializeToString(), dtype=np.uint8)
    if not count:
        return None
    last = message.poses[count - 1]
    stated = tuple(bool(number) for number in (*_numbers_of(last.pose), last.timestamp_us))
    record = _record(stated)
    if len(data) != count * len(record.sample):
        return None
    between = data.reshape(count, -1)[:, record.is_between]
    if (between != np.frombuffer(record.sample, dtype=np.uint8)[record.is_between]).any():
        return None
    table = data.view(record.layout)
    numbers = np.zeros((count, len(NUMBERS)), dtype=np.float64)
    for i in np.flatnonzero(stated[:-1]):
        numbers[:, i] = table[NUMBERS[i]]
    times = table[TIME] if stated[-1] else np.zeros(count, dtype=np.uint64)
    return numbers, times


def _numbers_of(pose: common_pb2.Pose) -> tuple[float, ...]:
    vec = pose.vec
    quat = pose.quat
    return vec.x, vec.y, vec.z, quat.w, quat.x, quat.y, quat.z
