"""Where the processor time of the four hot parts goes, by function of ours.

Time in libraries (numpy, shapely, pyarrow) counts for the function of ours that called them.
Compiled kernels are invisible to the interpreter's profiler; those of the rasteriser are timed one
by one, on one thread.
"""

from __future__ import annotations

import cProfile
import pstats
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, get_args

from alpasim_plugin.core.errors import InfrastructureError
from alpasim_plugin.gaussians.raster import rasterize_cpu
from alpasim_plugin.gaussians.raster.prepared import prepare
from alpasim_plugin.gaussians.sample_scene import driving_camera, driving_like_scene
from alpasim_plugin.lab.bench.aggregation import write_random_table
from alpasim_plugin.lab.bench.evaluators import PAPER
from alpasim_plugin.lab.bench.raster import SKY
from alpasim_plugin.log.run_folder.columns import RolloutTable
from alpasim_plugin.runs.cell import run_cell
from alpasim_plugin.runs.plan import RunOptions, make_plan
from evaluators.metrics.reference import busy_road
from evaluators.metrics.score import score
from evaluators.statistics.summary import numbers
from scenarios.suite import expand

Part = Literal["raster", "loop", "evaluators", "aggregation"]
PARTS: tuple[Part, ...] = get_args(Part)
OURS = tuple(
    str(Path(__file__).resolve().parents[3] / name)
    for name in ("alpasim_plugin", "evaluators", "policies", "scenarios")
)
FURTHEST = 40  # calls from a library's function up to one of ours
SCENE = "urban/avenue_traffic"
Function = tuple[str, int, str]  # file, line, name, as in pstats


@dataclass(frozen=True)
class Share:
    """One function's share of a part's processor time.

    Attributes:
        part: Which of `PARTS`.
        where: Function, or kernel.
        ms: Per pass (frame, rollout, scoring, table).
        share: Of the part.
    """

    part: str
    where: str
    ms: float
    share: float


def profile(part: Part, passes: int = 3) -> list[Share]:
    """Run a part several times after a first, which warms caches, and return its functions, the
    largest first.

    Args:
        part: ``raster``: a frame of 100,000 Gaussians at 480x272 on one thread. ``loop``: a rollout
            of `SCENE` for two seconds behind ``3dgs``, driven by ``lane-camera``, scored and
            written. ``evaluators``: scoring 900 steps among 40 others. ``aggregation``: a table of
            20,000 rollouts.
        passes: How often.

    Raises:
        InfrastructureError: The rollout fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        run = _MAKERS[part](Path(folder))
        run()
        if part == "raster":
            return _kernels(run, passes)
        profiler = cProfile.Profile(time.process_time)
        for _ in range(passes):
            profiler.runcall(run)
    return shares(part, pstats.Stats(profiler), passes)


def shares(part: str, stats: pstats.Stats, passes: int) -> list[Share]:
    """Return our functions with their own time and that of the libraries that they call."""
    table: dict[Function, tuple[Any, ...]] = stats.stats  # type: ignore[attr-defined]
    mass = {function: entry[2] for function, entry in table.items()}
    for _ in range(FURTHEST):
        moved: dict[Function, float] = defaultdict(float)
        for function, own in mass.items():
            callers = table[function][4]
            weight = sum(entry[3] for entry in callers.values())
            if function[0].startswith(OURS) or weight <= 0.0:
                moved[function] += own
                continue
            for caller, entry in callers.items():
                moved[caller] += own * entry[3] / weight
        mass = dict(moved)
    total = sum(mass.values())
    named: dict[str, float] = defaultdict(float)
    for function, own in mass.items():
        named[_name(function)] += own
    rows = [Share(part, where, 1e3 * own / passes, own / total) for where, own in named.items()]
    return sorted(rows, key=lambda row: -row.ms)


def _name(function: Function) -> str:
    file = Path(function[0])
    return (
        f"{file.parent.name}/{file.stem}.{function[2]}"
        if function[0].startswith(OURS)
        else "outside"
    )


def _kernels(run: Callable[[], object], passes: int) -> list[Share]:
    spent: dict[str, float] = defaultdict(float)
    with _timed_kernels(spent):
        began = time.process_time()
        for _ in range(passes):
            run()
        total = time.process_time() - began
    spent["outside kernels"] = total - sum(spent.values())
    return sorted(
        (Share("raster", name, 1e3 * s / passes, s / total) for name, s in spent.items()),
        key=lambda row: -row.ms,
    )


@contextmanager
def _timed_kernels(spent: dict[str, float]) -> Iterator[None]:
    names = ("run_on_threads", "spheres_in_view", "depth_order", "tile_offsets")
    plain = {name: getattr(rasterize_cpu, name) for name in names}

    def timed(name: str, *args: Any) -> Any:
        began = time.process_time()
        try:
            return plain[name](*args)
        finally:
            kernel = args[1].__name__ if name == "run_on_threads" else name
            spent[kernel] += time.process_time() - began

    for name in names:
        setattr(rasterize_cpu, name, partial(timed, name))
    try:
        yield
    finally:
        for name, kept in plain.items():
            setattr(rasterize_cpu, name, kept)


def _raster(_: Path) -> Callable[[], object]:
    nodes, camera = [(prepare(driving_like_scene(100_000)), None)], driving_camera(480, 272)
    return partial(rasterize_cpu.rasterize_prepared, nodes, camera, SKY, threads=1)


def _loop(folder: Path) -> Callable[[], object]:
    refs = expand(SCENE, ("timing.duration_us=2000000",))
    plan = make_plan(refs, ("3dgs",), ("lane-camera",), (0,), RunOptions())

    def run() -> None:
        manifest = run_cell(plan.cells[0], plan.options, folder, 1)
        if manifest["status"] != "ok":
            raise InfrastructureError(
                f"{SCENE}: {manifest['error']}",
                "see the traceback in its manifest",
            )

    return run


def _evaluators(_: Path) -> Callable[[], object]:
    log, scene = busy_road(40, 900)
    return partial(score, log, scene, PAPER)


def _aggregation(folder: Path) -> Callable[[], object]:
    path = folder / "rollouts.parquet"
    write_random_table(path, 20_000, 1_000)
    return lambda: numbers(RolloutTable.of_files([path]))


_MAKERS: dict[Part, Callable[[Path], Callable[[], object]]] = {
    "raster": _raster,
    "loop": _loop,
    "evaluators": _evaluators,
    "aggregation": _aggregation,
}
