"""Fuzz every reader: ``python -m tests.fuzz --inputs 20000 --jobs 1``.

Input i of a seed is always the same. Children are reused from input to input; one that hangs is
ended and replaced. ``--start`` goes on where an earlier call stopped; ``--seconds`` ends the run
after a time; ``--only`` takes targets whose name contains a word; ``--input N`` runs one input
here, with its traceback. Ctrl-C and SIGTERM end the run with the table of what was done.
"""

from __future__ import annotations

import argparse
import collections
import itertools
import math
import multiprocessing.connection
import signal
import sys
import time

from tests.fuzz.targets import TARGETS, check, inputs, workplace
from tests.fuzz.worker import Worker, rng_of


def main() -> int:
    """Run the inputs and print a table; return 1 if there are findings."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--inputs", type=int, default=20_000)
    parser.add_argument("--seconds", type=float, default=math.inf)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--only", default="")
    parser.add_argument("--input", type=int)
    arguments = parser.parse_args()
    targets = [t for t in TARGETS if arguments.only in t.name]
    if arguments.input is not None:
        target = targets[arguments.input % len(targets)]
        with workplace() as folder:
            print(
                target.name,
                check(target, inputs(target, rng_of(arguments.seed, arguments.input)), folder),
            )
        return 0
    stopped: list[int] = []
    for stop in (signal.SIGINT, signal.SIGTERM):
        signal.signal(stop, lambda number, _: stopped.append(number))
    numbers = range(arguments.start, arguments.start + arguments.inputs)
    tally: collections.Counter[tuple[str, str]] = collections.Counter()
    findings: dict[tuple[str, str, str], list[int]] = {}
    workers = [Worker(arguments.seed, targets) for _ in range(arguments.jobs)]
    busy: list[Worker] = []
    until = time.monotonic() + arguments.seconds
    todo = itertools.takewhile(lambda _: not stopped and time.monotonic() < until, numbers)
    for worker in workers:
        if (number := next(todo, None)) is not None:
            worker.give(number)
            busy.append(worker)
    began = time.monotonic()
    done = 0
    slowest = (0.0, -1)
    while busy:
        ready = multiprocessing.connection.wait([w.pipe for w in busy], 1.0)
        for worker in [w for w in busy if w.pipe in ready or w.overdue()]:
            outcome, where = worker.take() if worker.pipe in ready else worker.replace()
            name, number = targets[worker.number % len(targets)].name, worker.number
            slowest = max(slowest, (time.monotonic() - worker.since, number))
            tally[name, outcome] += 1
            done += 1
            if outcome not in ("accepted", "refused"):
                known = findings.setdefault((outcome, name, where.rpartition("|")[2] or where), [])
                known.append(number)
                if len(known) == 1:
                    print(f"\n{outcome}: {name}, input {number}: {where}", flush=True)
            if done % 100 == 0:
                rate, found = done / (time.monotonic() - began), sum(map(len, findings.values()))
                print(
                    f"\r{done} of {arguments.inputs}, {rate:.1f} a second, {found} findings",
                    end="",
                    flush=True,
                )
            if (following := next(todo, None)) is not None:
                worker.give(following)
            else:
                busy.remove(worker)
    print(
        "\n\n| reader | inputs | accepted | refused | traceback | hang | memory | crash |\n|---|---:|---:|---:|---:|---:|---:|---:|"
    )
    kinds = ("accepted", "refused", "traceback", "hang", "memory", "crash")
    for target in targets:
        counts = [tally[target.name, kind] for kind in kinds]
        print(f"| {target.name} | {sum(counts)} | {' | '.join(map(str, counts))} |")
    totals = [sum(n for (_, kind), n in tally.items() if kind == wanted) for wanted in kinds]
    print(f"| all | {sum(totals)} | {' | '.join(map(str, totals))} |")
    print(f"\nslowest input: {slowest[1]} with {slowest[0]:.1f} s of wall time")
    for (outcome, name, where), numbers in sorted(findings.items()):
        print(f"{outcome}: {name}: {len(numbers)} inputs, such as {numbers[:3]}: {where}")
    for worker in workers:
        worker.pipe.send(None)
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
