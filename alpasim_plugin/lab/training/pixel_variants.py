"""The paper's ablation (OneFixer, Tab. 2a) for the per-frame generator: which terms, on which
history, from which source.

The terms in pixels (picture, perceptual, temporal, grid) take the place of the paper's perceptual
term.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from itertools import accumulate
from types import MappingProxyType
from typing import Any

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.training.pixel_rollout import PixelObjectives

FULL = PixelObjectives()
FLOW_ALONE = PixelObjectives(
    picture=0.0, perceptual=0.0, temporal=0.0, flow=1.0, grid=0.0, choice=0.0
)
PIXELS_ALONE = replace(FULL, flow=0.0)
DEPLOYED = "V9"


@dataclass(frozen=True)
class PixelVariant:
    """One row of the ablation.

    Args:
        name: As in the paper.
        stages: Objectives in sequence.
        about: Short description for tables.
        shares: Parts of the updates that the stages take; they sum to 1.
    """

    name: str
    stages: tuple[PixelObjectives, ...]
    about: str
    shares: tuple[float, ...] = (1.0,)

    def objectives(self, step: int, steps: int) -> PixelObjectives:
        """Return the objectives of update ``step`` of ``steps``."""
        ends = accumulate(self.shares)
        return next(
            (stage for stage, end in zip(self.stages, ends, strict=True) if step < end * steps),
            self.stages[-1],
        )

    def facts(self, steps: int) -> dict[str, Any]:
        """Return what identifies it in a run of ``steps`` updates; the length matters only where it
        moves a border between stages.
        """
        stages = [asdict(stage) for stage in self.stages]
        return {"name": self.name, "stages": stages} | (
            {"shares": self.shares, "steps": steps} if len(stages) > 1 else {}
        )

    def weighted(
        self, perceptual: float, temporal: float, flow: float, grid: float, horizon: int
    ) -> PixelVariant:
        """Return the variant with other weights of the terms that it has, and another k unless it
        is about k.
        """

        def stage_of(stage: PixelObjectives) -> PixelObjectives:
            return replace(
                stage,
                perceptual=perceptual if stage.perceptual else 0.0,
                temporal=temporal if stage.temporal else 0.0,
                flow=flow if stage.flow and stage.in_pixels else stage.flow,
                grid=grid if stage.grid else 0.0,
                horizon=horizon if stage.horizon == FULL.horizon else stage.horizon,
            )

        return replace(self, stages=tuple(map(stage_of, self.stages)))

    @property
    def use_map(self) -> bool:
        """Whether the map is given; otherwise it is black."""
        return self.stages[-1].use_map

    @property
    def holes(self) -> str:
        """Where noise enters the source, as the fixer's setting says it."""
        return {"mixed": "noise", "noise": "everywhere", "render": "render"}[self.stages[-1].source]


_ALL = (
    PixelVariant("V1", (replace(FLOW_ALONE, history="clean"),), "flow matching on clean history"),
    PixelVariant("V2", (FLOW_ALONE,), "flow matching on own history"),
    PixelVariant("V3", (PIXELS_ALONE,), "terms in pixels alone"),
    PixelVariant("V4", (replace(FULL, horizon=1),), "k = 1"),
    PixelVariant("V5", (replace(FULL, use_map=False),), "black map"),
    PixelVariant(
        "V6", (replace(FULL, source="noise"),), "from noise everywhere, render as a condition"
    ),
    PixelVariant(
        "V7", (FLOW_ALONE, PIXELS_ALONE), "flow matching, then terms in pixels", (0.625, 0.375)
    ),
    PixelVariant("V8", (replace(FULL, history="redenoised"),), "history noised and denoised again"),
    PixelVariant(DEPLOYED, (FULL,), "OneFixer"),
    PixelVariant("V9-still", (replace(FULL, source="render"),), "OneFixer, without noise in holes"),
    PixelVariant(
        "V3b-still", (replace(FULL, source="render", history="clean"),), "the same on clean history"
    ),
)
PIXEL_VARIANTS: Mapping[str, PixelVariant] = MappingProxyType(
    {variant.name: variant for variant in _ALL}
)


def pixel_variant(name: str) -> PixelVariant:
    """Return a variant by its name.

    Raises:
        InputError: No such variant.
    """
    if name not in PIXEL_VARIANTS:
        raise InputError(
            f"variant {name!r}: no such variant", f"choose one of {', '.join(PIXEL_VARIANTS)}"
        )
    return PIXEL_VARIANTS[name]
