"""What a frame and the main job cost here and at another commit, in pairs: ``python -m tests.speed
BASE``; and what the first run of the README's main job waits for: ``python -m tests.speed
--first-run``.

Processes of both commits take turns on one processor, by processor time, so that a busy machine
slows both, with the fixer in one precision; a ratio is the median of those of the pairs. Numbers
are printed and nothing is judged by them.
The commit is checked out beside this one for the time of the measurement. Where it needs libraries
of its own, ``--base-python`` names an interpreter that has them.

The first run is that of a clone of what is committed, with an empty home. The same command is given
again with its kernels kept, and then with its fits kept as well: what each of them takes is the
difference.
"""

import argparse
import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

REPO = Path(__file__).resolve().parents[1]
RENDERERS = ("clean", "3dgs", "onefixer")
Costs = Mapping[str, float]  # milliseconds of processor time by what was measured

# The precision of the fixer, of both commits: earlier ones choose it by the clock.
PRECISION = "fp32"
# Names that both commits have; what a frame costs is the least of equal drives, pass by pass.
LOOP = (
    f"PRECISION = {PRECISION!r}"
    + """
import json, sys, time
from unittest.mock import patch
import numba, torch
from alpasim_plugin.lab.bench import loop
numba.set_num_threads(1)
torch.set_num_threads(1)
scenario = loop.scene((512, 288), 3.0)
costs = {}
for renderer in sys.argv[1:]:
    drives = []
    for _ in range(3):
        loop.clear_cache("recording:")
        overrides = ["precision=" + PRECISION] if renderer == "onefixer" else []
        session = loop.make_renderer(renderer, scenario, threads=1, overrides=overrides)
        clock = patch.object(time, "perf_counter", time.process_time)
        with clock, loop.Recorder(scenario) as recorder:
            policy = loop.make_policy(loop.POLICY, scenario)
            loop.run_rollout(scenario, session, policy, recorder=recorder)
            drives.append(recorder.facts()["stage_ms"])
    frames = len(drives[0]["render"])
    for stage in drives[0]:
        passes = zip(*(drive[stage] for drive in drives))
        costs[f"{renderer}: {stage}"] = sum(map(min, passes)) / frames
print(json.dumps(costs))
"""
)
RASTER = """
import json, time
import numba, numpy as np
from alpasim_plugin.gaussians import GaussianCloud, PinholeCamera, rasterize
numba.set_num_threads(1)
costs = {}
for count, width, height in ((100_000, 480, 272), (500_000, 960, 544)):
    rng = np.random.default_rng(0)
    z = rng.uniform(2, 60, count)
    means = np.column_stack([rng.uniform(-1, 1, (count, 2)) * z[:, None] * [0.9, 0.5], z])
    quats = rng.standard_normal((count, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    scales = np.exp(rng.normal(-3.2, 0.6, (count, 3)))
    sh = 0.3 * rng.standard_normal((count, 4, 3))
    cloud = GaussianCloud(means, quats, scales, rng.uniform(0.1, 0.95, count), sh)
    K = np.array([[0.6 * width, 0, width / 2], [0, 0.6 * width, height / 2], [0, 0, 1.0]])
    camera = PinholeCamera(width, height, K, np.eye(4))
    rasterize(cloud, camera, backend="cpu")
    spent = []
    for _ in range(12):
        began = time.process_time()
        rasterize(cloud, camera, backend="cpu")
        spent.append(time.process_time() - began)
    costs[f"rasteriser: {count:,} splats at {width}x{height}"] = 1e3 * min(spent)
print(json.dumps(costs))
"""
# A whole warm command, in one process so that all of its processor time is counted.
JOB = (
    f"PRECISION = {PRECISION!r}"
    + """
import json, pathlib, resource, subprocess, sys, tempfile
names = ",".join(sys.argv[1:])
command = [sys.executable, "-m", "alpasim_plugin.cli.main", "--renderer", names]
command += ["--policy", "lane-camera", "--workers", "1", "smoke/curve"]
if "onefixer" in names:
    command += ["--set", "fixer.precision=" + PRECISION]
command += ["--out"]
with tempfile.TemporaryDirectory() as folder:
    done = subprocess.run([*command, folder + "/run"], capture_output=True, text=True)
    manifests = pathlib.Path(folder, "run", "rollouts").rglob("manifest.json")
    whole = [json.loads(path.read_text())["status"] for path in manifests].count("ok")
if done.returncode not in (0, 1) or whole < len(sys.argv) - 1:
    sys.exit(f"{whole} rollouts are whole: {done.stderr}")
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(json.dumps({"main job": 1e3 * (used.ru_utime + used.ru_stime)}))
"""
)


FIRST = "first"
FITTING = "kernels-kept"
WARM = "warm"
# The first line of the README's main job.
INSTALL = """
python3 -m venv .venv
.venv/bin/pip install -q torch==2.13.0
.venv/bin/pip install -q -e .
"""


@contextmanager
def checked_out(commit: str) -> Iterator[Path]:
    """Check a commit out into a temporary folder for the time of the block."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "base"
        git = ["git", "-C", str(REPO), "worktree"]
        subprocess.run([*git, "add", "-q", "--detach", str(tree), commit], check=True)
        try:
            yield tree
        finally:
            subprocess.run([*git, "remove", "--force", str(tree)], check=True)


def costs_of(tree: Path, python: str, cache: Path, renderers: Sequence[str]) -> Costs:
    """Measure a commit once, in processes of its own.

    Raises:
        subprocess.CalledProcessError: It cannot run what is measured.
    """
    threads = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    environment = os.environ | threads | {"PYTHONPATH": str(tree), "SIMRUN_CACHE": str(cache)}
    # Warm processes read bytecode, as a user's do, whatever this environment says of writing it.
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    environment["PYTHONPYCACHEPREFIX"] = str(cache / "bytecode")
    costs: dict[str, float] = {}
    for script, arguments in ((RASTER, ()), (LOOP, renderers), (JOB, renderers)):
        command = [python, "-c", script, *arguments]
        done = subprocess.run(
            command,
            check=True,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
            cwd=cache,
            preexec_fn=use_one_processor,
        )
        costs |= json.loads(done.stdout.splitlines()[-1])
    return costs


def use_one_processor() -> None:
    """Keep this process, and those that it starts, to one of the processors that it may use: what
    shares its work among all of them then takes one thread.
    """
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


class Wait(NamedTuple):
    """Seconds of a command: those that passed, and those of processors."""

    passed_s: float
    processor_s: float

    def less(self, other: "Wait") -> "Wait":
        """Return by how much this takes longer than another."""
        return Wait(self.passed_s - other.passed_s, self.processor_s - other.processor_s)


def wait_for(command: Sequence[str], folder: Path, environment: Mapping[str, str]) -> Wait:
    """Run a command in a folder and return what it took.

    A run in which a variant fails ends with 1, an undecided one with 3.
    """

    def used_s() -> float:
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        return used.ru_utime + used.ru_stime

    began = time.perf_counter()
    used_before_s = used_s()
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True)
    if done.returncode not in (0, 1, 3):
        sys.exit(done.stderr.decode())
    return Wait(time.perf_counter() - began, used_s() - used_before_s)


def first_run(suite: str, renderers: str, install: bool) -> Mapping[str, Wait]:
    """Measure what a user waits for in a clone with an empty home.

    Args:
        suite: What is driven.
        renderers: Behind what, separated by commas.
        install: Whether the README's installation is measured too; else this interpreter's
            libraries are used.
    """
    waits: dict[str, Wait] = {}
    with tempfile.TemporaryDirectory() as folder:
        clone = Path(folder) / "clone"
        home = Path(folder) / "home"
        home.mkdir()
        subprocess.run(["git", "clone", "-q", str(REPO), str(clone)], check=True)
        environment = os.environ | {"HOME": str(home), "PYTHONPATH": str(clone)}
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
        environment["SIMRUN_CACHE"] = str(home / "cache")
        environment["NUMBA_CACHE_DIR"] = str(home / "kernels")
        python = sys.executable
        if install:
            waits["install"] = wait_for(["bash", "-ec", INSTALL], clone, environment)
            python = str(clone / ".venv/bin/python")
        simrun = [python, "-m", "alpasim_plugin.cli.main"]
        job = [*simrun, "--renderer", renderers, "--policy", "lane-camera", suite]
        for name in (FIRST, FITTING, WARM):
            if name == FITTING:
                shutil.rmtree(home / "cache", ignore_errors=True)
            waits[name] = wait_for([*job, "--out", str(home / name)], clone, environment)
        report = [*simrun, "report", str(home / WARM)]
        waits["report"] = wait_for(report, clone, environment)
    return waits


def table_of_waits(waits: Mapping[str, Wait]) -> str:
    """Return what `first_run` has measured as Markdown, with the differences that it is measured
    for.

    Example:
        >>> print(table_of_waits({FIRST: Wait(60, 90), FITTING: Wait(35, 60), WARM: Wait(20, 40)}))
        | | passed, s | processor, s |
        |---|---:|---:|
        | first run | 60.0 | 90.0 |
        | of it compiling kernels | 25.0 | 30.0 |
        | of it fitting | 15.0 | 20.0 |
        | warm run | 20.0 | 40.0 |
    """
    others = {name: wait for name, wait in waits.items() if name not in (FIRST, FITTING, WARM)}
    rows = {name: wait for name, wait in others.items() if name == "install"}
    rows["first run"] = waits[FIRST]
    rows["of it compiling kernels"] = waits[FIRST].less(waits[FITTING])
    rows["of it fitting"] = waits[FITTING].less(waits[WARM])
    rows["warm run"] = waits[WARM]
    lines = [
        f"| {name} | {wait.passed_s:.1f} | {wait.processor_s:.1f} |"
        for name, wait in (rows | others).items()
    ]
    return "\n".join(["| | passed, s | processor, s |", "|---|---:|---:|", *lines])


def table(pairs: Sequence[tuple[Costs, Costs]]) -> str:
    """Return the medians over pairs of base and here as Markdown; what only one of them measures
    is left out.

    Example:
        >>> print(table([({"log": 2.0}, {"log": 3.0}), ({"log": 4.0}, {"log": 5.0})]))
        | | base, ms | here, ms | ratio, median | least | most |
        |---|---:|---:|---:|---:|---:|
        | log | 3.0 | 4.0 | 1.38 | 1.25 | 1.50 |
    """
    lines = [
        "| | base, ms | here, ms | ratio, median | least | most |",
        "|---|---:|---:|---:|---:|---:|",
    ]
    base, here = pairs[0]
    for name in [name for name in here if name in base]:
        ratios = [pair[1][name] / max(pair[0][name], 1e-9) for pair in pairs]
        base_ms, here_ms = (statistics.median(pair[i][name] for pair in pairs) for i in (0, 1))
        numbers = [f"{base_ms:.1f}", f"{here_ms:.1f}", f"{statistics.median(ratios):.2f}"]
        lines.append(f"| {name} | {' | '.join(numbers)} | {min(ratios):.2f} | {max(ratios):.2f} |")
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("base", nargs="?", help="a commit")
    parser.add_argument("--pairs", type=int, default=6)
    parser.add_argument("--base-python", default=sys.executable)
    parser.add_argument("--renderer", default=",".join(RENDERERS))
    parser.add_argument("--first-run", action="store_true", help="measure that instead")
    parser.add_argument("--install", action="store_true", help="of it also the installation")
    parser.add_argument("--suite", default="suites/first", help="what the first run drives")
    options = parser.parse_args()
    if options.first_run:
        print(table_of_waits(first_run(options.suite, options.renderer, options.install)))
        return
    if options.base is None:
        parser.error("name a commit, or --first-run")
    renderers = options.renderer.split(",")
    with checked_out(options.base) as base, tempfile.TemporaryDirectory() as folder:
        caches = [Path(folder) / name for name in ("cache-base", "cache-here")]
        sides = list(zip((base, REPO), (options.base_python, sys.executable), caches, strict=True))
        for cache in caches:
            cache.mkdir()
        pairs = []
        # The first pair compiles and fits, and is not counted.
        for number in range(options.pairs + 1):
            first, second = (costs_of(*side, renderers) for side in sides)
            if number:
                pairs.append((first, second))
                print(f"pair {number} of {options.pairs}", file=sys.stderr)
    print(table(pairs))


if __name__ == "__main__":
    main()
