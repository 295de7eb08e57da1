import pytest

from tests.viewer.make_watched import make_watched


@pytest.fixture(scope="session")
def watched_run(tmp_path_factory):
    """Make three renderers x two scenes x two seeds with logs, of which some end differently."""
    return make_watched(tmp_path_factory.mktemp("watched"))
