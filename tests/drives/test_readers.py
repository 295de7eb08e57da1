"""Every form of a recorded drive gives the same street: its way, its road and its scale."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from alpasim_plugin.drives.opening import read_source
from alpasim_plugin.drives.source import checked
from tests.drives.opened_drives import opened
from tests.drives.street import COUNT, edited, write_colmap, write_transforms
from tests.examples import first_rows_of


@pytest.mark.slow
def test_transforms_of_both_conventions_are_recognised_without_a_word(tmp_path):
    for axes in ("opencv", "opengl"):
        drive, _ = opened(write_transforms(tmp_path / axes, axes=axes, say_axes=False))
        assert any(f"axes recognised as {axes}" in note for note in drive.notes)


@pytest.mark.parametrize(
    ("model", "bend"),
    first_rows_of(
        [
            ("SIMPLE_RADIAL", (-0.05,)),
            ("OPENCV", (-0.08, 0.01, 0.001, -0.001)),
            ("OPENCV_FISHEYE", (0.02, -0.01, 0.0, 0.0)),
        ]
    ),
)
def test_photographs_are_freed_of_every_lens(tmp_path, model, bend):
    drive = read_source(write_colmap(tmp_path / "a", True, model, bend))
    plain = read_source(write_colmap(tmp_path / "b", True))
    bent = drive.photographs[5]
    straight = plain.photographs[5]
    K = bent.lens.straight_K()
    H = straight.lens.K @ np.linalg.inv(K)
    back = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1.0]])
    warped = cv2.warpPerspective(
        straight.rgb(),
        np.linalg.inv(back) @ H @ back,
        (320, 128),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
    )
    inner = (slice(20, -20), slice(30, -30))
    off = np.abs(
        cv2.GaussianBlur(warped, (0, 0), 1.5)[inner].astype(float)
        - cv2.GaussianBlur(bent.rgb(), (0, 0), 1.5)[inner]
    ).mean()
    assert off < 6.0
    assert np.abs(straight.rgb()[inner].astype(float) - bent.rgb()[inner]).mean() > 2 * off


def test_the_facts_of_a_real_street(data_set):
    folder = data_set("kitti-street")
    drive = checked(read_source(folder), folder)
    assert (len(drive.of("left")), len(drive.of("right"))) == (51, 51)
    across = np.linalg.inv(drive.of("left")[9].T_world_camera) @ drive.of("right")[9].T_world_camera
    assert across[:3, 3] == pytest.approx([0.5372, 0.0, 0.0], abs=1e-4)


def test_the_second_camera_of_a_turned_rig_stays_at_its_side(tmp_path):
    folder = tmp_path / "street"
    for name in ("image_l", "image_r"):
        (folder / name).mkdir(parents=True)
        for i in range(2):
            cv2.imwrite(str(folder / name / f"{i:06d}.png"), np.zeros((4, 8), dtype=np.uint8))
    turns = Rotation.from_euler("yxz", [(100, 4, -7), (120, -3, 5)], degrees=True).as_matrix()
    poses = np.concatenate([turns, [[[5.0], [0.0], [9.0]], [[6.0], [0.1], [9.5]]]], axis=2)
    np.savetxt(folder / "poses.txt", poses.reshape(2, 12))
    left = np.array([[10.0, 0, 4, 0], [0, 10, 2, 0], [0, 0, 1, 0]])
    right = left.copy()
    right[0, 3] = -10 * 0.54
    np.savetxt(folder / "calib.txt", [left.ravel(), right.ravel()])
    drive = read_source(folder)
    for left, right in zip(drive.of("left"), drive.of("right"), strict=True):
        T_left_right = np.linalg.inv(left.T_world_camera) @ right.T_world_camera
        assert T_left_right[:3, 3] == pytest.approx([0.54, 0.0, 0.0], abs=1e-6)


def test_times_put_photographs_in_order(tmp_path):
    folder = write_transforms(tmp_path / "a", unit="m")
    with edited(folder) as document:
        for i, frame in enumerate(document["frames"]):
            frame["t_us"] = 50_000 * i
        document["frames"].reverse()
    drive = read_source(folder)
    assert [one.t_us for one in drive.photographs] == [50_000 * i for i in range(COUNT)]
    assert drive.metric == "the file's word that its unit is the metre"
