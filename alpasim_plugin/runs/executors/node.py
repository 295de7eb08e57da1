"""The far side of a pool: a process on a node that says whether it may work, and then answers with
results.

Numerical libraries read the number of their threads when they are imported, so this module imports
none.
"""

from __future__ import annotations

import os
import pickle
import socket
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.core.subprocesses import own_path_only
from alpasim_plugin.runs.executors.base import THREAD_VARIABLES, Node


class Serving:
    """A worker on a node of a Ray cluster; Ray makes an actor of it.

    Args:
        node: Name of the node.
        threads: Of numerical libraries; set before they are imported.
        expected: What `alpasim_plugin.runs.executors.assignment.identity_of` says on the driver.
        targets: Modules of parts that are not simrun's.
    """

    def __init__(
        self, node: str, threads: int, expected: Mapping[str, str], targets: Sequence[str]
    ) -> None:
        own_path_only()  # Ray adds the driver's working directory
        os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(threads)))
        self._node, self._expected, self._targets = node, expected, targets
        self._work: Any = None

    def begun(self) -> None:
        """Answer, so that the driver knows that this process runs."""

    def accept(self, work: bytes) -> tuple[int, list[str]]:
        """Compare this node with the driver; take the work if nothing differs. Return the process
        number and what differs.
        """
        from alpasim_plugin.runs.executors.assignment import differences, identity_of, sweep

        sweep()
        reasons = differences(self._expected, identity_of(self._targets))
        if not reasons:
            self._work = pickle.loads(work)
        return os.getpid(), reasons

    def do(self, jobs: bytes, refs: Mapping[str, Any]) -> bytes:
        """Do jobs; ``refs`` are Ray's references to the contents that they need, by SHA-256."""
        import ray

        return serve(
            self._work,
            pickle.loads(jobs),
            Node(self._node, lambda sha256: bytes(ray.get(refs[sha256]))),
        )


@dataclass(frozen=True)
class JobAnswer:
    """What a job of Slurm says.

    Attributes:
        node: Name of its node.
        reasons: What the node has that the driver has not; with any, nothing was done.
        keys: Of its work.
        answers: As `serve` returns them.
    """

    node: str
    reasons: Sequence[str]
    keys: Sequence[str]
    answers: bytes


def serve_job(
    folder: str,
    work: str,
    jobs: bytes,
    keys: Sequence[str],
    expected: Mapping[str, str],
    targets: Sequence[str],
    threads: int,
) -> JobAnswer:
    """Do the pool's jobs in a job of Slurm; contents are files of a folder that all nodes see.

    Args:
        folder: The session's folder.
        work: SHA-256 of the pickled work, among the contents.
        jobs: Pickled.
        keys: One per job.
        expected, targets, threads: As `Serving` takes them.
    """
    own_path_only()
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, str(threads)))
    from alpasim_plugin.runs.executors.assignment import differences, identity_of, sweep

    sweep()
    node = Node(
        os.environ.get("SLURMD_NODENAME") or socket.gethostname(),
        lambda sha256: Path(folder, "placed", sha256).read_bytes(),
    )
    reasons = differences(expected, identity_of(targets))
    if reasons:
        return JobAnswer(node.name, reasons, keys, b"")
    return JobAnswer(
        node.name, (), keys, serve(pickle.loads(node.fetch(work)), pickle.loads(jobs), node)
    )


def serve(work: Callable[[Any, Node], Any], jobs: Sequence[Any], node: Node) -> bytes:
    """Return the pickled answers to jobs: results, or exceptions that the work raised."""
    answers: list[Any] = []
    for job in jobs:
        try:
            answer: Any = work(job, node)
            pickle.dumps(answer)
        except Exception as error:
            error.add_note(traceback.format_exc())
            answer = _sendable(error)
        answers.append(answer)
    return pickle.dumps(answers)


def _sendable(error: Exception) -> Exception:
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # whatever an exception's own pickling raises
        return InfrastructureError(
            f"{type(error).__name__}: {error}",
            "read the traceback with --executor local",
        )
    return error
