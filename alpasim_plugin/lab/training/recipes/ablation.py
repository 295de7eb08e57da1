"""The paper's ablation (Tab. 2a), its common initialisation.

The paper initialises all variants from one pretrained causal video model. Here ``base`` is that
initialisation: diffusion forcing on the same clips, with histories of every noise level.
``base-bi`` is the same for bidirectional networks.
"""

from __future__ import annotations

from alpasim_plugin.lab.training.clip_batches import Conditioning
from alpasim_plugin.lab.training.flow_matching import FlowMatching
from alpasim_plugin.lab.training.generator import SharedRollout
from alpasim_plugin.lab.training.recipes.recipe import (
    INIT_BI,
    Recipe,
    Stage,
    whole_clip,
)
from alpasim_plugin.lab.training.shared_rollout import Objectives

BASE = "base"
BASE_BI = "base-bi"
BASE_FORCING = FlowMatching(
    "latent", window=True, source_share=0.35, context_share=0.2, noise_share=0.25
)


def _row(
    name: str,
    about: str,
    *objectives: Objectives,
    shares: tuple[float, ...] = (1.0,),
    conditioning: Conditioning = Conditioning(),
) -> Recipe:
    return Recipe(
        name, about, (Stage(name, SharedRollout(objectives, shares), conditioning=conditioning),)
    )


ABLATION = (
    Recipe(
        BASE,
        "diffusion forcing on noisy histories: initialisation of the others",
        (Stage(BASE, BASE_FORCING),),
    ),
    Recipe(
        BASE_BI,
        "flow matching of whole clips: initialisation of bidirectional networks",
        (
            Stage(
                BASE_BI,
                FlowMatching("clip", noise_share=0.25),
                attention=whole_clip,
                start={"dit": f"{INIT_BI}.dit"},
            ),
        ),
    ),
    _row("V1", "teacher forcing: flow matching on clean history", Objectives("clean", 0)),
    _row("V2", "flow matching on own history", Objectives("own", 0)),
    _row("V3", "perceptual loss only", Objectives(None, 4)),
    _row("V3b", "flow matching on clean history and the perceptual loss", Objectives("clean", 4)),
    _row("V4", "k = 1", Objectives("own", 1)),
    _row("V5", "black map", Objectives("own", 4), conditioning=Conditioning(map="black")),
    _row(
        "V6",
        "from noise, render as a condition",
        Objectives("own", 4),
        conditioning=Conditioning(source="noise"),
    ),
    _row(
        "V7",
        "flow matching, then the perceptual loss",
        Objectives("own", 0),
        Objectives(None, 4),
        shares=(0.625, 0.375),
    ),
    _row(
        "V8",
        "clean latents noised and denoised again: history and perceptual loss",
        Objectives("redenoised", 4, predicted="redenoised"),
    ),
    _row(
        "V8-own",
        "history noised and denoised again, perceptual loss on the own rollout",
        Objectives("redenoised", 4),
    ),
    _row("V9", "OneFixer", Objectives("own", 4)),
)
