"""Every verb on every machine that lacks something: ``python -m tests.degradation``; needs root, to
become another user and to mount.

``--machine`` and ``--verb`` take those whose name contains a word, or one of several with commas
between. The table says the exit code of each cell; what ended otherwise than docs/cli.md says is
printed below it, and makes the command end with 1.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tests.degradation.cells import MACHINES, VERBS, make_work, outcome
from tests.other_user import can_become_nobody, shared_folder


def main() -> int:
    """Print the table; return 1 if a cell ended in another way than documented, 4 where this
    machine does not allow the trial.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--machine", default="", help="machines whose name contains this, or one of several: A,B"
    )
    parser.add_argument(
        "--verb", default="", help="verbs whose name contains this, or one of several: A,B"
    )
    arguments = parser.parse_args()
    if not can_become_nobody():
        print("needs root that may mount, to become another user", file=sys.stderr)
        return 4
    verbs = [verb for verb in VERBS if any(word in verb for word in arguments.verb.split(","))]
    wrong = []
    print(f"| machine | {' | '.join(verbs)} |\n|---|{'---:|' * len(verbs)}")
    with shared_folder() as root:
        made = root / "made"
        made.mkdir()
        make_work(made)
        for name, machine in MACHINES.items():
            if not any(word in name for word in arguments.machine.split(",")):
                continue
            print(f"| {machine.what} |", end="", flush=True)
            for i, verb in enumerate(verbs):
                found = outcome(machine, verb, made, Path(root, f"{name.replace(' ', '-')}-{i}"))
                print(f" {found.code}{'!' if found.wrong else ''} |", end="", flush=True)
                wrong += [f"{name}, {verb}: {found.wrong}\n{found.said}\n"] if found.wrong else []
            print(flush=True)
    print(
        "\n" + "\n".join(wrong)
        if wrong
        else f"\nno cell of {len(verbs)} verbs ended otherwise than documented"
    )
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
