"""Videos as cameras and editors write them: turned and mirrored by their display matrix, and with
more than one track.

Every file is made here.
"""

import struct

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.log.video import VideoReader

av = pytest.importorskip("av", reason="PyAV is not installed")

ONE = 1 << 16
WIDTH = 48
HEIGHT = 32


def video(path, matrix=None, tracks=1):
    """Write a video of a bright corner at the upper left, and put a display matrix a, b, c, d into
    its track's header.
    """
    image = np.full((HEIGHT, WIDTH, 3), 30, dtype=np.uint8)
    image[:8, :16] = 230
    with av.open(str(path), "w") as container:
        for _ in range(tracks):
            stream = container.add_stream("libx264", rate=10)
            stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        for stream in container.streams.video:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image)))
            container.mux(stream.encode())
    if matrix is not None:
        a, b, c, d = matrix
        data = bytearray(path.read_bytes())
        at = data.index(b"tkhd") + 44  # after version, times, number, duration, layer and volume
        data[at : at + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
        path.write_bytes(bytes(data))
    return path


def bright(image):
    """Return whether the bright corner lies below and on the right, and its height and width."""
    rows, columns = np.nonzero(image[..., 0] > 150)
    middle = rows.mean() > image.shape[0] / 2, columns.mean() > image.shape[1] / 2
    return *middle, (int(np.ptp(rows)) + 1, int(np.ptp(columns)) + 1)


@pytest.mark.parametrize(
    ("matrix", "below", "right", "turned"),
    [
        ((ONE, 0, 0, ONE), False, False, False),
        ((-ONE, 0, 0, -ONE), True, True, False),  # half a turn
        ((-ONE, 0, 0, ONE), False, True, False),  # left and right exchanged
        ((ONE, 0, 0, -ONE), True, False, False),  # upside down, mirrored
        ((0, ONE, -ONE, 0), False, True, True),  # a quarter turn clockwise
        ((0, -ONE, ONE, 0), True, False, True),
        ((0, ONE, ONE, 0), False, False, True),  # rows for columns
        ((0, -ONE, -ONE, 0), True, True, True),
    ],
)
def test_quarter_turns_and_mirrors_are_applied(tmp_path, matrix, below, right, turned):
    with VideoReader(video(tmp_path / "a.mp4", matrix)) as reader:
        image = next(iter(reader)).image
        assert (reader.format.height, reader.format.width) == image.shape[:2]
    assert image.shape[:2] == ((WIDTH, HEIGHT) if turned else (HEIGHT, WIDTH))
    assert bright(image) == (below, right, (16, 8) if turned else (8, 16))


@pytest.mark.parametrize("matrix", [(46341, 46341, -46341, 46341), (ONE, 0, 0, ONE // 2)])
def test_other_display_matrices_are_refused(tmp_path, matrix):
    with pytest.raises(InputError, match="matrix"):
        VideoReader(video(tmp_path / "a.mp4", matrix))


def test_a_second_video_track_is_said(tmp_path):
    with VideoReader(video(tmp_path / "a.mp4", tracks=2)) as reader:
        assert reader.format.left_out == (f"video track 1 ({WIDTH}x{HEIGHT})",)
    with VideoReader(video(tmp_path / "b.mp4")) as reader:
        assert reader.format.left_out == ()
