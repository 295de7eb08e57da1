"""The paper's appearance experiment: OneFixer's start and objective, targets in four styles, a
learned prompt for each.

Four times OneFixer's updates, so that every style sees as many clips as OneFixer does.
"""

from __future__ import annotations

from alpasim_plugin.block_fixers.settings import CLEAR, STYLES
from alpasim_plugin.lab.training.recipes.recipe import Recipe, Stage
from alpasim_plugin.lab.training.styled_rollout import StyledRollout
from alpasim_plugin.lab.training.trainer import PartSchedule

NAME = "appearance"
PROMPT_RATE = (
    10.0  # a prompt is 64 numbers of unit variance, and only the clips of its style move it
)

APPEARANCE = Recipe(
    NAME,
    "night, fog and snow by learned prompts, from the clear render",
    (
        Stage(
            NAME,
            StyledRollout(),
            share=len(STYLES),
            trained={"dit": PartSchedule(), "prompt": PartSchedule(rate=PROMPT_RATE)},
        ),
    ),
    deployed={"prompt": CLEAR},
)
