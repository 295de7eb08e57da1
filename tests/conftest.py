"""Fixtures shared by all tests."""

from __future__ import annotations

import os
import shutil
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("same-every-time", derandomize=True, deadline=None)
settings.load_profile("same-every-time")

if "PYTEST_XDIST_WORKER" in os.environ:  # one worker a core: threads of several workers on the same cores wait for each other
    os.environ.setdefault("OMP_NUM_THREADS", "1")

REPO = Path(__file__).resolve().parents[1]


def pytest_configure(config: pytest.Config) -> None:
    """Keep what tests fit out of the user's cache; workers inherit the folder."""
    if "SIMRUN_CACHE" not in os.environ:
        folder = tempfile.mkdtemp(prefix="simrun-tests-")
        os.environ["SIMRUN_CACHE"] = folder
        config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files that take longest, so that no worker is left alone with one at the end."""
    items.sort(key=lambda item: item.path.parent.name != "runtime")


def find_shared_data() -> Path | None:
    """Return the folder of third-party data sets, or None where this machine has none.

    ``SIMRUN_SHARED_DATA`` names it; otherwise ``../shared/data`` beside the checkout is tried.
    """
    named = os.environ.get("SIMRUN_SHARED_DATA")
    folder = Path(named) if named else REPO.parent / "shared" / "data"
    return folder if folder.is_dir() else None


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Give the data folder or skip: its files have licences that keep them out of this repository."""
    folder = find_shared_data()
    if folder is None:
        pytest.skip("third-party data sets absent (set SIMRUN_SHARED_DATA to their folder)")
    return folder


@pytest.fixture(scope="session")
def repo() -> Path:
    """Give the repository root."""
    return REPO
