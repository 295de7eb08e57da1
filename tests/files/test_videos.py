"""Videos as cameras and editors write them: turned and mirrored by their display matrix, and with
more than one track.

Every file is made here.
"""

from __future__ import annotations

import struct

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.log.video import VideoReader

av = pytest.importorskip("av", reason="PyAV is not installed")

ONE = 1 << 16
WIDTH, HEIGHT = 48, 32


def video(path, matrix=None, tracks=1):
    """Write a video of a bright corner at the upper left, and put a display matrix a, b, c, d into
    its track's header.
    """
    image = np.full((HEIGHT, WIDTH, 3), 30, np.uint8)
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


def test_an_upright_display_matrix_is_taken(tmp_path):
    with VideoReader(video(tmp_path / "a.mp4", (ONE, 0, 0, ONE))) as reader:
        image = next(iter(reader)).image
    assert image[:8, :16].min() > 150 > 100 > image[8:].max()


@pytest.mark.parametrize("matrix", [(0, ONE, -ONE, 0), (-ONE, 0, 0, ONE)])
def test_turned_and_mirrored_videos_are_refused(tmp_path, matrix):
    with pytest.raises(InputError, match="matrix"):
        VideoReader(video(tmp_path / "a.mp4", matrix))
