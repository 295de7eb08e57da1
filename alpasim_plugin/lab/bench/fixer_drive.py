"""Drive a scene behind a fixer and record its input and its output: the closed-loop part of the
fixer's bench.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np

from alpasim_plugin.block_fixers.whole_clip import Clip
from alpasim_plugin.core.interfaces import Fixer, Renderer
from alpasim_plugin.core.types import U8, CameraSpec, Frame, RenderRequest
from alpasim_plugin.fixers import make_fixer
from alpasim_plugin.fixers.loop import fixed_renderer
from alpasim_plugin.fixers.settings import FixerSettings
from alpasim_plugin.renderers import make_renderer
from alpasim_plugin.runs.recorder import Recorder
from alpasim_plugin.runs.rollout import run_rollout
from policies import make_policy
from scenarios.load import load_scenario

SPARE = 8  # extra frames of a drive, so that the last block is completed


@dataclass(frozen=True)
class DriveSample:
    """One drive behind a fixer.

    Attributes:
        clip: Frames of the true poses before the fixer, with their maps, in whole blocks.
        shown: ``(T, H, W, 3)`` uint8 what the policy saw at the same times.
        ms: Fixer time per frame, drafts included, one entry per block after the first.
        stages: The same by stage, where the fixer has stages.
        first_ms: Fixer time of the first block.
        facts: Counts of the mode, such as hits.
    """

    clip: Clip
    shown: U8
    ms: list[float]
    stages: dict[str, list[float]]
    first_ms: float
    facts: Mapping[str, Any]


def drive(
    scene: str,
    frames: int,
    size: tuple[int, int],
    settings: FixerSettings,
    scene_id: str,
    *,
    renderer: str = "3dgs",
    policy: str = "lane-camera",
    seed: int = 0,
    device: str = "cpu",
    threads: int | None = None,
) -> DriveSample:
    """Drive a scene until at least ``frames`` frames of whole blocks have gone through a fixer.

    Args:
        scene: A shipped name or a scenario file that is long enough; its first camera is used.
        frames: Least number of frames; the last block is completed.
        size: Width and height of the camera, pixels; its field of view stays.
        settings: The fixer.
        scene_id: Key of the fixer's noise.
        renderer: What the fixer works on.
        policy: Who drives; must look at the camera.
        seed: Of the rollout.
        device, threads: Where the fixer computes, and with how many threads.
    """
    loaded = load_scenario(scene)
    loaded = load_scenario(
        scene, overrides=[f"timing.duration_us={(frames + SPARE) * loaded.rates.camera_us}"]
    )
    scenario = replace(loaded, cameras=(resized(loaded.cameras[0], *size),))
    base = make_renderer(renderer, scenario, seed, "cpu", threads)
    fixer = _RecordingFixer(
        make_fixer(
            settings.name, settings, scene_id=scene_id, seed=seed, device=device, threads=threads
        )
    )
    fixed = fixed_renderer(base.render, lambda: fixer, settings, scenario, threads)
    recording = RecordingRenderer(fixed)
    with Recorder(scenario, seed, images="none") as recorder:
        run_rollout(scenario, recording, make_policy(policy, scenario), seed, recorder)
    given = [frame for block in fixer.given for frame in block]
    maps = [image for block in fixer.maps for image in block]
    shown = np.stack([frame.rgb for frame in recording.frames[: len(given)]])
    ends = np.cumsum([0, *(len(block) for block in fixer.given)])
    per_block = [recording.ms[begin:end] for begin, end in pairwise(ends)]
    names = sorted({name for ms in recording.ms for name in ms} - {"map"})
    series = {
        name: [float(np.mean([ms.get(name, 0.0) for ms in block])) for block in per_block]
        for name in names
    }
    all_in = [sum(parts) for parts in zip(*series.values(), strict=True)]
    stages = {name.removeprefix("fix: "): ms[1:] for name, ms in series.items() if name != "fix"}
    return DriveSample(
        Clip.of(given, maps),
        shown,
        all_in[1:],
        stages,
        all_in[0] * len(fixer.given[0]),
        fixed.facts(),
    )


def resized(camera: CameraSpec, width: int, height: int) -> CameraSpec:
    """Return the camera with another number of pixels and the same field of view."""
    scale = np.diag([width / camera.width, height / camera.height, 1.0])
    return replace(camera, width=width, height=height, K=scale @ camera.K)


@dataclass
class _RecordingFixer(Fixer):
    """A fixer that records the blocks it takes into its history."""

    fixer: Fixer
    given: list[Sequence[Frame]] = field(default_factory=list)
    maps: list[Sequence[U8]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.blocks, self.trained, self.label = (
            self.fixer.blocks,
            self.fixer.trained,
            self.fixer.label,
        )

    @property
    def stage_ms(self) -> Mapping[str, float]:  # type: ignore[override]  # computed when it is read
        return getattr(self.fixer, "stage_ms", {})

    def reset(self, seed: int) -> None:
        self.fixer.reset(seed)

    def preview(self, block: Sequence[Frame], maps: Sequence[U8]) -> Sequence[Frame]:
        return self.fixer.preview(block, maps)

    def step(self, block: Sequence[Frame], maps: Sequence[U8]) -> Sequence[Frame]:
        self.given.append(tuple(block))
        self.maps.append(tuple(maps))
        return self.fixer.step(block, maps)


class RecordingRenderer(Renderer):
    """A renderer that records requests, frames and, per frame, the milliseconds by stage."""

    def __init__(self, renderer: Renderer) -> None:
        self._renderer = renderer
        self.lookahead, self.block = renderer.lookahead, renderer.block
        self.requests: list[RenderRequest] = []
        self.frames: list[Frame] = []
        self.ms: list[dict[str, float]] = []

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
        self.ms += [{stage: ms / len(frames) for stage, ms in self.stage_ms.items()}] * len(frames)
        return frames
