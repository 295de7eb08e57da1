"""Measurements of a machine: one process of a run takes them, the others wait for it."""

from __future__ import annotations

import json
import os
import time
from functools import partial
from pathlib import Path

import pytest

from alpasim_plugin.core import cache as module
from alpasim_plugin.core.cache import measured, share_measurements
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.runs.executors.local import run_jobs


@pytest.fixture(autouse=True)
def _with_nobody():
    yield
    share_measurements(None)


def take(log: Path, number: int = 0) -> dict[str, int]:
    with log.open("a") as file:
        file.write(f"{os.getpid()}\n")
    time.sleep(0.2)
    return {"pid": os.getpid()}


def work(folder: Path, log: Path, item: int) -> tuple[int, int]:
    started = log.with_name("started")
    started.mkdir(exist_ok=True)
    (started / str(os.getpid())).touch()
    until_s = time.monotonic() + 60.0
    while (
        len(list(started.iterdir())) < 2 and time.monotonic() < until_s
    ):  # so that neither does all of it alone
        time.sleep(0.01)
    share_measurements(folder)
    return os.getpid(), measured("speed", partial(take, log))["pid"]


def test_of_two_processes_at_once_one_measures_and_both_have_its_values(tmp_path: Path) -> None:
    log = tmp_path / "log"
    answers = [
        got
        for _, got in run_jobs(partial(work, tmp_path / "measured" / "run", log), [0, 1, 2, 3], 2)
    ]
    assert len({pid for pid, _ in answers}) == 2
    (measurer,) = log.read_text().split()
    assert {measurer} == {str(taken) for _, taken in answers}


def test_another_run_measures_again_and_what_was_measured_alone_is_kept_by_the_process(
    tmp_path: Path,
) -> None:
    log = tmp_path / "log"
    for folder in (None, tmp_path / "m" / "a", tmp_path / "m" / "b", None):
        share_measurements(folder)
        for _ in range(2):
            assert measured("speed again", partial(take, log)) == {"pid": os.getpid()}
    assert len(log.read_text().split()) == 3


def test_folders_of_runs_long_ago_are_removed(tmp_path: Path) -> None:
    for name, age_s in (("old", module.KEPT_S + 60), ("new", 60)):
        (tmp_path / name).mkdir()
        os.utime(tmp_path / name, (time.time() - age_s,) * 2)
    share_measurements(tmp_path / "mine")
    measured("speed", partial(take, tmp_path / "log"))
    assert sorted(path.name for path in tmp_path.iterdir() if path.is_dir()) == ["mine", "new"]


def test_a_damaged_measurement_is_named(tmp_path: Path) -> None:
    share_measurements(tmp_path)
    (tmp_path / "speed.json").write_text(json.dumps({"pid": 1})[:-1])
    with pytest.raises(InputError, match=r"speed\.json"):
        measured("speed", partial(take, tmp_path / "log"))
