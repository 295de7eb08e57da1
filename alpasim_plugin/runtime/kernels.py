"""Compile the CPU kernels that a run needs before its workers need them: each once, side by side.

Numba compiles a kernel when it is first called and keeps it beside the module, so only the first run on a machine waits. Workers that
start together would all compile the same kernels.
"""

from __future__ import annotations

import hashlib
import importlib
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib.metadata import version
from pathlib import Path

import alpasim_plugin
from alpasim_plugin.core.types import Scenario
from alpasim_plugin.renderers.cache import cache_root, cached
from alpasim_plugin.renderers.reconstruction_key import is_reconstructed
from alpasim_plugin.runtime.plan import Cell
from alpasim_plugin.runtime.provenance import hardware
from alpasim_plugin.runtime.workers import Lost, in_workers

KIND = "kernels"
SUBJECTS = {  # subject -> tiny case, imported in the process that compiles
    "rasteriser": "alpasim_plugin.renderers.kernels:rasterise",
    "gradient": "alpasim_plugin.renderers.kernels:fit",
    "map": "alpasim_plugin.fixers.gather:draw_and_gather",
}
SOURCES = ("gaussians", "semantic_map", "fixers")  # where kernels are
GAUSSIANS = ("clean", "3dgs")  # base renderers that draw Gaussians themselves


def compile_for(todo: Sequence[Cell], scenarios: Mapping[str, Scenario], workers: int) -> None:
    """Compile what rollouts need that several workers are about to drive; nothing where that was done before.

    Args:
        todo: The rollouts.
        scenarios: Their scenarios by scene.
        workers: Processes. One compiles nothing here: it compiles while it drives.
    """
    cold = [subject for subject in needed(todo, scenarios) if not (cache_root() / KIND / _key(subject)).exists()]
    if workers < 2 or not cold:
        return
    for subject, got in in_workers(compile_kernels, cold, min(workers, len(cold)), 1):
        if isinstance(got, Lost):
            print(f"warning: compiling {subject} kernels: {got.found}; the rollouts compile them", file=sys.stderr, flush=True)


def needed(todo: Iterable[Cell], scenarios: Mapping[str, Scenario]) -> list[str]:
    """Return the subjects of `SUBJECTS` whose kernels some rollouts call."""
    found = set()
    for cell in todo:
        if cell.renderer.base.name in GAUSSIANS:
            found.add("rasteriser")
        if cell.renderer.base.name == "3dgs" and is_reconstructed(scenarios[cell.scene]):
            found.add("gradient")
        if cell.renderer.fixer is not None:
            found.add("map")
    return [subject for subject in SUBJECTS if subject in found]


def compile_kernels(subject: str) -> None:
    """Compile the kernels of a subject on a tiny case, unless that was done; wait where another process is about to."""

    module, _, case = SUBJECTS[subject].partition(":")

    def make(folder: Path) -> None:
        getattr(importlib.import_module(module), case)()

    cached(KIND, _key(subject), make, lambda folder: folder, f"compiling {subject} kernels, once on this machine")


@cache
def _key(subject: str) -> str:
    """Name what is compiled as numba does: by the sources' times and sizes, its version, its folder, the processor."""
    package = Path(alpasim_plugin.__file__).parent
    sources = sorted(path for folder in SOURCES for path in (package / folder).rglob("*.py"))
    stamps = [(str(path), (stat := path.stat()).st_mtime_ns, stat.st_size) for path in sources]
    facts = repr((stamps, version("numba"), os.environ.get("NUMBA_CACHE_DIR"), hardware()["cpu"]))
    return f"{subject}-{hashlib.blake2b(facts.encode(), digest_size=8).hexdigest()}"
