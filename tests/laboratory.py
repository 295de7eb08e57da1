"""Whether the laboratory, a distribution of its own, is installed."""

import sys
from importlib import metadata

DISTRIBUTION = "alpasim-onefixer-lab"
NOT_COLLECTED = (
    "tests/lab: not collected, the laboratory is not installed (pip install -e alpasim_plugin/lab)"
)


def laboratory_is_installed(path=None):
    """Return whether the folders of `path`, by default `sys.path`, hold the distribution."""
    installed = metadata.distributions(name=DISTRIBUTION, path=sys.path if path is None else path)
    return any(True for _ in installed)
