"""Training variants of the generator: the paper's ablation, their common initialisation, and a fixer without history.

The paper initialises all variants from one pretrained causal video model. Here ``base`` is that initialisation: diffusion forcing on the
same clips, with histories of every noise level. ``image`` takes one frame at a time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TypeVar

from alpasim_plugin.errors import InputError
from alpasim_plugin.training.shared_rollout import Objectives

V = TypeVar("V")
BASE, IMAGE = "base", "image"


@dataclass(frozen=True)
class Variant:
    """One row of the ablation.

    Args:
        name: As in the paper.
        stages: Objectives in sequence, each for an equal share of the updates.
        history: Whether the network attends to latents before its block.
        about: Short description for tables.
    """

    name: str
    stages: tuple[Objectives, ...]
    about: str
    history: bool = True

    def objectives(self, step: int, steps: int) -> Objectives:
        """Return the objectives of update ``step`` of ``steps``."""
        return self.stages[min(step * len(self.stages) // steps, len(self.stages) - 1)]

    def with_perceptual_weight(self, perceptual: float) -> Variant:
        """Return the variant with another weight lambda of its perceptual term.

        Raises:
            InputError: A negative weight.
        """
        return replace(self, stages=tuple(replace(stage, weight=perceptual) for stage in self.stages))

    @property
    def use_map(self) -> bool:
        """Whether the network is conditioned on the semantic map."""
        return self.stages[0].use_map

    @property
    def mixed(self) -> bool:
        """Whether a block starts from Eq. 1; otherwise from noise, with the render as a condition."""
        return self.stages[0].mixed


_ALL = (
    Variant(BASE, (Objectives("clean", 0),), "diffusion forcing on noisy histories: initialisation of the others"),
    Variant(IMAGE, (Objectives("clean", 1),), "one frame at a time, no history", history=False),
    Variant("V1", (Objectives("clean", 0),), "diffusion forcing: clean history"),
    Variant("V2", (Objectives("own", 0),), "flow matching on own history"),
    Variant("V3", (Objectives(None, 4),), "perceptual loss only"),
    Variant("V4", (Objectives("own", 1),), "k = 1"),
    Variant("V5", (Objectives("own", 4, use_map=False),), "no map"),
    Variant("V6", (Objectives("own", 4, mixed=False),), "from noise, render as a condition"),
    Variant("V7", (Objectives("own", 0), Objectives(None, 4)), "two stages in sequence"),
    Variant("V8", (Objectives("redenoised", 4),), "history noised and denoised again"),
    Variant("V9", (Objectives("own", 4),), "OneFixer"),
)
VARIANTS: Mapping[str, Variant] = MappingProxyType({variant.name: variant for variant in _ALL})


def variant_of(name: str) -> Variant:
    """Return a variant by its name.

    Raises:
        InputError: No such variant.
    """
    return lookup(name, VARIANTS)


def lookup(name: str, known: Mapping[str, V]) -> V:
    """Return one of the known variants, of whichever generator.

    Raises:
        InputError: No such variant.
    """
    if name not in known:
        raise InputError("choosing what to train", f"variant {name!r}", "no such variant", f"choose one of {', '.join(known)}")
    return known[name]
