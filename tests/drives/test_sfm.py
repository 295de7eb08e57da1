"""Photographs and videos without poses: structure from motion finds the way of a car that drives
straight on.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.drives.build import _points
from alpasim_plugin.drives.opening import read_source
from alpasim_plugin.drives.placing import place
from alpasim_plugin.drives.sfm import CLEARLY, FAR, FRAMES, LENSES, PLAIN, _fits, _lenses
from alpasim_plugin.drives.source import checked
from tests.drives.street import COUNT, FOCAL, STEP_M, Street, stations


def told(*given: Any) -> None:
    """Take reports of progress."""


def film(path: Path, black: int = 1) -> Path:
    """Write the street as a video of 10 frames a second that begins with black frames."""
    import av

    street = Street()
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.bit_rate = 320, 128, 8_000_000
        pictures = [np.zeros((128, 320, 3), np.uint8)] * black + [
            street.photograph(street.pose(x)) for x in stations()
        ]
        for picture in pictures:
            for packet in stream.encode(av.VideoFrame.from_ndarray(picture, format="bgr24")):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


def test_a_video_becomes_a_drive(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap", reason="the extra sfm is not installed")
    path, work = film(tmp_path / "street.mp4"), tmp_path / "work"
    drive = checked(read_source(path, work, told), path)
    assert (drive.kind, drive.metric) == ("sfm", None)
    assert "1 pictures that are black were left out" in drive.notes
    times = [one.t_us for one in drive.pictures]
    assert len(times) > 0.8 * COUNT
    assert np.diff(times).min() == pytest.approx(100_000, abs=10)
    placed = place(drive, _points(drive, path, told), camera_height_m=1.5)
    ego = placed.ego.xyz
    way = np.linalg.norm(ego[-1] - ego[0]) / ((times[-1] - times[0]) / 1e5)
    assert drive.pictures[0].lens.K[0, 0] == pytest.approx(
        LENSES[PLAIN] * 320
    )  # what is begun with, as nothing here turns
    free = (
        drive.pictures[0].lens.K[0, 0] / FOCAL
    )  # driving straight on: a longer lens and a longer way look the same
    assert way == pytest.approx(STEP_M * free, rel=0.15)
    before = sorted(one.name for one in (work / FRAMES).iterdir())
    again = read_source(path, work, told)  # goes on from what was found
    assert [one.T_world_camera.tolist() for one in again.pictures] == [
        one.T_world_camera.tolist() for one in drive.pictures
    ]
    assert sorted(one.name for one in (work / FRAMES).iterdir()) == before


class Matched:
    """A database of photographs of points around a camera that turns, all of which are matched."""

    def __init__(self, project: Any) -> None:
        rng = stream("sfm", 0, "points")
        world = rng.uniform([-30, -4, 4], [30, 8, 60], (600, 3))
        self.at = []
        for i in range(FAR + 6):
            turn, _ = cv2.Rodrigues(np.array([0.0, 0.02 * i, 0.0]))
            self.at.append(
                project((world - [0.3 * i, 0.0, 0.4 * i]) @ turn.T) + rng.normal(0, 0.2, (600, 2))
            )

    def read_all_images(self) -> list[Any]:
        return [SimpleNamespace(name=f"{i:03d}", image_id=i) for i in range(len(self.at))]

    def read_keypoints(self, number: int) -> np.ndarray:
        return np.asarray(self.at[number])

    def exists_matches(self, one: int, other: int) -> bool:
        return True

    def read_matches(self, one: int, other: int) -> np.ndarray:
        seen = np.flatnonzero(
            np.max([np.abs(self.at[i] - 400).max(axis=1) for i in (one, other)], axis=0) < 400
        )
        return np.stack([seen, seen], axis=1).astype(np.uint32)


def test_a_wide_lens_is_told_from_a_plain_one() -> None:
    pycolmap = pytest.importorskip("pycolmap", reason="the extra sfm is not installed")

    def plain(local: np.ndarray) -> np.ndarray:
        return np.asarray(400 + 640 * local[:, :2] / np.maximum(local[:, 2:], 0.1))

    def wide(local: np.ndarray) -> np.ndarray:
        across = np.linalg.norm(local[:, :2], axis=1, keepdims=True)
        return np.asarray(400 + 400 * np.arctan2(across, local[:, 2:]) * local[:, :2] / across)

    camera = pycolmap.Camera(model=PLAIN, width=800, height=800, params=[640, 400, 400, 0])
    for project, lens in ((plain, PLAIN), (wide, "SIMPLE_RADIAL_FISHEYE")):
        fits = {
            name: _fits(Matched(project), one)
            for name, one in _lenses(camera, (400.0, 400.0)).items()
        }
        assert (fits["SIMPLE_RADIAL_FISHEYE"] > CLEARLY * fits[PLAIN]) == (lens != PLAIN), fits


def test_a_camera_that_only_turns_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("pycolmap", reason="the extra sfm is not installed")
    street, K = Street(), np.array([[FOCAL, 0, 163.0], [0, FOCAL, 54.0], [0, 0, 1]])
    picture = street.photograph(street.pose(8.0))
    folder = tmp_path / "turning"
    folder.mkdir()
    for i in range(8):
        turn, _ = cv2.Rodrigues(np.array([0.0, 0.03 * (i - 4), 0.0]))
        seen = cv2.warpPerspective(
            picture, K @ turn @ np.linalg.inv(K), (320, 128), flags=cv2.INTER_CUBIC
        )
        cv2.imwrite(str(folder / f"{i}.png"), seen)
    with pytest.raises(InputError, match="only turns"):
        read_source(folder, tmp_path / "work", told)


def test_a_video_that_shows_nothing_or_is_none_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "odd.mp4"
    path.write_bytes(b"\0" * 2000)
    with pytest.raises(InputError, match="video"):
        read_source(path, tmp_path / "work", told)
    dark = tmp_path / "dark"
    dark.mkdir()
    for i in range(3):
        cv2.imwrite(str(dark / f"{i}.png"), np.zeros((128, 320, 3), np.uint8))
    pytest.importorskip("pycolmap", reason="the extra sfm is not installed")
    with pytest.raises(InputError, match="show something"):
        read_source(dark, tmp_path / "work2", told)
