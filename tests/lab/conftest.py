"""Collect the laboratory's tests only where its distribution is installed."""

from tests.alpasim.conftest import bundle, overrides  # noqa: F401 - fixtures
from tests.block_fixers.conftest import weights  # noqa: F401 - a fixture
from tests.laboratory import laboratory_is_installed

if not laboratory_is_installed():
    collect_ignore_glob = ["*"]
