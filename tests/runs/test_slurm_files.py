"""Work and results of Slurm's jobs are pickles: they are read from a folder of this user alone,
never from a run folder.
"""

from __future__ import annotations

import os
import pickle
from pathlib import Path
from types import SimpleNamespace

import pytest

from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.runs.executors import slurm_backend
from alpasim_plugin.runs.executors.assignment import Contents, assignment_as_here
from alpasim_plugin.runs.executors.base import Resources
from alpasim_plugin.runs.executors.slurm_backend import SlurmBackend, sessions_folder
from tests.runs.remote_work import Scripted


class Hostile:
    """Makes a file when it is unpickled."""

    def __init__(self, made: Path) -> None:
        self.made = made

    def __reduce__(self) -> tuple:
        return os.mkdir, (str(self.made),)


def no_cluster(**settings: object) -> None:
    raise RuntimeError("no sbatch here")


def open_in(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Open the jobs of a run as far as it goes without submitit and Slurm: what an earlier driver
    has left was taken over before.
    """
    monkeypatch.setattr(
        slurm_backend, "require_library", lambda *words: SimpleNamespace(AutoExecutor=no_cluster)
    )
    with pytest.raises(InfrastructureError, match="no sbatch here"):
        SlurmBackend(
            assignment_as_here(Scripted(run), Contents(), (), Resources(), 1, print), "", run
        )


def test_a_pickle_that_came_with_a_run_folder_does_not_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SIMRUN_SLURM", str(tmp_path / "private"))
    run, made = tmp_path / "run", tmp_path / "made"
    for session in (run / ".slurm" / "1.abc", run / "slurm" / "1.abc", run):
        session.mkdir(parents=True, exist_ok=True)
        (session / "jobs").write_text("1\n")
        (session / "1_0_result.pkl").write_bytes(pickle.dumps(("success", Hostile(made))))
    open_in(run, monkeypatch)
    assert not made.exists()


def test_a_session_of_this_user_is_taken_over_from_outside_of_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SIMRUN_SLURM", str(tmp_path / "private"))
    (run := tmp_path / "run").mkdir()
    sessions = sessions_folder(run)
    assert not sessions.is_relative_to(run)
    assert sessions.stat().st_mode & 0o777 == 0o700
    assert sessions_folder(tmp_path / "another") != sessions
    (sessions / "1.abc").mkdir()
    (sessions / "1.abc" / "1_0_result.pkl").write_bytes(pickle.dumps(("failure", "out of memory")))
    open_in(run, monkeypatch)
    assert not (sessions / "1.abc").exists()


@pytest.mark.parametrize(
    "spoil",
    [
        lambda path: path.chmod(0o770),
        lambda path: path.rename(path.with_name("x")) and path.symlink_to("x"),
    ],
)
def test_a_folder_that_another_user_could_write_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spoil
) -> None:
    monkeypatch.setenv("SIMRUN_SLURM", str(tmp_path / "private"))
    (sessions := sessions_folder(tmp_path / "run")).rmdir()
    spoil(sessions.parent)
    with pytest.raises(InfrastructureError, match="not private to this user"):
        sessions_folder(tmp_path / "run")
