"""Pairs of a recorded street: what a reconstruction of some photographs shows where the others were
taken, and those photographs.

Every ``every``-th photograph is held out, in each of the ``every`` ways. A sequence is what was
held out of one camera, in order of time; the photographs that were fitted are its recording.
Render, map and recording are made as behind an imported drive in a closed loop, so the damage is
that of a real fit: of its poses, its depth, its exposure and its sky.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import interpolate, inverse
from alpasim_plugin.core.image_metrics import psnr_db
from alpasim_plugin.core.interfaces import Renderer
from alpasim_plugin.core.types import (
    F32,
    U8,
    CameraSpec,
    Photograph,
    RecordedFrame,
    RenderRequest,
    Scenario,
)
from alpasim_plugin.drives.build import POINTS_FILE
from alpasim_plugin.fixers.semantic_map.draw import draw_map
from alpasim_plugin.fixers.semantic_map.prepare import actor_boxes, prepare_map
from alpasim_plugin.gaussians.camera import PinholeCamera
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.fit.drive import fit_drive
from alpasim_plugin.gaussians.fit.photographs import read_points
from alpasim_plugin.gaussians.fit.recipe import SplatRecipe
from alpasim_plugin.gaussians.fit.views import PosedView
from alpasim_plugin.gaussians.scene.log_views import log_actors
from alpasim_plugin.lab.bench.photograph import posed_photograph
from alpasim_plugin.lab.training.pair_store import Pair, PairSequence, is_made, write_sequence
from alpasim_plugin.lab.training.photograph_pairs import PhotographPairs, PhotographRecipe
from alpasim_plugin.lab.training.reference_store import FrameGeometry, write_references
from alpasim_plugin.renderers import make_renderer

DRIVE = "drive"  # the family of these sequences


@dataclass(frozen=True, eq=False)
class Shot:
    """A photograph at the size of the pairs."""

    photograph: Photograph
    camera: PinholeCamera
    rgb: U8

    @classmethod
    def read(cls, photograph: Photograph, width: int) -> Self:
        """Read a photograph at a width in pixels, never larger than it is."""
        return cls(photograph, *posed_photograph(photograph, width))

    def spec(self, scenario: Scenario) -> CameraSpec:
        """Return its camera on the rig."""
        T_rig_camera = (
            inverse(interpolate(scenario.ego_log, self.photograph.t_us))
            @ self.photograph.T_world_camera
        )
        return CameraSpec(
            self.photograph.camera,
            self.camera.width,
            self.camera.height,
            self.camera.K,
            T_rig_camera,
        )

    def view(self, scenario: Scenario, i: int) -> PosedView:
        """Return it as the ``i``-th view to fit to."""
        actors = log_actors(scenario, self.photograph.t_us)
        return PosedView(self.camera, self.rgb, f"{self.photograph.camera}-{i:06d}", actors=actors)


def make_drive_pairs(
    scenario: Scenario, name: str, out: Path, recipe: PhotographRecipe, device: str = "cpu"
) -> Iterator[PhotographPairs]:
    """Write the sequences ``out/SPLIT/NAME_CAMERA_PHASE``; equal ones are kept.

    Args:
        scenario: Of an imported drive.
        name: Of the sequences.
        out: Folder of pairs.
        recipe: How.
        device: Where to fit and to render.

    Raises:
        InputError: A camera that took too few photographs.
    """
    points = read_points(Path(str(scenario.model)).parent / POINTS_FILE)
    for camera in sorted(
        {photograph.camera for photograph in scenario.recording if photograph.use != "never-fitted"}
    ):
        taken = sorted(
            (photograph for photograph in scenario.recording if photograph.camera == camera),
            key=lambda photograph: photograph.t_us,
        )
        if len(taken) < 2 * recipe.every:
            raise InputError(
                f"{name}, camera {camera}: {len(taken)} photographs for every {recipe.every}th to be held out",
                "give more photographs, or hold out more of them",
            )
        for phase in range(recipe.every):
            folder = out / recipe.split / f"{name}_{camera}_{phase}"
            info = _info(scenario, camera, recipe, phase)
            made = not is_made(folder, info)
            if made:
                shots = [Shot.read(photograph, recipe.width) for photograph in taken]
                _write(scenario, shots, points, folder, recipe, phase, info, device)
            yield PhotographPairs(folder, made, PairSequence(folder).info["psnr_db"])


def _info(scenario: Scenario, camera: str, recipe: PhotographRecipe, phase: int) -> dict[str, Any]:
    return {
        "scene_id": scenario.scene_id,
        "scene_hash": scenario.content_hash,
        "seed": recipe.seed,
        "split": recipe.split,
        "family": DRIVE,
        "actors": len(scenario.actors),
        "moving_actors": 0,
        "degradation": {"kind": DRIVE},
        "recipe": asdict(recipe),
        "name_of_camera": camera,
        "phase": phase,
    }


def _write(
    scenario: Scenario,
    shots: Sequence[Shot],
    points: GaussianCloud,
    folder: Path,
    recipe: PhotographRecipe,
    phase: int,
    info: dict[str, Any],
    device: str,
) -> None:
    held = [shot for i, shot in enumerate(shots) if i % recipe.every == phase]
    fitted = [shot for i, shot in enumerate(shots) if i % recipe.every != phase]
    with tempfile.TemporaryDirectory(prefix="simrun-pairs-") as scratch:
        fitted_scenario = _fitted(scenario, fitted, points, Path(scratch), recipe, phase, device)
        write_drive_sequence(fitted_scenario, held, fitted, folder, info, device)


def write_drive_sequence(
    scenario: Scenario,
    shots: Sequence[Shot],
    recorded: Sequence[Shot],
    folder: Path,
    info: dict[str, Any],
    device: str = "cpu",
) -> None:
    """Write what a drive's model shows where photographs were taken, those photographs, and its
    recording.

    Args:
        scenario: With the model.
        shots: The frames of the sequence, in order of time.
        recorded: Its recording. A photograph that is in both is never its own reference in
            training.
        folder: ROOT/SPLIT/SEQUENCE.
        info: Of sequence.json.
        device: Where to render.
    """
    renderer = make_renderer("3dgs", scenario, int(info["seed"]), device, threads=1)
    geometry: list[FrameGeometry] = []
    pairs = list(_frames(scenario, shots, renderer, geometry))
    frames = [_recorded(scenario, shot, renderer) for shot in recorded]
    lens = shots[0].spec(scenario)
    facts = {
        "width": lens.width,
        "height": lens.height,
        "K": lens.K.tolist(),
        "T_rig_camera": lens.T_rig_camera.tolist(),
    }
    psnr = {
        "held_out": round(
            float(np.mean([psnr_db(pair.rgb_input, pair.rgb_gt) for pair in pairs])), 3
        )
    }
    write_sequence(
        folder,
        pairs,
        len(pairs),
        {**info, "camera": facts, "psnr_db": psnr},
        lambda partial: write_references(partial, geometry, frames, scenario.actors),
    )


def _fitted(
    scenario: Scenario,
    shots: Sequence[Shot],
    points: GaussianCloud,
    scratch: Path,
    recipe: PhotographRecipe,
    phase: int,
    device: str,
) -> Scenario:
    """Return the scenario with a model that was fitted to these photographs alone."""
    views = [shot.view(scenario, i) for i, shot in enumerate(shots)]
    splat = replace(SplatRecipe.street(), steps=recipe.steps)
    done = fit_drive(
        views,
        points,
        boxes={actor.actor_id: actor.box for actor in scenario.actors},
        scene_id=f"{scenario.scene_id}-{phase}",
        seed=recipe.seed,
        threads=1,
        recipe=splat,
        device=device,
    )
    done.model.save(scratch, {"scene_id": scenario.scene_id, "views": len(views)})
    recording = [
        replace(shot.photograph, use="fitted", exposure=done.exposures[view.name])
        for shot, view in zip(shots, views, strict=True)
    ]
    return replace(scenario, model=str(scratch), recording=tuple(recording))


def _frames(
    scenario: Scenario, shots: Sequence[Shot], renderer: Renderer, geometry: list[FrameGeometry]
) -> Iterator[Pair]:
    """Yield the pairs, and append depth and actors of each to ``geometry``."""
    layers = prepare_map(scenario.lane_map)
    for shot in shots:
        spec = shot.spec(scenario)
        T = shot.photograph.T_world_camera
        t_us = shot.photograph.t_us
        actors = log_actors(scenario, t_us)
        frame = renderer.render(RenderRequest(t_us, spec, np.stack([T, T]), actors))
        assert frame.alpha is not None
        assert frame.depth is not None
        geometry.append(FrameGeometry(frame.depth.astype(np.float16), actors))
        opacity = np.rint(frame.alpha * 255).clip(0, 255).astype(np.uint8)
        sdmap = draw_map(layers, spec, T, actor_boxes(actors, scenario.actors), threads=1)
        yield Pair(frame.rgb, shot.rgb, opacity, sdmap, T, t_us)


def _recorded(scenario: Scenario, shot: Shot, renderer: Renderer) -> RecordedFrame:
    photograph = shot.photograph
    actors = log_actors(scenario, photograph.t_us)

    def read() -> tuple[U8, F32]:
        T = photograph.T_world_camera
        depth = renderer.render(
            RenderRequest(photograph.t_us, shot.spec(scenario), np.stack([T, T]), actors)
        ).depth
        assert depth is not None
        return shot.rgb, depth

    return RecordedFrame(
        photograph.t_us, photograph.camera, shot.camera.K, photograph.T_world_camera, actors, read
    )
