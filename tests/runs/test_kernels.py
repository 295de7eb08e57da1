"""Kernels are compiled before the workers of a run need them, each once."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from alpasim_plugin.core.places import cache
from alpasim_plugin.runs.execute import KERNELS, compile_for, compile_kernels, needed
from alpasim_plugin.runs.kernels import SUBJECTS
from alpasim_plugin.runs.plan import RunOptions, RunPlan, make_plan
from scenarios.suite import ScenarioRef


def plan_of(*renderers: str, scene: str = "smoke/straight") -> RunPlan:
    return make_plan([ScenarioRef(scene)], renderers, ["log-replay"], [0], RunOptions())


@pytest.mark.parametrize(
    ("renderers", "subjects"),
    [
        (("clean",), ["rasteriser"]),
        (("3dgs",), ["rasteriser", "gradient"]),
        (("onefixer+clean",), ["map", "rasteriser", "network"]),
        (("clean", "onefixer"), ["map", "rasteriser", "network", "gradient"]),
        (("nre://localhost:1",), []),
    ],
)
def test_a_run_compiles_what_its_renderers_call(
    renderers: tuple[str, ...], subjects: list[str]
) -> None:
    plan = plan_of(*renderers)
    assert needed(plan.cells, plan.scenarios) == subjects


def test_one_worker_compiles_while_it_drives_and_two_beforehand(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SIMRUN_CACHE", str(tmp_path))
    plan = plan_of("clean")
    compile_for(plan.cells, plan.scenarios, 1)
    assert not (cache() / KERNELS).exists()
    compile_kernels("rasteriser")
    assert [path.name.split("-")[0] for path in (cache() / KERNELS).iterdir() if path.is_dir()] == [
        "rasteriser"
    ]
    before = sys.modules.copy()
    compile_for(plan.cells, plan.scenarios, 2)  # nothing is left to do: no process is started
    assert sys.modules.keys() == before.keys()


# Run in a process of its own with an empty cache: counts what numba compiles for the subjects, and
# during a drive afterwards.
COMPILED_LATER = """
import sys
from numba.core import event
from alpasim_plugin.runs.kernels import SUBJECTS
from alpasim_plugin.runs.execute import compile_kernels

class Compiled(event.Listener):
    names = []
    def on_start(self, happened): self.names.append(str(happened.data["dispatcher"]))
    def on_end(self, happened): pass

event.register("numba:compile", Compiled())
for subject in SUBJECTS:
    compile_kernels(subject)
print("text:", [name for name in Compiled.names if "raise_with_shape" in name or "unicode" in name])
Compiled.names.clear()
from alpasim_plugin.cli.main import main
words = "--renderer clean,3dgs,onefixer --workers 1 --set timing.duration_us=1500000 --out"
sys.argv = ["simrun", *words.split(), sys.argv[1], "smoke/straight"]
try:
    main()
except SystemExit as end:
    assert end.code == 0, end.code
print("compiled later:", Compiled.names)
"""


@pytest.mark.slow
def test_a_drive_compiles_nothing_that_its_subjects_did_not(tmp_path: Path) -> None:
    caches = {"NUMBA_CACHE_DIR": str(tmp_path / "numba"), "SIMRUN_CACHE": str(tmp_path / "simrun")}
    command = [sys.executable, "-c", COMPILED_LATER, str(tmp_path / "run")]
    done = subprocess.run(
        command, check=True, capture_output=True, text=True, env=os.environ | caches
    )
    # An array that is assigned to a part of another costs two seconds: numba's error for wrong
    # shapes is text.
    assert "text: []" in done.stdout.splitlines()
    assert done.stdout.splitlines()[-1] == "compiled later: []"
    assert done.stderr.count("once on this machine:") == len(SUBJECTS)
