"""What a run folder says of its making: versions, machine and source."""

import os
import platform
import re
import subprocess
import sys
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from alpasim_plugin import __version__
from alpasim_plugin.core.cores import usable_cores
from alpasim_plugin.core.json_types import JsonObject
from alpasim_plugin.core.parts import PartSpec
from alpasim_plugin.log.run_folder.records import Manifest, PartFacts, Project
from evaluators.results import FixerFacts

PACKAGES = (
    "numpy",
    "scipy",
    "numba",
    "torch",
    "shapely",
    "opencv-contrib-python-headless",
    "pyarrow",
    "av",
)
VARIABLE = "SIMRUN_COMMIT"
PATIENCE_S = 5.0
# The repository may be a stranger's: nothing that its configuration names may run, and nothing may
# be fetched.
GIT = (
    "git",
    "--no-optional-locks",
    "-c",
    "core.fsmonitor=false",
    "-c",
    "core.hooksPath=/dev/null",
)
ALONE = {"GIT_ALLOW_PROTOCOL": "none", "GIT_NO_LAZY_FETCH": "1"}
_COMMIT = re.compile(r"[0-9a-f]{7,64}")


def versions() -> dict[str, str]:
    """Return the versions of Python and of the libraries that affect results, or "not
    installed".
    """
    version_by_name = {"alpasim-onefixer": __version__, "python": platform.python_version()}
    for package in PACKAGES:
        try:
            version_by_name[package] = version(package)
        except PackageNotFoundError:
            version_by_name[package] = "not installed"
    return version_by_name


def hardware() -> JsonObject:
    """Return the processor, the cores that this process may use, memory and operating system."""
    memory = (
        os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") if hasattr(os, "sysconf") else None
    )
    return {
        "cpu": _cpu_name(),
        "cores": usable_cores(),
        "memory_gib": round(memory / 2**30, 1) if memory else None,
        "system": f"{platform.system()} {platform.machine()}",
        "python_optimised": sys.flags.optimize > 0,
    }


def _cpu_name() -> str:
    info = Path("/proc/cpuinfo")
    if os.path.exists(info):
        for line in info.open(encoding="utf-8"):
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or "unknown"


def part_facts(part: PartSpec) -> PartFacts:
    """Return what ``run.json`` says of a part."""
    return PartFacts(
        name=part.name,
        target=part.target,
        label=part.label,
        digest=part.digest,
        trained=part.trained,
        files=dict(part.files),
        code=dict(part.code),
        unseen=part.unseen,
        settings=None if part.settings is None else part.settings.model_dump(),
    )


def project(folder: Path | None = None) -> Project:
    """Return the commit of the repository that holds a folder, or what ``SIMRUN_COMMIT`` says where
    the repository is elsewhere.

    Args:
        folder: The working directory by default.

    Returns:
        Without a repository, or without git, ``commit`` is None and ``reason`` says why: a run
        needs neither.
    """
    stated = os.environ.get(VARIABLE, "").strip().lower()
    if stated:
        if not _COMMIT.fullmatch(stated):
            return _without(f"{VARIABLE} is no commit: {stated[:40]!r}")
        return Project(commit=stated, dirty=None, reason="")
    try:
        commit = _git(folder, "rev-parse", "--verify", "HEAD").strip()
        state = _git(
            folder,
            *_no_filters(folder),
            "status",
            "--porcelain",
            "--untracked-files=no",
            "--ignore-submodules=dirty",
        )
    except FileNotFoundError:
        return _without("git is not installed")
    except subprocess.TimeoutExpired:
        return _without(f"git did not answer in {PATIENCE_S:g} s")
    except subprocess.CalledProcessError as error:
        error_lines = str(error.stderr or "").strip().splitlines()
        return _without(error_lines[0] if error_lines else f"git ended with {error.returncode}")
    return Project(commit=commit, dirty=bool(state.strip()), reason="")


def _without(reason: str) -> Project:
    return Project(commit=None, dirty=None, reason=reason)


def _git(folder: Path | None, *words: str) -> str:
    """Return what git prints; its errors are raised."""
    run_git = partial(
        subprocess.run, capture_output=True, text=True, check=True, timeout=PATIENCE_S
    )
    return str(run_git([*GIT, *words], cwd=folder, env=os.environ | ALONE).stdout)


def _no_filters(folder: Path | None) -> list[str]:
    """Return the words that switch off what a repository's configuration runs on files: a filter's
    file then counts as it lies there.

    Raises:
        subprocess.CalledProcessError: A filter's name cannot be said on a command line.
    """
    words = [
        "config",
        "--name-only",
        "-z",
        "--get-regexp",
        r"^filter\..*\.(clean|process|required)$",
    ]
    try:
        names = _git(folder, *words).split("\0")[:-1]
    except subprocess.CalledProcessError as error:
        if error.returncode != 1 or error.stderr:
            raise
        return []  # none is configured
    if any("=" in name for name in names):
        raise subprocess.CalledProcessError(
            1, words, stderr="a filter of its configuration has '=' in its name"
        )
    return [
        word
        for name in names
        for word in ("-c", f"{name}={'false' if name.endswith('.required') else ''}")
    ]


def fixers(manifests: Sequence[Manifest]) -> dict[str, FixerFacts]:
    """Return what the fixer of each renderer with one did.

    Args:
        manifests: Of finished rollouts of one policy.
    """
    facts: dict[str, list[JsonObject]] = {}
    for manifest in manifests:
        if manifest.fixer:
            facts.setdefault(manifest.renderer, []).append(manifest.fixer)
    return {renderer: _fixer_facts(rollouts) for renderer, rollouts in facts.items()}


def _fixer_facts(rollouts: Sequence[JsonObject]) -> FixerFacts:
    """Add up what a fixer did in the rollouts of its renderer."""
    first = rollouts[0]

    def total(name: str) -> int:
        return sum(int(rollout[name]) for rollout in rollouts)

    facts = FixerFacts(
        label=first["label"],
        trained=first["trained"],
        mode=first["mode"],
        rollouts=len(rollouts),
        frames=total("frames"),
        blocks=total("blocks") if "blocks" in first else None,
    )
    if facts.mode != "speculative":
        return facts
    predicted, hits, redrafts, blocks = map(total, ("predicted", "hits", "redrafts", "blocks"))
    return replace(
        facts,
        predicted=predicted,
        hits=hits,
        drafts=total("drafts"),
        redrafts=redrafts,
        hit_rate=round(hits / predicted, 4) if predicted else None,
        redrafts_per_block=redrafts / blocks if blocks else None,
        forecast_error=_largest(rollout["forecast_error"] for rollout in rollouts),
        shown_error=_largest(rollout["shown_error"] for rollout in rollouts),
    )


def _largest(errors: Iterable[dict[str, float | None]]) -> dict[str, float | None]:
    """Return the largest of each kind of error over rollouts; None where there is none."""
    values_by_kind: dict[str, list[float]] = {}
    for rollout_errors in errors:
        for name, value in rollout_errors.items():
            values_by_kind.setdefault(name, []).extend([] if value is None else [value])
    return {name: max(values, default=None) for name, values in values_by_kind.items()}
