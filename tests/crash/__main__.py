"""Kill runs, start two at once, and fill the disk at every write; then finish them and compare with
an undisturbed run. Kill readers too.

    python -m tests.crash --kills 100 --seed 0

Linux only: it looks for orphans in /proc. Exit code 1 if anything was lost, done twice, left
running or left behind.
"""

from __future__ import annotations

import argparse
import errno
import os
import random
import shutil
import signal
import socket
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from tests.crash.drivers import Driver, handles_signals, in_child, processes_of, start, workers_of
from tests.crash.folder import Scene, comparable, finished, problems_after_finish

ORPHAN_S = 10.0  # in which workers must be gone after their parent
TARGETS = ("parent", "worker", "both")
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
PHASES = ("start", "building", "driving", "scoring", "reporting", "anywhere")
GIVE_UP_S = 300.0
READ_S = 4.0  # in which readers are killed


@dataclass(frozen=True)
class Kill:
    """One kill: who, by what, and when."""

    target: str
    signal: signal.Signals
    phase: str
    after_s: float

    def __str__(self) -> str:
        return f"{self.target}, {self.signal.name}, {self.phase} + {self.after_s:.2f} s"


def kills(count: int, seed: int, run_s: float) -> list[Kill]:
    """Draw kills: every combination of target, signal and phase in turn, at a drawn instant of the
    phase.
    """
    stream = random.Random(seed)
    combinations = [
        (target, number, phase) for phase in PHASES for target in TARGETS for number in SIGNALS
    ]
    stream.shuffle(combinations)
    chosen = [combinations[i % len(combinations)] for i in range(count)]
    return [
        Kill(*one, stream.uniform(0.0, run_s if one[2] == "anywhere" else 0.4)) for one in chosen
    ]


def reached(phase: str, root: Path, driver: Driver, before: int) -> bool:
    """Tell whether a driver has come to a phase, by what it has written."""
    cells = list(root.glob("rollouts/*/*/*/*"))
    done = sum((cell / "manifest.json").exists() for cell in cells)
    if not handles_signals(driver.pid):
        return False
    match phase:
        case "building":
            return (root / "run.json").exists() and bool(workers_of(driver.pid))
        case "driving":
            return any((cell / "rollout.asl.part").exists() for cell in cells) or done > before
        case "scoring":
            return (
                any(
                    (cell / "frames.jsonl").exists() and not (cell / "manifest.json").exists()
                    for cell in cells
                )
                or done > before
            )
        case "reporting":
            return (root / "summary.json").exists() or any(root.glob(".repeat.*"))
    return True


class Campaign:
    """Everything that is tried, in one working folder.

    Attributes:
        tally: What was tried, counted.
        problems: What went wrong.
    """

    def __init__(self, work: Path, scene: Scene) -> None:
        self.work, self.scene = work, scene
        self.tally: Counter[str] = Counter()
        self.problems: list[str] = []
        began = time.monotonic()
        if self._run(work / "undisturbed").wait() != 0:
            raise SystemExit(f"the undisturbed run fails: {self._said().read_text()}")
        self.run_s = time.monotonic() - began
        self.expected: dict[str, Any] = in_child(partial(comparable, work / "undisturbed"))

    def _said(self) -> Path:
        return self.work / "stderr.txt"

    def _run(
        self, root: Path, scene: Scene | None = None, before: Callable[[], object] = lambda: None
    ) -> Driver:
        return start((scene or self.scene).arguments(root), self._said(), before)

    def _report(self, label: str, found: list[str]) -> None:
        self.problems += [f"{label}: {text}" for text in found]

    def finish(self, root: Path, label: str) -> None:
        """Give the command once more and compare the folder with the undisturbed run."""
        kept = finished(root)
        driver = self._run(root, replace(self.scene, workers=1))
        code = driver.wait()
        found = (
            [f"exit code {code}: {driver.said[-300:]}"]
            if code != 0
            else in_child(partial(problems_after_finish, root, self.expected, kept))
        )
        self._report(f"{label}, then finished", found)
        self.tally["finished and compared"] += 1

    def kill(self, count: int, seed: int, budget_s: float) -> None:
        """Kill runs one after the other, up to three times in one folder; then finish it and
        compare.
        """
        began, root = time.monotonic(), self.work / "killed"
        for number, kill in enumerate(kills(count, seed, self.run_s)):
            if time.monotonic() - began > budget_s:
                print(f"stopped after {number} of {count} kills: the time is up")
                break
            # With one worker the rollouts run in the driver itself.
            scene = (
                replace(self.scene, workers=1)
                if kill.target == "parent" and number % 3
                else self.scene
            )
            whole = finished(root)
            code, found = self._strike(kill, root, scene)
            now = finished(root)
            found += [f"{cell} was finished and is lost" for cell in whole if cell not in now]
            self._report(f"kill {number} ({kill})", found)
            for what in (
                "kills",
                f"kills of {kill.target}",
                f"kills by {kill.signal.name}",
                f"kills while {kill.phase}",
                f"exit code {code}",
            ):
                self.tally[what] += 1
            print(
                f"kill {number} ({kill}): exit code {code}, {len(now)} rollouts whole, {len(self.problems)} problems",
                flush=True,
            )
            if number % 3 == 2 or kill.phase == "reporting":
                self.finish(root, f"kill {number} ({kill})")
                shutil.rmtree(root)
        if root.exists():
            self.finish(root, "the last kill")

    def _strike(self, kill: Kill, root: Path, scene: Scene) -> tuple[int | None, list[str]]:
        """Start a driver and kill it; return its exit code and what went wrong."""
        before = len(list(root.glob("rollouts/*/*/*/*/manifest.json")))
        driver = self._run(root, scene)
        give_up = time.monotonic() + GIVE_UP_S
        while (
            driver.poll() is None
            and not reached(kill.phase, root, driver, before)
            and time.monotonic() < give_up
        ):
            time.sleep(0.002)
        time.sleep(kill.after_s)
        workers = workers_of(driver.pid) if driver.poll() is None else []
        targets = ([driver.pid] if kill.target != "worker" and driver.poll() is None else []) + (
            workers if kill.target != "parent" else []
        )
        for pid in targets:
            try:
                os.kill(pid, kill.signal)
            except ProcessLookupError:
                continue
            self.tally["signals that reached a process"] += 1
        code = driver.wait()
        found = ["the driver hangs"] if code is None else []
        until = time.monotonic() + ORPHAN_S
        while (left := processes_of(driver.pid)) and time.monotonic() < until:
            time.sleep(0.02)
        if left:
            found.append(f"{len(left)} orphans {ORPHAN_S:g} s after the driver ended")
            os.killpg(driver.pid, signal.SIGKILL)
        if "Traceback" in driver.said:
            found.append(f"a traceback: {driver.said[-300:]}")
        wanted = {0, 128 + kill.signal if kill.signal != signal.SIGKILL else -signal.SIGKILL}
        if code is not None and code not in wanted:
            found.append(f"exit code {code}: {driver.said[-300:]}")
        return code, found

    def pairs(self, count: int) -> None:
        """Start two drivers of one folder at once: one is refused by name, or waits with
        ``--wait``.
        """
        for number in range(count):
            root, waiting = self.work / f"two-{number}", number % 2 == 1
            arguments = [*self.scene.arguments(root), *(["--wait"] if waiting else [])]
            drivers = [start(arguments, self.work / f"stderr-{i}.txt") for i in range(2)]
            codes = sorted(driver.wait() or 0 for driver in drivers)
            label = f"two drivers ({'--wait' if waiting else 'refused'})"
            self.tally[label] += 1
            found = [] if codes == ([0, 0] if waiting else [0, 4]) else [f"exit codes {codes}"]
            if not waiting and not any("is writing it" in driver.said for driver in drivers):
                found.append("the refusal names nobody")
            self._report(
                label, found + in_child(partial(problems_after_finish, root, self.expected, {}))
            )

    def readers(self, count: int, seed: int) -> None:
        """Kill ``gate`` and ``serve`` at any time: the run stays as it was, nothing keeps running,
        and the port can be had again.
        """
        stream, root = random.Random(seed), self.work / "undisturbed"
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        serve = [
            "serve",
            "--scenes",
            "smoke/straight",
            "--renderer",
            "clean",
            "--listen",
            f"127.0.0.1:{port}",
        ]
        for number in range(count):
            arguments, signal_ = (["gate", str(root)], serve)[number % 2], stream.choice(SIGNALS)
            driver, after_s = start(arguments, self._said()), stream.uniform(0.0, READ_S)
            time.sleep(after_s)
            if driver.poll() is None:
                os.kill(driver.pid, signal_)
                self.tally[f"kills of {arguments[0]} by {signal_.name}"] += 1
            code = driver.wait()
            found = (
                []
                if code in (0, 1, 3, 128 + signal_, -signal_)
                else [f"exit code {code}: {driver.said[-300:]}"]
            )
            found += ["a traceback"] if "Traceback" in driver.said else []
            found += ["it left a process"] if processes_of(driver.pid) else []
            self._report(f"{arguments[0]} {number} ({signal_.name} after {after_s:.2f} s)", found)
        self._report("readers", in_child(partial(problems_after_finish, root, self.expected, {})))

    def full_disk(self, every: int) -> None:
        """Refuse the n-th write of a run; it must say so, lose nothing, and finish when the disk
        has room.
        """
        one, counter = replace(self.scene, workers=1), self.work / "writes.txt"
        self._run(self.work / "counted", one, partial(fill_disk, 0, counter)).wait()
        writes = len(counter.read_text())
        for n in range(1, writes + 1, every):
            root = self.work / "full"
            driver = self._run(root, one, partial(fill_disk, n, counter))
            code = driver.wait()
            good = code == 4 and "Traceback" not in driver.said and "free disk space" in driver.said
            self._report(
                f"write {n} of {writes} refused",
                [] if good else [f"exit code {code}: {driver.said[-300:]}"],
            )
            self.tally[f"writes refused, of {writes}"] += 1
            self.finish(root, f"write {n} of {writes} refused")
            shutil.rmtree(root)


def fill_disk(refused: int, counter: Path) -> None:
    """Refuse one write of this process: every file of simrun ends with an fsync, where a full disk
    is noticed.
    """
    fsync, made = os.fsync, 0

    def refuse(handle: int) -> None:
        nonlocal made
        made += 1
        if refused == 0:
            with counter.open("a") as file:
                file.write(".")
        if made == refused:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(handle)

    os.fsync = refuse  # type: ignore[assignment]


def main() -> int:
    """Run what the command line asks for and print what was found."""
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("--kills", type=int, default=100)
    options.add_argument("--pairs", type=int, default=4, help="pairs of drivers started at once")
    options.add_argument(
        "--full-disk",
        type=int,
        default=0,
        metavar="N",
        help="refuse every N-th write of a run in turn; 1 is every write",
    )
    options.add_argument(
        "--readers",
        type=int,
        default=0,
        metavar="N",
        help="kill simrun gate and simrun serve in turn, N times",
    )
    options.add_argument("--seed", type=int, default=0)
    options.add_argument("--minutes", type=float, default=1e9, help="stop killing after this time")
    given = options.parse_args()
    began = time.monotonic()
    work = Path(tempfile.mkdtemp(prefix="simrun-crash-"))
    campaign = Campaign(work, Scene())
    campaign.kill(given.kills, given.seed, 60 * given.minutes)
    campaign.pairs(given.pairs)
    campaign.readers(given.readers, given.seed)
    if given.full_disk:
        campaign.full_disk(given.full_disk)
    for name, count in sorted(campaign.tally.items()):
        print(f"{count:6d}  {name}")
    print(f"{len(campaign.problems)} problems in {(time.monotonic() - began) / 60:.1f} minutes")
    for text in campaign.problems:
        print(f"PROBLEM: {text}")
    if campaign.problems:
        print(f"the folders are kept: {work}")
    else:
        shutil.rmtree(work)
    return 1 if campaign.problems else 0


if __name__ == "__main__":
    sys.exit(main())
