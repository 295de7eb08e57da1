"""What must be trained for the arms of a comparison: every stage once, however many arms have it.

    initial/base, initial/base-bi   the initial networks
    ARM                             an arm's last stage
    ARM/STAGE                       a stage before the last that is no arm's last; ARM is the first of the comparison that has it

Two stages are one training where everything that decides their weights is equal: objective, share
of the updates, attention, what the network sees, trained parts and rates, sizes, and, likewise,
what they start from. Names play no part, nor do settings of the deployment.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.lab.training.recipes.ablation import BASE, BASE_BI, IMAGE
from alpasim_plugin.lab.training.recipes.recipe import INIT, INIT_BI, Recipe, Stage
from alpasim_plugin.lab.training.recipes.registry import RECIPES

FIRST = "V9"
INITIAL: Mapping[str, str] = {
    INIT: BASE,
    INIT_BI: BASE_BI,
}  # weights that stages start from -> recipe that makes them
BUILT_FROM = (
    "dit",
    "vae",
    "decoder",
    "rope_ratios",
    "render_level",
    "opacity_to_decoder",
)  # settings that decide weights
DOING = "planning the arms"


@dataclass(frozen=True)
class Training:
    """One stage to train.

    Args:
        name: Its folder, below that of all arms.
        recipe: The first that has it.
        stage: Of that recipe.
        starts: Names of weights that the stage starts from -> the trainings that make them.
    """

    name: str
    recipe: Recipe
    stage: Stage
    starts: Mapping[str, str]

    @property
    def after(self) -> tuple[str, ...]:
        """Trainings that must be finished before."""
        return tuple(self.starts.values())

    @property
    def is_last(self) -> bool:
        """Whether it makes an arm, or an initial network."""
        return self.stage is self.recipe.stages[-1]


@dataclass(frozen=True)
class Plan:
    """Trainings of some arms.

    Args:
        trainings: In an order in which they can be made, the initial networks first.
        arms: ARM -> the trainings of its stages in their order, without the initial networks.
    """

    trainings: tuple[Training, ...]
    arms: Mapping[str, tuple[str, ...]]


def comparison() -> tuple[Recipe, ...]:
    """Return the recipes of the comparison, the paper's own method first."""
    arms = [recipe for name, recipe in RECIPES.items() if name not in (BASE, BASE_BI, IMAGE)]
    return tuple(sorted(arms, key=lambda recipe: recipe.name != FIRST))


def plan(recipes: Sequence[Recipe], chosen: Collection[str], given: Collection[str] = ()) -> Plan:
    """Return the trainings of the chosen arms; an arm that another one starts from is trained as
    well.

    Args:
        recipes: All of the comparison, of which folders and sharing are a function: a part has the
            folders of the whole.
        chosen: Names of arms.
        given: Initial networks that need no training, by recipe (``base``).

    Raises:
        InputError: No such arm, or no such initial network.
    """
    known = {recipe.name: recipe for recipe in recipes}
    if unknown := sorted(set(chosen) - set(known)):
        raise InputError(f"{', '.join(unknown)}: no such arm", f"name some of {', '.join(known)}")
    if unknown := sorted(set(given) - set(INITIAL.values())):
        raise InputError(
            f"{', '.join(unknown)}: no initial network", f"give {' or '.join(INITIAL.values())}"
        )
    every = {training.name: training for training in _trainings(recipes)}
    names = training_names(recipes)
    arms = {
        name: tuple(names[name, stage.name] for stage in recipe.stages)
        for name, recipe in known.items()
        if name in chosen
    }
    wanted: dict[str, Training] = {}

    def want(name: str) -> None:
        for before in every[name].after:
            want(before)
        wanted.setdefault(name, every[name])

    for trainings in arms.values():
        for name in trainings:
            want(name)
    left = [
        training
        for name, training in wanted.items()
        if name not in {initial_name(one) for one in given}
    ]
    return Plan(
        tuple(sorted(left, key=lambda training: training.recipe.name not in INITIAL.values())), arms
    )


def initial_name(recipe: str) -> str:
    """Return the training that makes an initial network."""
    return f"initial/{recipe}"


def training_names(recipes: Sequence[Recipe]) -> dict[tuple[str, str], str]:
    """Return the training of every stage of every arm: (ARM, STAGE) -> its name."""
    owners: dict[Hashable, str] = {}
    for recipe in recipes:
        owners.setdefault(identity(recipe, recipe.stages[-1]), recipe.name)
    for recipe in recipes:
        for stage in recipe.stages[:-1]:
            owners.setdefault(identity(recipe, stage), f"{recipe.name}/{stage.name}")
    return {
        (recipe.name, stage.name): owners[identity(recipe, stage)]
        for recipe in recipes
        for stage in recipe.stages
    }


def identity(recipe: Recipe, stage: Stage) -> Hashable:
    """Return all that decides a stage's weights, besides the options of the run."""
    stages = {one.name: one for one in recipe.stages}
    starts = []
    for part, source in sorted(stage.start.items()):
        name, _, of = source.partition(".")
        starts.append((part, of, name if name in INITIAL else identity(recipe, stages[name])))
    settings = fixer_settings(recipe.fixer).model_dump()
    built = tuple((key, repr(settings.get(key))) for key in BUILT_FROM)
    return (
        stage.objective,
        stage.share,
        stage.attention,
        stage.seen,
        tuple(starts),
        tuple(sorted(stage.trained.items(), key=_first)),
        stage.decay,
        stage.last_share,
        stage.latents,
        stage.always_float32,
        built,
    )


def _first(pair: tuple[str, Any]) -> str:
    return pair[0]


def _trainings(recipes: Sequence[Recipe]) -> Iterator[Training]:
    for name in INITIAL.values():
        recipe = RECIPES[name]
        yield Training(initial_name(name), recipe, recipe.stages[0], {})
    names, seen = training_names(recipes), set[str]()
    in_order = [(recipe, stage) for recipe in recipes for stage in recipe.stages]
    # A training belongs to the arm that is named after it, so that its card says so.
    for recipe, stage in sorted(in_order, key=lambda pair: pair[1] is not pair[0].stages[-1]):
        name = names[recipe.name, stage.name]
        if name in seen:
            continue
        seen.add(name)
        starts = {
            one: initial_name(INITIAL[one]) if one in INITIAL else names[recipe.name, one]
            for one in stage.sources
        }
        yield Training(name, recipe, stage, starts)
