"""How long each file of tests takes, and the order that follows from it: ``pytest
--durations-file FILE`` writes the seconds and says what became slower than
`tests/durations.json`.

Nothing fails for it. ``pytest --durations-file tests/durations.json`` keeps a new standard, which
holds for one machine and one number of workers: CI's.
"""

import json
from collections import defaultdict
from pathlib import Path

KEPT = Path(__file__).with_name("durations.json")
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


def kept_seconds():
    """Return the seconds of each file as they were kept; none where nothing is."""
    return json.loads(KEPT.read_text(encoding="utf-8")) if KEPT.exists() else {}


# A kernel's first call compiles it, for half a minute, and leaves it on disk for every later
# process. The files that compile the three groups of kernels come first, one a worker, so that no
# two processes compile the same ones; then what took longest when it was last measured, so that no
# worker is left alone with it at the end.
FIRST = (
    "tests/gaussians/test_rasterize_hard_cases.py",
    "tests/fixers/test_draw.py",
)


def pytest_collection_modifyitems(items):
    """Put the files in the order in which workers take them."""
    took_s = kept_seconds()

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


def pytest_runtest_logreport(report):
    seconds[report.nodeid.partition("::")[0]] += report.duration


def pytest_terminal_summary(terminalreporter, config):
    file = config.getoption("--durations-file")
    if file is None:
        return
    before = kept_seconds()
    now = {name: round(took, 1) for name, took in sorted(seconds.items())}
    file.write_text(json.dumps(now, indent=1) + "\n", encoding="utf-8")
    terminalreporter.section("files that became slower")
    lines = slower(before, now) if before else ["there is nothing to compare with"]
    total = sum(now.values())
    was = sum(before.get(name, 0.0) for name in now)
    for line in [*lines, f"all {len(now)} files: {was:.0f} s -> {total:.0f} s"]:
        terminalreporter.write_line(line)
