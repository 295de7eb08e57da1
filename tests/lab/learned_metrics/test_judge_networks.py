"""The judges' networks: what they decode, that files are those that were frozen, and the loaders of
the paper's own networks.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import CameraSpec
from alpasim_plugin.lab.learned_metrics.nets.cuboid_net import OUTPUTS, decode, encode
from alpasim_plugin.lab.learned_metrics.nets.detect import find_cuboids, find_lanes
from alpasim_plugin.lab.learned_metrics.nets.files import (
    NAMES,
    SEEDS,
    check_digests,
    file_name,
    freeze,
    frozen_digests,
    load_judge,
    save_judge,
    untrained,
)
from alpasim_plugin.lab.learned_metrics.nets.ground_view import GroundView
from alpasim_plugin.lab.learned_metrics.nets.lane_net import CELLS, join_lines
from alpasim_plugin.lab.learned_metrics.nets.video_net import VideoNet, window_features
from alpasim_plugin.lab.learned_metrics.types import FORWARD_M, Cuboid

REPO = Path(__file__).resolve().parents[3]
TYPES = "alpasim_plugin.lab.learned_metrics.types"  # what is measured, without a network
LAB = REPO / "alpasim_plugin" / "lab"
K = np.array([[167.0, 0.0, 128.0], [0.0, 167.0, 72.0], [0.0, 0.0, 1.0]])
# 1.5 m above the ground, looking along the rig's x axis.
MOUNT = np.array(
    [[0.0, 0.0, 1.0, 1.0], [-1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 1.5], [0.0, 0.0, 0.0, 1.0]]
)
CAMERA = CameraSpec("camera", 256, 144, K, MOUNT)


def cells_with(
    lines: dict[float, float], logit: float = 4.0, rows: range = range(29)
) -> np.ndarray:
    """Network output for straight lines: lateral position at 3 m -> slope, metres per row."""
    out = np.zeros((3, 29, CELLS), dtype=np.float32)
    out[0] = -6.0
    for at, slope in lines.items():
        for row in rows:
            cell = (10.8 - (at + slope * row)) / 0.4
            out[:, row, int(cell)] = logit, cell - int(cell) - 0.5, slope
    return out


def test_points_are_joined_to_lines_where_they_are() -> None:
    found = join_lines(cells_with({-1.73: 0.0, 1.81: 0.05, 5.0: 0.06}))
    assert sorted(round(float(lane.lateral_m[0]), 2) for lane in found) == [-1.73, 1.81, 5.0]
    assert {round(float(lane.lateral_m[28] - lane.lateral_m[0]), 2) for lane in found} == {
        0.0,
        1.4,
        1.68,
    }
    assert found[0].score == pytest.approx(1 / (1 + np.exp(-4.0)), rel=1e-6)


def test_a_line_bridges_a_gap_between_dashes_and_no_longer_one() -> None:
    short, long = cells_with({1.8: 0.0}), cells_with({1.8: 0.0})
    short[0, 10:13], long[0, 10:14] = -6.0, -6.0
    assert [np.isfinite(lane.lateral_m).sum() for lane in join_lines(short)] == [29]
    assert sorted(int(np.isfinite(lane.lateral_m).sum()) for lane in join_lines(long)) == [10, 15]


def test_lines_that_cross_keep_their_direction() -> None:
    found = join_lines(cells_with({-2.0: 0.2, 3.6: -0.2}))
    ends = sorted(
        (round(float(lane.lateral_m[0]), 1), round(float(lane.lateral_m[28]), 1))
        for lane in found
        if np.isfinite(lane.lateral_m).all()
    )
    assert (-2.0, 3.6) in ends


def test_single_points_and_unsure_ones_are_no_line() -> None:
    assert join_lines(cells_with({0.0: 0.0}, rows=range(2))) == []
    assert join_lines(cells_with({0.0: 0.0}, logit=-1.0)) == []


def test_the_ground_view_puts_a_painted_line_where_it_is() -> None:
    image = np.zeros((144, 256, 3), dtype=np.uint8)
    for x_m in np.linspace(3.5, 30, 4000):  # a line 2 m to the left
        u, v = 128 - 167 * 2.0 / (x_m - 1.0), 72 + 167 * 1.5 / (x_m - 1.0)
        if 0 <= u < 256 and 0 <= v < 144:
            image[int(v), int(u)] = 255
    seen = GroundView(CAMERA)(image)
    assert seen.shape == (4, 58, 216)
    rows = slice(4, 14)  # 6.5 to 15.5 m
    assert np.abs(brightest(seen[:, rows], 10.8) - 2.0).max() < 0.15
    assert seen[3, 0].mean() < 1.0
    assert seen[3, 30].all()
    aside = GroundView(CAMERA, shift_m=1.0)(image)
    assert np.abs(brightest(aside[:, rows], 11.8) - 2.0).max() < 0.15


def brightest(seen: np.ndarray, left_m: float) -> np.ndarray:
    return left_m - 0.1 * (np.where(seen[3] > 0, seen[0], -2.0).argmax(axis=1) + 0.5)


@pytest.mark.parametrize("yaw", [-3.0, -1.5, 0.0, 0.4, 2.9])
def test_a_vehicle_that_is_encoded_is_decoded(yaw: float) -> None:
    box = Cuboid("truck", 1.0, -4.0, 0.6, 27.0, 8.2, 3.1, 2.5, yaw)
    coded = encode(box, K, 256)
    assert coded is not None
    u, v, values = coded
    cells = np.full((OUTPUTS, 36, 64), -9.0, dtype=np.float32)
    cells[:9, int(v), int(u)] = 3.0, u - int(u), v - int(v), *values[1:]
    cells[9 + int(values[0]), int(v), int(u)] = 5.0
    (found,) = decode(cells, K, 256, 0.1)
    assert found.label == "truck"
    assert (found.x_m, found.y_m, found.z_m) == pytest.approx((-4.0, 0.6, 27.0), rel=1e-5)
    assert (found.length_m, found.height_m, found.width_m) == pytest.approx(
        (8.2, 3.1, 2.5), rel=1e-5
    )
    assert np.exp(1j * found.yaw_rad) == pytest.approx(np.exp(1j * yaw), rel=1e-5)


def test_the_focal_length_sets_the_depth() -> None:
    near, far = (
        Cuboid("car", 1.0, 0.0, 0.5, 10.0, 4.0, 1.5, 1.8, 0.0),
        Cuboid("car", 1.0, 0.0, 0.5, 20.0, 4.0, 1.5, 1.8, 0.0),
    )
    twice = np.array([[334.0, 0, 128], [0, 334.0, 72], [0, 0, 1]])
    one, other = encode(near, K, 256), encode(far, twice, 256)
    assert one is not None
    assert other is not None
    assert one[2] == pytest.approx(other[2])
    assert one[:2] == pytest.approx(other[:2])


def test_judges_give_arrays_and_no_gradient_passes() -> None:
    frames = np.zeros((2, 144, 256, 3), dtype=np.uint8)
    assert len(find_lanes(untrained("lane"), frames, CAMERA)) == 2
    assert len(find_cuboids(untrained("cuboid"), frames, K)) == 2
    net = VideoNet()
    features = window_features(net, np.zeros((33, 144, 256, 3), dtype=np.uint8))
    assert features.shape == (2, 128)
    assert isinstance(features, np.ndarray)
    assert window_features(net, np.zeros((15, 144, 256, 3), dtype=np.uint8)).shape == (0, 128)
    with pytest.raises(InputError, match="the camera that took the frames"):
        find_lanes(untrained("lane"), frames[:, :100], CAMERA)
    with pytest.raises(InputError, match="multiples of 16"):
        find_cuboids(untrained("cuboid"), frames[:, :100], K)


def test_a_judge_whose_file_has_changed_is_not_loaded(tmp_path: Path) -> None:
    path = tmp_path / file_name("style", 0)
    save_judge(path, "style", untrained("style"), {"seed": "0"})
    with pytest.raises(InputError, match="simrun judge freeze"):
        load_judge("style", 0, tmp_path)
    freeze(tmp_path)
    assert list(check_digests(tmp_path)) == [path.name]
    assert not any(p.requires_grad for p in load_judge("style", 0, tmp_path).parameters())
    save_judge(path, "style", untrained("style"), {"seed": "1"})
    load_judge.cache_clear()
    for call in (
        lambda: load_judge("style", 0, tmp_path),
        lambda: check_digests(tmp_path),
        lambda: freeze(tmp_path),
    ):
        with pytest.raises(InputError, match="frozen was"):
            call()


def test_the_shipped_judges_are_those_that_were_frozen() -> None:
    shipped = check_digests()
    assert set(shipped) == {file_name(name, seed) for name in NAMES for seed in SEEDS}
    assert frozen_digests() == shipped
    for name in NAMES:
        load_judge(name, 0)


def test_weights_of_another_judge_are_refused(tmp_path: Path) -> None:
    path = tmp_path / file_name("lane", 0)
    save_judge(path, "style", untrained("style"), {})
    freeze(tmp_path)
    with pytest.raises(InputError, match="of judge 'style'"):
        load_judge("lane", 0, tmp_path)


IMPORT = re.compile(r"^\s*(?:from ([\w.]+) import (\([^)]*\)|[^\n]*)|import ([\w., ]+))", re.M)


def imported(path: Path) -> set[str]:
    """Return the modules and names that a file imports, by its text: parsing every file takes
    seconds.
    """
    found: set[str] = set()
    for module, names, plain in IMPORT.findall(path.read_text()):
        found |= (
            {f"{module}.{name}" for name in re.findall(r"\w+", names)} | {module}
            if module
            else set(re.findall(r"[\w.]+", plain))
        )
    return found


def test_imports_are_read_from_text() -> None:
    seen = imported(Path(__file__))
    assert {
        "alpasim_plugin.lab.learned_metrics.nets.files.load_judge",
        "numpy",
        "alpasim_plugin.core.types",
    } <= seen


def test_nothing_that_is_trained_or_driven_may_load_a_judge() -> None:
    trained = [*(LAB / "training").rglob("*.py"), *(LAB / "cli").glob("train*.py")]
    driven = [
        p
        for part in ("fixers", "renderers", "runtime", "nets")
        for p in (REPO / "alpasim_plugin" / part).rglob("*.py")
    ]
    driven += (REPO / "policies").rglob("*.py")
    loaders = {
        "alpasim_plugin.lab.learned_metrics.nets.files.load_judge",
        "alpasim_plugin.lab.learned_metrics.nets.files.read_judge",
        "alpasim_plugin.lab.learned_metrics.nets.detect",
    }
    wrong = []
    for path in (*trained, *driven):
        inside = "learned_metrics" in path.parts or path.name == "train_judge.py"
        names = {
            name
            for name in imported(path)
            if name.startswith("alpasim_plugin.lab.learned_metrics") and not name.startswith(TYPES)
        }
        if names & loaders or (names and not inside):
            wrong.append((path.name, sorted(names)))
    assert len(trained) > 40
    assert len(driven) > 60
    assert wrong == []


def test_forward_samples_lie_between_two_rows_of_the_view() -> None:
    rows = 2.5 + np.arange(58)
    assert np.allclose((rows[::2] + rows[1::2]) / 2, FORWARD_M)
