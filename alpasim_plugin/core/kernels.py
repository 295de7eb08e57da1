"""Compiled kernels: those that lie in the package, the user's own cache, and numba's compiler, in
this order.

MADE / compiled / PYTHON-NUMBA-LLVMLITE-TRIPLE-LEVEL /            what one version of the compiler made for one level of processors
                                           SUBJECT-DIGEST         empty: the folder has all that the subject's case calls
                                           KERNEL-DIGEST          one kernel for arguments of one kind: a pickle, as in numba's own cache

A kernel is named by its arguments and by the code of its module with everything that it imports:
where a constant was edited it is compiled anew, in the user's cache too, which numba names by the
kernel's own file alone.

``python -m alpasim_plugin.core.kernels`` fills the folder for the levels that this machine runs;
the next wheel holds it.
"""

# Numba's interface is untyped.
# mypy: disable-error-code="no-untyped-def,no-any-unimported"

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from alpasim_plugin.core.parts.source import own_code_digest
from alpasim_plugin.core.places import MADE

COMPILED = MADE / "compiled"
# subject -> tiny case, imported in the process that compiles; two at a time, in this order, leave
# no core idle for long
SUBJECTS = {
    "map": "alpasim_plugin.fixers.pixel_network:draw_and_warp",
    "rasteriser": "alpasim_plugin.gaussians.sample_scene:rasterise",
    "network": "alpasim_plugin.fixers.pixel_network:gather_and_mix",
    # last: it calls much of what the rasteriser has compiled by then
    "gradient": "alpasim_plugin.gaussians.sample_scene:fit",
}
# Level, best first -> what a processor must have, and how the code differs from what the level's
# name alone gives.
V3 = frozenset({"avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe"})
LEVELS = {
    "x86-64-v4": (
        V3 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"},
        "-prefer-256-bit",
    ),
    "x86-64-v3": (V3, ""),
    "generic": (frozenset({"neon"}), ""),  # 64-bit Arm
}
DECIDES = (
    "CPU_NAME",
    "CPU_FEATURES",
    "ENABLE_AVX",
    "OPT",
    "BOUNDSCHECK",
    "DEBUGINFO",
)  # numba's settings that change the code

_chosen: Path | None = None  # by `use`
_filled: Path | None = None  # by `fill`


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Compile a function at its first call, unless it was compiled before: ``numba.njit`` with the
    cache of this module.
    """
    import numba

    def decorate(function: Callable[..., Any]) -> Any:
        kernel = numba.njit(**options)(function)
        if options.get("cache") and hasattr(kernel, "_cache"):  # not where kernels are interpreted
            kernel._cache = _Compiled(kernel._cache, function)
        return kernel

    return decorate


class _Compiled:
    """What numba asks for a kernel: its own cache, preceded by what lies in the package."""

    def __init__(self, cached: Any, function: Callable[..., Any]) -> None:
        self._cached, self._name_of_kernel = cached, function.__qualname__
        self._code = _code(
            function.__module__
        )  # now: the file may be edited before the first call compiles what was imported
        cached._cache_file._source_stamp = self._code

    def load_overload(self, sig, target_context):
        """Return a kernel that was compiled for arguments of these types; None where there is
        none.
        """
        if _filled is not None:
            return None
        from numba.core.compiler import CompileResult
        from numba.core.runtime import rtsys

        rtsys.initialize(
            target_context
        )  # what kernels call; numba would also load all that compiling takes, scipy.linalg too: 0.2 s
        folder = shipped()
        path = None if folder is None else folder / self._name(sig)
        if path is not None and path.exists():
            return CompileResult._rebuild(target_context, *pickle.loads(path.read_bytes()))
        with self._cached._guard_against_spurious_io_errors():
            return self._cached._load_overload(sig, target_context)

    def save_overload(self, sig, data):
        """Keep what was just compiled: in the user's cache, or in the folder that is being
        filled.
        """
        if _filled is None:
            self._cached.save_overload(sig, data)
            return
        from numba.core.serialize import dumps

        (_filled / self._name(sig)).write_bytes(dumps(data._reduce()))

    def _name(self, sig) -> str:
        return f"{self._name_of_kernel}-{hashlib.blake2b(f'{self._code} {sig}'.encode(), digest_size=8).hexdigest()}"

    def __getattr__(self, name: str) -> Any:
        return getattr(self._cached, name)


@cache
def _code(module: str) -> str:
    return own_code_digest(module)


def shipped() -> Path | None:
    """Return the folder of the best level that this processor runs, and that the compiler in use
    made; None: there is none.
    """
    return _chosen if _chosen is not None else _found()


@cache
def _found() -> Path | None:
    if not COMPILED.is_dir() or any(f"NUMBA_{name}" in os.environ for name in DECIDES):
        return None
    return next(
        (folder for level in levels_here() if (folder := COMPILED / target(level)).is_dir()), None
    )


def use(folder: Path) -> None:
    """Take kernels from this folder from now on."""
    global _chosen
    _chosen = folder


def levels_here() -> list[str]:
    """Return the levels of `LEVELS` that this processor runs, best first."""
    from llvmlite import binding

    has = {name for name, there in binding.get_host_cpu_features().items() if there}
    return [level for level, (needs, _) in LEVELS.items() if needs <= has]


def target(level: str) -> str:
    """Name what decides, besides a kernel's code and arguments, which machine code is made."""
    from llvmlite import binding

    return f"{sys.implementation.cache_tag}-{version('numba')}-{version('llvmlite')}-{binding.get_process_triple()}-{level}"


def covers(subject: str) -> bool:
    """Tell whether the package holds all compiled kernels of a subject."""
    folder = shipped()
    return folder is not None and (folder / subject_name(subject)).exists()


def subject_name(subject: str) -> str:
    """Name a subject and the code that its case reaches."""
    return f"{subject}-{_code(SUBJECTS[subject].partition(':')[0])[:16]}"


def call(subject: str) -> None:
    """Run the tiny case of a subject: what it calls is compiled, or loaded."""
    module, _, case = SUBJECTS[subject].partition(":")
    getattr(importlib.import_module(module), case)()


def fills() -> bool:
    """Tell whether this process compiles what a package will hold, for users of any setting."""
    return _filled is not None


def fill(folder: Path) -> None:
    """Compile the kernels of all subjects into a folder, for the processor that numba's settings
    name.
    """
    global _filled
    _filled = folder
    for subject in SUBJECTS:
        call(subject)
        (folder / subject_name(subject)).touch()


def build(root: Path = COMPILED) -> list[Path]:
    """Make the folders of the levels that this machine runs, each anew, and return them.

    Raises:
        subprocess.CalledProcessError: Compiling failed; its message stands above.
    """
    made = []
    for level in levels_here():
        folder = root / target(level)
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        settings = {
            "NUMBA_CPU_NAME": level,
            "NUMBA_CPU_FEATURES": LEVELS[level][1],
            "NUMBA_DISABLE_INTEL_SVML": "1",
        }
        code = f"from pathlib import Path; from {__spec__.name} import fill; fill(Path({str(folder)!r}))"
        subprocess.run([sys.executable, "-P", "-c", code], check=True, env=os.environ | settings)
        made.append(folder)
    return made


if __name__ == "__main__":
    for built in build():
        print(f"{built}: {sum(path.stat().st_size for path in built.iterdir()) / 1e6:.1f} MB")
