"""Fixtures shared by all tests.

Hypothesis draws few examples of each property by default, and more in CI, the same ones in every
run. The full numbers, which stand beside the properties (`tests.examples`), are drawn with
``SIMRUN_HYPOTHESIS=nightly pytest -n auto --dist loadfile``, others in every run.
"""

import gc
import os
import shutil
import sys
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings

from tests.data_sets import shared_folder
from tests.examples import PROFILE, examples
from tests.laboratory import NOT_COLLECTED, laboratory_is_installed
from tests.pages.browser import Browser, find_chromium

pytest_plugins = ("tests.durations",)
settings.register_profile(
    PROFILE, derandomize=PROFILE != "nightly", deadline=None, max_examples=examples(100)
)
settings.load_profile(PROFILE)

if (
    "PYTEST_XDIST_WORKER" in os.environ
):  # one worker a core: threads of several workers on the same cores wait for each other
    os.environ.setdefault("OMP_NUM_THREADS", "1")

REPO = Path(__file__).resolve().parents[1]


def pytest_configure(config):
    """Keep what tests fit out of the user's cache; workers inherit the folder."""
    if hasattr(config.option, "loadscopereorder"):
        config.option.loadscopereorder = (
            False  # files are handed out in the order below, not those of most tests first
        )
    if config.option.markexpr != "gpu":  # Triton reads it at import: kernels run on the CPU
        os.environ.setdefault("TRITON_INTERPRET", "1")
    if "SIMRUN_CACHE" not in os.environ:
        folder = tempfile.mkdtemp(prefix="simrun-tests-")
        os.environ["SIMRUN_CACHE"] = folder
        config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))


@pytest.hookimpl(hookwrapper=True)
def pytest_collection(session):
    """Collect without Python's own search for cycles: modules and tests are made by the million and
    stay until the end, so nothing that it finds is worth a second's walk over them, then or later.
    """
    gc.disable()
    yield
    gc.freeze()
    gc.enable()
    session.config.add_cleanup(gc.unfreeze)


def pytest_terminal_summary(terminalreporter):
    """Say that the laboratory's tests were not collected."""
    if not laboratory_is_installed():
        terminalreporter.write_line(NOT_COLLECTED)


@pytest.fixture(scope="session", autouse=True)
def no_waiting_for_the_disk():
    """Let no write of this process wait until it is on the disk: thousands do, and no test cuts the
    power.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda handle: None)
        yield


@pytest.fixture(autouse=True)
def same_threads():
    """Leave torch's number of threads as it was: two workers with two threads each wait for one
    another most of the time.
    """
    torch = sys.modules.get("torch")
    before = torch.get_num_threads() if torch else 0
    yield
    if torch and torch.get_num_threads() != before:
        torch.set_num_threads(before)


@pytest.fixture(autouse=True)
def same_import_path():
    """Leave the import path as it was: what a worker on a cluster does to its own, a test that calls
    it here would do to all tests after it.
    """
    before = list(sys.path)
    yield
    sys.path[:] = before


@pytest.fixture(scope="session")
def shared_data():
    """Give the data folder or skip: its files have licences that keep them out of this
    repository.
    """
    folder = shared_folder()
    if not folder.is_dir():
        pytest.skip("third-party data sets absent (set SIMRUN_SHARED_DATA to their folder)")
    return folder


@pytest.fixture(scope="session")
def data_set(shared_data):
    """Give what returns one of the data sets by its folder's name, or skips."""

    def found(name):
        if not (shared_data / name).is_dir():
            pytest.skip(f"the data set {shared_data / name} is absent")
        return shared_data / name

    return found


@pytest.fixture(scope="session")
def repo():
    """Give the repository root."""
    return REPO


@pytest.fixture(scope="module")
def browser():
    """Give an installed Chromium; the test skips where there is none."""
    executable = find_chromium()
    if executable is None:
        pytest.skip(
            "no Chromium on this machine (looked for chromium, chromium-browser, google-chrome)"
        )
    with Browser(executable) as opened:
        yield opened
