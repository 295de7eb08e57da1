"""References of training episodes: cut as the frames are, absent where they are missing, wrong
where they are drawn so.
"""

from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.core.types import Actor, Box, RecordedFrame, Trajectory
from alpasim_plugin.lab.training.episode_references import (
    SLOTS,
    ReferenceDraw,
    pair_references,
    road_users,
)
from alpasim_plugin.lab.training.pair_store import PairSequence, write_sequence
from alpasim_plugin.lab.training.reference_store import FrameGeometry, write_references
from tests.lab.training.pair_files import make, pair

FRAMES = 6
HEIGHT = 32
WIDTH = 48
EXACT = ReferenceDraw(2, 0, np.zeros((SLOTS, 6)), np.ones((SLOTS, 3)), -1, 0)
INDEX = np.arange(3)
K = [[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]


WALL = np.full((HEIGHT, WIDTH), 10, dtype=np.float16)
STANDS = Trajectory(np.array([0]), np.zeros((1, 3)), np.array([[1.0, 0, 0, 0]]))
CAR = Actor("car", "car", Box(4, 2, 1.5), STANDS)


def written(folder, frames, count):
    """Write a sequence with so many recorded frames; a wall stands 10 m ahead."""

    def recorded(i):
        T = np.eye(4)
        T[0, 3] = 2.0 * i
        shown = pair(10 * i).rgb_gt, WALL.astype(np.float32)
        return RecordedFrame(200_000 * i, "front", np.array(K), T, {}, lambda: shown)

    def beside(partial):
        write_references(partial, frames, [recorded(i) for i in range(count)], [CAR])

    info = {"camera": {"K": K, "T_rig_camera": np.eye(4).tolist()}}
    write_sequence(folder, (pair(i) for i in range(FRAMES)), FRAMES, info, beside)
    return PairSequence(folder)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory):
    folder = tmp_path_factory.mktemp("references") / "train" / "a"
    return written(folder, [FrameGeometry(WALL, {})] * FRAMES, 3)


def shown(
    sequence,
    draw,
    rows=slice(0, HEIGHT),
    columns=slice(0, WIDTH),
):
    return pair_references(sequence, draw, INDEX, rows, columns)


def test_a_crop_has_the_references_of_the_whole_frame_cut_to_it(sequence):
    rows = slice(8, 24)
    columns = slice(16, 48)
    whole = shown(sequence, EXACT)
    part = shown(sequence, EXACT, rows, columns)
    assert part.shape == (3, SLOTS, 16, 32, 4)
    assert np.abs(whole[:, :, rows, columns].astype(int) - part).max() <= 1


def test_road_users_are_where_their_boxes_are(tmp_path):
    """A car of 4 x 2 x 1.5 m stands 10 m ahead of the camera in the first frame alone."""
    T_world_box = np.eye(4)
    T_world_box[2, 3] = 10.0
    frames = [FrameGeometry(WALL, {"car": T_world_box} if i == 0 else {}) for i in range(FRAMES)]
    with_car = written(tmp_path / "a", frames, 1)
    whole = road_users(with_car, np.array([0, 1]), slice(0, HEIGHT), slice(0, WIDTH))
    part = road_users(with_car, np.array([0]), slice(8, 24), slice(16, 48))
    assert whole[0].any()
    assert not whole[0].all()
    assert not whole[1].any()
    assert np.array_equal(part[0], whole[0, 8:24, 16:48])
    without = road_users(make(tmp_path / "b"), np.array([0]), slice(0, 16), slice(0, 16))
    assert without.shape == (1, 16, 16)
    assert not without.any()


def test_as_many_references_as_drawn_and_none_without_a_recording(sequence, tmp_path):
    for count in range(SLOTS + 1):
        there = shown(sequence, replace(EXACT, count=count)).any(axis=(0, 2, 3, 4))
        assert there.tolist() == [True] * count + [False] * (SLOTS - count)
    assert not shown(make(tmp_path), EXACT).any()
