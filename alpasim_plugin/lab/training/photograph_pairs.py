"""Pairs of photographs: an under-trained reconstruction of most of them, seen from the places of
all.

Every ``every``-th photograph is held out; each of the ``every`` ways of doing so gives a sequence
of all photographs in order along the way, so that each photograph is held out once. The photograph
is the clean frame. There is no map (black), and between two photographs the camera moves far.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.geometry import inverse
from alpasim_plugin.core.image_metrics import psnr_db
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import U8
from alpasim_plugin.gaussians.fit.loop import fit
from alpasim_plugin.gaussians.fit.photographs import resized
from alpasim_plugin.gaussians.fit.recipe import SplatRecipe
from alpasim_plugin.gaussians.fit.start import Match, matches
from alpasim_plugin.gaussians.scene.scene_graph import SceneGraph
from alpasim_plugin.lab.training.pair_store import Pair, PairSequence, is_made, write_sequence
from alpasim_plugin.lab.training.photographs import Photographs, triangulated

PERIOD_US = 100_000  # photographs have no clock
FITTED_PX = 160  # width of the views that are fitted, as for driving scenes


@dataclass(frozen=True)
class PhotographRecipe:
    """How photographs become sequences.

    Attributes:
        width: Pixels across.
        every: One photograph of so many is held out.
        steps: Updates of the fit: few, so that it is under-trained.
        points: Most points that the fit starts from.
        cap: Most Gaussians.
        split: Of the sequences.
        seed: Of the fit.
    """

    width: int = 256
    every: int = 5
    steps: int = 300
    points: int = 6_000
    cap: int = 12_000
    split: str = "test"
    seed: int = 0

    def __post_init__(self) -> None:
        if self.every < 2:
            raise InputError(
                f"every {self.every}: no photograph would be left to fit",
                "hold out every second at most",
            )

    def splat(self) -> SplatRecipe:
        """Return the recipe of the fit."""
        return SplatRecipe(
            steps=self.steps,
            cap=self.cap,
            sh_degree=1,
            densify_until=0.8,
            densify_every=30,
            seed=self.seed,
        )


@dataclass(frozen=True)
class PhotographPairs:
    """One sequence.

    Attributes:
        folder: Where it is.
        made: Whether it was made now.
        psnr_db: Mean PSNR of the render on ``held_out`` photographs and on those that were fitted
            (``fitted``).
    """

    folder: Path
    made: bool
    psnr_db: Mapping[str, float]


def make_photograph_pairs(
    photographs: Photographs, name: str, out: Path, recipe: PhotographRecipe, device: str = "cpu"
) -> Iterator[PhotographPairs]:
    """Write the sequences ``out/SPLIT/NAME_PHASE``; equal ones are kept.

    Args:
        photographs: Of the recipe's width.
        name: Of the sequences.
        out: Folder of pairs.
        recipe: How.
        device: Where to fit and to render.

    Raises:
        InputError: Too few photographs, or none that overlap.
    """
    if len(photographs.views) < 2 * recipe.every:
        raise InputError(
            f"{name}: {len(photographs.views)} photographs for every {recipe.every}th to be held out",
            "give more photographs, or hold out more of them",
        )
    matched: list[Match] | None = None
    for phase in range(recipe.every):
        folder = out / recipe.split / f"{name}_{phase}"
        info = _info(photographs, name, recipe, phase)
        made = not is_made(folder, info)
        if made:
            matched = matches(photographs.views) if matched is None else matched
            graph = _fitted(photographs, matched, recipe, phase, name, device)
            renders = [graph.render(view.camera, {}, 1, device) for view in photographs.views]
            images = [
                (render.to_uint8(), np.rint(render.alpha * 255).clip(0, 255).astype(np.uint8))
                for render in renders
            ]
            psnr = _psnr(photographs, [image for image, _ in images], set(info["held_out"]))
            write_sequence(
                folder, _frames(photographs, images), len(images), {**info, "psnr_db": psnr}
            )
        yield PhotographPairs(folder, made, PairSequence(folder).info["psnr_db"])


def _info(
    photographs: Photographs, name: str, recipe: PhotographRecipe, phase: int
) -> dict[str, Any]:
    camera = photographs.views[0].pinhole
    lens = {
        "width": camera.width,
        "height": camera.height,
        "K": camera.K.tolist(),
        "T_rig_camera": np.eye(4).tolist(),
    }
    return {
        "scene_id": f"photographs-{name}",
        "seed": recipe.seed,
        "split": recipe.split,
        "family": "photographs",
        "actors": 0,
        "moving_actors": 0,
        "degradation": {"kind": "photographs"},
        "recipe": asdict(recipe),
        "camera": lens,
        "held_out": [i for i in range(len(photographs.views)) if i % recipe.every == phase],
        "photographs": [view.name for view in photographs.views],
        "missing": list(photographs.missing),
    }


def _fitted(
    photographs: Photographs,
    matches: list[Match],
    recipe: PhotographRecipe,
    phase: int,
    name: str,
    device: str,
) -> SceneGraph:
    used = [i for i in range(len(photographs.views)) if i % recipe.every != phase]
    rng = stream(f"photographs-{name}", recipe.seed, "photographs.start", phase)
    start = triangulated(photographs.views, matches, used, recipe.points, rng)
    views = [resized(photographs.views[i], min(FITTED_PX, recipe.width)) for i in used]
    scene_id = f"photographs-{name}"
    return fit(views, start, recipe.splat(), scene_id=scene_id, threads=1, device=device).graph()


def _psnr(photographs: Photographs, images: list[U8], held_out: set[int]) -> dict[str, float]:
    values = [
        psnr_db(image, view.rgb) for image, view in zip(images, photographs.views, strict=True)
    ]
    groups = {
        "held_out": [v for i, v in enumerate(values) if i in held_out],
        "fitted": [v for i, v in enumerate(values) if i not in held_out],
    }
    return {key: round(float(np.mean(group)), 3) for key, group in groups.items()}


def _frames(photographs: Photographs, images: list[tuple[U8, U8]]) -> Iterator[Pair]:
    for i, (view, (image, opacity)) in enumerate(zip(photographs.views, images, strict=True)):
        pose = inverse(view.camera.T_camera_world)
        yield Pair(image, view.rgb, opacity, np.zeros_like(image), pose, i * PERIOD_US)
