"""Nothing that a file of the laboratory holds makes its reader hang, swell or show its
internals.
"""

from __future__ import annotations

import random

import pytest

from tests.core.reading.test_reading import SLICE
from tests.examples import first_of
from tests.fuzz.targets import check, inputs, workplace
from tests.fuzz.uses import Target
from tests.lab.fuzz_targets import TARGETS


@pytest.mark.parametrize("target", first_of(TARGETS[::-1]), ids=lambda target: target.name)
def test_damaged_files_are_refused_or_usable(target: Target) -> None:
    with workplace() as folder:
        for number in range(SLICE):
            assert check(target, inputs(target, random.Random(f"suite/{number}")), folder) in (
                "refused",
                "accepted",
            )
