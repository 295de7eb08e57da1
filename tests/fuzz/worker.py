"""Children that work on one input after another, within limits of time and memory."""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import random
import resource
import signal
import sys
import time
import traceback
from pathlib import Path
from typing import Any

from tests.fuzz.targets import TARGETS, Target, check, inputs, out_of_memory, valid, workplace

CPU_S, WALL_S = 5.0, 60.0  # a loaded machine stretches wall time: a hang is 5 s of work
MEMORY_BYTES = 1 << 30  # beyond what the process holds when all is imported


class TookTooLong(BaseException):
    """The input used up its time; no handler of a reader may swallow it."""


def rng_of(seed: int, number: int) -> random.Random:
    """Return the chance of one input."""
    return random.Random(f"{seed}/{number}")


def one(target: Target, seed: int, number: int, folder: Path) -> tuple[str, str]:
    """Return the outcome of one input and, for a finding, where it came from."""
    files = inputs(target, rng_of(seed, number))

    def late(*_: Any) -> None:
        raise TookTooLong

    signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, CPU_S)
    try:
        return check(target, files, folder), ""
    except TookTooLong:
        return "hang", _where()
    except MemoryError:
        return "memory", _where()
    except Exception as error:
        try:
            out_of_memory(error)
        except MemoryError:
            return "memory", _where()
        return "traceback", f"{type(error).__name__}: {str(error)[:200]} | {_where()}"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def _where() -> str:
    frames = traceback.extract_tb(sys.exc_info()[2])
    own = [
        f"{Path(f.filename).name}:{f.lineno}"
        for f in frames
        if "site-packages" not in f.filename and "/tests/" not in f.filename
    ]
    return " > ".join(own[-4:])


def child(pipe: multiprocessing.connection.Connection, seed: int, names: list[str]) -> None:
    """Answer inputs until the pipe closes; Ctrl-C is for the parent, which then gives no further
    input.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    targets = [t for t in TARGETS if t.name in names]
    with workplace() as folder:
        for target in targets:  # import all that a valid input needs, before memory is limited
            try:
                if check(target, valid(target), folder) != "accepted":
                    raise ValueError("refused")
            except Exception as error:
                pipe.send(("invalid", target.name, f"{type(error).__name__}: {error}"))
                return
        held = (
            int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            if sys.platform == "linux"
            else 0
        )
        if held:
            resource.setrlimit(resource.RLIMIT_AS, (held + MEMORY_BYTES, resource.RLIM_INFINITY))
        pipe.send(("ready", "", ""))
        while (number := pipe.recv()) is not None:
            pipe.send(one(targets[number % len(targets)], seed, number, folder))


class Worker:
    """A child and the input that it works on."""

    def __init__(self, seed: int, targets: list[Target]) -> None:
        self.seed, self.targets = seed, targets
        self.start()

    def start(self) -> None:
        here, there = multiprocessing.get_context("spawn").Pipe()
        self.pipe = here
        names = [target.name for target in self.targets]
        self.process = multiprocessing.get_context("spawn").Process(
            target=child, args=(there, self.seed, names), daemon=True
        )
        self.process.start()
        there.close()
        state, name, text = self.pipe.recv()
        if state == "invalid":
            raise SystemExit(f"the undamaged files of {name} are refused: {text}")

    def give(self, number: int) -> None:
        self.number, self.since = number, time.monotonic()
        self.pipe.send(number)

    def take(self) -> tuple[str, str]:
        try:
            return self.pipe.recv()  # type: ignore[no-any-return]
        except EOFError:
            self.process.join()
            outcome = ("crash", f"the process ended with code {self.process.exitcode}")
            self.start()
            return outcome

    def overdue(self) -> bool:
        return time.monotonic() - self.since > WALL_S

    def replace(self) -> tuple[str, str]:
        self.process.kill()
        self.process.join()
        self.start()
        return "hang", f"no answer in {WALL_S:.0f} s"
