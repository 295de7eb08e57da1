"""Which folders are chosen for what nobody named, by home, variables, owners and rights."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from alpasim_plugin.core import places
from alpasim_plugin.core.errors import InfrastructureError
from tests.other_user import NOBODY, as_root, run_as_nobody, shared_folder

REPO = Path(__file__).resolve().parents[2]
VARIABLES = (
    "SIMRUN_CACHE",
    "XDG_CACHE_HOME",
    "NUMBA_CACHE_DIR",
    "SIMRUN_SCRATCH",
    "NUMBA_DISABLE_JIT",
    "MPLCONFIGDIR",
)
SAYS = """
import os, sys
sys.path.insert(0, {repo!r})
before = set(os.environ)
import alpasim_plugin
from alpasim_plugin.core import places
kept = places.cache().path
print(kept, places.cache().chosen, places.kernels().path, places.kernels().chosen, *sorted(set(os.environ) - before), sep="|")
print(kept is not None and kept.is_dir() and kept.stat().st_uid == os.getuid() and oct(kept.stat().st_mode & 0o777))
"""


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    return tmp_path


def said_by_nobody(home: Path, **variables: str) -> tuple[list[str], str]:
    """Return what another user's process chooses who cannot write the source, and what is known of
    its cache.
    """
    done = run_as_nobody(
        [sys.executable, "-c", SAYS.format(repo=str(REPO))], HOME=str(home), **variables
    )
    assert done.returncode == 0, done.stderr
    first, second = done.stdout.splitlines()
    return first.split("|"), second


def test_a_named_cache_goes_before_the_standard_folders_and_those_before_the_home(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert places.cache() == places.Place(home / ".cache" / "simrun", "below the home folder")
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")  # to be ignored, says the standard
    assert places.cache().path == home / ".cache" / "simrun"
    monkeypatch.setenv("XDG_CACHE_HOME", str(home / "xdg"))
    assert places.cache() == places.Place(home / "xdg" / "simrun", "XDG_CACHE_HOME")
    monkeypatch.setenv("SIMRUN_CACHE", str(home / "named"))
    assert places.cache() == places.Place(home / "named", "SIMRUN_CACHE")


def test_a_cache_that_others_may_write_is_not_chosen(home: Path) -> None:
    (home / ".cache" / "simrun").mkdir(parents=True)
    (home / ".cache" / "simrun").chmod(0o777)
    assert places.cache().path is None


@as_root
def test_the_home_of_another_user_is_not_chosen(home: Path) -> None:
    os.chown(home, NOBODY, NOBODY)
    assert places.cache().path is None, "a kernel there could be anybody's code"


@as_root
def test_without_a_writable_home_a_private_folder_is_made_and_goes_with_the_process() -> None:
    with shared_folder() as temporary:
        left = temporary / f"{places.TEMPORARY}4194305-x"  # of a process that is gone
        left.mkdir()
        os.chown(left, NOBODY, NOBODY)
        left.chmod(0o700)
        found, mode = said_by_nobody(Path("/nonexistent"), TMPDIR=str(temporary))
        kept, why, kernels, _, *set_there = found
        assert Path(kept).parent == temporary
        assert mode == "0o700"
        assert "private temporary folder" in why
        assert kernels == f"{kept}/numba"
        assert set_there == ["MPLCONFIGDIR", "NUMBA_CACHE_DIR", "SIMRUN_CACHE"]
        assert list(temporary.iterdir()) == []


@as_root
def test_kernels_of_a_source_that_cannot_be_written_lie_in_the_cache() -> None:
    with shared_folder() as own:
        os.chown(own, NOBODY, NOBODY)
        own.chmod(0o700)
        kept = f"{own}/.cache/simrun"
        found, _ = said_by_nobody(own)
        assert found[:4] == [kept, "below the home folder", f"{kept}/numba", "below the cache"]
        found, _ = said_by_nobody(own, NUMBA_CACHE_DIR="/proc/none", TMPDIR=str(own))
        assert found[2] == f"{kept}/numba", "a named folder that cannot be written"


def test_where_nothing_can_be_written_nothing_is_compiled_and_it_is_said(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    monkeypatch.setattr(places, "_make_temporary", lambda: None)
    monkeypatch.setattr(places, "_notes", {})
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "")
    places.prepare()
    assert places.cache().path is None
    assert os.environ["NUMBA_DISABLE_JIT"] == "1"
    with pytest.raises(InfrastructureError, match="no folder can be written"):
        places.require_kernels()
