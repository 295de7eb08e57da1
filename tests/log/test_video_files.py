"""MP4 files: exact times, colours within the codec's loss, odd sizes padded."""

from fractions import Fraction

import numpy as np
import pytest

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.log import read_mp4, write_mp4


def frames(n, height=144, width=256):
    y, x = np.mgrid[:height, :width]
    return [
        np.stack([x * 200 // width, y * 200 // height, np.full_like(x, 7 * i)], axis=-1).astype(
            np.uint8
        )
        for i in range(n)
    ]


@pytest.mark.parametrize("fps", [10, 30, 7.5, 29.97, Fraction(30000, 1001), Fraction(10, 3), 1])
def test_frame_times_are_exact(tmp_path, fps):
    write_mp4(tmp_path / "a.mp4", frames(25), fps)
    video = read_mp4(tmp_path / "a.mp4")
    rate = Fraction(fps).limit_denominator(1001)
    assert video.fps == rate
    assert video.t_us.tolist() == [round(i / rate * 1_000_000) for i in range(25)]


def test_pictures_come_back_in_order_and_close(tmp_path):
    given = np.stack(frames(30))
    write_mp4(tmp_path / "a.mp4", given, 10)
    back = read_mp4(tmp_path / "a.mp4").frames
    assert back.shape == given.shape
    assert np.abs(back.astype(int) - given).mean() < 2
    nearest = [int(np.argmin([np.abs(b.astype(int) - g).mean() for g in given])) for b in back]
    assert nearest == list(range(30))


def test_odd_sizes_are_padded_by_their_last_row_and_column(tmp_path):
    given = frames(3, 45, 61)
    write_mp4(tmp_path / "a.mp4", given, 10)
    back = read_mp4(tmp_path / "a.mp4").frames
    assert back.shape == (3, 46, 62, 3)
    assert np.abs(back[0, 45, :61].astype(int) - given[0][44]).mean() < 4
    assert np.abs(back[0, :45, 61].astype(int) - given[0][:, 60]).mean() < 4


def test_single_frame_is_a_video(tmp_path):
    write_mp4(tmp_path / "a.mp4", frames(1), 10)
    assert read_mp4(tmp_path / "a.mp4").t_us.tolist() == [0]


def test_frames_may_come_from_a_generator(tmp_path):
    write_mp4(tmp_path / "a.mp4", iter(frames(4)), 10)
    assert len(read_mp4(tmp_path / "a.mp4").frames) == 4


@pytest.mark.parametrize(
    ("bad", "found"),
    [
        ([], "no frames"),
        ([np.zeros((8, 8, 3), dtype=np.uint8), np.zeros((8, 10, 3), dtype=np.uint8)], "frame 1: "),
        ([np.zeros((8, 8, 3), dtype=np.float32)], "float32"),
        ([np.zeros((8, 8), dtype=np.uint8)], "frame 0: "),
    ],
)
def test_unusable_frames_are_refused_and_leave_no_file(tmp_path, bad, found):
    with pytest.raises(InputError, match=found):
        write_mp4(tmp_path / "a.mp4", bad, 10)
    assert list(tmp_path.iterdir()) == []


def test_rate_must_be_positive(tmp_path):
    with pytest.raises(InputError, match="0 frames per second"):
        write_mp4(tmp_path / "a.mp4", frames(1), 0)


def test_missing_folder_is_an_infrastructure_failure(tmp_path):
    with pytest.raises(InfrastructureError):
        write_mp4(tmp_path / "absent" / "a.mp4", frames(1), 10)


def test_unreadable_videos_are_refused(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"no video at all")
    with pytest.raises(InputError):
        read_mp4(tmp_path / "a.mp4")
    with pytest.raises(InputError):
        read_mp4(tmp_path / "absent.mp4")
