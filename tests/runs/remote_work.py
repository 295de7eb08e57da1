"""Work for the tests of executors: what happens to a worker is written in the item."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from alpasim_plugin.runs.executors.base import Faulty, Node

DAY_S = 86_400


@dataclass(frozen=True)
class Scripted:
    """Do what the item says, and note in a folder that all nodes see which node did it, and which
    day it is there.

    Items: ``sleep S``, ``die``, ``die once``, ``raise``, ``fetch SHA256``, ``late S`` (slow only
        the first time), ``hold`` (until
    there is a note ``go``).
    """

    notes: Path
    bad_node: str = ""  # results of this node are faulty

    def __call__(self, job: str, node: Node) -> Any:
        name = job.replace(" ", "-")[:60]
        seen = len(list(self.notes.glob(f"{name}.*")))
        (self.notes / f"{name}.{os.getpid()}.{time.monotonic_ns()}").write_text(
            f"{node.name} {int(time.time() // DAY_S)}"
        )
        words = job.split("#")[0].split()
        if words[0] == "sleep" or (words[0] == "late" and seen == 0):
            time.sleep(float(words[1]))
        while words[0] == "hold" and not (self.notes / "go").exists():
            time.sleep(0.05)
        if words[0] == "die" and (len(words) == 1 or seen == 0):
            os.kill(os.getpid(), signal.SIGKILL)
        if words[0] == "raise":
            raise ValueError("no")
        if words[0] == "fetch":
            return len(node.fetch(words[1]))
        if self.bad_node and node.name == self.bad_node:
            return Faulty(f"{job} failed", "disk full")
        return job.upper()

    def key(self, item: str) -> str:
        """Return the item."""
        return item

    def needs(self, item: str) -> list[str]:
        """Return what the item fetches."""
        words = item.split()
        return [words[1]] if words[0] == "fetch" else []
