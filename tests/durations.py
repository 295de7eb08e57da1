"""How long each file of tests takes, and the order that follows from it: ``pytest
--durations-file FILE`` writes the seconds and says what became slower than
`tests/durations.json`.

Nothing fails for it. ``pytest --durations-file tests/durations.json`` keeps a new standard, which
holds for one machine and one number of workers: CI's. Slow tests have a standard of their own,
`tests/durations_of_slow_tests.json`.

``pytest --no-test-after SECONDS`` skips, with the reason, each test that would begin later than that
after the session's start: CI's time has an end.
"""

import json
import os
import time
from collections import defaultdict
from pathlib import Path

import pytest

KEPT = Path(__file__).with_name("durations.json")
KEPT_OF_SLOW_TESTS = Path(__file__).with_name("durations_of_slow_tests.json")
BEGAN = "SIMRUN_TESTS_BEGAN_S"  # the variable that tells workers when the session began
FACTOR, LEAST_S = 1.5, 3.0  # a file is slower if it takes so many times as long, and so much longer
seconds = defaultdict(float)  # by file, set-up and tear-down included


def slower(before, now):
    """Return a line for each file that became slower and for each new one that takes long, the
    worst first.
    """
    worse = []
    for file, took in now.items():
        was = before.get(file, 0.0)
        if took > FACTOR * was and took > was + LEAST_S:
            worse.append((was - took, f"{file}: {was:.1f} s -> {took:.1f} s"))
    return [line for _, line in sorted(worse)]


def kept_seconds(config):
    """Return the seconds of each file as they were kept for the tests that are selected; none where
    nothing is.
    """
    is_slow = config.option.markexpr.replace("not slow", "").find("slow") >= 0
    kept = KEPT_OF_SLOW_TESTS if is_slow else KEPT
    return json.loads(kept.read_text(encoding="utf-8")) if kept.exists() else {}


# A kernel's first call compiles it, for half a minute, and leaves it on disk for every later
# process. The files that compile the three groups of kernels come first, one a worker, so that no
# two processes compile the same ones; then what took longest when it was last measured, so that no
# worker is left alone with it at the end.
FIRST = (
    "tests/gaussians/test_rasterize_hard_cases.py",
    "tests/fixers/test_draw.py",
)


def pytest_collection_modifyitems(items, config):
    """Put the files in the order in which workers take them."""
    took_s = kept_seconds(config)

    def order_of(item):
        file = item.nodeid.partition("::")[0]
        return (FIRST.index(file) if file in FIRST else len(FIRST)), -took_s.get(file, 0.0)

    items.sort(key=order_of)


def pytest_addoption(parser):
    parser.addoption(
        "--durations-file",
        type=Path,
        help="write the seconds that each file of tests took here, and compare them",
    )
    parser.addoption(
        "--no-test-after",
        type=float,
        metavar="SECONDS",
        help="skip each test that would begin later than this after the session's start",
    )


def pytest_configure(config):
    if not hasattr(config, "workerinput"):  # workers inherit the start of the whole session
        os.environ[BEGAN] = str(time.monotonic())


@pytest.hookimpl(tryfirst=True)  # before the marks are looked at
def pytest_runtest_setup(item):
    limit_s = item.config.getoption("--no-test-after")
    if limit_s is not None and time.monotonic() - float(os.environ[BEGAN]) > limit_s:
        item.add_marker(pytest.mark.skip(reason=f"no time after {limit_s:g} s (--no-test-after)"))


def pytest_runtest_logreport(report):
    seconds[report.nodeid.partition("::")[0]] += report.duration


def pytest_terminal_summary(terminalreporter, config):
    file = config.getoption("--durations-file")
    if file is None:
        return
    before = kept_seconds(config)
    now = {name: round(took, 1) for name, took in sorted(seconds.items())}
    file.write_text(json.dumps(now, indent=1) + "\n", encoding="utf-8")
    terminalreporter.section("files that became slower")
    lines = slower(before, now) if before else ["there is nothing to compare with"]
    total = sum(now.values())
    was = sum(before.get(name, 0.0) for name in now)
    for line in [*lines, f"all {len(now)} files: {was:.0f} s -> {total:.0f} s"]:
        terminalreporter.write_line(line)
