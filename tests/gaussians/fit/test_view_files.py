"""Folders of posed images: what is written is read back, and what cannot be is said."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.gaussians.fit.photographs import FILE, read_points, read_views
from tests.gaussians.fit.view_files import write_views


def change(folder, **keys: object):
    """Set keys of the document; None removes one, ``frame`` changes the first frame."""
    path = folder / FILE
    document = json.loads(path.read_text())
    document["frames"][0] |= keys.pop("frame", {})  # type: ignore[arg-type]
    document = {k: v for k, v in {**document, **keys}.items() if v is not None}
    path.write_text(json.dumps(document))


def write_points(path, names, rows):
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n"
    header += "".join(
        f"property {'uchar' if n in ('red', 'green', 'blue') else 'float'} {n}\n"
        for n in names.split()
    )
    dtype = [(n, "u1" if n in ("red", "green", "blue") else "<f4") for n in names.split()]
    data = np.array([tuple(row) for row in rows], dtype=dtype)
    path.write_bytes(header.encode() + b"end_header\n" + data.tobytes())


def test_views_come_back_as_they_were_written(posed, tmp_path):
    masked = replace(posed.views[1], mask=np.arange(32 * 48).reshape(32, 48) % 3 > 0)
    write_views(tmp_path, [posed.views[0], masked])
    views, start = read_views(tmp_path)
    assert start is None
    for found, wanted in zip(views, [posed.views[0], masked], strict=True):
        assert np.array_equal(found.rgb, wanted.rgb)
        assert np.array_equal(found.sky, wanted.sky)
        assert np.allclose(found.camera.K, wanted.camera.K)
        assert (
            np.abs(
                inverse(found.camera.T_camera_world) - inverse(wanted.camera.T_camera_world)
            ).max()
            < 1e-9
        )
    assert views[0].mask is None
    assert np.array_equal(views[1].mask, masked.mask)


def test_axes_of_opengl_are_turned_to_ours(posed, tmp_path):
    write_views(tmp_path, posed.views[:1])
    pose = inverse(posed.views[0].camera.T_camera_world)
    change(
        tmp_path,
        axes="opengl",
        frame={"transform_matrix": (pose @ np.diag([1.0, -1, -1, 1])).tolist()},
    )
    views, _ = read_views(tmp_path)
    assert np.abs(inverse(views[0].camera.T_camera_world) - pose).max() < 1e-9


def test_sizes_and_intrinsics_may_stand_for_all_frames(posed, tmp_path):
    write_views(tmp_path, posed.views[:2])
    document = json.loads((tmp_path / FILE).read_text())
    shared = {key: document["frames"][0][key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")}
    frames = [{k: v for k, v in frame.items() if k not in shared} for frame in document["frames"]]
    change(tmp_path, frames=frames, **shared)
    assert len(read_views(tmp_path)[0]) == 2


def test_actors_are_placed_at_a_frames_time(posed, tmp_path):
    write_views(tmp_path, posed.views[:2])
    change(tmp_path, frame={"t_us": 300_000})
    views, _ = read_views(tmp_path, lambda t_us: {"car": np.eye(4) * t_us})
    assert views[0].actors["car"][0, 0] == 300_000
    assert not views[1].actors


def test_points_to_start_from_keep_place_and_colour(posed, tmp_path):
    write_views(tmp_path, posed.views[:1])
    write_points(
        tmp_path / "points.ply",
        "x y z red green blue",
        np.array([[1, 2, 3, 255, 0, 128], [2, 2, 3, 0, 0, 0], [np.nan, 0, 0, 0, 0, 0]]),
    )
    change(tmp_path, ply_file_path="points.ply")
    _, start = read_views(tmp_path)
    assert start.means.tolist() == [[1, 2, 3], [2, 2, 3]]
    assert start.sh[0, 0, 0] > 1.7
    write_points(tmp_path / "grey.ply", "x y z", np.array([[1, 2, 3]]))
    assert np.allclose(read_points(tmp_path / "grey.ply").sh, 0.0)


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"axes": None}, "opengl"),
        ({"axes": "nerf"}, "'nerf'"),
        ({"frames": []}, "no frames"),
        ({"k4": 0.1}, "undistort"),
        ({"frame": {"transform_matrix": [[1, 2], [3, 4]]}}, "frame 0"),
        ({"frame": {"file_path": "gone.png"}}, "gone.png"),
        ({"frame": {"fl_x": "wide"}}, "frame 0"),
        ({"frame": {"w": 47}}, "the file says 47x32"),
        ({"ply_file_path": "gone.ply"}, "gone.ply"),
    ],
)
def test_what_cannot_be_is_one_clear_error(posed, tmp_path, keys, says):
    write_views(tmp_path, posed.views[:1])
    change(tmp_path, **keys)
    with pytest.raises(InputError):
        read_views(tmp_path)
