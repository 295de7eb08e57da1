"""One frame of the closed loop by stage with its error, what a user waits for around it, and a
fixed piece of work to compare machines by.

Every ratio is a time over that of the reference work of the same run: of two machines, or two loads
of one, ratios can be compared where milliseconds cannot. Drives are repeated, equal to the bit;
each pass through a stage counts with its least processor time.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import torch

from alpasim_plugin.core.files.places import temporary_folder
from alpasim_plugin.core.image_metrics import psnr_db
from alpasim_plugin.core.interfaces import Renderer
from alpasim_plugin.core.types import Frame, RenderRequest, Scenario
from alpasim_plugin.renderers.gaussian import clear_cache
from alpasim_plugin.runs.provenance import hardware, versions
from alpasim_plugin.runs.recorder import Recorder
from alpasim_plugin.runs.renderer import make_renderer
from alpasim_plugin.runs.rollout import run_rollout
from policies.base import make_policy
from scenarios.load import load_scenario
from scenarios.suite import expand

# The README's, a winding street
SUITE = "suites/first"
SCENE = 1
SIZES = ((512, 288), (256, 144))  # its own, and that of most shipped scenes
POLICY = "lane-camera"
STAGES = ("render", "references", "map", "fix", "policy", "control", "actors", "log")
REFERENCE_SIDE = 768  # of the matrices of the reference work: 0.9 billion floating-point operations
# What a user waits for -> words of the command
COMMANDS = {
    "start": ("--help",),
    "one rollout": ("--renderer", "clean", "--policy", POLICY, "--out", "{run}", "smoke/curve"),
    "report": ("report", "{run}"),
}


@dataclass(frozen=True)
class FrameCost:
    """A frame of the loop behind one renderer.

    Attributes:
        renderer: Its name.
        size: Width and height of the camera's image, pixels.
        frames: How many the means are over.
        ms: Mean processor time by stage, on one thread; each pass through a stage with its least
            time of the repeats.
        psnr_db: Of the frames that the policy saw, against the scene as built from the same poses;
            100 for equal ones.
    """

    renderer: str
    size: tuple[int, int]
    frames: int
    ms: Mapping[str, float]
    psnr_db: float

    @property
    def total_ms(self) -> float:
        """Give the whole loop's time of a frame."""
        return sum(self.ms.values())


@dataclass(frozen=True)
class CommandCost:
    """A command: processor time of all its processes, and the time that passed, of its fastest
    repeat.
    """

    command: str
    processor_s: float
    wall_s: float


def bench_loop(renderers: Sequence[str], repeats: int = 3, seconds: float = 6.0) -> dict[str, Any]:
    """Measure frames and commands, with the reference work between them.

    Args:
        renderers: Behind which to drive.
        repeats: Equal drives, and equal commands.
        seconds: Of each drive.

    Returns:
        ``machine``, ``versions``, ``scene``, ``repeats``, ``reference_ms``; ``frames`` and
        ``commands``, each time with its ``ratio``.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        reference = [reference_ms()]
        frames = []
        for size in SIZES:
            scenario = scene(size, seconds)
            for renderer in renderers:
                frames.append(frame_cost(renderer, scenario, repeats))
                reference.append(reference_ms())
        with temporary_folder("simrun-") as folder:
            commands = [command_cost(name, Path(folder), repeats) for name in COMMANDS]
        reference.append(reference_ms())
    finally:
        torch.set_num_threads(before)
    return {
        "machine": hardware(),
        "versions": versions(),
        "scene": scenario.scene_id,
        "repeats": repeats,
        "reference_ms": min(reference),
        "frames": [_frame_row(cost, min(reference)) for cost in frames],
        "commands": [_command_row(cost, min(reference)) for cost in commands],
    }


class RecordingRenderer(Renderer):
    """A renderer that records requests and frames."""

    def __init__(self, renderer: Renderer) -> None:
        self._renderer = renderer
        self.lookahead = renderer.lookahead
        self.block = renderer.block
        self.requests: list[RenderRequest] = []
        self.frames: list[Frame] = []

    @property
    def stage_ms(self) -> Mapping[str, float]:  # type: ignore[override]  # computed when it is read
        """Give what the renderer timed itself."""
        return self._renderer.stage_ms

    def render(self, request: RenderRequest) -> Frame:
        """Render one frame."""
        return self.render_batch([request])[0]

    def render_batch(self, requests: Sequence[RenderRequest]) -> list[Frame]:
        """Render frames of one instant, or of a block."""
        self.requests += requests
        frames = list(self._renderer.render_batch(requests))
        self.frames += frames
        return frames


def scene(size: tuple[int, int], seconds: float) -> Scenario:
    """Load the scene that is driven, with one camera of a size."""
    ref = expand(SUITE)[SCENE]
    loaded = load_scenario(
        ref.path, ref.seed, [*ref.overrides, "cameras=[{{width: {}, height: {}}}]".format(*size)]
    )
    return replace(loaded, end_us=min(loaded.end_us, loaded.start_us + int(1e6 * seconds)))


def reference_ms(times: int = 7) -> float:
    """Return the least processor time of a product of two matrices on one thread: work that no
    change of ours makes faster.
    """
    a = torch.linspace(-1.0, 1.0, REFERENCE_SIDE**2).reshape(REFERENCE_SIDE, REFERENCE_SIDE)
    spent = []
    for _ in range(times):
        began = time.thread_time()
        a @ a
        spent.append(time.thread_time() - began)
    return 1e3 * min(spent)


def frame_cost(renderer: str, scenario: Scenario, repeats: int) -> FrameCost:
    """Drive a scene several times behind a renderer, on one thread, and measure the images."""
    drives: list[dict[str, list[float]]] = []
    for _ in range(repeats):
        clear_cache("recording:")  # each drive reads its photographs, as the first of a scene does
        recording = RecordingRenderer(make_renderer(renderer, scenario, threads=1))
        # On a busy machine the time that passes is others' too: the stages' clock is this process's
        # own.
        with (
            patch.object(time, "perf_counter", time.process_time),
            Recorder(scenario, images="png") as recorder,
        ):
            run_rollout(scenario, recording, make_policy(POLICY, scenario), recorder=recorder)
            drives.append(recorder.facts()["stage_ms"])
    count = len(recording.frames)
    truth = make_renderer("clean", scenario, threads=1)
    clean = np.stack([truth.render(request).rgb for request in recording.requests])
    return FrameCost(
        renderer,
        (clean.shape[2], clean.shape[1]),
        count,
        {
            stage: sum(fastest(drives, stage)) / count
            for stage in dict.fromkeys(name for drive in drives for name in drive)
        },
        psnr_db(np.stack([frame.rgb for frame in recording.frames]), clean),
    )


def fastest(drives: Sequence[Mapping[str, Sequence[float]]], stage: str) -> list[float]:
    """Return the least time of each pass through a stage over equal drives.

    Raises:
        ValueError: The drives passed through it differently often: they were not equal.
    """
    return [min(times) for times in zip(*(drive.get(stage, ()) for drive in drives), strict=True)]


def command_cost(name: str, folder: Path, repeats: int) -> CommandCost:
    """Run a command several times, each in a process of its own.

    Raises:
        subprocess.CalledProcessError: It failed.
    """
    costs = []
    for repeat in range(repeats):
        # A report is of a run that is there; a rollout begins in a new folder.
        run = folder / ("run-0" if name == "report" else f"run-{repeat}")
        words = [word.format(run=run) for word in COMMANDS[name]]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        began = time.perf_counter()
        command = [
            sys.executable,
            "-P",
            "-c",
            "from alpasim_plugin.cli.main import main; main()",
            *words,
        ]
        subprocess.run(command, check=True, capture_output=True)
        wall_s = time.perf_counter() - began
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        costs.append((after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, wall_s))
    return CommandCost(name, min(cost[0] for cost in costs), min(cost[1] for cost in costs))


def _frame_row(cost: FrameCost, reference: float) -> dict[str, Any]:
    odd = set(cost.ms) - set(STAGES)
    stages = {stage: cost.ms[stage] for stage in (*STAGES, *sorted(odd)) if stage in cost.ms}
    return {
        "renderer": cost.renderer,
        "size": "x".join(map(str, cost.size)),
        "frames": cost.frames,
        "ms": cost.total_ms,
        "ratio": cost.total_ms / reference,
        "stages": {stage: {"ms": ms, "ratio": ms / reference} for stage, ms in stages.items()},
        "psnr_db": cost.psnr_db,
    }


def _command_row(cost: CommandCost, reference: float) -> dict[str, Any]:
    return {
        "command": cost.command,
        "processor_s": cost.processor_s,
        "wall_s": cost.wall_s,
        "ratio": 1e3 * cost.processor_s / reference,
    }


def markdown(record: Mapping[str, Any]) -> str:
    """Return the tables of a record, and the line that says where they come from."""
    head = [
        "frame behind",
        "size",
        "all, processor ms",
        "x reference",
        *STAGES,
        "PSNR, dB",
    ]
    lines = [f"| {' | '.join(head)} |", f"|---|{'---:|' * (len(head) - 1)}"]
    for row in record["frames"]:
        stages = [
            f"{row['stages'][stage]['ms']:.1f}" if stage in row["stages"] else ""
            for stage in STAGES
        ]
        cells = [
            f"`{row['renderer']}`",
            row["size"],
            f"{row['ms']:.1f}",
            f"{row['ratio']:.2f}",
            *stages,
            "equal" if row["psnr_db"] >= 100 else f"{row['psnr_db']:.1f}",
        ]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    lines += ["", "| command | processor, s | passed, s | x reference |", "|---|---:|---:|---:|"]
    lines += [
        f"| {row['command']} | {row['processor_s']:.2f} | {row['wall_s']:.2f} | {row['ratio']:.0f} |"
        for row in record["commands"]
    ]
    machine = record["machine"]
    used = record["versions"]
    lines += [
        "",
        f"Reference work: {record['reference_ms']:.2f} ms. {record['scene']}, best of {record['repeats']}; {machine['cpu']}, one thread of "
        f"{machine['cores']} cores; numba {used['numba']}, torch {used['torch']}.",
    ]
    return "\n".join(lines)
