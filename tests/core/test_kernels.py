"""Compiled kernels of the package: used where they are those of the code, the compiler and the
processor, and nowhere else.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from llvmlite import binding

import alpasim_plugin
from alpasim_plugin.core import kernels

PACKAGE = Path(alpasim_plugin.__file__).parent
V4 = sorted(kernels.LEVELS["x86-64-v4"][0])

# Prints where the first pixel of a tile lies, which is a constant of another module than the
# kernel's, and how many kernels were loaded.
ASK = """
import sys
from pathlib import Path
from alpasim_plugin.core import kernels
folder = Path(sys.argv[1])
if sys.argv[2:] == ["fill"]:
    kernels._filled = folder
else:
    kernels.use(folder)
from alpasim_plugin.gaussians.raster.raster_kernels import pixel_of
print(pixel_of(1, 0, 0, 0)[0], sum(pixel_of.stats.cache_hits.values()))
"""


def test_an_edited_constant_is_served_neither_from_the_package_nor_from_the_cache(
    tmp_path: Path,
) -> None:
    copy, compiled = tmp_path / "copy" / "alpasim_plugin", tmp_path / "compiled"
    compiled.mkdir()
    for room in ("core", "gaussians"):
        shutil.copytree(PACKAGE / room, copy / room, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(PACKAGE / "__init__.py", copy)
    constants = copy / "gaussians" / "constants.py"

    def ask(*words: str) -> list[int]:
        settings = {
            "PYTHONPATH": str(copy.parent),
            "NUMBA_CACHE_DIR": str(tmp_path / "numba"),
            "PYTHONDONTWRITEBYTECODE": "1",
        }
        command = [sys.executable, "-P", "-c", ASK, str(compiled), *words]
        return [
            int(word)
            for word in subprocess.run(
                command, check=True, capture_output=True, env=os.environ | settings
            ).stdout.split()
        ]

    def edit(tile_px: int) -> None:
        text = constants.read_text()
        before = text[text.index("TILE = ") :].splitlines()[0]
        constants.write_text(text.replace(before, f"TILE = {tile_px}"))

    assert ask("fill") == [16, 0]
    assert ask() == [16, 1]  # from the package
    edit(32)
    assert ask() == [32, 0]
    assert ask() == [32, 1]  # from the cache
    edit(64)
    assert ask() == [64, 0]


CALL = """
import sys
import numba
from alpasim_plugin.core import kernels
from alpasim_plugin.gaussians.raster.raster_kernels import pixel_of
print(pixel_of(2, 0, 0, 0)[0], sum(pixel_of.stats.cache_hits.values()), int("scipy.linalg" in sys.modules))
print(numba.njit(lambda tile: pixel_of(tile, 0, 0, 0))(2)[0])
"""


def test_a_kernel_from_the_cache_is_called_and_compiled_into_another_without_what_compiling_takes(
    tmp_path: Path,
) -> None:
    def call() -> list[int]:
        settings = {"NUMBA_CACHE_DIR": str(tmp_path)}
        found = subprocess.run(
            [sys.executable, "-c", CALL], check=True, capture_output=True, env=os.environ | settings
        ).stdout
        return [int(word) for word in found.split()]

    assert call() == [32, 0, 1, 32]
    assert call() == [32, 1, 0, 32]


def test_kernels_of_the_core_are_all_made_here() -> None:
    rooms = [
        room for room in PACKAGE.iterdir() if room.is_dir() and room.name != "lab"
    ]  # another distribution
    texts = {path: path.read_text() for room in rooms for path in room.rglob("*.py")}
    assert [
        str(path)
        for path, text in texts.items()
        if re.search(r"from numba import .*njit|numba\.njit\(", text)
    ] == [kernels.__file__]


@pytest.mark.parametrize(
    ("has", "levels"),
    [
        (V4, ["x86-64-v4", "x86-64-v3"]),
        ([one for one in V4 if one != "avx512vl"], ["x86-64-v3"]),
        (["sse2", "avx"], []),
        (["neon"], ["generic"]),
    ],
)
def test_a_processor_is_given_the_levels_that_it_runs(
    has: list[str], levels: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        binding, "get_host_cpu_features", lambda: {**dict.fromkeys(has, True), "avx512bf16": False}
    )
    assert kernels.levels_here() == levels


def test_the_best_level_that_is_there_is_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernels, "COMPILED", tmp_path)
    monkeypatch.setattr(kernels, "levels_here", lambda: ["x86-64-v4", "x86-64-v3"])
    find = kernels._found.__wrapped__
    assert find() is None
    plain, best = (tmp_path / kernels.target(level) for level in ("x86-64-v3", "x86-64-v4"))
    (tmp_path / plain.name.replace(kernels.version("numba"), "0.1")).mkdir()  # of another compiler
    assert find() is None
    plain.mkdir()
    assert find() == plain
    best.mkdir()
    assert find() == best
    monkeypatch.setenv("NUMBA_OPT", "1")  # asks for other code
    assert find() is None


def test_a_subject_is_covered_where_its_code_is_what_was_compiled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kernels, "_chosen", tmp_path)
    assert not kernels.covers("map")
    (tmp_path / kernels.subject_name("map")).touch()
    assert kernels.covers("map")
    assert not kernels.covers("gradient")


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return kernels.build(tmp_path_factory.mktemp("compiled"))


# What the fast rasterisers, the semantic map and the warps are held to, on the cases in which each
# may break.
HARD_CASES = (
    "gaussians/test_rasterize_hard_cases.py",
    "gaussians/test_gradient_gsplat.py",
    "semantic_map/test_draw.py",
    "fixers/test_references.py",
    "fixers/test_gather.py",
)
AT_LEVEL = "import sys, pathlib, pytest; from alpasim_plugin.core import kernels; kernels.use(pathlib.Path(sys.argv[1])); "


@pytest.mark.slow
def test_every_level_agrees_with_the_references(built: list[Path]) -> None:
    if not built:
        pytest.skip("this processor runs no level")
    cases = [str(Path(__file__).parents[1] / name) for name in HARD_CASES]
    for folder in built:
        command = [
            sys.executable,
            "-c",
            f"{AT_LEVEL}sys.exit(pytest.main(sys.argv[2:]))",
            str(folder),
            "-p",
            "no:cacheprovider",
            "-k",
            "not torch",
            *cases,
        ]
        done = subprocess.run(
            command, capture_output=True, text=True, cwd=Path(__file__).parents[2]
        )
        assert done.returncode == 0, f"{folder.name}: {done.stdout[-3000:]}"


# Run in a process of its own with an empty cache: counts what numba compiles on the way to a run's
# end.
COMPILED = """
import sys
from numba.core import event

class Compiled(event.Listener):
    names = []
    def on_start(self, happened): self.names.append(str(happened.data["dispatcher"]))
    def on_end(self, happened): pass

event.register("numba:compile", Compiled())
import alpasim_plugin
from alpasim_plugin.cli.main import main
sys.argv = ["simrun", "--renderer", "clean,3dgs,onefixer", "--policy", "lane-camera", "--workers", "1", "--no-report",
            "--set", "timing.duration_us=1000000", "--out", sys.argv[1], "suites/first"]
try:
    main()
except SystemExit as end:
    assert end.code == 0, end.code
print("compiled:", alpasim_plugin.__file__, Compiled.names)
"""


@pytest.mark.slow
def test_an_installed_wheel_compiles_nothing(built: list[Path], tmp_path: Path) -> None:
    if not built:
        pytest.skip("this processor runs no level")
    source, site = tmp_path / "source", tmp_path / "site"
    root = PACKAGE.parent
    for name in subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard"],
        cwd=root,
        check=True,
        capture_output=True,
        text=True,
    ).stdout.split():
        if not name.startswith(("tests/", "alpasim_plugin/lab/")) and (root / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(root / name, source / name)
    for folder in built:
        shutil.copytree(folder, source / "alpasim_plugin" / "made" / "compiled" / folder.name)
    pip = [sys.executable, "-m", "pip", "-q"]
    subprocess.run(
        [*pip, "wheel", "--no-deps", "--no-build-isolation", "-w", str(tmp_path), str(source)],
        check=True,
    )
    subprocess.run(
        [*pip, "install", "--no-deps", "--target", str(site), *map(str, tmp_path.glob("*.whl"))],
        check=True,
    )
    empty = {
        "PYTHONPATH": str(site),
        "NUMBA_CACHE_DIR": str(tmp_path / "numba"),
        "SIMRUN_CACHE": str(tmp_path / "simrun"),
    }
    command = [sys.executable, "-P", "-c", COMPILED, str(tmp_path / "run")]
    done = subprocess.run(
        command, check=True, capture_output=True, text=True, env=os.environ | empty, cwd=tmp_path
    )
    assert done.stdout.splitlines()[-1] == f"compiled: {site / 'alpasim_plugin' / '__init__.py'} []"
