"""PyAV is loaded where a video is read or written and nowhere else."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow

CODE = """
import sys
sys.modules["av"] = None
import alpasim_plugin.cli.main, alpasim_plugin.cli.run, alpasim_plugin.runs.refine
from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.log.video import VideoReader
try:
    VideoReader(sys.argv[1])
except InfrastructureError as error:
    print(error)
"""


def test_everything_but_video_works_without_it(tmp_path):
    video = tmp_path / "a.mp4"
    video.write_bytes(b"0" * 64)
    done = subprocess.run([sys.executable, "-c", CODE, str(video)], capture_output=True, text=True)
    assert 'pip install "av>=14"' in done.stdout, done.stderr
