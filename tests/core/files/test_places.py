"""Which folders are chosen for what nobody named, by home, variables, owners and rights."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.core.files import places
from tests.other_user import NOBODY, as_root, run_as_nobody, shared_folder

REPO = Path(__file__).resolve().parents[3]
VARIABLES = (
    "SIMRUN_CACHE",
    "XDG_CACHE_HOME",
    "NUMBA_CACHE_DIR",
    "NUMBA_DISABLE_JIT",
    "MPLCONFIGDIR",
)
SAYS = """
import os, sys
sys.path.insert(0, {repo!r})
import alpasim_plugin
from alpasim_plugin.core.files import places
kept = places.cache()
print(kept, places.kernels(), kept.is_dir() and oct(kept.stat().st_mode & 0o777), sep="|")
"""


@pytest.fixture
def home(tmp_path, monkeypatch):
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    return tmp_path


def chosen_by_nobody(home, **variables):
    """Return what another user's process chooses who cannot write the source: cache, kernels, and
    the mode of the cache.
    """
    done = run_as_nobody(
        [sys.executable, "-c", SAYS.format(repo=str(REPO))], HOME=str(home), **variables
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip().split("|")


def test_a_named_cache_goes_before_the_standard_folders_and_those_before_the_home(
    home, monkeypatch
):
    assert places.cache() == home / ".cache" / "simrun"
    monkeypatch.setenv("XDG_CACHE_HOME", str(home / "xdg"))
    assert places.cache() == home / "xdg" / "simrun"
    monkeypatch.setenv("SIMRUN_CACHE", str(home / "named"))
    assert places.cache() == home / "named"


@as_root
def test_without_a_writable_home_a_private_folder_is_made_and_goes_with_the_process():
    with shared_folder() as temporary:
        kept, kernels, mode = chosen_by_nobody(Path("/nonexistent"), TMPDIR=str(temporary))
        assert Path(kept).parent == temporary
        assert mode == "0o700"
        assert kernels == f"{kept}/numba"
        assert list(temporary.iterdir()) == []


@as_root
def test_kernels_of_a_source_that_cannot_be_written_lie_in_the_cache():
    with shared_folder() as own:
        os.chown(own, NOBODY, NOBODY)
        own.chmod(0o700)
        kept = f"{own}/.cache/simrun"
        assert chosen_by_nobody(own)[:2] == [kept, f"{kept}/numba"]
        chosen = chosen_by_nobody(own, NUMBA_CACHE_DIR="/proc/none", TMPDIR=str(own))
        assert chosen[1] == f"{kept}/numba", "a named folder that cannot be written"


def test_where_nothing_can_be_written_nothing_is_compiled_and_it_is_said(home, monkeypatch):
    def refuse(prefix):
        raise FileNotFoundError

    monkeypatch.setattr(os, "access", lambda path, mode: False)
    monkeypatch.setattr(places.tempfile, "mkdtemp", refuse)
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "")
    places.prepare()
    assert os.environ["NUMBA_DISABLE_JIT"] == "1"
    with pytest.raises(InfrastructureError):
        places.require_kernels()


USES_A_KERNEL = """
import sys
sys.path.insert(0, {repo!r})
from alpasim_plugin.core.parts.blame import blaming
from alpasim_plugin.core.errors import RendererError, SimrunError
import numba
@numba.njit(cache=True)
def twice(x):
    return 2 * x
try:
    with blaming(RendererError, "a renderer"):
        twice(1)
except SimrunError as error:
    sys.exit(error.exit_code)
"""


@pytest.mark.slow
def test_compiled_kernels_that_are_damaged_are_no_fault_of_a_part(tmp_path):
    script = tmp_path / "uses.py"
    kept = tmp_path / "kept"
    script.write_text(USES_A_KERNEL.format(repo=str(REPO)))
    kept.mkdir()

    def exit_code():
        environment = {**os.environ, "NUMBA_CACHE_DIR": str(kept)}
        return subprocess.run([sys.executable, str(script)], env=environment).returncode

    assert exit_code() == 0
    for file in kept.rglob("*.nbi"):
        file.write_bytes(b"damaged")
    assert exit_code() == InfrastructureError.exit_code
    for file in kept.rglob("*.nb?"):
        file.unlink()
    assert exit_code() == 0
