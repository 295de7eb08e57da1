"""Which executor a run uses, by the text of ``--executor``."""

import math
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.queries import options_of


@dataclass(frozen=True)
class Executor:
    """Where rollouts run.

    Attributes:
        kind: ``local``: processes of this machine. ``ray``: tasks of a Ray cluster.
        address: HOST:PORT of the cluster's head; empty: the one at hand.
        cores: Processor cores of each rollout on a cluster.
        gpus: Share of a GPU; 0.5 lets two rollouts share one.
        memory_gib: Memory; 0 declares none.
    """

    kind: Literal["local", "ray"] = "local"
    address: str = ""
    cores: int = 1
    gpus: float = 0.0
    memory_gib: float = 0.0

    @property
    def is_local(self) -> bool:
        """Tell whether workers are processes of this machine that write the run folder."""
        return self.kind == "local"

    def __str__(self) -> str:
        return f"{self.kind}:{self.address}" if self.address else self.kind


LOCAL = Executor()


def parse_executor(text: str) -> Executor:
    """Parse ``--executor``: ``local``, or ``ray[:HOST:PORT]`` with what each rollout needs behind a
    question mark.

    Example:
        >>> parse_executor("ray:10.0.0.1:6379?cores=4&gpus=0.5")
        Executor(kind='ray', address='10.0.0.1:6379', cores=4, gpus=0.5, memory_gib=0.0)

    Raises:
        InputError: There is no such executor, or a need is unknown or no number of its kind.
    """
    if text == "local":
        return LOCAL
    named, _, query = text.partition("?")
    kind, _, address = named.partition(":")
    needs = options_of(query, ("cores", "gpus", "memory"), f"--executor {text}")
    if kind == "ray" and not address.startswith("//"):
        with suppress(ValueError):
            cores = int(needs.get("cores", 1))
            gpus = float(needs.get("gpus", 0))
            memory_gib = float(needs.get("memory", 0))
            if cores >= 1 and 0 <= gpus < math.inf and 0 <= memory_gib < math.inf:
                return Executor("ray", address, cores, gpus, memory_gib)
    raise InputError(
        f"--executor {text}: no such executor, or not what a rollout can need",
        "write local, ray, ray:HOST:PORT, or ray?cores=2&gpus=0.5&memory=7.5 (whole cores, a "
        "share of a GPU, GiB)",
    )
