"""How long each file of tests takes: ``pytest --durations-file FILE`` writes it and says what
became slower than `tests/durations.json`.

Nothing fails for it. ``pytest --durations-file tests/durations.json`` keeps a new standard, which
holds for one machine and one number of workers: CI's.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

import pytest

KEPT = Path(__file__).with_name("durations.json")
FACTOR, LEAST_S = 1.5, 3.0  # a file is slower if it takes so many times as long, and so much longer
seconds: defaultdict[str, float] = defaultdict(float)  # by file, set-up and tear-down included


def slower(before: Mapping[str, float], now: Mapping[str, float]) -> list[str]:
    """Return a line for each file that became slower and for each new one that takes long, the
    worst first.
    """
    worse = []
    for file, took in now.items():
        was = before.get(file, 0.0)
        if took > FACTOR * was and took > was + LEAST_S:
            worse.append((was - took, f"{file}: {was:.1f} s -> {took:.1f} s"))
    return [line for _, line in sorted(worse)]


def kept_seconds() -> dict[str, float]:
    """Return the seconds of each file as they were kept; none where nothing is."""
    return json.loads(KEPT.read_text(encoding="utf-8")) if KEPT.exists() else {}


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--durations-file",
        type=Path,
        help="write the seconds that each file of tests took here, and compare them",
    )


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    seconds[report.nodeid.partition("::")[0]] += report.duration


def pytest_terminal_summary(
    terminalreporter: pytest.TerminalReporter, config: pytest.Config
) -> None:
    file: Path | None = config.getoption("--durations-file")
    if file is None:
        return
    before = kept_seconds()
    now = {name: round(took, 1) for name, took in sorted(seconds.items())}
    file.write_text(json.dumps(now, indent=1) + "\n", encoding="utf-8")
    terminalreporter.section("files that became slower")
    lines = slower(before, now) if before else ["there is nothing to compare with"]
    total, was = sum(now.values()), sum(before.get(name, 0.0) for name in now)
    for line in [*lines, f"all {len(now)} files: {was:.0f} s -> {total:.0f} s"]:
        terminalreporter.write_line(line)
