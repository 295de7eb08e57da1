"""Train the style judge on clean frames of training scenes and their targets by formula; the frames
are rendered with their depth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from alpasim_plugin.block_fixers.settings import STYLES
from alpasim_plugin.core.atomic import atomic_file
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.reading import parsing
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.core.types import F32, U8, Scenario
from alpasim_plugin.lab.learned_metrics.nets.layers import initialise
from alpasim_plugin.lab.learned_metrics.nets.style_net import StyleNet, style_input
from alpasim_plugin.lab.training.appearance import restyle
from alpasim_plugin.lab.training.learned_metrics.frames import WIDTH_PX, jitter_colours
from alpasim_plugin.lab.training.learned_metrics.labels import TRAINING_SPLITS
from alpasim_plugin.lab.training.pairs import offset_from_log
from alpasim_plugin.lab.training.seen_scene import SeenScene
from alpasim_plugin.lab.training.trainer import Loss
from scenarios.load import load_scenario

FRAMES_A_SCENE = 6
VERSION = 1


@dataclass(frozen=True)
class StyleRecipe:
    """Batch, and the seed of weights and draws."""

    batch: int = 32
    seed: int = 0


@dataclass(frozen=True)
class StyleBatch:
    """B frames ``(B, 3, 72, 128)`` and their styles ``(B,)``."""

    image: Tensor
    style: Tensor


class StyleTask:
    """Batches and loss of the style judge, for `Trainer`.

    Args:
        frames: ``(S, N, H, W, 3)``: by style in the order of `STYLES`.
        recipe: Batch and seed.
        facts: Identity of the frames.
    """

    def __init__(self, frames: U8, recipe: StyleRecipe, facts: dict[str, Any]) -> None:
        self.frames, self.recipe, self._facts = frames, recipe, facts
        self.module = StyleNet()
        initialise(self.module, recipe.seed)

    @property
    def facts(self) -> dict[str, Any]:
        """Identify data and recipe."""
        return {**self._facts, "recipe": asdict(self.recipe)}

    def batch(self, index: int) -> StyleBatch:
        """Make batch ``index``."""
        rows = [self._example(index * self.recipe.batch + i) for i in range(self.recipe.batch)]
        return StyleBatch(
            torch.from_numpy(np.stack([image for image, _ in rows])),
            torch.tensor([style for _, style in rows]),
        )

    def loss(self, batch: StyleBatch, index: int) -> Loss:
        """Return the cross entropy of a batch."""
        del index
        logits = self.module(batch.image)
        right = float((logits.argmax(1) == batch.style).float().mean())
        return F.cross_entropy(logits, batch.style), {"right": right}

    def _example(self, number: int) -> tuple[F32, int]:
        rng = stream("training", self.recipe.seed, "judge.style", number)
        style = int(rng.integers(len(STYLES)))
        image = self.frames[style, int(rng.integers(self.frames.shape[1]))]
        seen = style_input(jitter_colours(rng, image))
        return (np.ascontiguousarray(seen[..., ::-1]) if rng.random() < 0.5 else seen), style


def styled_frames(
    scenes: Sequence[Path], kept: Path, report: Callable[[int, int], None] | None = None
) -> U8:
    """Return frames of scenes in all styles ``(S, N, H, W, 3)``, six a scene, from disk where they
    are there.

    Args:
        scenes: Scenario files below a folder ``train`` or ``val``; those of another camera than the
            judges' are left out.
        kept: Folder of the frames.
        report: Gets how many scenes are done.

    Raises:
        InputError: A scene of a test split, or none with the judges' camera.
    """
    parts = []
    for done, path in enumerate(scenes, start=1):
        if path.parent.name not in TRAINING_SPLITS:
            raise InputError(
                f"{path}: not a training split",
                "give scenes of the splits train and val",
            )
        file = kept / path.parent.name / f"{path.stem}-style-{VERSION}.npz"
        if not file.is_file():
            scenario = load_scenario(path)
            frames = (
                _render(scenario)
                if scenario.cameras[0].width == WIDTH_PX
                else np.zeros((len(STYLES), 0, 1, 1, 3), dtype=np.uint8)
            )
            file.parent.mkdir(parents=True, exist_ok=True)
            with atomic_file(file) as partial, partial.open("wb") as out:
                np.savez_compressed(out, frames=frames)
        do = f"remove {file}; it is made again"
        with (
            parsing(file, do, "not whole frames"),
            np.load(file) as stored,
        ):
            if stored["frames"].shape[1]:
                parts.append(stored["frames"])
        if report is not None:
            report(done, len(scenes))
    if not parts:
        raise InputError(
            f"{len(scenes)} scenes: none with a camera {WIDTH_PX} pixels wide",
            "give others",
        )
    return np.concatenate(parts, axis=1)


def _render(scenario: Scenario) -> U8:
    camera = scenario.cameras[0]
    scene = SeenScene(scenario, camera, with_street_lights=False)
    out: list[list[U8]] = [[] for _ in STYLES]
    for t_us in np.linspace(scenario.start_us, scenario.end_us, FRAMES_A_SCENE).astype(np.int64):
        seen = scene.frame(
            int(t_us), offset_from_log(scenario, int(t_us), 0.0) @ camera.T_rig_camera
        )
        for frames, style in zip(out, STYLES, strict=True):
            frames.append(restyle(seen, style, scenario.scene_id, 0))
    return np.stack([np.stack(frames) for frames in out])
