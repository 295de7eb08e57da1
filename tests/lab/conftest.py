"""Fixtures that the laboratory's tests share with those of the core."""

from __future__ import annotations

from tests.alpasim.conftest import bundle, overrides  # noqa: F401 - fixtures
from tests.block_fixers.conftest import weights  # noqa: F401 - a fixture
