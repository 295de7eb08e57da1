"""Photographs with poses: what is missing is said, lenses are straightened, points are placed; and
the facts of a real set.
"""

import json

import cv2
import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.training.photographs import read_photographs

LENS = {
    "fl_x": 300.0,
    "fl_y": 302.0,
    "cx": 158.0,
    "cy": 121.0,
    "w": 320,
    "h": 240,
    "k1": -0.12,
    "k2": 0.03,
    "p1": 0.002,
    "p2": -0.001,
}
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def pose(x):
    T = np.eye(4)
    T[0, 3] = x
    return T @ OPENGL  # the file's axes are OpenGL's: this camera looks along the world's z, y down


def write(
    folder,
    dots,
    places=(-0.5, 0.5),
    lens=LENS,
):
    """Photograph white dots ``(N, 3)`` from places along x; one more photograph is listed and
    missing.
    """
    (folder / "images").mkdir(parents=True)
    K = np.array(
        [[lens["fl_x"], 0, lens["cx"] - 0.5], [0, lens["fl_y"], lens["cy"] - 0.5], [0, 0, 1]]
    )
    bend = np.array([lens.get(k, 0.0) for k in ("k1", "k2", "p1", "p2")])
    frames = []
    for i, x in enumerate(places):
        image = np.zeros((int(lens["h"]), int(lens["w"]), 3), dtype=np.uint8)
        for u, v in cv2.projectPoints(dots - [x, 0, 0], np.zeros(3), np.zeros(3), K, bend)[
            0
        ].reshape(-1, 2):
            cv2.circle(
                image, (round(u * 16), round(v * 16)), 3 * 16, (255, 255, 255), -1, cv2.LINE_AA, 4
            )
        cv2.imwrite(str(folder / f"images/{i}.png"), image)
        frames.append({"file_path": f"images/{i}.png", "transform_matrix": pose(x).tolist()})
    frames.append({"file_path": "images/lost.png", "transform_matrix": pose(9.0).tolist()})
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    return folder


def test_a_bent_lens_is_straightened_and_a_missing_photograph_is_named(tmp_path):
    dots = np.array([[-1.6, -1.2, 4.0], [1.5, 1.1, 4.0], [0.2, -0.9, 4.0], [-1.0, 0.8, 4.0]])
    read = read_photographs(write(tmp_path, dots), 256)
    assert (len(read.views), read.listed, read.missing) == (2, 3, ("images/lost.png",))
    for view in read.views:
        camera = view.camera
        assert (camera.width, camera.height) == (256, 192)
        local = dots @ camera.T_camera_world[:3, :3].T + camera.T_camera_world[:3, 3]
        assert local[:, 2].mean() == pytest.approx(4.0)  # no place lies along z
        pixel = (dots - [0.5 if view.name == "1" else -0.5, 0, 0]) @ camera.K.T  # dots stay
        for u, v in pixel[:, :2] / pixel[:, 2:]:
            left = round(u) - 4
            top = round(v) - 4
            if 0 < left < 248 and 0 < top < 184:
                found = cv2.moments(view.rgb[top : top + 8, left : left + 8, 0])
                centre = np.array([found["m10"], found["m01"]]) / found["m00"] + 0.5
                assert np.abs(centre - [u - left, v - top]).max() < 0.4


@pytest.mark.parametrize(
    ("change", "found"),
    [
        ({"fl_x": None}, "focal length"),
        ({"k4": 0.1}, "k4"),
        ({"camera_model": "FISHEYE"}, "FISHEYE"),
        ({"w": 321}, "320x240"),
        ({"frames": []}, "0 of 0"),
    ],
)
def test_what_cannot_be_a_set_of_photographs_is_refused(tmp_path, change, found):
    path = write(tmp_path, np.array([[0.0, 0.0, 4.0]])) / "transforms.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(InputError) as caught:
        read_photographs(tmp_path, 256)
    assert found in caught.value.message
