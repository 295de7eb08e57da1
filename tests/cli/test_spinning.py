"""Threads that wait do not hold on to a core for long, unless the user says so."""

import os
import subprocess
import sys

import pytest

LOOK = "import alpasim_plugin.cli, os; print(os.environ.get('GOMP_SPINCOUNT'))"


@pytest.mark.parametrize(
    ("given", "spins"),
    [({}, "10000"), ({"GOMP_SPINCOUNT": "5"}, "5"), ({"OMP_WAIT_POLICY": "ACTIVE"}, "None")],
)
def test_short_spins_are_the_default_and_the_users_choice_stands(given, spins):
    bare = {
        key: value
        for key, value in os.environ.items()
        if key not in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")
    }
    done = subprocess.run(
        [sys.executable, "-c", LOOK], env=bare | given, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == spins
