"""Hold a finished reconstruction, and keep it in a folder of ordinary files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from typing_extensions import TypedDict

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.gaussians.cloud import GaussianCloud
from alpasim_plugin.gaussians.files.ply import read_ply, write_ply
from alpasim_plugin.gaussians.scene.builder import with_background
from alpasim_plugin.gaussians.scene.nodes import Level, SceneNode
from alpasim_plugin.gaussians.scene.scene_graph import SceneGraph
from alpasim_plugin.gaussians.scene.sky import HEIGHT, WIDTH, Sky
from alpasim_plugin.io.atomic import write_json
from alpasim_plugin.io.reading import read_json_as
from alpasim_plugin.io.reading.images import read_image

DOING = "reading a reconstruction"
INDEX_FILE, BACKGROUND_FILE, SKY_FILE = "reconstruction.json", "background.ply", "sky.png"


class _Index(TypedDict):
    """What is relied on in `INDEX_FILE`."""

    actors: dict[str, str]  # actor id -> its file


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """A scene fitted to posed views.

    Attributes:
        background: World coordinates.
        actors: Actor id to Gaussians in its box frame; an actor that no view showed well enough is missing.
        sky: What stands behind everything; black where the views had no sky.
    """

    background: GaussianCloud
    actors: Mapping[str, GaussianCloud]
    sky: Sky

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return len(self.background) + sum(len(cloud) for cloud in self.actors.values())

    def graph(self) -> SceneGraph:
        """Return it as a scene to be rendered from anywhere; colours turn with the actors."""
        actors = [SceneNode(name, "actor", (Level(0.0, cloud),)) for name, cloud in self.actors.items()]
        return with_background(SceneGraph([], actors, self.sky), self.background, np.eye(4))

    def save(self, folder: Path, facts: Mapping[str, Any]) -> None:
        """Write ``background.ply``, ``actors/*.ply``, ``sky.png`` (8 bits) and, last, ``reconstruction.json`` with ``facts``.

        The PLY files have the layout of the original 3DGS code: any tool for Gaussians reads them.
        """
        (folder / "actors").mkdir(parents=True, exist_ok=True)
        write_ply(folder / BACKGROUND_FILE, self.background)
        files = {name: f"actors/{i:03d}.ply" for i, name in enumerate(sorted(self.actors))}
        for name, file in files.items():
            write_ply(folder / file, self.actors[name])
        cv2.imwrite(str(folder / SKY_FILE), np.rint(self.sky.panorama[..., ::-1] * 255).clip(0, 255).astype(np.uint8))
        write_json(folder / INDEX_FILE, {"actors": files, "gaussians": len(self), **facts})

    @classmethod
    def load(cls, folder: Path) -> Reconstruction:
        """Read what `save` wrote.

        Raises:
            InputError: The folder holds no finished reconstruction.
        """
        path = folder / INDEX_FILE
        if not path.exists():
            do = "make it with 'simrun train splat SCENARIO --out FOLDER'"
            raise InputError(DOING, str(folder), f"no {INDEX_FILE}", do)
        files = read_json_as(_Index, path, DOING)["actors"]
        image = read_image(folder / SKY_FILE, DOING)
        if image.shape != (HEIGHT, WIDTH, 3):
            found = f"an image of shape {image.shape}"
            raise InputError(DOING, str(folder / SKY_FILE), found, f"give {WIDTH} x {HEIGHT} pixels, or make it again")
        actors = {name: read_ply(folder / file) for name, file in files.items()}
        return cls(read_ply(folder / BACKGROUND_FILE), actors, Sky(image[..., ::-1].astype(np.float32) / 255))
