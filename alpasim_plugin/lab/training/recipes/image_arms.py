"""Systems without a causal history: image models that take a step from the render, and windows from
noise.

Shares are the published updates in units of OneFixer's, rates the published learning rates over its
own.
"""

from __future__ import annotations

from typing import Literal

from alpasim_plugin.lab.training.clip_batches import Conditioning
from alpasim_plugin.lab.training.noise_window_task import NoiseWindowLoss
from alpasim_plugin.lab.training.recipes.recipe import (
    INIT_BI,
    Recipe,
    Stage,
    frame_by_frame,
    whole_clip,
)
from alpasim_plugin.lab.training.render_step_task import RenderStepLoss
from alpasim_plugin.lab.training.trainer import PartSchedule

NO_MAP = Conditioning(map="nothing")
TWO_THIRDS = PartSchedule(rate=2 / 3)
HARMONIZER = Stage(
    "harmonizer",
    RenderStepLoss(weight=0.3, clamp=0.9),
    share=10,
    attention=frame_by_frame,
    conditioning=NO_MAP,
    latents=1,
    trained={"dit": TWO_THIRDS, "vae": TWO_THIRDS},
    deployed={"references": 0},
)
# Its rate falls to a hundredth in 25,000 updates; the paper's run has 10,000
GSFIX3D_LAST_SHARE = 0.01 ** (10_000 / 25_000)
CONDITION_DROPOUT = (
    0.2  # .1 for the image alone and .1 for image and embedding; there is no embedding here
)
WINDOW = 7  # latents of 25 frames


def _temporal(name: str, about: str, references: Literal["own", "clean"]) -> Recipe:
    stage = Stage(
        name,
        RenderStepLoss(weight=0.3, clamp=0.9, references=references),
        share=3.75,
        attention=whole_clip,
        conditioning=NO_MAP,
        latents=2,
        start={"dit": "harmonizer.dit", "vae": "harmonizer.vae"},
        trained=HARMONIZER.trained,
    )
    return Recipe(name, about, (HARMONIZER, stage), fixer="harmonizer-temporal")


IMAGE_ARMS = (
    Recipe(
        "difix",
        "DiFix3D+: one step from the render, transformer and decoder trained on images",
        (
            Stage(
                "difix",
                RenderStepLoss(),
                share=2,
                attention=frame_by_frame,
                conditioning=NO_MAP,
                latents=1,
                decay="constant",
                trained={"dit": TWO_THIRDS, "vae.decoder": TWO_THIRDS},
            ),
        ),
        fixer="difix",
    ),
    Recipe(
        "harmonizer",
        "DiffusionHarmonizer: one step from the render, transformer and autoencoder trained on images",
        (HARMONIZER,),
        fixer="harmonizer",
    ),
    _temporal(
        "harmonizer-temporal",
        "DiffusionHarmonizer that looks at its last four outputs, trained on its own",
        "own",
    ),
    _temporal(
        "harmonizer-temporal-teacher",
        "the same, trained on clean frames in place of its outputs",
        "clean",
    ),
    Recipe(
        "gsfix3d",
        "GSFix3D: eight steps from noise, the render as a condition, frame by frame",
        (
            Stage(
                "gsfix3d",
                NoiseWindowLoss("uniform", "squared", multi_resolution=True, cut_outs=True),
                share=25,
                attention=frame_by_frame,
                conditioning=NO_MAP,
                latents=1,
                decay="exponential",
                last_share=GSFIX3D_LAST_SHARE,
            ),
        ),
        fixer="gsfix3d",
    ),
    Recipe(
        "3dgs-enhancer",
        "3DGS-Enhancer: windows of 25 frames in eight steps from noise, the render as a condition",
        (
            Stage(
                "3dgs-enhancer",
                NoiseWindowLoss("log-normal", "edm", dropout=CONDITION_DROPOUT),
                share=1.25,
                attention=whole_clip,
                conditioning=NO_MAP,
                latents=WINDOW,
                start={"dit": f"{INIT_BI}.dit"},
                trained={"dit": PartSchedule(rate=1 / 3)},
            ),
        ),
        fixer="3dgs-enhancer",
    ),
)
