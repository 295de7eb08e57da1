"""How much of a property is tried in every run, and how much in the nightly one.

Hypothesis draws few examples by default, a fifth of them in CI (``SIMRUN_HYPOTHESIS=ci``) and all of
them with ``SIMRUN_HYPOTHESIS=nightly``; further cases of one rule are marked ``slow``.
"""

import os

import pytest

PROFILE = os.environ.get("SIMRUN_HYPOTHESIS", "quick")
SHARE = {"quick": 0.05, "ci": 0.2, "nightly": 1.0}[PROFILE]
FEWEST = 4


def examples(full):
    """Return the number of examples to draw of a property that deserves ``full``."""
    return max(min(full, FEWEST), round(SHARE * full))


def first_of(cases, count=1):
    """Return the cases of a test with one parameter, all but the first ``count`` of them marked
    ``slow``.
    """
    return [
        case if k < count else pytest.param(case, marks=pytest.mark.slow)
        for k, case in enumerate(cases)
    ]


def first_rows_of(cases, count=1):
    """Do the same for a test with several parameters, whose cases are tuples of their values."""
    return [
        case if k < count else pytest.param(*case, marks=pytest.mark.slow)
        for k, case in enumerate(cases)
    ]
