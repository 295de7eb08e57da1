"""The causal video systems of the paper's comparison: OmniDreams, Self-Forcing, One-Forcing,
ArtiFixer.

Shares and rates are the papers': U is OneFixer's updates, a rate is relative to OneFixer's. Where
they are not published, docs/lab/arms.md has the choice.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

from alpasim_plugin.fixers.network.schedule import SHIFT
from alpasim_plugin.lab.training.adversarial import AdversarialTerm
from alpasim_plugin.lab.training.clip_batches import Conditioning
from alpasim_plugin.lab.training.distillation import Distillation
from alpasim_plugin.lab.training.flow_matching import FlowMatching
from alpasim_plugin.lab.training.recipes.recipe import INIT_BI, Attention, Recipe, Stage, whole_clip
from alpasim_plugin.lab.training.tail_drop import TailDrop
from alpasim_plugin.lab.training.trainer import PartSchedule

STUDENT = PartSchedule(rate=1 / 15, betas=(0.0, 0.999), clip=10.0)
CRITIC = PartSchedule(rate=1 / 75, betas=(0.0, 0.999), clip=10.0)

# OmniDreams: the causal backbone, fine-tuned to the fixer task. It is also the student of the
# distilled systems.
CAUSAL = Stage("student", FlowMatching("block"))
# Their teacher: the bidirectional backbone, fine-tuned alike.
TEACHER = Stage(
    "teacher", FlowMatching("clip"), attention=whole_clip, start={"dit": f"{INIT_BI}.dit"}
)
SELF_FORCING = Stage(
    "dmd",
    Distillation(),
    start={"dit": "student.dit", "real": "teacher.dit", "fake": "teacher.dit"},
    trained={"dit": STUDENT, "fake": CRITIC},
    decay="constant",
)
# Its second regulariser divides differences of logits by .01, which bfloat16 rounds away.
ONE_FORCING = replace(
    SELF_FORCING,
    objective=Distillation(adversarial=AdversarialTerm()),
    trained={**SELF_FORCING.trained, "head": CRITIC},
    always_float32=True,
)


def long_blocks(latents: int) -> Attention:
    """Return ArtiFixer's attention: blocks of a quarter of the clip, with the first block as a
    sink; a third of short clips.

    The published block of 7 latents in a window of 21, 7 of them sink, divides no clip of 24.
    """
    block = max(latents // (4 if latents >= 16 else 3), 1)
    return Attention(block, 3 * block, block, "last-forward")


def artifixers(times: Literal["block", "clip"]) -> FlowMatching:
    """Return ArtiFixer's flow matching: times warped towards the source, errors weighted by a bell,
    renders hidden from a frame on.
    """
    return FlowMatching(times, shift=SHIFT, bell=True, tail_drop=TailDrop())


OPACITY = Conditioning(map="nothing", opacity=True)
BIDIRECTIONAL = Stage(
    "bidirectional",
    artifixers("clip"),
    attention=whole_clip,
    conditioning=OPACITY,
    start={"dit": f"{INIT_BI}.dit"},
)
FORCED = Stage(
    "causal", artifixers("block"), 1.5, long_blocks, OPACITY, {"dit": "bidirectional.dit"}
)
DISTILLED = Stage(
    "dmd",
    Distillation(steps=4, same_rollout=True, gradient_latents=None, tail_drop=TailDrop()),
    0.5,
    long_blocks,
    OPACITY,
    {"dit": "causal.dit", "real": "bidirectional.dit", "fake": "bidirectional.dit"},
    {"dit": STUDENT, "fake": CRITIC},
    decay="constant",
)

CAUSAL_ARMS = (
    Recipe(
        "omnidreams",
        "diffusion forcing from the mixed source",
        (replace(CAUSAL, name="omnidreams"),),
        "omnidreams",
    ),
    Recipe("self-forcing", "DMD on own rollouts", (TEACHER, CAUSAL, SELF_FORCING), "self-forcing"),
    Recipe(
        "one-forcing",
        "DMD on own rollouts with an adversarial head",
        (TEACHER, CAUSAL, ONE_FORCING),
        "one-forcing",
    ),
    Recipe(
        "artifixer-pre",
        "opacity in every block, diffusion forcing in long blocks",
        (BIDIRECTIONAL, FORCED),
        "artifixer-pre",
    ),
    Recipe(
        "artifixer", "the same, distilled by DMD", (BIDIRECTIONAL, FORCED, DISTILLED), "artifixer"
    ),
)
