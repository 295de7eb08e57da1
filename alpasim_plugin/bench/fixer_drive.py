"""Drive a scene behind a fixer and keep what went into it and what came out: the closed-loop part of the fixer's bench."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from alpasim_plugin.bench.fixer_speed import Clip
from alpasim_plugin.fixers import BlockFixer, make_fixer
from alpasim_plugin.fixers.blocks import FixedRenderer, fixed_renderer
from alpasim_plugin.fixers.onefixer import OneFixer
from alpasim_plugin.fixers.settings import FixerSettings
from alpasim_plugin.fixers.stage_clock import StageClock
from alpasim_plugin.renderers import make_renderer
from alpasim_plugin.runtime.recorder import Recorder
from alpasim_plugin.runtime.rollout import run_rollout
from alpasim_plugin.types import U8, CameraSpec, Frame, RenderRequest
from policies import make_policy
from scenarios.load import load_scenario

SPARE = 8  # frames that a drive is longer, so that the block begun last is completed


@dataclass(frozen=True)
class DriveSample:
    """One drive behind a fixer.

    Attributes:
        clip: Frames of the true poses before the fixer, with their maps, in whole blocks.
        shown: ``(T, H, W, 3)`` uint8 what the policy saw at the same times.
        ms: Fixer time per frame, one entry per block after the first, everything made for it included.
        stages: The same by stage, where the fixer has stages.
        first_ms: Fixer time of the first block.
        facts: What the mode counted, such as hits.
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
    """Drive a scene until so many frames of whole blocks have gone through a fixer.

    Args:
        scene: A shipped name or a scenario file that is long enough; its first camera is used.
        frames: Least number of frames; a block that was begun is completed.
        size: Width and height of the camera, pixels; its field of view stays.
        settings: The fixer.
        scene_id: Key of the fixer's noise.
        renderer: What the fixer works on.
        policy: Who drives; must look at the camera.
        seed: Of the rollout.
        device, threads: Where the fixer computes, and with how many threads.
    """
    loaded = load_scenario(scene)
    loaded = load_scenario(scene, overrides=[f"timing.duration_us={(frames + SPARE) * loaded.rates.camera_us}"])
    scenario = replace(loaded, cameras=(resized(loaded.cameras[0], *size),))
    base = make_renderer(renderer, scenario, seed, "cpu", threads)
    tap = _Tap(make_fixer(settings.name, settings, scene_id=scene_id, seed=seed, device=device, threads=threads), device)
    fixed = fixed_renderer(base.render, lambda: tap, settings, scenario, threads)
    watched = _Watched(fixed)
    with Recorder(scenario, seed, images="none") as recorder:
        run_rollout(scenario, watched, make_policy(policy, scenario), seed, recorder)
    given = [frame for block in tap.given for frame in block]
    maps = [image for block in tap.maps for image in block]
    ends = np.cumsum([len(block) for block in tap.given])
    spent = [float(sum(watched.ms[end - len(block) : end])) for end, block in zip(ends, tap.given, strict=True)]
    shares = [ms / len(block) for ms, block in zip(spent, tap.given, strict=True)]
    names = sorted({name for taken in tap.stages for name in taken})
    stages = {name: [taken.get(name, 0.0) / len(block) for taken, block in zip(tap.stages, tap.given, strict=True)][1:] for name in names}
    shown = np.stack([frame.rgb for frame in watched.frames[: len(given)]])
    return DriveSample(Clip.of(given, maps), shown, shares[1:], stages, spent[0], fixed.facts())


def resized(camera: CameraSpec, width: int, height: int) -> CameraSpec:
    """Return the camera with another number of pixels and the same field of view."""
    scale = np.diag([width / camera.width, height / camera.height, 1.0])
    return replace(camera, width=width, height=height, K=scale @ camera.K)


@dataclass
class _Tap:
    """A fixer that remembers the blocks it took into its history, and its stages' times."""

    fixer: BlockFixer
    device: str
    given: list[Sequence[Frame]] = field(default_factory=list)
    maps: list[Sequence[U8]] = field(default_factory=list)
    stages: list[dict[str, float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.blocks, self.trained, self.label = self.fixer.blocks, self.fixer.trained, self.fixer.label
        self.clock = StageClock(self.device)
        if isinstance(self.fixer, OneFixer) and self.device == "cpu":  # elsewhere clocks at the stages would slow the whole
            self.fixer.pipeline.stage = self.clock

    def reset(self, seed: int) -> None:
        self.fixer.reset(seed)

    def preview(self, block: Sequence[Frame], maps: Sequence[U8]) -> Sequence[Frame]:
        return self.fixer.preview(block, maps)

    def step(self, block: Sequence[Frame], maps: Sequence[U8]) -> Sequence[Frame]:
        fixed = self.fixer.step(block, maps)
        self.given.append(tuple(block))
        self.maps.append(tuple(maps))
        self.stages.append(self.clock.take())
        return fixed


class _Watched:
    """A renderer that remembers the frames it handed out and the fixer's time for each."""

    def __init__(self, renderer: FixedRenderer) -> None:
        self._renderer = renderer
        self.lookahead, self.chunk = renderer.lookahead, renderer.chunk
        self.frames: list[Frame] = []
        self.ms: list[float] = []

    @property
    def stage_ms(self) -> Mapping[str, float]:
        return self._renderer.stage_ms

    def render(self, request: RenderRequest) -> Frame:
        return self.render_batch([request])[0]

    def render_batch(self, requests: Sequence[RenderRequest]) -> list[Frame]:
        frames = self._renderer.render_batch(requests)
        self.frames += frames
        spent = sum(ms for stage, ms in self._renderer.stage_ms.items() if stage != "map")
        self.ms += [spent / len(frames)] * len(frames)
        return frames
