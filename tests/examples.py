"""How many examples a property is tried with: few in every run, all of them with ``SIMRUN_HYPOTHESIS=nightly``."""

from __future__ import annotations

import os

PROFILE = os.environ.get("SIMRUN_HYPOTHESIS", "quick")
SHARE = {"quick": 0.2, "nightly": 1.0}[PROFILE]
FEWEST = 5


def examples(full: int) -> int:
    """Return the number of examples to draw of a property that deserves ``full``."""
    return max(min(full, FEWEST), round(SHARE * full))
