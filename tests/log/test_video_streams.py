"""Video frame by frame, as real files come: variable rates, late starts, rotated, cut short,
damaged, without pictures.
"""

import struct
from fractions import Fraction

import av
import numpy as np
import pytest

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.log.video import VideoReader, VideoWriter


def picture(value=120, height=32, width=48):
    return np.full((height, width, 3), value, dtype=np.uint8)


def write(path, times, time_base, durations=None):
    with VideoWriter(path, time_base, Fraction(10)) as video:
        for i, time in enumerate(times):
            video.write(picture(20 * i % 200), time, durations[i] if durations else 1)
    return path


def times_s(path):
    with VideoReader(path) as video:
        return [frame.time * video.format.time_base for frame in video]


@pytest.mark.parametrize(
    ("times", "base"),
    [
        ([0, 40, 47, 1600, 1601], Fraction(1, 1000)),  # variable rate
        ([900, 1000, 1100], Fraction(1, 1000)),  # starts late
        ([0, 1001, 2002, 3003], Fraction(1, 30000)),
        ([0, 3000, 6000], Fraction(1, 90000)),
    ],
)
def test_times_are_kept_exactly(tmp_path, times, base):
    assert times_s(write(tmp_path / "a.mp4", times, base)) == [t * base for t in times]


@pytest.mark.parametrize("matrix", [1, 2, 5, 6, 7, 9])
def test_colours_follow_the_stated_matrix(tmp_path, matrix):
    image = picture()
    image[:] = (200, 40, 90)
    with VideoWriter(
        tmp_path / "a.mp4", Fraction(1, 10), Fraction(10), colour=(matrix, 1, 1), crf=1
    ) as video:
        video.write(image, 0)
    with VideoReader(tmp_path / "a.mp4") as back:
        assert back.format.colour == (matrix, 1, 1)
        assert np.abs(next(iter(back)).image.astype(int) - image).max() <= 2


def test_brightness_does_not_drift_over_generations(tmp_path):
    rng = np.random.default_rng(0)
    image = np.repeat(np.repeat(rng.integers(20, 235, (8, 12, 3)), 4, 0), 4, 1).astype(np.uint8)
    given = image
    for _ in range(4):
        with VideoWriter(tmp_path / "a.mp4", Fraction(1, 10), Fraction(10), crf=4) as video:
            video.write(image, 0)
        with VideoReader(tmp_path / "a.mp4") as back:
            image = next(iter(back)).image
    assert (
        abs(float(image.mean()) - float(given.mean())) < 0.5
    )  # the default scaler loses a grey level each time


def test_pixel_aspect_is_kept(tmp_path):
    with VideoWriter(
        tmp_path / "a.mp4", Fraction(1, 10), Fraction(10), pixel_aspect=Fraction(4, 3)
    ) as video:
        video.write(picture(), 0)
    with VideoReader(tmp_path / "a.mp4") as back:
        assert back.format.pixel_aspect == Fraction(4, 3)


def turn(path, quarter):
    """Write into the header of an mp4 that its track is shown turned."""
    data = bytearray(path.read_bytes())
    upright = struct.pack(">9i", 1 << 16, 0, 0, 0, 1 << 16, 0, 0, 0, 1 << 30)
    turned = struct.pack(">9i", 0, quarter << 16, 0, -quarter << 16, 0, 0, 0, 0, 1 << 30)
    # The first matrix is the film's, the second the track's.
    track = data.index(upright, data.index(b"tkhd"))
    data[track : track + len(turned)] = turned
    path.write_bytes(data)


@pytest.mark.parametrize("quarter", [1, -1])
def test_the_pixels_of_a_turned_video_are_as_wide_as_they_were_high(tmp_path, quarter):
    path = tmp_path / "a.mp4"
    with VideoWriter(path, Fraction(1, 10), Fraction(10), pixel_aspect=Fraction(4, 3)) as video:
        video.write(picture(height=32, width=48), 0)
    turn(path, quarter)
    with VideoReader(path) as back:
        assert (back.format.width, back.format.height) == (32, 48)
        assert back.format.pixel_aspect == Fraction(3, 4)


def cut_short(folder):
    """Return a file whose index is whole and whose last pictures are gone."""
    path = folder / "cut.mp4"
    rng = np.random.default_rng(0)
    with av.open(str(path), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=10, options={"crf": "1"})
        stream.width, stream.height, stream.pix_fmt = 48, 32, "yuv420p"
        for _ in range(40):
            container.mux(
                stream.encode(
                    av.VideoFrame.from_ndarray(rng.integers(0, 255, (32, 48, 3), dtype=np.uint8))
                )
            )
        container.mux(stream.encode())
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return path


def damaged(folder):
    path = write(folder / "whole.mp4", list(range(60)), Fraction(1, 10))
    data = bytearray(path.read_bytes())
    middle = data.index(b"mdat") + 400
    data[middle : middle + 600] = bytes(600)
    (folder / "damaged.mp4").write_bytes(data)
    return folder / "damaged.mp4"


def sound_only(folder):
    path = folder / "sound.wav"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000, layout="mono")
        frame = av.AudioFrame.from_ndarray(
            np.zeros((1, 800), dtype=np.int16), format="s16", layout="mono"
        )
        frame.rate = 8000
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def without_frames(folder):
    with av.open(str(folder / "none.avi"), "w") as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 48, 32, "yuv420p"
        container.start_encoding()
    return folder / "none.avi"


def empty(folder):
    (folder / "empty.mp4").touch()
    return folder / "empty.mp4"


@pytest.mark.parametrize(
    ("make", "found"),
    [
        (without_frames, "no frames"),
        (empty, "Invalid data"),
        (cut_short, r"stops after frame \d+ of 40|damage after frame"),
        (damaged, "damage after frame"),
        (sound_only, "no video stream"),
        (lambda folder: folder, "a folder, not a file"),
        (lambda folder: folder / "absent.mp4", "no such file"),
    ],
)
def test_broken_files_are_refused_with_what_was_found(tmp_path, make, found):
    assert callable(make)
    with pytest.raises(InputError, match=found), VideoReader(make(tmp_path)) as video:
        list(video)


def write_until(path, times, stop=None):
    with VideoWriter(path, Fraction(1, 10), Fraction(10)) as video:
        for time in times:
            video.write(picture(), time)
        if stop is not None:
            raise stop


def test_times_that_go_back_are_refused(tmp_path):
    with pytest.raises(InfrastructureError):
        write_until(tmp_path / "a.mp4", [0, 5, 3, 3, 3])
    assert not list(tmp_path.iterdir())


def test_an_error_on_the_way_leaves_neither_file_nor_remains(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        write_until(tmp_path / "a.mp4", [0], KeyboardInterrupt())
    assert not list(tmp_path.iterdir())


def test_an_old_file_stays_until_the_new_one_is_complete(tmp_path):
    write(tmp_path / "a.mp4", [0, 1], Fraction(1, 10))
    old = (tmp_path / "a.mp4").read_bytes()
    with VideoWriter(tmp_path / "a.mp4", Fraction(1, 10), Fraction(10)) as video:
        video.write(picture(), 0)
        assert (tmp_path / "a.mp4").read_bytes() == old
    assert (tmp_path / "a.mp4").read_bytes() != old
