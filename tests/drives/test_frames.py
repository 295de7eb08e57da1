"""Which pictures of a film are used for finding the way: those in which the world moves, without
the car itself.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.drives.sfm import car_begins, moved_px, write_frames
from tests.drives.test_sfm import film, told

SIZE = (180, 320)
BONNET = 140  # its uppermost row


def passing(count: int, step_px: int = 3) -> list[np.ndarray]:
    """Return pictures of a pattern that moves to the left."""
    wide = cv2.GaussianBlur(
        stream("frames", 0, "pattern").uniform(0, 255, (SIZE[0], SIZE[1] + 200)).astype(np.float32),
        (0, 0),
        2.0,
    )
    wide = np.clip(128 + 4 * (wide - 128), 0, 255).astype(np.uint8)
    return [wide[:, i * step_px : i * step_px + SIZE[1]].copy() for i in range(count)]


def with_bonnet(pictures: list[np.ndarray]) -> list[np.ndarray]:
    """Lay the same pattern over the lower part of all."""
    bonnet = passing(1)[0][::-1, ::-1]
    for one in pictures:
        one[BONNET:, 40:280] = bonnet[BONNET:, 40:280]
    return pictures


def test_the_own_car_is_found_and_nothing_where_there_is_none() -> None:
    assert car_begins(passing(12)) == 1.0
    assert car_begins(with_bonnet(passing(12))) * SIZE[0] == pytest.approx(BONNET, abs=6)


def test_lane_lines_that_stay_in_their_place_are_no_car() -> None:
    pictures = passing(12)
    for one in pictures:
        cv2.line(one, (160, 90), (60, 179), 255, 3)
        cv2.line(one, (160, 90), (260, 179), 255, 3)
    assert car_begins(pictures) == 1.0


def test_motion_is_that_of_the_world_beside_a_bonnet() -> None:
    before, after = with_bonnet(passing(2))
    assert moved_px(before, after) == pytest.approx(3.0, abs=0.3)
    assert moved_px(before, before) == pytest.approx(0.0, abs=0.01)


@pytest.mark.slow
def test_films_that_follow_each_other_are_one_drive(tmp_path: Path) -> None:
    folder = tmp_path / "films"
    folder.mkdir()
    for name in ("b.mp4", "a.mp4"):
        film(folder / name, black=0)
    found = write_frames(folder, tmp_path / "out", told)
    times = np.array(list(found.times.values()))
    assert (np.diff(times) > 0).all()
    assert times[-1] == pytest.approx(2 * (len(times) / 2) * 100_000, rel=0.1)
    assert "2 videos in order by name, each taken to begin where the one before ends" in found.notes
    assert sorted(found.times) == sorted(one.name for one in (tmp_path / "out").iterdir())


def test_pictures_in_which_nothing_moves_are_left_out(tmp_path: Path) -> None:
    folder = tmp_path / "walk"
    folder.mkdir()
    for i, one in enumerate([*passing(9), *[passing(9)[-1]] * 4]):
        cv2.imwrite(str(folder / f"{i:02d}.png"), one)
    found = write_frames(folder, tmp_path / "out", told)
    assert len(found.times) == 9
    assert "4 pictures in which the world hardly moves were left out" in found.notes
    assert found.middle == (160.0, 90.0)


def test_a_car_that_stands_is_refused(tmp_path: Path) -> None:
    for i in range(10):
        cv2.imwrite(str(tmp_path / f"{i}.png"), passing(1)[0])
    with pytest.raises(InputError, match="the world moves"):
        write_frames(tmp_path, tmp_path / "out", told)


def test_a_photograph_of_another_size_is_named(tmp_path: Path) -> None:
    for i, one in enumerate(passing(9)):
        cv2.imwrite(str(tmp_path / f"{i}.png"), one[: 100 if i == 4 else 180])
    with pytest.raises(InputError, match="320x100") as caught:
        write_frames(tmp_path, tmp_path / "out", told)
    assert "4.png" in str(caught.value)
