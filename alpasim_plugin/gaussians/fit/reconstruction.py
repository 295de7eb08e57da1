"""Hold a finished reconstruction, keep it in a folder of ordinary files, and put its sky together
from the views.

The sky is so far away that where a camera stands does not matter: every sky pixel is one direction.
Reconstructions of recorded drives learn such an environment map beside the Gaussians (Street
Gaussians, OmniRe); its optimum under fixed opacity is the mean of what the views saw in each
direction, which is computed here at once. Directions that no view saw take their colour from near
ones that were seen.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from typing_extensions import TypedDict

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import read_json_as
from alpasim_plugin.core.files.atomic import write_json
from alpasim_plugin.core.files.images import read_image
from alpasim_plugin.core.types import F32
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.files.ply import read_ply, write_ply
from alpasim_plugin.gaussians.fit.views import PosedView
from alpasim_plugin.gaussians.scene.scene_graph import (
    Level,
    SceneGraph,
    SceneNode,
    with_background,
)
from alpasim_plugin.gaussians.scene.sky import HEIGHT, HIGH_RAD, LOW_RAD, WIDTH, Sky

INDEX_FILE = "reconstruction.json"
BACKGROUND_FILE = "background.ply"
SKY_FILE = "sky.png"


class _Index(TypedDict):
    """What is relied on in `INDEX_FILE`."""

    actors: dict[str, str]  # actor id -> its file


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A scene fitted to posed views.

    Attributes:
        background: World coordinates.
        actors: Actor id to Gaussians in its box frame; an actor that no view showed well enough is
            missing.
        sky: What stands behind everything; black where the views had no sky.
        gains: Of the views that it was fitted to, in their order: red, green and blue of each over
            the model's; not written with it.
    """

    background: GaussianCloud
    actors: Mapping[str, GaussianCloud]
    sky: Sky
    gains: tuple[tuple[float, float, float], ...] = ()

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return len(self.background) + sum(len(cloud) for cloud in self.actors.values())

    def graph(self) -> SceneGraph:
        """Return it as a scene to be rendered from anywhere; colours turn with the actors."""
        actors = [
            SceneNode(name, "actor", (Level(0.0, cloud),)) for name, cloud in self.actors.items()
        ]
        return with_background(SceneGraph([], actors, self.sky), self.background, np.eye(4))

    def save(self, folder: Path, facts: Mapping[str, Any]) -> None:
        """Write ``background.ply``, ``actors/*.ply``, ``sky.png`` (8 bits) and, last,
        ``reconstruction.json`` with ``facts``.

        The PLY files have the layout of the original 3DGS code: any tool for Gaussians reads them.
        """
        (folder / "actors").mkdir(parents=True, exist_ok=True)
        write_ply(folder / BACKGROUND_FILE, self.background)
        files = {name: f"actors/{i:03d}.ply" for i, name in enumerate(sorted(self.actors))}
        for name, file in files.items():
            write_ply(folder / file, self.actors[name])
        cv2.imwrite(
            str(folder / SKY_FILE),
            np.rint(self.sky.panorama[..., ::-1] * 255).clip(0, 255).astype(np.uint8),
        )
        write_json(folder / INDEX_FILE, {"actors": files, "gaussians": len(self), **facts})

    @classmethod
    def load(cls, folder: Path) -> Reconstruction:
        """Read what `save` wrote.

        Raises:
            InputError: The folder holds no finished reconstruction.
        """
        path = folder / INDEX_FILE
        if not os.path.exists(path):
            raise InputError(
                f"{folder}: no {INDEX_FILE}",
                "make it with 'simrun import drive FOLDER -o OUT'",
            )
        files = read_json_as(_Index, path)["actors"]
        image = read_image(folder / SKY_FILE)
        if image.shape != (HEIGHT, WIDTH, 3):
            raise InputError(
                f"{folder / SKY_FILE}: an image of shape {image.shape}",
                f"give {WIDTH} x {HEIGHT} pixels, or make it again",
            )
        actors = {name: read_ply(folder / file) for name, file in files.items()}
        return cls(
            read_ply(folder / BACKGROUND_FILE),
            actors,
            Sky(image[..., ::-1].astype(np.float32) / 255),
        )


def sky_of(views: Sequence[PosedView]) -> Sky | None:
    """Return the sky that the views saw; None where no view has a sky pixel."""
    total = np.zeros((HEIGHT, WIDTH, 3))
    weight = np.zeros((HEIGHT, WIDTH))
    for view in views:
        if view.sky is not None:
            rows, columns = np.nonzero(
                cv2.erode(view.sky.astype(np.uint8), np.ones((3, 3), dtype=np.uint8), borderValue=1)
            )
            camera = view.camera
            local = camera.unprojected(rows, columns, np.ones(len(rows)))
            x, y, z = (local @ camera.T_camera_world[:3, :3]).T
            # A pixel of the panorama has its middle at a whole number, in rows and in columns.
            column = np.rint(np.arctan2(y, x) * (WIDTH / (2 * np.pi))).astype(np.int64) % WIDTH
            below = HIGH_RAD - np.arctan2(z, np.hypot(x, y))
            row = np.rint(below * ((HEIGHT - 1) / (HIGH_RAD - LOW_RAD))).astype(np.int64)
            row = row.clip(0, HEIGHT - 1)
            np.add.at(total, (row, column), view.rgb[rows, columns] / (255.0 * np.array(view.gain)))
            np.add.at(weight, (row, column), 1.0)
    if not weight.any():
        return None
    return Sky(
        _spread(
            (total / np.maximum(weight, 1e-9)[..., None]).astype(np.float32),
            (weight > 0).astype(np.float32),
        )
    )


def _spread(image: F32, validity: F32) -> F32:
    """Fill unknown pixels from known ones near by: means over ever coarser cells, the finest that
    holds a known pixel (pull and push).
    """
    if min(image.shape[:2]) <= 1 or validity.all():
        return image
    half = (max(1, image.shape[1] // 2), max(1, image.shape[0] // 2))
    area = cv2.resize(validity, half, interpolation=cv2.INTER_AREA)
    mean = (
        cv2.resize(image * validity[..., None], half, interpolation=cv2.INTER_AREA)
        / np.maximum(area, 1e-9)[..., None]
    )
    coarse = _spread(
        np.where(area[..., None] > 0, mean, 0).astype(np.float32), (area > 0).astype(np.float32)
    )
    filled = cv2.resize(coarse, (image.shape[1], image.shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(np.where(validity[..., None] > 0, image, filled), dtype=np.float32)
