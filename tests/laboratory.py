"""Whether the laboratory, a distribution of its own, is installed."""

from __future__ import annotations

import sys
from importlib import metadata

DISTRIBUTION = "alpasim-onefixer-lab"
NOT_COLLECTED = (
    "tests/lab: not collected, the laboratory is not installed (pip install -e alpasim_plugin/lab)"
)


def laboratory_is_installed(path: list[str] | None = None) -> bool:
    """Return whether the folders of `path`, by default `sys.path`, hold the distribution."""
    installed = metadata.distributions(name=DISTRIBUTION, path=sys.path if path is None else path)
    return any(True for _ in installed)
