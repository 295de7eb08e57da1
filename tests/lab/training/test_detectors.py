"""Our own detectors: what is to be found, what the networks' cells mean, and the command that trains
them.
"""

import numpy as np
import pytest
import torch

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import CameraSpec
from alpasim_plugin.lab.training.detector_nets import CuboidNet, LaneNet
from alpasim_plugin.lab.training.detector_targets import (
    Frame,
    FrameBatches,
    box_cells,
    is_visible,
    lane_cells,
    usual_sequences,
)
from alpasim_plugin.lab.training.lane_lines import lateral_positions, read_lanes, write_lanes
from alpasim_plugin.lab.video_metrics.cuboids import Boxes, overlap
from alpasim_plugin.lab.video_metrics.lanes import SAMPLES_M, Lanes, lane_matches, lanes_at
from alpasim_plugin.lab.video_metrics.torchscript import load_script, save_script
from tests.lab.training.pair_files import make

K = np.array([[166.8, 0.0, 128.0], [0.0, 166.8, 72.0], [0.0, 0.0, 1.0]])
BOXES = np.array([[-4.0, 0.6, 15.0, 4.4, 1.5, 1.8, 1.2], [3.0, 0.4, 30.0, 9.0, 3.0, 2.5, -0.3]])
AHEAD = np.stack([np.full(29, 1.7), -1.8 + 0.01 * SAMPLES_M**1.5])


def frame(boxes=BOXES, lanes=AHEAD):
    return Frame(np.zeros((3, 144, 256), dtype=np.float32), K, boxes, lanes)


def certain(cells):
    """Return targets as what a sure network says: scores become logits."""
    out = torch.from_numpy(cells.copy())[None]
    out[:, 0] = torch.where(out[:, 0] == 1, 8.0, -8.0)
    return out


def decoded(net, cells):
    net.cells = lambda images, K: certain(cells)
    return [part.numpy() for part in net(torch.zeros(3, 144, 256), torch.from_numpy(K).float())]


@pytest.mark.parametrize("mirror", [False, True])
def test_cells_of_boxes_mean_the_boxes(mirror):
    shown = frame().mirrored() if mirror else frame()
    boxes, scores, labels = decoded(CuboidNet(), box_cells(shown))
    order = np.argsort(boxes[:, 2])
    assert scores.min() > 0.9
    assert labels.tolist() == [0, 0]
    np.testing.assert_allclose(boxes[order, :6], shown.boxes[:, :6], atol=2e-2)
    turn = boxes[order, 6] - shown.boxes[:, 6]
    np.testing.assert_allclose(np.sin(turn), 0.0, atol=2e-2)  # front and back are one
    made, true = (
        Boxes(x, np.ones(2), np.zeros(2, dtype=np.int64), K, (144, 256)).mask()
        for x in (boxes, shown.boxes)
    )
    assert overlap([made], [true]).f1 > 0.97


@pytest.mark.parametrize("mirror", [False, True])
def test_cells_of_lanes_mean_the_lanes(mirror):
    shown = frame().mirrored() if mirror else frame()
    points, visible, scores = decoded(LaneNet(1.5, 0.07), lane_cells(shown))
    matches = lane_matches([Lanes(points, visible > 0, scores)], [lanes_at(shown.lanes)])
    assert (matches.matched, matches.extra, matches.missed) == (2, 0, 0)
    assert matches.error_m < 1e-3


@pytest.mark.parametrize("net", [CuboidNet(), LaneNet(1.5, 0.07)])
def test_an_exported_network_answers_as_the_network(net, tmp_path):
    save_script(net, tmp_path / "net.pt")
    image = torch.linspace(0, 1, 3 * 288 * 512).reshape(3, 288, 512)
    matrix = torch.from_numpy(K * np.array([[2.0], [2.0], [1.0]])).float()
    program = load_script(tmp_path / "net.pt")
    with torch.inference_mode():
        for ours, theirs in zip(net(image, matrix), program(image, matrix), strict=True):
            torch.testing.assert_close(theirs, ours, atol=1e-3, rtol=1e-3)


def test_a_gap_of_a_lane_is_bridged_and_a_far_line_begins_another():
    lane = np.full(29, 1.0)
    lane[10:12] = np.nan
    aside = np.where(SAMPLES_M > 30.0, 8.0, np.nan)
    points, visible, _ = decoded(
        LaneNet(1.5, 0.07), lane_cells(frame(lanes=np.stack([lane, aside])))
    )
    assert sorted((visible > 0).sum(axis=1).tolist()) == [15, 27]
    assert len(points) == 2


def test_a_hidden_a_near_and_an_outside_vehicle_are_not_to_be_found():
    depth = np.full((144, 256), 60.0, dtype=np.float32)
    car = BOXES[0]
    assert is_visible(car, K, depth)
    assert not is_visible(car, K, np.full_like(depth, 8.0))
    assert is_visible(car, K, np.zeros_like(depth))  # no surface near
    beside = car.copy()
    beside[0] = 40.0
    assert not is_visible(beside, K, depth)
    near = car.copy()
    near[2] = 1.0
    assert not is_visible(near, K, depth)


def test_lines_run_in_metres_beside_the_way_the_camera_looks(tmp_path):
    camera = CameraSpec("front", 256, 144, K, np.eye(4))
    T = np.eye(4)  # looks along the world's x axis, level: right is -y
    T[:3, 0], T[:3, 1], T[:3, 2] = (0, -1, 0), (0, 0, -1), (1, 0, 0)
    T[:3, 3] = (100.0, 50.0, 1.5)
    x = np.linspace(90.0, 140.0, 6)
    left = np.stack([x, np.full(6, 52.0), np.zeros(6)], axis=1)
    double = left + np.array([0.0, 0.2, 0.0])
    wide = left + np.array([0.0, 9.0, 0.0])
    behind = left - [200.0, 0.0, 0.0]
    rows = lateral_positions([left, double, wide, behind], camera, T)
    assert len(rows) == 2  # a double line is one, and what lies behind is none
    np.testing.assert_allclose(rows[0, :19], -2.0)
    assert np.isnan(rows[0, 19:]).all()  # the line ends 40 m ahead
    assert np.isnan(rows[1, SAMPLES_M < 11.0 / 0.77]).all()  # outside the image
    write_lanes(tmp_path, [rows, rows[:1], rows[:0]])
    assert [len(lanes) for lanes in read_lanes(tmp_path)] == [2, 1, 0]


def test_pairs_without_lanes_or_of_another_lens_are_refused(tmp_path):
    camera = {"K": K.tolist(), "T_rig_camera": np.eye(4).tolist()}
    sequence = make(tmp_path, camera=camera)
    with pytest.raises(InputError, match=r"no road users|lanes\.npy"):
        FrameBatches([sequence], 1, 0)[0]
    other = make(tmp_path, name="b", camera={**camera, "K": (2 * K).tolist()})
    with pytest.raises(InputError, match="none with the camera"):
        usual_sequences([other])
