"""One rollout log written by us, as a file and as read back."""

import pytest

from alpasim_plugin.log import read_asl
from tests.log.make_rollout import write_rollout
from tests.pages.conftest import usual_run as usual_run


@pytest.fixture
def path(tmp_path):
    return write_rollout(tmp_path / "rollout.asl")


@pytest.fixture
def log(path):
    return read_asl(path)
