"""Measure what a user waits for and needs, and write the table of docs/costs.md: processor time, time
that passed, peak memory and disk of each step, in an empty folder with an empty cache.

Usage: python docs/scripts/costs.py [NAME...] | --installed

Steps share the folder and its cache, in the order of `STEPS`; one that is named alone is measured
after those that it needs were run. ``--installed`` prints the size of simrun and all that it
requires in the environment that this runs in.
"""

from __future__ import annotations

import ctypes
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import Distribution, PackageNotFoundError, distribution
from pathlib import Path

from pages import DOCS, replaced, table

TREE = DOCS.parent
RECORD = DOCS / "experiments" / "costs.json"
PAGE = DOCS / "costs.md"
SIMRUN = "simrun"
PYTHON = "python"
DISTRIBUTION = "alpasim-onefixer"
MAKE_PHOTOGRAPHS = (PYTHON, str(DOCS / "scripts" / "street_photographs.py"), "photographs", "40")
PR_SET_CHILD_SUBREAPER = 36  # linux/prctl.h

Command = tuple[str, ...]


@dataclass(frozen=True)
class Step:
    """Something that a user waits for.

    Attributes:
        title: As the table calls it.
        commands: Each program with its arguments; `simrun` and `python` are those of this environment.
        needs: Names of steps that come before.
    """

    title: str
    commands: tuple[Command, ...]
    needs: tuple[str, ...] = ()


def simrun_of(line: str) -> Command:
    """Return a command of simrun, written as in a shell."""
    return (SIMRUN, *line.split())


STEPS: dict[str, Step] = {
    "install": Step(
        "install it as the page says: `pip install torch`, which is the build for CUDA",
        (
            (PYTHON, "-m", "venv", "env"),
            ("env/bin/pip", "install", "--quiet", "torch"),
            ("env/bin/pip", "install", "--quiet", str(TREE)),
        ),
    ),
    "start": Step("start the program: `simrun --version`", (simrun_of("--version"),)),
    "first": Step(
        "the first run of the README: compile kernels, fit three scenes, 9 rollouts, a report",
        (
            simrun_of(
                "--renderer clean,3dgs,onefixer --policy lane-camera suites/first --out first"
            ),
        ),
    ),
    "again": Step(
        "the same 9 rollouts in another folder: nothing is compiled or fitted",
        (
            simrun_of(
                "--renderer clean,3dgs,onefixer --policy lane-camera suites/first --out again"
            ),
        ),
        needs=("first",),
    ),
    "suite": Step(
        "a suite behind `clean`: `suites/urban`, 14 rollouts",
        (simrun_of("--renderer clean --policy lane-camera suites/urban --out suite"),),
        needs=("first",),
    ),
    "gate": Step(
        "the same suite for a gate: `--images none`, a policy that uses no camera",
        (
            simrun_of(
                "--renderer clean --policy pure-pursuit --images none --no-report suites/urban"
                " --out gate"
            ),
        ),
        needs=("first",),
    ),
    "fit": Step(
        "one more scene behind `3dgs`: its fit and one rollout",
        (simrun_of("--renderer 3dgs --policy lane-camera --no-report urban/s_bend --out fit"),),
        needs=("first",),
    ),
    "street": Step(
        f"import a street of {MAKE_PHOTOGRAPHS[-1]} photographs of 256x144 pixels",
        (simrun_of("import drive photographs -o street"),),
        needs=("first",),
    ),
    "drive": Step(
        "drive the imported street behind `3dgs` and `onefixer`: 2 rollouts",
        (
            simrun_of(
                "--renderer 3dgs,onefixer --policy lane-camera street/scenario.yaml --out drive"
            ),
        ),
        needs=("first", "street"),
    ),
    "train": Step(
        "train a first small fixer: 16 scenes, their pairs, 100 updates",
        (
            simrun_of("train scenes --out scenes --split train --count 12"),
            simrun_of("train scenes --out scenes --split val --count 4"),
            simrun_of("train pairs scenes --out pairs --split val,train --jobs 2"),
            simrun_of("train per-frame pairs --out small --steps 100 --decay-from 80"),
        ),
        needs=("first",),
    ),
}


@dataclass(frozen=True)
class Cost:
    """What a step took. This module imports little, since Linux counts the memory of the process that
    starts another one as the other's too.

    Attributes:
        processor_s: Of all its processes, user and system.
        passed_s: From its start to its end, by the clock.
        memory_mb: Largest resident memory of any one of its processes.
        disk_mb: By which folder and cache grew.
    """

    processor_s: float
    passed_s: float
    memory_mb: float
    disk_mb: float


def folder_mb(folder: Path) -> float:
    """Return the size of all files below a folder."""
    files = (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    return sum(path.stat().st_size for path in files) / 1e6


def environment_of(folder: Path) -> Mapping[str, str]:
    """Return variables by which everything that simrun keeps lies in a folder."""
    return os.environ | {
        "SIMRUN_CACHE": str(folder / "cache"),
        "NUMBA_CACHE_DIR": str(folder / "kernels"),
        "PYTHONPATH": str(TREE),
    }


def program(command: Command) -> Command:
    """Return a command with the programs of this environment in it."""
    programs = {
        SIMRUN: (sys.executable, "-m", "alpasim_plugin.cli.main"),
        PYTHON: (sys.executable,),
    }
    return programs.get(command[0], command[:1]) + command[1:]


def required_mb(name: str, counted_names: set[str]) -> float:
    """Return the size of a distribution's files and of all that it requires, megabytes.

    Args:
        name: Of an installed distribution; one that is not installed, as on another system, counts 0.
        counted_names: Names that were counted before; grows.
    """
    if name.lower() in counted_names:
        return 0.0
    counted_names.add(name.lower())
    try:
        installed = distribution(name)
    except PackageNotFoundError:
        return 0.0
    files = [Path(installed.locate_file(file)) for file in installed.files or []]
    size_mb = sum(file.stat().st_size for file in files if file.is_file()) / 1e6
    required = [re.split(r"[^\w.-]", line, maxsplit=1)[0] for line in requirements_of(installed)]
    return size_mb + sum(required_mb(other, counted_names) for other in required)


def requirements_of(installed: Distribution) -> list[str]:
    """Return what a distribution requires without its extras."""
    return [line for line in installed.requires or [] if "extra ==" not in line]


def take_over_orphans() -> None:
    """Become the parent of processes whose parent ends: workers are children of a process that the
    command starts and does not wait for.
    """
    if ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0) != 0:
        raise RuntimeError("the times of workers cannot be counted: prctl failed")


def ended(pid: int) -> tuple[int, list[resource.struct_rusage]]:
    """Wait for a process and everything that it left, and return its exit code and what all took."""
    code, usages = 0, []
    while True:
        try:
            child, status, usage = os.wait4(-1, 0)
        except ChildProcessError:
            return code, usages
        usages.append(usage)
        if child == pid:
            code = os.waitstatus_to_exitcode(status)


def cost_of(step: Step, folder: Path) -> Cost:
    """Run a step in a folder and return what it took.

    Raises:
        RuntimeError: A command ended with an error. A run that found failures of the policy is none.
    """
    before_mb = folder_mb(folder)
    begun_s = time.monotonic()
    processor_s = memory_mb = 0.0
    for command in step.commands:
        with tempfile.TemporaryFile("w+") as output:
            process = subprocess.Popen(
                program(command),
                cwd=folder,
                env=environment_of(folder),
                stdout=output,
                stderr=output,
            )
            code, usages = ended(process.pid)
            process.returncode = code
            output.seek(0)
            if code not in (0, 1, 3):
                raise RuntimeError(f"{command} ended with {code}: {output.read()}")
        processor_s += sum(usage.ru_utime + usage.ru_stime for usage in usages)
        memory_mb = max(memory_mb, *(usage.ru_maxrss / 1e3 for usage in usages))
    passed_s = time.monotonic() - begun_s
    return Cost(processor_s, passed_s, memory_mb, folder_mb(folder) - before_mb)


def rounded(value: float) -> str:
    """Return a number with as many digits as matter to somebody who waits."""
    return f"{value:,.1f}" if value < 10 else f"{value:,.0f}"


def page_of(record: Mapping[str, Mapping[str, float]], text: str) -> str:
    """Return the page with the table of a record."""
    columns = ("processor_s", "passed_s", "memory_mb", "disk_mb")
    rows = [
        (step.title, *(rounded(record[name][column]) for column in columns))
        for name, step in STEPS.items()
        if name in record
    ]
    head = (
        "what",
        "processor time, s",
        "time that passed, s",
        "memory of the largest process, MB",
        "disk, MB",
    )
    return replaced(text, "costs", table(head, rows))


def with_needs(names: list[str]) -> list[str]:
    """Return the names of steps, and of those that they need, in the order of `STEPS`."""
    needed = set(names)
    for name in reversed(STEPS):
        if name in needed:
            needed |= set(STEPS[name].needs)
    return [name for name in STEPS if name in needed]


def main() -> None:
    """Measure the named steps, or all; write record and page."""
    if sys.argv[1:] == ["--installed"]:
        print(f"{required_mb(DISTRIBUTION, set()):,.0f} MB in this environment")
        return
    names = sys.argv[1:] or list(STEPS)
    record = json.loads(RECORD.read_text()) if RECORD.is_file() else {}
    take_over_orphans()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        subprocess.run(
            program(MAKE_PHOTOGRAPHS), cwd=folder, env=environment_of(folder), check=True
        )
        for step in with_needs(names):
            cost = cost_of(STEPS[step], folder)
            print(f"{step}: {cost}", flush=True)
            if step in names:
                record[step] = {key: round(value, 1) for key, value in asdict(cost).items()}
                RECORD.write_text(json.dumps(record, indent=1) + "\n")
                PAGE.write_text(page_of(record, PAGE.read_text()))


if __name__ == "__main__":
    main()
