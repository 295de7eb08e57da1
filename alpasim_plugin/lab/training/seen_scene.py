"""Depth and lamps of a scene as a camera sees them: what the formulas of an appearance need besides
the frame.

Pairs hold no depth, so it is rendered again from their scene: for the style judge's training, the
targets of the recipe ``appearance``, and the controls of its measurement.
"""

from __future__ import annotations

from functools import cached_property, partial
from pathlib import Path

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import F64, U8, CameraSpec, RenderRequest, Scenario
from alpasim_plugin.gaussians.scene.builder import street_lights
from alpasim_plugin.gaussians.scene.degrade import log_actors
from alpasim_plugin.lab.learned_metrics.types import cuboid_corners
from alpasim_plugin.lab.training.appearance import (
    SeenFrame,
    lights_of_posts,
    restyle,
    vehicle_lamps,
)
from alpasim_plugin.lab.training.learned_metrics.truth import vehicle_cuboids
from alpasim_plugin.lab.training.pair_store import PairSequence
from alpasim_plugin.renderers import make_renderer
from alpasim_plugin.world.ground import height_at
from scenarios.load import load_scenario

DOING = "looking up the scene of a sequence"
WEATHER_SEED = 0  # of density, gain and flakes, with the scene's name
# levels of 255: mean difference below which a frame rendered again is the sequence's; machines
# differ in rounding
SAME_FRAME = 2.0


def scene_of(sequence: PairSequence, scenes: Path | None) -> Scenario:
    """Return the scene behind a sequence of pairs, from the folder that `simrun train scenes`
    wrote.

    Raises:
        InputError: It is not there.
    """
    path = (
        None
        if scenes is None
        else scenes / str(sequence.info.get("split")) / f"{sequence.name}.yaml"
    )
    if path is None or not path.is_file():
        raise InputError(
            f"{sequence.folder}: its scene, or the mounting of its camera, is asked for, and there is no scene",
            "name the folder of its scenes with --scenes",
        )
    return load_scenario(path)


class SeenScene:
    """One scene, rendered clean on request.

    Args:
        scenario: The scene.
        camera: That looks.
        with_street_lights: Whether street lights shine at night. The shipped style judges were
            trained without.
        threads: Of the rasteriser.
    """

    def __init__(
        self,
        scenario: Scenario,
        camera: CameraSpec,
        with_street_lights: bool = True,
        threads: int = 1,
    ) -> None:
        self.scenario, self.camera, self.with_street_lights = scenario, camera, with_street_lights
        self._renderer = make_renderer("clean", scenario, seed=0, threads=threads)

    @cached_property
    def street_lights(self) -> F64:
        """Places of the street lights' lamps ``(N, 3)``, metres, world."""
        return (
            street_lights(self.scenario, partial(height_at, self.scenario.ground))
            if self.with_street_lights
            else np.zeros((0, 3))
        )

    def frame(self, t_us: int, T_world_camera: F64) -> SeenFrame:
        """Render the clean frame of an instant with its depth, and find its lamps.

        Raises:
            InputError: The renderer gives no depth.
        """
        poses = log_actors(self.scenario, t_us)
        made = self._renderer.render(
            RenderRequest(t_us, self.camera, np.stack([T_world_camera, T_world_camera]), poses)
        )
        if made.depth is None:
            raise InputError(
                "renderer 'clean': frames without depth",
                "choose a renderer that gives it",
            )
        vehicles = vehicle_lamps(
            [cuboid_corners(c) for c in vehicle_cuboids(self.scenario, poses, T_world_camera)]
        )
        lamps = np.concatenate([vehicles, lights_of_posts(self.street_lights, T_world_camera)])
        return SeenFrame(made.rgb, made.depth, self.camera.K, T_world_camera, t_us, lamps)


def seen_frames(
    sequence: PairSequence, scenario: Scenario, start: int, frames: int, threads: int = 1
) -> list[SeenFrame]:
    """Return consecutive clean frames of a sequence with their depth and lamps.

    Args:
        sequence: Pairs whose target is the clean render.
        scenario: Its scene (`scene_of`).
        start, frames: Which.
        threads: Of the rasteriser.

    Raises:
        InputError: Another scene than the pairs were rendered from: its frames differ.
    """
    cut = sequence.clip.cut(start, frames)
    camera = next(
        (c for c in scenario.cameras if (c.height, c.width) == cut.rgb_gt.shape[1:3]),
        scenario.cameras[0],
    )
    scene = SeenScene(scenario, camera, threads=threads)
    out = [
        scene.frame(int(t_us), np.array(T))
        for t_us, T in zip(cut.t_us, cut.T_world_camera, strict=True)
    ]
    for i in (0, frames - 1):
        again, kept = out[i].rgb, cut.rgb_gt[i]
        off = (
            float("inf")
            if again.shape != kept.shape
            else float(np.abs(again.astype(np.float32) - kept).mean())
        )
        if off > SAME_FRAME:
            raise InputError(
                f"{sequence.folder}: frame {start + i} rendered again differs by {off:.1f} levels from the pairs' clean frame",
                "give the scenes that the pairs were rendered from, with renderer 'clean'",
            )
    return out


def restyle_video(video: U8, seen: list[SeenFrame], style: str, scene_id: str) -> U8:
    """Return a video ``(T, H, W, 3)`` in another style, by the formulas with the depth of clean
    frames of the same instants.

    Raises:
        InputError: No such style.
    """
    made = [
        restyle(
            SeenFrame(np.array(rgb), f.depth_m, f.K, f.T_world_camera, f.t_us, f.lamps),
            style,
            scene_id,
            WEATHER_SEED,
        )
        for rgb, f in zip(video, seen, strict=True)
    ]
    return np.stack(made)
