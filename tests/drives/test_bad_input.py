"""Recordings that cannot be driven in are refused with what was found and what to do, and nothing
is left behind.
"""

import shutil
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.drives import build
from alpasim_plugin.drives.build import import_drive
from tests.drives.conftest import at_once
from tests.drives.street import HEIGHT, WIDTH, edited, write_colmap, write_transforms

pytestmark = pytest.mark.slow

Change = Callable[[Path], None]


def poses(change):
    """Change the poses of a KITTI folder."""

    def apply(folder):
        path = folder / "poses.txt"
        rows = [
            np.array([float(word) for word in line.split()]).reshape(3, 4)
            for line in path.read_text().splitlines()
        ]
        path.write_text(
            "\n".join(" ".join(f"{v:.9e}" for v in row.ravel()) for row in change(rows))
        )

    return apply


def not_a_number(rows):
    rows[5][0, 3] = np.nan
    return rows


def left_handed(rows):
    rows[7][:, 0] *= -1
    return rows


def sheared(rows):
    rows[2][:, 1] *= 1.4
    return rows


def centimetres_from_the_twelfth_on(rows):
    start = rows[11][:, 3].copy()
    for row in rows[12:]:
        row[:, 3] = start + 100 * (row[:, 3] - start)
    return rows


def standing(rows):
    for row in rows:
        row[:, 3] = rows[0][:, 3]
    return rows


def turning_only(rows):
    for i, row in enumerate(rows):
        row[:, :3] = cv2.Rodrigues(np.array([0.0, 0.05 * i, 0.0]))[0]
        row[:, 3] = 0.001 * i
    return rows


def other_poses(rows):
    """Poses of a drive to the side."""
    for row in rows:
        row[:, 3] = [row[2, 3], 0.0, 0.0]
    return rows


def cut_off(folder):
    path = folder / "image_r/000010.png"
    path.write_bytes(path.read_bytes()[:-200])


def cut_off_jpeg(folder):
    for path in sorted((folder / "image_r").iterdir()):
        data = cv2.imencode(".jpg", cv2.imread(str(path)))[1].tobytes()
        path.with_suffix(".jpg").write_bytes(
            data[: len(data) // 2] if path.stem == "000003" else data
        )
        path.unlink()


def another_size(folder):
    path = folder / "image_l/000004.png"
    cv2.imwrite(str(path), cv2.imread(str(path))[:-8])


def printed_colours(folder):
    for path in sorted((folder / "image_l").iterdir()):
        path.with_suffix(".jpg").write_bytes(
            cv2.imencode(".jpg", cv2.imread(str(path)))[1].tobytes()
        )
        path.unlink()
    path = folder / "image_l/000006.jpg"
    data = bytearray(path.read_bytes())
    at = data.index(b"\xff\xc0")
    data[at + 9] = 4
    path.write_bytes(bytes(data))


def hundred_megapixels(folder):
    path = folder / "image_l/000000.png"
    data = bytearray(path.read_bytes())
    data[16:24] = struct.pack(">II", 10_000, 10_000)
    path.write_bytes(bytes(data))


def many_pictures_without_poses(folder):
    path = folder / "poses.txt"
    path.write_text("\n".join(path.read_text().splitlines()[:12]))


@pytest.mark.parametrize(
    "change",
    [
        poses(not_a_number),
        poses(left_handed),
        poses(sheared),
        poses(centimetres_from_the_twelfth_on),
        poses(standing),
        poses(turning_only),
        poses(other_poses),
        many_pictures_without_poses,
        cut_off,
        cut_off_jpeg,
        another_size,
        printed_colours,
        hundred_megapixels,
        lambda folder: (folder / "poses.txt").unlink(),
        lambda folder: (folder / "calib.txt").write_text("1 2 3"),
    ],
)
def test_a_recording_that_cannot_be_is_refused_and_leaves_nothing(
    tmp_path, kitti_street, change, quick_fit
):
    folder = Path(shutil.copytree(kitti_street, tmp_path / "street"))
    change(folder)
    before = sorted(path.name for path in tmp_path.iterdir())
    with pytest.raises(InputError):
        import_drive(folder, tmp_path / "out")
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_axes_that_both_fit_are_asked_for(tmp_path, quick_fit):
    folder = write_transforms(tmp_path / "walk", say_axes=False)
    blank = np.full((HEIGHT, WIDTH, 3), 120, dtype=np.uint8)
    for path in (folder / "images").iterdir():
        cv2.imwrite(str(path), blank)
    with pytest.raises(InputError):
        import_drive(folder, tmp_path / "out")


@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_a_colmap_model_that_is_cut_off_is_named(tmp_path, name):
    folder = write_colmap(tmp_path / "a", True)
    path = folder / f"sparse/0/{name}.bin"
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(InputError):
        import_drive(folder, tmp_path / "out")


def test_a_whole_benchmark_sequence_is_refused_at_once(tmp_path, walk):
    folder = Path(shutil.copytree(walk, tmp_path / "walk"))
    with edited(folder) as document:
        document["frames"] = [frame for _ in range(30) for frame in document["frames"]]
    with pytest.raises(InputError):
        import_drive(folder, tmp_path / "out")


def test_a_fit_that_covers_nearly_nothing_is_refused_and_leaves_nothing(
    tmp_path, kitti_street, monkeypatch
):
    def fit_few(views, start, **rest):
        return at_once(views, start.take(np.arange(20)), **rest)

    monkeypatch.setattr(build, "fit_drive", fit_few)
    with pytest.raises(InputError, match=r"street: from the poses the model covers [0-9.]+ %"):
        import_drive(kitti_street, tmp_path / "out")
    assert not list(tmp_path.iterdir())
