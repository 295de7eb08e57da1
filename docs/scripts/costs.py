"""Measure what a user waits for and needs, and write the table of docs/costs.md: processor time, peak
memory and disk of one command each, in an empty folder with an empty cache.

Usage: python docs/scripts/costs.py [NAME...]
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from pages import DOCS, replaced, table

RECORD = DOCS / "experiments" / "costs.json"
PAGE = DOCS / "costs.md"
SIMRUN = (sys.executable, "-m", "alpasim_plugin.cli.main")
TWO = ("--no-report", "--out", "runs/two")
FIRST = ("--renderer", "clean,3dgs,onefixer", "--policy", "lane-camera", "suites/first")
# Name -> what it is, and the command. All share one folder and its cache, in this order.
STEPS: dict[str, tuple[str, tuple[str, ...]]] = {
    "start": ("start the program", (*SIMRUN, "--version")),
    "rollout": (
        "the first rollout: compiles kernels, fits one scene, drives it behind `3dgs`",
        (*SIMRUN, "--renderer", "3dgs", "smoke/curve", "--no-report", "--out", "runs/one"),
    ),
    "again": (
        "the same rollout with another policy: nothing is compiled or fitted",
        (*SIMRUN, "--renderer", "3dgs", "--policy", "lane-camera", "smoke/curve", *TWO),
    ),
    "first": ("the README's first run: 9 rollouts and a report", (*SIMRUN, *FIRST)),
    "suite": (
        "a suite behind `clean`: 14 rollouts",
        (*SIMRUN, "--renderer", "clean", "--no-report", "suites/urban", "--out", "runs/suite"),
    ),
}


@dataclass(frozen=True)
class Cost:
    """What one command took.

    Attributes:
        processor_s: Of the process and its children, user and system.
        memory_mb: Largest resident memory of any one of its processes.
        disk_mb: By which folder and cache grew.
    """

    processor_s: float
    memory_mb: float
    disk_mb: float


def folder_mb(folder: Path) -> float:
    """Return the size of all files below a folder."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e6


def measured(command: Sequence[str], folder: Path) -> Cost:
    """Run a command in a folder and return what it took."""
    before = folder_mb(folder)
    environment = os.environ | {
        "SIMRUN_CACHE": str(folder / "cache"),
        "NUMBA_CACHE_DIR": str(folder / "kernels"),
        "PYTHONPATH": str(DOCS.parent),
    }
    process = subprocess.Popen(
        command, cwd=folder, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
    )
    _, errors = process.stderr.read(), process.stderr.close()
    _, status, usage = os.wait4(process.pid, 0)
    code = os.waitstatus_to_exitcode(status)
    assert code in (0, 1), f"{command} ended with {code}: {errors}"
    return Cost(usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1e3, folder_mb(folder) - before)


def installed_mb() -> float:
    """Return the size of the environment that this runs in."""
    return folder_mb(Path(sys.prefix))


def page_of(record: dict[str, dict[str, float]], text: str) -> str:
    """Return the page with the table of a record."""
    rows = [
        (step, f"{cost['processor_s']:.0f}", f"{cost['memory_mb']:.0f}", f"{cost['disk_mb']:.0f}")
        for name, (step, _) in STEPS.items()
        if (cost := record.get(name))
    ]
    head = ("what", "processor seconds", "memory of the largest process, MB", "disk, MB")
    return replaced(text, "costs", table(head, rows))


def main() -> None:
    """Measure the named steps, or all; write record and page."""
    names = sys.argv[1:] or list(STEPS)
    record = json.loads(RECORD.read_text()) if RECORD.is_file() else {}
    with tempfile.TemporaryDirectory() as name:
        for step in names:
            begun = time.monotonic()
            record[step] = asdict(measured(STEPS[step][1], Path(name)))
            print(f"{step}: {record[step]}, {time.monotonic() - begun:.0f} s passed", flush=True)
    RECORD.write_text(json.dumps(record, indent=1) + "\n")
    PAGE.write_text(page_of(record, PAGE.read_text()))


if __name__ == "__main__":
    main()
