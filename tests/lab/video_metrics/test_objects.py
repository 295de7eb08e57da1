"""Cuboid F1 and Lane F1 of made-up detections whose overlap is known, and of made-up detectors."""

import sys

import numpy as np
import pytest

from alpasim_plugin.core.errors import EvaluatorError, InfrastructureError, InputError
from alpasim_plugin.fixers.semantic_map.style import BOX_COLOURS, COLOURS
from alpasim_plugin.lab.video_metrics.cuboids import Boxes, drawn_vehicles, overlap
from alpasim_plugin.lab.video_metrics.detectors import (
    FILES,
    available_detectors,
    detect_boxes,
    intrinsics_of,
)
from alpasim_plugin.lab.video_metrics.lanes import SAMPLES_M, Lanes, lane_matches, match
from alpasim_plugin.lab.video_metrics.objects import clean_metrics, detect_objects, object_metrics
from alpasim_plugin.lab.video_metrics.onnx_program import load_onnx
from alpasim_plugin.lab.video_metrics.summary import summarise
from tests.lab.video_metrics.scripted_detectors import BoxDetector, LaneDetector, save_script

K = np.array([[100.0, 0.0, 160.0], [0.0, 100.0, 90.0], [0.0, 0.0, 1.0]])


def boxes(*rows, scores=None, labels=None):
    count = len(rows)
    scores = np.ones(count) if scores is None else np.array(scores)
    labels = np.zeros(count, dtype=np.int64) if labels is None else np.array(labels)
    return Boxes(np.array(rows).reshape(-1, 7), scores, labels, K, (180, 320))


def flat(x, length=4.0, z=10.0):
    """Return a box of almost no depth: its mask is a rectangle."""
    return [x, 0.0, z, length, 2.0, 1e-9, 0.0]


def test_mask_of_a_frontal_box_is_its_rectangle():
    rows, columns = np.nonzero(boxes(flat(0.0)).mask())
    assert (rows.min(), rows.max(), columns.min(), columns.max()) == (80, 100, 140, 180)
    assert len(rows) == 21 * 41


def test_equal_disjoint_and_half_shifted_boxes():
    true = boxes(flat(0.0)).mask()
    assert overlap([true], [true]).f1 == 1.0
    assert overlap([boxes(flat(8.0)).mask()], [true]).f1 == 0.0
    assert overlap([boxes(flat(2.0)).mask()], [true]).f1 == pytest.approx(0.5, abs=0.02)
    nothing = boxes().mask()
    assert overlap([nothing], [nothing]).f1 is None
    assert overlap([nothing], [true]).f1 == 0.0
    both = overlap([true, nothing], [true, true])
    assert (both.precision, both.recall) == (1.0, 0.5)
    assert both.f1 == pytest.approx(2 / 3)


def test_a_box_turned_by_a_right_angle_shows_its_width():
    row = [0.0, 0.0, 10.0, 1e-9, 2.0, 4.0, np.pi / 2]
    assert np.array_equal(boxes(row).mask(), boxes(flat(0.0)).mask())


def test_weak_scores_other_classes_and_boxes_behind_the_camera_do_not_count():
    assert not boxes(flat(0.0), scores=[0.09]).mask().any()
    assert not boxes(flat(0.0), labels=[7]).mask().any()
    assert not boxes([0.0, 0.0, 1.0, 1.0, 1.0, 1.2, 0.0]).mask().any()  # a corner at 0.4 m
    assert boxes([0.0, 0.0, 1.2, 1.0, 1.0, 1.2, 0.0]).mask().any()


def test_drawn_vehicles_are_cars_and_trucks_and_no_paint():
    sdmap = np.zeros((4, 8, 3), dtype=np.uint8)
    front, back = (np.array(colour) for colour in BOX_COLOURS["car"])
    sdmap[0, :3] = [front, back, (front + back) / 4]
    sdmap[1, :2] = BOX_COLOURS["truck"]
    sdmap[2, :2] = BOX_COLOURS["pedestrian"]
    paint = ("line_white", "road_boundary", "line_yellow", "line_untyped")
    sdmap[3, :4] = [COLOURS[name] for name in paint]
    mask = drawn_vehicles(sdmap, (8, 16))
    assert mask.shape == (8, 16)
    assert mask[::2, ::2].sum(axis=1).tolist() == [3, 2, 0, 0]


def test_a_near_car_in_the_colour_of_an_untyped_line_is_a_vehicle_and_the_line_is_none():
    sdmap = np.zeros((40, 256, 3), dtype=np.uint8)
    sdmap[10:30, 50:80] = (101, 174, 231)  # between its front and its back colour
    sdmap[:, 120:122] = COLOURS["line_untyped"]
    mask = drawn_vehicles(sdmap, (40, 256))
    assert mask[10:30, 50:80].all()
    assert not mask[:, 90:].any()


def lanes(*offsets, end=80.0, scores=None, far=None):
    """Return straight lanes at lateral offsets; from ``far`` metres on the first lies 3 m aside."""
    ahead = np.linspace(3.0, end, 78)
    points = np.array([np.stack([np.full(78, x), ahead, np.zeros(78)], axis=-1) for x in offsets])
    points = points.reshape(-1, 78, 3)
    if far is not None:
        points[0, ahead >= far, 0] += 3.0
    scores = np.ones(len(offsets)) if scores is None else np.array(scores)
    return Lanes(points, np.ones(points.shape[:2], dtype=bool), scores)


def test_lanes_that_lie_beside_each_other_match_up_to_the_gate():
    near = lane_matches([lanes(0.4, 4.4)], [lanes(0.0, 4.0)])
    assert near.f1 == 1.0
    assert near.error_m == pytest.approx(0.4)
    apart = lane_matches([lanes(1.6)], [lanes(0.0)])
    assert apart.f1 == 0.0
    assert apart.error_m is None
    assert lane_matches([lanes()], [lanes()]).f1 is None
    part = lane_matches([lanes(0.0), lanes()], [lanes(0.0, 4.0), lanes(0.0)])
    assert (part.matched, part.extra, part.missed) == (1, 0, 2)
    assert part.f1 == 0.5


def test_three_quarters_of_the_common_samples_must_lie_within_the_gate():
    straight = lanes(0.0)
    for far, count in ((46.5, 1), (44.5, 0)):  # 22 and 21 of 29 samples
        assert lane_matches([lanes(0.0, far=far)], [straight]).matched == count


def test_lanes_are_paired_for_the_least_sum():
    a, b = lanes(0.0, 1.0).resampled(), lanes(0.9, 1.4).resampled()
    assert match(a, b) == [(0, 0), (1, 1)]


def test_short_far_and_weak_lanes_do_not_count():
    assert len(lanes(0.0, end=22.0).resampled()) == 0
    assert len(lanes(0.0, end=24.0).resampled()) == 1
    assert len(lanes(10.5, -10.5, 9.5).resampled()) == 1
    assert len(lanes(0.0, 1.0, scores=[0.49, 0.5]).resampled()) == 1


def video(level):
    return np.full((2, 18, 32, 3), level, dtype=np.uint8)


SMALL_K = np.array([[10.0, 0.0, 16.0], [0.0, 10.0, 9.0], [0.0, 0.0, 1.0]])


def test_detectors_from_files_are_asked_about_both_videos(tmp_path):
    assert available_detectors(tmp_path) == {}
    save_script(BoxDetector(), tmp_path / FILES["cuboid_f1"])
    save_script(LaneDetector(), tmp_path / FILES["lane_f1"])
    assert sorted(available_detectors(tmp_path)) == ["cuboid_f1", "lane_f1"]
    sdmap = video(0)
    sdmap[:, 8:10, 14:18] = BOX_COLOURS["car"][0]
    true = detect_objects(video(51), SMALL_K, tmp_path)
    values = object_metrics(detect_objects(video(204), SMALL_K, tmp_path), true)
    line = np.where(SAMPLES_M < 40.0, 0.4, np.nan)
    beside = np.where(SAMPLES_M < 40.0, -5.0, np.nan)
    values |= clean_metrics(true, sdmap, [np.stack([line, beside])] * 2)
    assert values["lane_clean_precision"] == 1.0
    assert values["lane_clean_recall"] == 0.5
    assert "lane_clean_recall" not in clean_metrics(true, sdmap, None)
    assert values["cuboid_f1"] == pytest.approx((4 - 2.4) / 4, abs=0.01)
    assert values["cuboid_clean_precision"] == pytest.approx(3.2 / 4, abs=0.01)
    assert values["cuboid_clean_recall"] == pytest.approx(3.2 / 4, abs=0.01)
    assert values["lane_f1"] == 1.0
    assert values["lane_error_m"] == pytest.approx(0.6)
    (found, _) = detect_boxes(video(51), SMALL_K, tmp_path)
    assert found.size == (2280, 4053)
    assert found.K[0, 0] == pytest.approx(1266.42)
    nothing = detect_objects(video(0), SMALL_K, tmp_path)
    assert sorted(object_metrics(nothing, nothing)) == ["lane_error_m", "lane_f1"]


def test_every_fifth_frame_is_searched(tmp_path):
    save_script(LaneDetector(), tmp_path / FILES["lane_f1"])
    frames = np.concatenate([video(51), video(204)] * 3)[:11]
    offsets = [lane.points[0, 0, 0] for lane in detect_objects(frames, SMALL_K, tmp_path).lanes]
    assert offsets == pytest.approx([0.2, 0.2, 0.8])  # frames 0, 5 and 10
    assert detect_objects(frames, SMALL_K, tmp_path).boxes is None


def test_a_detector_that_answers_otherwise_and_a_clip_without_a_camera_are_said(tmp_path):
    save_script(LaneDetector(), tmp_path / FILES["cuboid_f1"])
    with pytest.raises(EvaluatorError, match="boxes"):
        list(detect_boxes(video(9), SMALL_K, tmp_path))
    with pytest.raises(InputError, match="camera"):
        intrinsics_of({"lens": 3}, "clip")
    assert intrinsics_of({"K": SMALL_K.tolist()}, "clip").shape == (3, 3)


def save_onnx(path, inputs=("image", "K")):
    """Write a network that finds a lane as far to the side as the image is bright."""
    onnx = pytest.importorskip("onnx")
    helper, types = onnx.helper, onnx.TensorProto
    ahead = np.linspace(3.0, 80.0, 40, dtype=np.float32)
    line = np.stack([np.zeros(40), ahead, np.zeros(40)], axis=1).astype(np.float32)[None]
    side = np.tile(np.array([1.0, 0.0, 0.0], dtype=np.float32), (1, 40, 1))
    values = {"line": line, "side": side, "visible": np.ones((1, 40), dtype=np.float32)}
    values["scores"] = np.ones(1, dtype=np.float32)
    constants = [onnx.numpy_helper.from_array(value, name) for name, value in values.items()]
    nodes = [
        helper.make_node("ReduceMean", [inputs[0]], ["bright"], keepdims=0),
        helper.make_node("Mul", ["side", "bright"], ["aside"]),
        helper.make_node("Add", ["line", "aside"], ["points"]),
        helper.make_node("Identity", ["visible"], ["out_visible"]),
        helper.make_node("Identity", ["scores"], ["out_scores"]),
        helper.make_node("Identity", [inputs[1]], ["unused"]),
    ]
    graph = helper.make_graph(
        nodes,
        "lanes",
        [
            helper.make_tensor_value_info(name, types.FLOAT, shape)
            for name, shape in zip(inputs, ([3, "h", "w"], [3, 3]), strict=True)
        ],
        [
            helper.make_tensor_value_info(name, types.FLOAT, None)
            for name in ("points", "out_visible", "out_scores")
        ],
        constants,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    path.write_bytes(model.SerializeToString())


def test_a_detector_may_be_an_onnx_file(tmp_path):
    pytest.importorskip("onnxruntime")
    save_onnx(tmp_path / "lane_detector.onnx")
    assert sorted(available_detectors(tmp_path)) == ["lane_f1"]
    found = detect_objects(video(51), SMALL_K, tmp_path).lanes
    assert [lane.points[0, 0, 0] for lane in found] == pytest.approx([0.2], rel=1e-5)
    save_script(LaneDetector(), tmp_path / FILES["lane_f1"])
    with pytest.raises(InputError, match=r"lane_detector\.pt and lane_detector\.onnx"):
        available_detectors(tmp_path)


def test_an_onnx_file_with_other_inputs_and_a_damaged_one_are_refused(tmp_path):
    pytest.importorskip("onnxruntime")
    path = tmp_path / "lane_detector.onnx"
    save_onnx(path, ("picture", "K"))
    with pytest.raises(InputError, match="inputs picture, K"):
        load_onnx(path)
    path.write_bytes(b"nothing")
    with pytest.raises(InputError, match="no ONNX network"):
        load_onnx(path)


def test_an_onnx_file_without_onnxruntime_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(InfrastructureError, match="onnxruntime is not installed"):
        load_onnx(tmp_path / "lane_detector.onnx")


def test_clips_without_a_vehicle_are_left_out_of_the_mean():
    def row(variant, clip, **values):
        common = {"frames": 2, "identical": 0, "events": {}, "ms_per_frame": []}
        return {"arm": variant, "clip": clip, "scene": clip, "values": values, **common}

    rows = [row("3dgs", "a", psnr_db=20.0, cuboid_f1=0.5), row("3dgs", "b", psnr_db=22.0)]
    rows += [row("f", "a", psnr_db=21.0, cuboid_f1=0.75), row("f", "b", psnr_db=23.0)]
    summary = summarise(rows, "3dgs")
    arm = summary["arms"]["f"]
    assert (arm["cuboid_f1"]["mean"], arm["cuboid_f1"]["n"], arm["psnr_db"]["n"]) == (0.75, 1, 2)
    pair = summary["paired"]["f"]["cuboid_f1"]
    assert (pair["diff"], pair["n"]) == (0.25, 1)
    assert "lane_f1" not in arm
