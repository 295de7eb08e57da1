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
    waits = {
        "install": speed.Wait(30, 20),
        speed.FIRST: speed.Wait(60, 90),
        speed.FITTING: speed.Wait(35, 50),
        speed.WARM: speed.Wait(20, 30),
        "report": speed.Wait(2, 2),
    }
    lines = speed.table_of_waits(waits).splitlines()
    assert lines[2:4] == ["| install | 30.0 | 20.0 |", "| first run | 60.0 | 90.0 |"]
    assert lines[4] == "| of it compiling kernels | 25.0 | 40.0 |"
    assert lines[5] == "| of it fitting | 15.0 | 20.0 |"
    assert lines[6:] == ["| warm run | 20.0 | 30.0 |", "| report | 2.0 | 2.0 |"]
