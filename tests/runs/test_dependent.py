"""Dependent tasks: each after what it needs, in any number of processes; what fails or dies ends
the rest.
"""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.runs.executors.local import Send, run_dependent


@dataclass(frozen=True)
class Step:
    """Write a file after checking that those before it are there."""

    name: str
    folder: Path
    after: tuple[str, ...] = ()
    what: str = ""


def work(step: Step, send: Send) -> None:
    missing = [name for name in step.after if not (step.folder / name).exists()]
    send(f"missing {missing}" if missing else "ready")
    if step.what == "dies":
        os.kill(os.getpid(), signal.SIGKILL)
    if step.what == "raises":
        raise ValueError("no")
    if step.what == "waits":
        time.sleep(60)
    (step.folder / step.name).touch()


@pytest.mark.parametrize("jobs", [1, 3])
def test_every_task_finds_what_it_depends_on(tmp_path: Path, jobs: int) -> None:
    steps = [
        Step("a", tmp_path),
        Step("b", tmp_path),
        Step("c", tmp_path, ("a",)),
        Step("d", tmp_path, ("b", "c")),
    ]
    messages: dict[str, str] = {}
    run_dependent(work, steps, jobs, messages.__setitem__)
    assert messages == dict.fromkeys("abcd", "ready")


@pytest.mark.parametrize(
    ("what", "error", "found"),
    [("raises", ValueError, "no"), ("dies", InfrastructureError, "killed by SIGKILL")],
)
def test_a_task_that_fails_ends_the_others(
    tmp_path: Path, what: str, error: type[Exception], found: str
) -> None:
    steps = [
        Step("a", tmp_path, what="waits"),
        Step("b", tmp_path, what=what),
        Step("c", tmp_path, ("b",)),
    ]
    with pytest.raises(error):
        run_dependent(work, steps, 2, lambda name, said: None)
    assert not any((tmp_path / name).exists() for name in "abc")


def test_an_order_that_cannot_be_kept_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="task a comes before b"):
        run_dependent(
            work, [Step("a", tmp_path, ("b",)), Step("b", tmp_path)], 1, lambda name, said: None
        )
