"""Rollouts on a Ray cluster, one task each. Ray places the tasks, and runs one again whose worker
or node died.

A task drives in a temporary folder of its node and returns the rollout's files, which the driver
writes. Nodes need the same libraries, the same code, and the files of the parts at the same paths;
a node that differs ends the run with an error that names it.
"""

import logging
import os
import pickle
import signal
import socket
import tempfile
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from alpasim_plugin.core.cores import usable_cores
from alpasim_plugin.core.errors import InfrastructureError, InputError, SimrunError
from alpasim_plugin.core.files import content_of, read_bytes
from alpasim_plugin.core.files.atomic import disk_error
from alpasim_plugin.core.files.inputs import ABSENT
from alpasim_plugin.core.lazy import require_library
from alpasim_plugin.core.parts import PartSpec
from alpasim_plugin.core.parts.source import code_digest, file_of, package_digest
from alpasim_plugin.core.subprocesses import own_path_only
from alpasim_plugin.core.types import Scenario
from alpasim_plugin.log.run_folder.manifests import read_manifest, write_manifest
from alpasim_plugin.log.run_folder.records import Manifest
from alpasim_plugin.log.run_folder.schema import OUTPUT_NAME
from alpasim_plugin.runs.cell import run_cell
from alpasim_plugin.runs.executor_choice import Executor
from alpasim_plugin.runs.local_executor import THREAD_VARIABLES, Lost, limited
from alpasim_plugin.runs.plan import Cell, RunOptions, RunPlan
from alpasim_plugin.runs.provenance import versions

RETRIES = 2  # of a rollout whose worker or node died
GIB = 2**30
MISSING = "not there"
LISTENING_S = 10.0  # how long the head of a cluster may take to accept a connection


@dataclass(frozen=True)
class DrivenRollout:
    """A rollout that a node has driven: its manifest, and its files by name."""

    manifest: Manifest
    files: Mapping[str, bytes]


@contextmanager
def connected(address: str) -> Iterator[Any]:
    """Be connected to a Ray cluster during the block, and yield the library.

    Args:
        address: HOST:PORT of its head. Empty: the one that ``RAY_ADDRESS`` names or that runs on
            this machine; where there is none, one of this machine's cores is started.

    Raises:
        InputError: Ray is not installed.
        InfrastructureError: There is no cluster at the address, or it has another version of Ray or
            Python.
    """
    ray = require_library("ray", "--executor ray", "pip install 'alpasim-onefixer[ray]'")
    if ray.is_initialized():
        yield ray
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    quiet = {"log_to_driver": False, "logging_level": logging.ERROR}
    named = address or os.environ.get("RAY_ADDRESS", "")
    try:
        require_listening(named)
        try:
            ray.init(address=address or "auto", **quiet)
        except ConnectionError:
            if named:
                raise
            ray.init(address="local", num_cpus=usable_cores(), include_dashboard=False, **quiet)
    except (OSError, RuntimeError, ValueError) as error:
        raise InfrastructureError(
            f"--executor ray: no cluster at {named or 'this machine'}: {error}",
            "start the cluster (ray start --head), or correct the address",
        ) from error
    finally:
        for number, handler in handlers.items():  # Ray's own would end the run without a word
            signal.signal(number, handler)
    try:
        yield ray
    finally:
        ray.shutdown()


def require_listening(address: str) -> None:
    """Refuse the address of a cluster at which nobody listens: Ray itself would wait for minutes.

    Args:
        address: ``HOST:PORT``, or ``ray://HOST:PORT``; other words, which Ray knows, pass.

    Raises:
        OSError: Nobody listens.
    """
    host, colon, port = address.rpartition("://")[2].rpartition(":")
    if colon and port.isdigit():
        socket.create_connection((host.strip("[]"), int(port)), LISTENING_S).close()


def run_on_ray(
    plan: RunPlan,
    todo: Sequence[Cell],
    root: Path,
    executor: Executor,
    workers: int,
    limit_s: float | None,
) -> Iterator[tuple[Cell, Manifest | Lost]]:
    """Yield every rollout with its manifest, as they finish; only this process writes ``root``.

    Args:
        plan: The run.
        todo: Its rollouts that are to be driven.
        root: The run folder.
        executor: Which cluster, and what each rollout needs.
        workers: Most rollouts at a time.
        limit_s: Seconds that a rollout may take before its worker is ended; None: no limit.

    Raises:
        InfrastructureError: There is no cluster, no node has what a rollout needs, or a node
            differs from this machine.
    """
    with connected(executor.address) as ray:
        _require_node(ray, executor)
        drive = ray.remote(drive_on_node).options(
            num_cpus=executor.cores,
            num_gpus=executor.gpus,
            memory=int(executor.memory_gib * GIB) or None,
            max_retries=RETRIES,
            runtime_env={"env_vars": dict.fromkeys(THREAD_VARIABLES, str(executor.cores))},
        )
        expected = ray.put(identity_of(*names_of(plan.parts)))
        scenarios = {name: ray.put(plan.scenarios[name]) for name in {cell.scene for cell in todo}}
        waiting = deque(todo)
        running: dict[Any, Cell] = {}
        try:
            while waiting or running:
                while len(running) < workers and (cell := _startable(waiting, running.values())):
                    waiting.remove(cell)
                    scenario = scenarios[cell.scene]
                    # As bytes: a node without the code of a part cannot read the cell.
                    job = pickle.dumps((cell, plan.options, executor.cores, limit_s))
                    task = drive.remote(job, scenario, names_of(plan.parts), expected)
                    running[task] = cell
                for task in ray.wait(list(running), num_returns=1)[0]:
                    yield running.pop(task), _result(ray, task, root)
        finally:
            for task in running:
                ray.cancel(task, force=True)


def _startable(waiting: Iterable[Cell], running: Iterable[Cell]) -> Cell | None:
    """Return the first rollout of a channel that no other one uses; None where there is none."""
    used = {cell.policy.channel for cell in running} - {""}
    return next((cell for cell in waiting if cell.policy.channel not in used), None)


def _require_node(ray: Any, executor: Executor) -> None:
    """Refuse a cluster in which no node has what a rollout needs.

    Raises:
        InfrastructureError: Naming the needs.
    """
    needs = {"CPU": executor.cores, "GPU": executor.gpus, "memory": executor.memory_gib * GIB}
    nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
    if not any(all(node.get(name, 0) >= need for name, need in needs.items()) for node in nodes):
        raise InfrastructureError(
            f"--executor {executor}: no node has {executor.cores} cores, {executor.gpus:g} "
            f"GPUs and {executor.memory_gib:g} GiB",
            "ask for less behind --executor, or add nodes",
        )


def _result(ray: Any, task: Any, root: Path) -> Manifest | Lost:
    """Write a finished rollout into the run folder and return its manifest.

    Raises:
        SimrunError: The node could not drive.
    """
    try:
        result = ray.get(task)
    except ray.exceptions.RayTaskError:
        raise
    except ray.exceptions.RayError as error:
        return Lost(
            f"{RETRIES + 1} workers died of it, or hung: {str(error).splitlines()[0]}",
            "run it alone with --executor local --workers 1, or raise --time-limit",
        )
    if isinstance(result, SimrunError):
        raise result
    return write_rollout(result, root)


def drive_on_node(
    job: bytes,
    scenario: Scenario,
    names: tuple[Sequence[str], Sequence[str]],
    expected: Mapping[str, str],
) -> DrivenRollout | SimrunError:
    """Drive a rollout on this node; an error of the node is returned, since Ray would wrap it.

    Args:
        job: The pickled cell, with the options of the run, the threads and the limit of time.
        scenario: What is driven.
        names: Of the run's parts, as `names_of` gives them.
        expected: The `identity_of` the machine that gave the command.
    """
    own_path_only()  # Ray adds the driver's working directory
    name = socket.gethostname()
    differences = differences_of(expected, identity_of(*names))
    if differences:
        return InfrastructureError(
            f"node {name} differs from this machine: {'; '.join(differences)}",
            "install the same versions and files on all nodes",
        )
    cell: Cell
    options: RunOptions
    try:
        cell, options, threads, limit_s = pickle.loads(job)
    except Exception as error:  # whatever a module of the user's raises when it is imported here
        return InfrastructureError(
            f"node {name} cannot read the rollout: {type(error).__name__}: {error}",
            "install the same packages on all nodes",
        )
    try:
        with tempfile.TemporaryDirectory(prefix="simrun-rollout-") as scratch:
            root = Path(scratch)

            def drive(cell: Cell) -> DrivenRollout:
                run_cell(cell, options, root, threads, load=lambda ref: scenario)
                return read_rollout(root / cell.folder, name)

            return limited(drive, cell, limit_s)
    except OSError as error:
        return disk_error(Path(tempfile.gettempdir()), error)


def names_of(parts: Sequence[PartSpec]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the targets of the parts that are not simrun's, and the files of all parts."""
    users = [part.target for part in parts if part.is_users]
    return tuple(users), tuple(path for part in parts for path in part.files)


def identity_of(targets: Sequence[str], files: Sequence[str]) -> dict[str, str]:
    """Return what must be the same on all machines of a run: name -> version or digest.

    Args:
        targets: Of parts that are not simrun's.
        files: Of all parts.
    """
    code = {f"code of {target}": _code_of(target) for target in targets}
    contents = {path: _content_of(path) for path in files}
    return versions() | {"code of simrun": package_digest()[:12]} | code | contents


def _code_of(target: str) -> str:
    try:
        file = file_of(target)
        return "compiled" if file is None else code_digest(file)[:12]
    except (ImportError, InputError):
        return MISSING


def _content_of(path: str) -> str:
    """Return the digest of a file as it is now: a process may outlive a training."""
    try:
        content = content_of(path)
    except InputError:
        return MISSING
    return MISSING if content == ABSENT else content[:12]


def differences_of(expected: Mapping[str, str], present: Mapping[str, str]) -> list[str]:
    """Say what a node has that the driver has not, one text each.

    Example:
        >>> differences_of({"numpy": "2.1.0"}, {"numpy": "2.2.0"})
        ['numpy is 2.2.0, the driver has 2.1.0']
    """
    return [
        f"{name} is {present.get(name, MISSING)}, the driver has {value}"
        for name, value in expected.items()
        if present.get(name, MISSING) != value
    ]


def read_rollout(folder: Path, node: str) -> DrivenRollout:
    """Read the folder of a rollout that was just driven; of a failed one what its parts printed."""
    manifest = read_manifest(folder)
    names = [*manifest.files] or [OUTPUT_NAME]
    files = {name: read_bytes(folder / name) for name in names if os.path.exists(folder / name)}
    return DrivenRollout(replace(manifest, node=node), files)


def write_rollout(rollout: DrivenRollout, root: Path) -> Manifest:
    """Write a rollout below a run folder, its manifest last, and return the manifest.

    Raises:
        InfrastructureError: The disk refuses.
    """
    folder = root / rollout.manifest.path
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path in folder.iterdir():
            path.unlink()
        for name, data in rollout.files.items():
            (folder / name).write_bytes(data)
    except OSError as error:
        raise disk_error(folder, error) from error
    manifest = replace(rollout.manifest, files={})
    write_manifest(folder, manifest)
    return manifest
