"""Fixtures of the fixers' tests."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Give a folder for small weights that tests share (`fixer_cases.busy_settings`)."""
    return tmp_path_factory.mktemp("weights")
