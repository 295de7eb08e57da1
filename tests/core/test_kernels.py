"""Machine code of kernels is that of the sources as they are now, and an edit elsewhere compiles
nothing.
"""

import ast
import fcntl
import os
import subprocess
import sys
from pathlib import Path

import pytest
from numba.core import event

from alpasim_plugin.core import kernel_sources
from alpasim_plugin.core.kernel_sources import ROOT, SAID, sources_digest, sources_of
from alpasim_plugin.core.kernels import LOCK, OneCompiler

KERNEL = """
import constants
from alpasim_plugin.core.kernels import kernel
from shapes import SIDE as EDGE, area
from words import TITLE

HALF = EDGE // 2

@kernel
def size(x):
    return x * HALF + constants.TILE + helped(x)

@kernel
def helped(x):
    return x * other.COUNT

import other

def heading():
    return TITLE
"""
FILES = {
    "kern.py": KERNEL,
    "constants.py": "TILE = 16\n",
    "shapes.py": "from inner import BASE\nfrom unused import NOTHING\nSIDE = BASE\ndef area():\n    return NOTHING\n",
    "inner.py": "BASE = 4\n",
    "other.py": "COUNT = 1\n",
    "words.py": "TITLE = 'size'\n",
    "unused.py": "NOTHING = 0\n",
}


@pytest.fixture
def folder(tmp_path):
    for name, text in FILES.items():
        (tmp_path / name).write_text(text)
    return tmp_path


def test_a_kernel_is_made_of_the_constants_and_kernels_that_it_uses(folder):
    used = {os.path.basename(path) for path in sources_of(str(folder / "kern.py"), folder)}
    assert used == {"kern.py", "constants.py", "shapes.py", "inner.py", "other.py"}


def test_what_sources_say_is_read_from_where_it_is_kept_and_is_the_same(folder, monkeypatch):
    files = [str(folder / name) for name in FILES]
    parsed = [sources_digest(file) for file in files]
    assert [sources_digest(file, folder / "kept") for file in files] == parsed
    assert len(list((folder / "kept" / SAID).iterdir())) == len(FILES)
    forget_sources()
    with monkeypatch.context() as patch:
        patch.delattr(ast, "parse")  # so that whatever parses fails
        assert [sources_digest(file, folder / "kept") for file in files] == parsed


@pytest.mark.parametrize("damage", ["", "{", "{}", "[1]", '{"bound": {}}'])
def test_what_is_kept_and_damaged_is_parsed_and_kept_again(folder, damage):
    file = str(folder / "kern.py")
    parsed = sources_digest(file, folder / "kept")
    whole = {path: path.read_text() for path in (folder / "kept" / SAID).iterdir()}
    for path in whole:
        path.write_text(damage)
    forget_sources()
    assert sources_digest(file, folder / "kept") == parsed
    assert {path: path.read_text() for path in whole} == whole


def test_a_name_that_moves_to_a_new_file_is_found_there_although_all_is_kept(folder):
    (folder / "inner.py").write_text("from depth import BASE\n")
    (folder / "depth").mkdir()
    (folder / "depth/__init__.py").write_text("BASE = 4\n")
    before = sources_digest(str(folder / "kern.py"), folder / "kept")
    (folder / "depth/BASE.py").write_text("COUNT = 5\n")
    forget_sources()
    assert sources_digest(str(folder / "kern.py"), folder / "kept") != before


def forget_sources():
    """Do what another process begins with."""
    kernel_sources.sources_of.cache_clear()
    kernel_sources._module.cache_clear()


@pytest.mark.parametrize("kept", [None, "kept"])
@pytest.mark.parametrize("name", FILES)
def test_an_edit_of_what_a_kernel_uses_makes_another_folder_and_no_other_edit_does(
    folder, name, kept
):
    file = str(folder / "kern.py")
    where = kept and folder / kept
    before = sources_digest(file, where)
    forget_sources()
    (folder / name).write_text(f"{FILES[name]}# edited\n")
    is_used = name not in ("words.py", "unused.py")
    assert (sources_digest(file, where) != before) == is_used


def test_kernels_of_simrun_know_the_size_of_a_tile_and_not_the_command_line():
    used = sources_of(str(ROOT / "alpasim_plugin/gaussians/raster/binning.py"))
    names = {os.path.relpath(path, ROOT / "alpasim_plugin") for path in used}
    assert "gaussians/constants.py" in names
    assert not any(name.startswith(("cli", "runs", "core/errors")) for name in names)


def test_every_kernel_is_made_in_one_place():
    """A kernel that calls ``njit`` by itself would be kept under the name of its own file alone."""
    makers = {"alpasim_plugin/core/kernels.py"}
    calling = {
        str(path.relative_to(ROOT))
        for package in ("alpasim_plugin", "policies", "scenarios", "evaluators")
        for path in (ROOT / package).rglob("*.py")
        if "njit" in path.read_text() or "cache=True" in path.read_text()
    }
    assert calling == makers


def test_a_constant_that_was_changed_in_another_file_is_the_one_that_is_computed_with(folder):
    script = "import sys; sys.path.insert(0, sys.argv[1]); import kern; print(kern.size(0))"
    kept = folder / "kept"

    def computed():
        done = subprocess.run(
            [sys.executable, "-c", script, str(folder)],
            env=os.environ | {"NUMBA_CACHE_DIR": str(kept), "PYTHONPATH": str(ROOT)},
            capture_output=True,
            text=True,
            check=True,
        )
        return int(done.stdout), {path: path.stat().st_mtime_ns for path in kept.rglob("*.nbc")}

    first, code = computed()
    assert first == 16
    (folder / "words.py").write_text("TITLE = 'other'\n")
    assert computed() == (16, code)
    (folder / "constants.py").write_text("TILE = 8\n")
    assert computed()[0] == 8
    assert len(list(Path(kept).glob("kern-*"))) == 2


def test_a_process_that_compiles_holds_the_lock_until_the_code_is_kept(tmp_path):
    compiler = OneCompiler(tmp_path / "kept")

    def is_held():
        with (tmp_path / "kept" / LOCK).open("rb") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
            return False

    held = []
    for notify in (compiler.on_start, compiler.on_start, compiler.on_end, compiler.on_end):
        notify(event.Event("numba:compiler_lock", event.EventStatus.START))
        held.append(is_held())
    assert held == [True, True, True, False]
