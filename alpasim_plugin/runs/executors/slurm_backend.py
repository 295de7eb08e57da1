"""Jobs of Slurm through submitit: each is one chunk of the pool's jobs, and answers through a
folder that all nodes see.

$SIMRUN_SLURM/RUN/SESSION/jobs          one line per job: its number, and for a local one when its process started
                         /placed/SHA    contents, by their SHA-256
                         /N_*.pkl, .out what submitit writes; gone as soon as a result was taken
RUN is a digest of the run folder's path. Work and results are pickles, which run code when they are
read, so they lie outside of the run folder, which may come from anybody, in a folder that only this
user can read and write. A driver that was killed leaves its session. The next one takes over the
results that lie there and cancels what still runs.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from alpasim_plugin.core import places
from alpasim_plugin.core.atomic import write_bytes
from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.core.lazy import require_library
from alpasim_plugin.core.processes import is_running, started_of
from alpasim_plugin.core.subprocesses import safe_path
from alpasim_plugin.runs.executors.assignment import Assignment, private_folder, sweep
from alpasim_plugin.runs.executors.base import Backend, Died, Done, Event, Faulty, Place, Rules
from alpasim_plugin.runs.executors.node import JobAnswer, serve_job

J = TypeVar("J")

DOING = "working in jobs of Slurm"
# instead of a partition: submitit's local executor, to try everything but Slurm itself
LOCAL = "@local"
JOB_MIN = 240  # time limit of a job, minutes
POLL_S, GRACE_S = (
    0.2,
    3.0,
)  # between looks; between the end of a job and its result on a slow file system
UNSEEN = "another"  # stands for the nodes that no job has run on yet
MOST_REFUSALS = 3  # of nodes, while none was accepted
MOST_JOBS = 256  # at a time


class SlurmBackend(Backend[J]):
    """Jobs as workers; see `alpasim_plugin.runs.executors.base.Backend`. A worker is a slot for a
    job.

    Args:
        assignment: What the jobs do.
        partition: Of Slurm; empty: its default. ``@local``: processes of this machine.
        folder: The run folder.

    Raises:
        InputError: submitit is not installed.
        InfrastructureError: There is no Slurm, or no private folder (`sessions_folder`).
    """

    rules = Rules(chunk_s=600.0)

    def __init__(self, assignment: Assignment[J], partition: str, folder: Path) -> None:
        submitit = require_library(
            "submitit",
            "--executor slurm",
            "pip install 'alpasim-onefixer[slurm]'",
        )
        self._given = assignment
        self._is_local = partition == LOCAL
        sessions = sessions_folder(folder)
        self._inherited = _take_over(sessions, assignment.notify)
        self._session = private_folder(sessions / f"{os.getpid()}.{os.urandom(4).hex()}")
        self._blob = self._placed(assignment.contents.add_bytes(pickle.dumps(assignment.work)))
        try:
            self._executor = submitit.AutoExecutor(
                folder=str(self._session), cluster="local" if self._is_local else "slurm"
            )
        except RuntimeError as error:
            raise InfrastructureError(
                f"submitit: {error}",
                f"start simrun where sbatch is, or try --executor slurm:{LOCAL}",
            ) from error
        self._executor.update_parameters(**self._parameters("" if self._is_local else partition))
        self._jobs: dict[int, Any] = {}  # slot -> job
        self._ended_s: dict[
            int, float
        ] = {}  # slot -> when its job was first seen to have ended without a result
        self._slots = range(min(assignment.workers, MOST_JOBS))
        self._accepted: set[str] = set()
        self._refused: dict[str, str] = {}

    def inherited(self, jobs: Sequence[J]) -> Iterator[tuple[int, Any]]:
        """Yield index and result of jobs that an earlier driver's jobs have done."""
        for index, job in enumerate(jobs):
            key = self._given.work.key(job)
            if key in self._inherited:
                yield index, self._inherited.pop(key)

    def free(self, wanted: int) -> list[Place]:
        """Return slots without a job. Nobody knows on which node Slurm will put the next one."""
        return [Place(slot, "") for slot in self._slots if slot not in self._jobs]

    def start(self, worker: int, jobs: Sequence[J]) -> None:
        """Submit a job."""
        for sha256 in dict.fromkeys(one for job in jobs for one in self._given.work.needs(job)):
            self._placed(sha256)
        keys = [self._given.work.key(one) for one in jobs]
        with safe_path():
            submitted = self._executor.submit(
                serve_job,
                str(self._session),
                self._blob.name,
                pickle.dumps(list(jobs)),
                keys,
                dict(self._given.expected),
                self._given.targets,
                self._given.resources.cores,
            )
        self._jobs[worker] = submitted
        with (self._session / "jobs").open("a") as file:
            file.write(
                f"{submitted.job_id} {started_of(int(submitted.job_id)) if self._is_local else ''}\n"
            )

    def wait(self, timeout_s: float) -> list[Event]:
        """Wait until jobs answer or end."""
        until_s = time.monotonic() + timeout_s
        while True:
            events = [event for slot in list(self._jobs) if (event := self._look(slot)) is not None]
            if events or time.monotonic() >= until_s:
                return events
            time.sleep(min(POLL_S, max(0.0, until_s - time.monotonic())))

    def end(self, worker: int) -> None:
        """Cancel a job."""
        job = self._jobs.pop(worker)
        self._ended_s.pop(worker, None)
        job.cancel(check=False)

    def nodes(self) -> frozenset[str]:
        """Return the nodes that are in use; on a cluster there may be another."""
        return (
            frozenset(self._accepted | (set() if self._is_local else {UNSEEN}))
            - self._refused.keys()
        )

    def set_aside(self, node: str, why: str) -> None:
        """Keep later jobs off a node; what runs there may end."""
        if node in self._refused:
            return
        self._refused[node] = why
        self._given.notify(f"node {node} is set aside: {why}")
        if not self._is_local:
            self._executor.update_parameters(slurm_exclude=",".join(sorted(self._refused)))
        if not self._accepted - self._refused.keys() and (
            self._is_local or len(self._refused) >= MOST_REFUSALS
        ):
            found = "; ".join(f"{name}: {reason}" for name, reason in self._refused.items())
            raise InfrastructureError(
                f"its nodes: no node takes the work: {found}",
                "install the same versions on the nodes",
            )

    def close(self) -> None:
        """Cancel all jobs and remove their files."""
        processes = [int(job.job_id) for job in self._jobs.values()] if self._is_local else []
        for slot in list(self._jobs):
            self.end(slot)
        if self._is_local:
            sweep(processes)
        shutil.rmtree(self._session, ignore_errors=True)  # a cancelled job may still write a line
        if self._session.parent.is_dir() and not any(self._session.parent.iterdir()):
            self._session.parent.rmdir()

    def _parameters(self, partition: str) -> dict[str, Any]:
        wanted: dict[str, Any] = {
            "timeout_min": JOB_MIN,
            "cpus_per_task": self._given.resources.cores,
            "name": "simrun",
        }
        if self._given.resources.gpus:
            wanted["gpus_per_node"] = max(
                1, round(self._given.resources.gpus)
            )  # Slurm gives whole GPUs
        if self._given.resources.memory_gib:
            wanted["mem_gb"] = self._given.resources.memory_gib
        if partition:
            wanted["slurm_partition"] = partition
        return wanted

    def _placed(self, sha256: str) -> Path:
        path = self._session / "placed" / sha256
        if not path.exists():
            write_bytes(path, self._given.contents.read(sha256))
        return path

    def _look(self, slot: int) -> Event | None:
        """Return what became of a job, if anything."""
        job = self._jobs[slot]
        if job.paths.result_pickle.exists():
            outcome, answer = pickle.loads(job.paths.result_pickle.read_bytes())
            del self._jobs[slot]
            if outcome != "success":
                return Died(slot, "", f"job {job.job_id}: {str(answer).strip().splitlines()[-1]}")
            _forget(job.paths.folder, job.job_id)
            return self._answered(slot, answer)
        if not job.done():
            return None
        if time.monotonic() - self._ended_s.setdefault(slot, time.monotonic()) < GRACE_S:
            return None
        del self._jobs[slot], self._ended_s[slot]
        return Died(
            slot,
            "",
            f"job {job.job_id} ended without a result ({job.state})",
            of_node=job.state == "NODE_FAIL",
        )

    def _answered(self, slot: int, answer: JobAnswer) -> Event:
        if answer.reasons:
            self.set_aside(answer.node, "; ".join(answer.reasons))
            return Died(slot, answer.node, "its node was set aside", of_node=True)
        self._accepted.add(answer.node)
        return Done(slot, answer.node, pickle.loads(answer.answers))


def sessions_folder(run: Path) -> Path:
    """Return the folder of a run's sessions: outside of it, private to this user, and on a file
    system that all nodes see.

    It is below `alpasim_plugin.core.places.state`.

    Raises:
        InfrastructureError: Another user could write there, or it cannot be made.
    """
    base = private_folder(places.state())
    return private_folder(base / hashlib.sha256(os.fsencode(run.resolve())).hexdigest()[:16])


def _forget(folder: Path, job_id: str) -> None:
    """Remove the files of a job whose result was taken."""
    for path in folder.glob(f"{job_id}_*"):
        path.unlink(missing_ok=True)


def _take_over(folder: Path, notify: Callable[[str], None]) -> dict[str, Any]:
    """Return the results that killed drivers' jobs have left, cancel what runs, and remove the
    sessions. The run folder's lock is held.
    """
    results: dict[str, Any] = {}
    for session in sorted(folder.iterdir()) if folder.is_dir() else []:
        jobs = session / "jobs"
        lines = [line.split() for line in jobs.read_text().splitlines()] if jobs.exists() else []
        waiting = [words for words in lines if not (session / f"{words[0]}_0_result.pkl").exists()]
        running = [words for words in waiting if _cancel(words)]
        for path in session.glob("*_result.pkl"):
            outcome, answer = pickle.loads(path.read_bytes())
            if outcome == "success" and not answer.reasons:
                done = zip(answer.keys, pickle.loads(answer.answers), strict=True)
                results |= {
                    key: got for key, got in done if not isinstance(got, Exception | Faulty)
                }
        notify(
            f"an earlier run was cut off: {len(results)} of its results are taken over, {len(running)} of its jobs are cancelled"
        )
        shutil.rmtree(session)
    return results


def _cancel(words: Sequence[str]) -> bool:
    """Cancel a job by its line; say whether there was anything to cancel."""
    number = words[0]
    if len(words) == 1:
        return subprocess.run(["scancel", number], check=False, capture_output=True).returncode == 0
    pid = int(number)
    if (
        not is_running(pid) or started_of(pid) != words[1]
    ):  # the number may be another process's by now
        return False
    os.kill(pid, signal.SIGINT)
    return True
