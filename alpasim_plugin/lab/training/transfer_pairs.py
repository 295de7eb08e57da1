"""Pairs of scenes that nobody drives through: a hand-held walk, seen clean and in an under-trained
reconstruction of another take of it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np

from alpasim_plugin.core.types import F64, U8
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.fit.views import PosedView, seen_from
from alpasim_plugin.gaussians.scene.log_views import SkyMask
from alpasim_plugin.gaussians.scene.scene_graph import SceneGraph
from alpasim_plugin.lab.interiors.places import Place, build_place
from alpasim_plugin.lab.training.hand_held import Hand, hand_held
from alpasim_plugin.lab.training.pair_store import Pair, is_made, write_sequence
from alpasim_plugin.lab.training.transfer_scenes import HEIGHT, WIDTH, TransferScene
from alpasim_plugin.renderers.reconstruction_build import reconstruct
from alpasim_plugin.renderers.reconstruction_key import recipe_for

PERIOD_S = 0.1
RECORDED, SHOWN = (
    "recording",
    "replay",
)  # takes of the same way: the reconstruction's, and the pairs'
HAND, AT_A_TABLE = Hand(), Hand(sway_m=0.012, bob_m=0.008, drift_m=0.03)


def make_transfer_sequence(scene: TransferScene, folder: Path, threads: int = 1) -> bool:
    """Render the sequence of a scene unless an equal one exists.

    The degraded frames are made like those of driving scenes: `reconstruct` with the scene's
    degradation. What it is fitted to is another take of the walk, so the pairs are seen from some
    centimetres and degrees beside its views.

    Args:
        scene: Its definition.
        folder: ROOT/SPLIT/SEQUENCE.
        threads: Of the rasteriser.

    Returns:
        Whether it was rendered now.
    """
    camera = PinholeCamera.from_hfov(WIDTH, HEIGHT, np.radians(scene.hfov_deg))
    info = {
        "scene_id": scene.scene_id,
        "scene_hash": scene.digest,
        "seed": scene.seed,
        "split": scene.split,
        "family": scene.family,
        "degradation": asdict(scene.degradation),
        "actors": 0,
        "moving_actors": 0,
        "camera": {
            "width": WIDTH,
            "height": HEIGHT,
            "K": camera.K.tolist(),
            "T_rig_camera": np.eye(4).tolist(),
        },
    }
    if is_made(folder, info):
        return False
    write_sequence(
        folder, pair_frames(scene, camera, threads, range(scene.frames)), scene.frames, info
    )
    return True


def pair_frames(
    scene: TransferScene, camera: PinholeCamera, threads: int, wanted: Iterable[int]
) -> Iterator[Pair]:
    """Yield the ``wanted`` frames of a scene in their order; the semantic map is black."""
    place = build_place(scene.family, scene.scene_id, scene.seed)
    graph, sky = _reconstruction(scene, place, camera, threads)
    walk = poses(scene, place, scene.frames, SHOWN)
    for i in wanted:
        T_world_camera = walk[i]
        view = PinholeCamera.from_pose(camera.width, camera.height, camera.K, T_world_camera)
        damaged = graph.render(view, {}, threads)
        opacity = (
            np.rint(np.maximum(damaged.alpha, sky.share(view)) * 255).clip(0, 255).astype(np.uint8)
        )
        clean: U8 = place.graph.render(view, {}, threads, sky_in_alpha=True).to_uint8()
        yield Pair(
            damaged.to_uint8(),
            clean,
            opacity,
            np.zeros_like(clean),
            T_world_camera,
            round(i * PERIOD_S * 1e6),
        )


def poses(scene: TransferScene, place: Place, count: int, take: str) -> F64:
    """Return ``count`` camera poses ``(count, 4, 4)`` along the whole walk of a take."""
    t_s = np.linspace(0.0, (scene.frames - 1) * PERIOD_S, count)
    hand = AT_A_TABLE if scene.family == "table" else HAND
    return hand_held(place.walk.eye, place.walk.target, t_s, hand, scene.scene_id, scene.seed, take)


def _reconstruction(
    scene: TransferScene, place: Place, camera: PinholeCamera, threads: int
) -> tuple[SceneGraph, SkyMask]:
    recipe = recipe_for(scene.degradation, (scene.frames - 1) * PERIOD_S)
    width = recipe.splat.width
    scale = width / camera.width
    K = np.diag([scale, scale, 1.0]) @ camera.K
    views: list[PosedView] = []
    for i, T in enumerate(poses(scene, place, recipe.splat.views, RECORDED)):
        small = PinholeCamera.from_pose(width, round(camera.height * scale), K, T)
        views.append(seen_from(small, place.graph, {}, f"view-{i}", threads))
    model, sky_views = reconstruct(views, {}, recipe, scene.scene_id, threads)
    return model.graph(), SkyMask(sky_views)
