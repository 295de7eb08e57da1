"""Render training pairs from scenarios: frames degraded as the scenario says, clean frames and the
map, along paths offset from the log.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import interpolate, yaw_of
from alpasim_plugin.core.interfaces import Renderer
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F64, CameraSpec, RenderRequest, Scenario
from alpasim_plugin.fixers.semantic_map.draw import draw_map
from alpasim_plugin.fixers.semantic_map.prepare import actor_boxes, prepare_map
from alpasim_plugin.gaussians.scene.log_views import log_actors
from alpasim_plugin.lab.training.lane_lines import lateral_positions, lines_of, write_lanes
from alpasim_plugin.lab.training.pair_store import Pair, is_made, write_sequence
from alpasim_plugin.lab.training.reference_store import FrameGeometry, write_references
from alpasim_plugin.renderers import make_renderer
from alpasim_plugin.world.ground import ground_pose

MOVING_M = 2.0  # an actor with a longer track counts as moving


@dataclass(frozen=True)
class PairRecipe:
    """Definition of a sequence.

    Args:
        source: Renderer of the degraded frames.
        target: Renderer of the clean frames.
        max_offset_m: Largest lateral offset from the logged path; the offset varies smoothly, and
            is zero in cycle renders.
        offset_m: One lateral offset for all frames, left positive; None lets it vary.
        interval_us: Time between frames.
        camera: Name of the scenario's camera; None for the first.
    """

    source: str = "3dgs"
    target: str = "clean"
    max_offset_m: float = 2.5
    offset_m: float | None = None
    interval_us: int = 100_000
    camera: str | None = None


def make_sequence(
    scenario: Scenario,
    folder: Path,
    recipe: PairRecipe,
    seed: int,
    *,
    split: str,
    family: str,
    device: str = "cpu",
) -> bool:
    """Render one sequence of a scenario unless an equal one exists.

    Args:
        scenario: Rendered over its whole duration; its section ``degradation`` says how the source
            differs from the target.
        folder: ROOT/SPLIT/SEQUENCE.
        recipe: Definition of the sequence.
        seed: Of the lateral offset and the source renderer.
        split, family: Stored in sequence.json.
        device: Where to fit and to render.

    Returns:
        Whether it was rendered now.

    Raises:
        InputError: The scenario has no such camera.
    """
    info = {
        "scene_id": scenario.scene_id,
        "scene_hash": scenario.content_hash,
        "seed": seed,
        "split": split,
        "family": family,
        "recipe": asdict(recipe),
        "degradation": asdict(scenario.degradation),
    }
    if is_made(folder, info):
        return False
    camera = _camera(scenario, recipe.camera)
    source = make_renderer(recipe.source, scenario, seed, device, threads=1)
    geometry: list[FrameGeometry] = []
    lanes: list[F64] = []
    recorded = [frame for frame in source.recorded() if frame.camera == camera.name]

    def beside(partial: Path) -> None:
        write_lanes(partial, lanes)
        if recorded:
            write_references(partial, geometry, recorded, scenario.actors)

    write_sequence(
        folder,
        pair_frames(scenario, camera, recipe, seed, source, geometry, lanes, device),
        len(_times(scenario, recipe)),
        {**info, **_camera_and_actors(scenario, camera)},
        beside,
    )
    return True


def _times(scenario: Scenario, recipe: PairRecipe) -> range:
    """Return the instants of the frames, microseconds."""
    return range(scenario.start_us, scenario.recorded_until_us + 1, recipe.interval_us)


def _camera_and_actors(scenario: Scenario, camera: CameraSpec) -> dict[str, Any]:
    """Return what sequence.json says of the camera and of the road users."""
    tracks = [actor.track.xyz for actor in scenario.actors]
    moving = [xyz for xyz in tracks if np.ptp(xyz, axis=0).max() > MOVING_M]
    return {
        "camera": {
            "width": camera.width,
            "height": camera.height,
            "K": camera.K.tolist(),
            "T_rig_camera": camera.T_rig_camera.tolist(),
        },
        "actors": len(tracks),
        "moving_actors": len(moving),
    }


def pair_frames(
    scenario: Scenario,
    camera: CameraSpec,
    recipe: PairRecipe,
    seed: int,
    source: Renderer,
    geometry: list[FrameGeometry],
    lanes: list[F64],
    device: str,
) -> Iterator[Pair]:
    """Yield the frames of one sequence in order of time, and append depth and actors of each to
    ``geometry``, its lane lines to ``lanes``.
    """
    target = make_renderer(recipe.target, scenario, seed, device, threads=1)
    layers = prepare_map(scenario.lane_map)
    lines = lines_of(scenario.lane_map)
    offset_m = lateral_offsets(scenario, recipe, seed)
    for i, t_us in enumerate(_times(scenario, recipe)):
        T_world_camera = offset_from_log(scenario, t_us, float(offset_m[i])) @ camera.T_rig_camera
        actors = log_actors(scenario, t_us)
        request = RenderRequest(t_us, camera, np.stack([T_world_camera, T_world_camera]), actors)
        damaged = source.render(request)
        if damaged.alpha is None or damaged.depth is None:
            raise InputError(
                f"renderer {recipe.source!r}: frames without opacity or depth",
                "choose a renderer that gives both",
            )
        geometry.append(FrameGeometry(damaged.depth.astype(np.float16), actors))
        lanes.append(lateral_positions(lines, camera, T_world_camera))
        opacity = np.rint(damaged.alpha * 255).clip(0, 255).astype(np.uint8)
        sdmap = draw_map(
            layers, camera, T_world_camera, actor_boxes(actors, scenario.actors), threads=1
        )
        yield Pair(damaged.rgb, target.render(request).rgb, opacity, sdmap, T_world_camera, t_us)


def lateral_offsets(scenario: Scenario, recipe: PairRecipe, seed: int) -> F64:
    """Return the lateral offset of every frame ``(T,)``, metres, left positive: two slow sines, at
    most ``max_offset_m``.

    A fifth of the sequences stays on the logged path, where a reconstruction is best; so do all
    cycle renders, which are degraded there.
    """
    if recipe.offset_m is not None:
        return np.full(len(_times(scenario, recipe)), recipe.offset_m)
    rng = stream(scenario.scene_id, seed, "training.wander")
    t_s = np.array(_times(scenario, recipe)) * 1e-6
    on_path = rng.random() < 0.2 or scenario.degradation.kind == "cycle"
    size = 0.0 if on_path else recipe.max_offset_m * np.sqrt(rng.uniform(0.05, 1.0))
    periods_s = rng.uniform([6.0, 12.0], [12.0, 30.0])
    phases = rng.uniform(0, 2 * np.pi, 2)
    waves = np.sin(2 * np.pi * t_s[:, None] / periods_s + phases) @ np.array([0.35, 0.65])
    return np.asarray(size * waves)


def offset_from_log(scenario: Scenario, t_us: int, offset_m: float) -> F64:
    """Return the rig's pose ``(4, 4)`` at a lateral offset from the logged one, on the ground, with
    the logged heading.
    """
    T = interpolate(scenario.ego_log, t_us)
    x, y = T[:2, 3] + offset_m * T[:2, 1]
    return ground_pose(scenario.ground, float(x), float(y), yaw_of(T))


def _camera(scenario: Scenario, name: str | None) -> CameraSpec:
    for camera in scenario.cameras:
        if name is None or camera.name == name:
            return camera
    names = sorted(c.name for c in scenario.cameras)
    raise InputError(
        f"camera {name!r}: scene {scenario.scene_id!r} has {names}", "name one of them"
    )
