"""The bench in pairs: what it prints of what it has measured."""

import doctest

from tests import speed


def test_the_table_is_of_medians_of_what_both_commits_measure():
    assert doctest.testmod(speed).failed == 0
    pairs = [({"a": 1.0, "old": 9.0}, {"a": 2.0, "new": 1.0})]
    assert speed.table(pairs).splitlines()[2:] == ["| a | 1.0 | 2.0 | 2.00 | 2.00 | 2.00 |"]


def test_its_scripts_are_python():
    for script in (speed.LOOP, speed.RASTER, speed.JOB):
        compile(script, "a script", "exec")


def test_the_first_run_is_told_from_what_it_keeps():
    waits = {"install": 30.0, "first run": 60.0, "first run, kernels kept": 35.0, "warm run": 20.0}
    lines = speed.table_of_waits(waits | {"report again": 2.0}).splitlines()
    assert lines[2:4] == ["| install | 30.0 |", "| first run | 60.0 |"]
    assert lines[4:6] == ["| of it compiling kernels | 25.0 |", "| of it fitting | 15.0 |"]
    assert lines[6:] == ["| warm run | 20.0 |", "| report again | 2.0 |"]
