"""Training of the judges: the truth of a scene, labels that fit their frames, batches that repeat,
styles by formula.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import CameraSpec, Lane, LaneMap, Marking
from alpasim_plugin.lab.learned_metrics.nets.cuboid_net import decode
from alpasim_plugin.lab.learned_metrics.types import FORWARD_M, Cuboid, cuboid_corners
from alpasim_plugin.lab.training.appearance import SeenFrame, restyle, vehicle_lamps
from alpasim_plugin.lab.training.learned_metrics.cuboid import (
    CuboidRecipe,
    CuboidTask,
    cuboid_cells,
)
from alpasim_plugin.lab.training.learned_metrics.frames import LabelledFrames, chosen
from alpasim_plugin.lab.training.learned_metrics.labels import Labels, for_training
from alpasim_plugin.lab.training.learned_metrics.lane import LaneRecipe, LaneTask, lane_cells
from alpasim_plugin.lab.training.learned_metrics.style import StyleRecipe, StyleTask
from alpasim_plugin.lab.training.learned_metrics.truth import (
    lanes_seen,
    visible_cuboids,
    world_lines,
)
from alpasim_plugin.lab.training.learned_metrics.video import VideoRecipe, VideoTask
from tests.lab.training.pair_files import make

K = np.array([[167.0, 0.0, 128.0], [0.0, 167.0, 72.0], [0.0, 0.0, 1.0]])
MOUNT = np.array(
    [[0.0, 0.0, 1.0, 1.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]]
)
CAMERA = CameraSpec("camera", 256, 144, K, MOUNT)
CAR = Cuboid("car", 1.0, 0.0, 0.7, 20.0, 4.5, 1.5, 1.8, -np.pi / 2)


def line(x0: float, x1: float, y: float) -> np.ndarray:
    x = np.linspace(x0, x1, 12)
    return np.stack([x, np.full_like(x, y), 0 * x], axis=1)


def test_pieces_of_one_line_are_joined_in_either_direction_and_others_are_not() -> None:
    pieces = [line(0, 30, 1.8), line(60, 30.2, 1.8), line(60.1, 90, 1.8), line(0, 90, 5.4)]
    found = world_lines(LaneMap({}, markings=tuple(Marking(p, "dashed_white") for p in pieces)))
    assert sorted(round(float(np.ptp(one[:, 0]))) for one in found) == [90, 90]


def test_paint_on_lane_edges_counts_beside_markings_of_their_own() -> None:
    lane = Lane(
        "a",
        line(0, 60, 0.0),
        line(0, 60, 1.8),
        line(0, 60, -1.8),
        left_paint="solid_white",
        right_paint="unknown",
    )
    found = world_lines(LaneMap({"a": lane}, markings=(Marking(line(0, 60, 9.0), "dashed_white"),)))
    assert sorted(float(one[0, 1]) for one in found) == [1.8, 9.0]


def test_lanes_are_seen_from_the_rig_and_end_at_the_images_border() -> None:
    pose = np.eye(4)
    pose[:2, 3] = 10.0, 1.0
    (lane,) = lanes_seen([line(0, 45, 2.8)], pose, CAMERA)
    seen = np.isfinite(lane.lateral_m)
    assert lane.lateral_m[seen] == pytest.approx(1.8)
    assert FORWARD_M[seen].max() == 35  # the line ends there
    assert FORWARD_M[seen].min() == 5  # nearer points are below the image
    assert lanes_seen([line(-60, -20, 1.8)], pose, CAMERA) == []


def test_a_hidden_vehicle_is_left_out_and_half_a_one_is_not() -> None:
    behind = replace(CAR, z_m=30.0)
    assert visible_cuboids([behind, CAR], CAMERA) == [CAR]
    beside = replace(CAR, z_m=30.0, x_m=2.0)
    assert visible_cuboids([beside, CAR], CAMERA) == [CAR, beside]
    assert visible_cuboids([replace(CAR, z_m=61.0), replace(CAR, x_m=40.0)], CAMERA) == []


def test_cells_of_lanes_say_where_they_pass() -> None:
    lane = np.full(29, np.nan)
    lane[2:10] = 1.85 + 0.1 * np.arange(8)
    cells = lane_cells(lane[None], np.ones((58, 216), dtype=np.float32))
    rows, columns = np.nonzero(cells[0])
    assert rows.tolist() == list(range(2, 10))
    assert 10.8 - 0.4 * (columns + 0.5 + cells[1, rows, columns]) == pytest.approx(
        lane[2:10], abs=1e-5
    )
    assert cells[2, rows, columns] == pytest.approx(0.1, abs=1e-5)
    across = np.full(29, np.nan)
    across[5:7] = -3.0, 3.0
    assert not lane_cells(across[None], np.ones((58, 216), dtype=np.float32))[0].any()


def test_cells_of_vehicles_decode_to_them() -> None:
    heat, middle, numbers, kind = cuboid_cells([CAR, replace(CAR, x_m=60.0)], K, 256, 144)
    assert middle.sum() == 1
    assert heat.max() == 1.0
    cells = np.concatenate(
        [
            np.where(middle, 5.0, -5.0)[None],
            numbers,
            (kind[None] == np.arange(3)[:, None, None]) * 1.0,
        ]
    )
    (found,) = decode(cells.astype(np.float32), K, 256, 0.1)
    assert (found.x_m, found.y_m, found.z_m, found.length_m) == pytest.approx(
        (0.0, 0.7, 20.0, 4.5), rel=1e-4, abs=1e-4
    )


def labelled(tmp_path: Path) -> LabelledFrames:
    sequence = make(tmp_path / "pairs", height=144, width=256, frames=3)
    lanes = np.full((2, 1, 29), 1.8)
    vehicle = np.array(
        [[0, CAR.x_m, CAR.y_m, CAR.z_m, CAR.length_m, CAR.height_m, CAR.width_m, CAR.yaw_rad]]
    )
    labels = Labels(np.array([0, 2]), lanes, np.stack([vehicle, np.full((1, 8), np.nan)]), CAMERA)
    return LabelledFrames((sequence,), (labels,))


def test_batches_depend_on_their_number_alone_and_give_finite_gradients(tmp_path: Path) -> None:
    data = labelled(tmp_path)
    for task in (LaneTask(data, LaneRecipe(batch=2)), CuboidTask(data, CuboidRecipe(batch=2))):
        one, again = task.batch(3), task.batch(3)
        assert all(
            torch.equal(getattr(one, k), getattr(again, k)) for k in one.__dataclass_fields__
        )
        assert not torch.equal(
            one.__dict__[next(iter(one.__dict__))], task.batch(4).__dict__[next(iter(one.__dict__))]
        )
        loss, _ = task.loss(one, 3)
        loss.backward()
        assert all(
            p.grad is not None and bool(p.grad.isfinite().all()) for p in task.module.parameters()
        )
        assert task.facts["labelled_frames"] == 2


def test_augmentation_moves_the_truth_with_the_picture(tmp_path: Path) -> None:
    """Depth over focal length, which the cells hold, shrinks by the zoom and by nothing else."""
    task = CuboidTask(labelled(tmp_path), CuboidRecipe(batch=1))
    seen = 0
    for number in range(12):
        batch = task.batch(number)
        if not batch.middle.any():
            continue
        row, column = (int(v) for v in batch.middle[0].nonzero()[0])
        numbers = batch.numbers[0, :, row, column]
        seen += 1
        zoom_depth = float(
            np.exp(float(numbers[2]) + np.log(30.0)) / 256
        )  # depth over focal length
        assert zoom_depth * 1.0001 >= 20.0 / (1.3 * 167)
        assert zoom_depth <= 20.0 / 167 * 1.0001
    assert seen > 3


def test_test_scenes_are_refused_for_training(tmp_path: Path) -> None:
    test = make(tmp_path, split="test-known", height=32, width=256)
    with pytest.raises(InputError, match="train and val only"):
        for_training([test])
    with pytest.raises(InputError, match="train and val only"):
        chosen([test])
    with pytest.raises(InputError, match="train and val only"):
        VideoTask([test], VideoRecipe())


def test_video_windows_tell_order_and_motion(tmp_path: Path) -> None:
    sequence = make(tmp_path, frames=20, height=64, width=112)
    sequence.info["family"] = "street"
    task = VideoTask([sequence], VideoRecipe(batch=6))
    batch = task.batch(0)
    assert batch.video.shape == (6, 3, 16, 64, 112)
    forward, back = batch.motion[batch.order == 0], batch.motion[batch.order == 1]
    assert torch.allclose(forward[:, 0], torch.tensor(1.0))
    assert torch.allclose(back[:, 0], torch.tensor(-1.0))
    loss, numbers = task.loss(batch, 0)
    assert bool(loss.isfinite())
    assert {"order", "motion", "occupancy"} <= set(numbers)


def seen(depth_m: float = 20.0) -> SeenFrame:
    rgb = np.full((36, 64, 3), 128, dtype=np.uint8)
    pose = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]])
    lens = np.array([[40.0, 0, 32], [0, 40.0, 18], [0, 0, 1]])
    return SeenFrame(
        rgb, np.full((36, 64), depth_m, dtype=np.float32), lens, pose, 0, np.zeros((0, 6))
    )


def test_fog_is_koschmieders_law() -> None:
    near, far = (restyle(seen(d), "fog", "scene", 0)[0, 0].astype(float) for d in (10.0, 40.0))
    sky = restyle(seen(0.0), "fog", "scene", 0)[0, 0].astype(float)
    share = [(sky - x)[0] / (sky - 128)[0] for x in (near, far)]
    assert share[1] == pytest.approx(share[0] ** 4, abs=0.02)  # exp(-b 40) = exp(-b 10)^4
    assert -np.log(share[0]) / 10 == pytest.approx(0.045, abs=0.016)


def test_night_is_dark_and_lamps_shine_where_nothing_hides_them() -> None:
    lamp = np.array([[0.0, 0.0, 15.0, 1.0, 1.0, 1.0]])
    dark, lit = (
        restyle(seen(), "night", "scene", 0),
        restyle(replace(seen(), lamps=lamp), "night", "scene", 0),
    )
    assert dark.mean() < 50
    assert lit[18, 32].min() > 150 > dark[18, 32].max()
    hidden = replace(seen(10.0), lamps=lamp)
    assert np.array_equal(
        restyle(hidden, "night", "scene", 0), restyle(seen(10.0), "night", "scene", 0)
    )


def test_snow_lies_on_ground_and_not_on_walls() -> None:
    v = np.arange(36)[:, None] + 0.5 - 18
    ground = np.where(v > 1, 1.5 * 40 / np.maximum(v, 1), 0.0) * np.ones((1, 64))
    floor = restyle(replace(seen(), depth_m=ground.astype(np.float32)), "snow", "scene", 0)
    wall = restyle(seen(), "snow", "scene", 0)
    assert np.median(floor[24:34]) > 165
    assert np.median(wall) == 128


def test_styles_repeat_and_unknown_ones_are_refused() -> None:
    assert np.array_equal(restyle(seen(), "snow", "scene", 1), restyle(seen(), "snow", "scene", 1))
    assert np.array_equal(restyle(seen(), "clear", "scene", 1), seen().rgb)
    with pytest.raises(InputError, match="no such style"):
        restyle(seen(), "rain", "scene", 1)


def test_a_vehicle_that_comes_has_white_lamps_and_one_ahead_red_ones() -> None:
    away = vehicle_lamps([cuboid_corners(CAR)])  # it looks where the camera looks
    coming = vehicle_lamps([cuboid_corners(replace(CAR, yaw_rad=np.pi / 2))])
    assert len(away) == len(coming) == 2
    assert (away[:, 3] > 3 * away[:, 4]).all()
    assert (coming[:, 3:] > 0.7).all()
    assert (np.abs(away[:, 0]) < 0.9).all()
    assert (away[:, 2] < CAR.z_m).all()


def test_style_batches_repeat() -> None:
    frames = np.stack([np.full((2, 144, 256, 3), v, dtype=np.uint8) for v in (10, 90, 170, 250)])
    task = StyleTask(frames, StyleRecipe(batch=8), {})
    one, again = task.batch(1), task.batch(1)
    assert torch.equal(one.image, again.image)
    assert torch.equal(one.style, again.style)
    loss, _ = task.loss(one, 1)
    assert bool(loss.isfinite())
