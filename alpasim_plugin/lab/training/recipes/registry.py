"""All recipes by name."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import MappingProxyType
from typing import get_type_hints

import yaml
from pydantic import TypeAdapter

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.training.flow_matching import FlowMatching
from alpasim_plugin.lab.training.generator import SharedRollout
from alpasim_plugin.lab.training.recipes.ablation import ABLATION
from alpasim_plugin.lab.training.recipes.causal_arms import CAUSAL_ARMS
from alpasim_plugin.lab.training.recipes.image_arms import IMAGE_ARMS
from alpasim_plugin.lab.training.recipes.recipe import Attention, Objective, Recipe, whole_clip


def by_name(recipes: Iterable[Recipe]) -> Mapping[str, Recipe]:
    """Return recipes by their names.

    Raises:
        InputError: Two of one name.
    """
    recipe_of_name: dict[str, Recipe] = {}
    for recipe in recipes:
        if recipe.name in recipe_of_name:
            raise InputError(
                f"{recipe.name}: a recipe of that name already",
                "choose another name",
            )
        recipe_of_name[recipe.name] = recipe
    return MappingProxyType(recipe_of_name)


RECIPES = by_name((*ABLATION, *CAUSAL_ARMS, *IMAGE_ARMS))


def recipe_of(name: str) -> Recipe:
    """Return a recipe by its name.

    Raises:
        InputError: No such recipe.
    """
    if name not in RECIPES:
        raise InputError(
            f"recipe {name!r}: no such recipe",
            f"choose one of {', '.join(RECIPES)}",
        )
    return RECIPES[name]


def with_perceptual_weight(recipe: Recipe, weight: float) -> Recipe:
    """Return a recipe with another weight lambda of the shared rollouts' perceptual term; others
    keep their papers' weights.

    Raises:
        InputError: A negative weight.
    """

    def weighted(objective: Objective) -> Objective:
        return objective.weighted(weight) if isinstance(objective, SharedRollout) else objective

    return _with_objectives(recipe, weighted)


def with_source_share(recipe: Recipe, share: float) -> Recipe:
    """Return a recipe with another share of positions at the source, where its flow matching has
    such a share.
    """

    def shared(objective: Objective) -> Objective:
        return (
            replace(objective, source_share=share)
            if isinstance(objective, FlowMatching) and objective.source_share
            else objective
        )

    return _with_objectives(recipe, shared)


def with_objective(recipe: Recipe, texts: Sequence[str]) -> Recipe:
    """Return a recipe with other fields of its objectives: ``KEY=VALUE`` in every stage that has
    it, ``STAGE.KEY=VALUE`` in one.

    Example:
        >>> with_objective(recipe_of("self-forcing"), ["dmd.steps=4"]).stages[-1].objective.steps
        4

    Raises:
        InputError: Not KEY=VALUE, a field that no stage has, or a value of another type.
    """
    for text in texts:
        recipe = _with_field(recipe, text)
    return recipe


def _with_field(recipe: Recipe, text: str) -> Recipe:
    path, equals, value = text.partition("=")
    stage_name, dot, key = path.rpartition(".")
    fields = {stage.name: get_type_hints(type(stage.objective)) for stage in recipe.stages}
    chosen = [
        name for name, names in fields.items() if key in names and (not dot or name == stage_name)
    ]
    option = f"--objective {text}"
    if not equals or not chosen:
        names = sorted({f"{name}.{field}" for name, types in fields.items() for field in types})
        raise InputError(
            f"{option}: no such field in recipe {recipe.name}",
            f"write KEY=VALUE with one of {', '.join(names)}",
        )
    try:
        read = TypeAdapter(fields[chosen[0]][key]).validate_python(yaml.safe_load(value))
    except (ValueError, yaml.YAMLError) as error:
        raise InputError(
            f"{option}: not a value of {key}: {str(error).splitlines()[-1].strip()}",
            "write it as YAML",
        ) from error
    stages = (
        replace(s, objective=replace(s.objective, **{key: read})) if s.name in chosen else s  # type: ignore[type-var]
        for s in recipe.stages
    )
    return replace(recipe, stages=tuple(stages))


def with_attention(
    recipe: Recipe, block: int | None = None, window: int | None = None, sink: int | None = None
) -> Recipe:
    """Return a recipe whose causal stages have another block, window or sink in latents; None
    leaves the recipe's.
    """
    if block is None and window is None and sink is None:
        return recipe

    def chosen(attention_of: Callable[[int], Attention], latents: int) -> Attention:
        attention = attention_of(latents)
        return Attention(
            attention.block_latents if block is None else block,
            attention.window if window is None else window,
            attention.sink if sink is None else sink,
            attention.history,
        )

    stages = (
        stage
        if stage.attention is whole_clip
        else replace(stage, attention=partial(chosen, stage.attention))
        for stage in recipe.stages
    )
    return replace(recipe, stages=tuple(stages))


def _with_objectives(recipe: Recipe, change: Callable[[Objective], Objective]) -> Recipe:
    return replace(
        recipe,
        stages=tuple(replace(stage, objective=change(stage.objective)) for stage in recipe.stages),
    )
