"""The state of the user's own project when a run began: the commit that a result belongs to.

The ``git`` command reads the repository, so worktrees, packed references and submodules are handled. It runs with options that disable
programs named by the repository (``core.fsmonitor``) and writes nothing.
"""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path
from typing import TypedDict

VARIABLE = "SIMRUN_COMMIT"
PATIENCE_S = 5.0
GIT = ("git", "--no-optional-locks", "-c", "core.fsmonitor=false")
_COMMIT = re.compile(r"[0-9a-f]{7,64}")


class Project(TypedDict):
    """What ``run.json`` says of the project.

    Attributes:
        commit: Full hash of the commit; None where there is none.
        committed_at: When it was made, ISO 8601.
        branch: None where no branch is checked out.
        dirty: Whether a file that git follows differs from the commit; files that it does not follow do not count.
        reason: Why there is no commit, else empty.
    """

    commit: str | None
    committed_at: str | None
    branch: str | None
    dirty: bool | None
    reason: str


def project(folder: Path | None = None) -> Project:
    """Return the commit of the repository that holds a folder, or what ``SIMRUN_COMMIT`` says where the repository is elsewhere.

    Args:
        folder: The working directory by default.

    Returns:
        Without a repository, or without git, ``commit`` is None and ``reason`` says why: a run needs neither.
    """
    stated = os.environ.get(VARIABLE, "").strip().lower()
    if stated:
        return _stated(stated) if _COMMIT.fullmatch(stated) else _without(f"{VARIABLE} is no commit: {stated[:40]!r}")
    try:
        last = _git(folder, "log", "-1", "--format=%H %cI")
        state = _git(folder, "status", "--porcelain=v2", "--branch", "--untracked-files=no")
    except FileNotFoundError:
        return _without("git is not installed")
    except subprocess.TimeoutExpired:
        return _without(f"git did not answer in {PATIENCE_S:g} s")
    except subprocess.CalledProcessError as error:
        said = str(error.stderr or "").strip().splitlines()
        return _without(said[0] if said else f"git ended with {error.returncode}")
    commit, _, committed_at = last.strip().partition(" ")
    lines = state.splitlines()
    branch = next((line.removeprefix("# branch.head ") for line in lines if line.startswith("# branch.head ")), "(detached)")
    dirty = any(not line.startswith("#") for line in lines)
    return {
        "commit": commit, "committed_at": committed_at, "branch": None if branch == "(detached)" else branch, "dirty": dirty, "reason": "",
    }  # fmt: skip


def _stated(commit: str) -> Project:
    return {"commit": commit, "committed_at": None, "branch": None, "dirty": None, "reason": ""}


def _without(reason: str) -> Project:
    return {"commit": None, "committed_at": None, "branch": None, "dirty": None, "reason": reason}


def _git(folder: Path | None, *words: str) -> str:
    """Return what git prints; its errors are raised."""
    return subprocess.run([*GIT, *words], cwd=folder, capture_output=True, text=True, check=True, timeout=PATIENCE_S).stdout
