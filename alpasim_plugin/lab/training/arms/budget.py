"""Equal core-minutes for every arm: recipes with other shares of the updates.

Every arm gets ``minutes`` of processor time for all of its own stages, in the proportions of its
recipe; the initial networks do not count. A stage before the last that several arms have stays one
training: it takes the fewest updates that any of them has for it, it counts for each, and each
one's last stage takes what is left.
"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import replace

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.training.arms.plan import identity
from alpasim_plugin.lab.training.recipes.recipe import Recipe

DOING = "giving arms equal time"


def related(recipes: Sequence[Recipe], chosen: Collection[str]) -> tuple[Recipe, ...]:
    """Return the chosen arms and all that have a stage before the last in common with one: their
    updates depend on one another.
    """
    inner = {
        recipe.name: {identity(recipe, stage) for stage in recipe.stages[:-1]} for recipe in recipes
    }
    found, grew = set(chosen), True
    while grew:
        stages: set[Hashable] = set().union(*(inner[name] for name in found))
        more = {name for name, own in inner.items() if own & stages} - found
        found, grew = found | more, bool(more)
    return tuple(recipe for recipe in recipes if recipe.name in found)


def in_equal_time(
    recipes: Sequence[Recipe],
    names: Mapping[tuple[str, str], str],
    seconds: Mapping[str, float],
    minutes: float,
    unit: int,
) -> tuple[Recipe, ...]:
    """Return the recipes with the shares that give each of them ``minutes``, to within an update.

    Args:
        recipes: `related` ones complete, so that a part of the comparison has the updates of the
            whole.
        names: Trainings of their stages, by the whole comparison's `training_names`.
        seconds: Processor seconds of an update by training.
        minutes: Of each arm.
        unit: Updates of a stage of share 1.

    Raises:
        InputError: An arm whose last stage would have no update.
    """
    updates: dict[str, int] = {}
    for recipe in recipes:
        of = {stage.name: names[recipe.name, stage.name] for stage in recipe.stages}
        own_unit = (
            60 * minutes / sum(stage.share * seconds[of[stage.name]] for stage in recipe.stages)
        )
        for stage in recipe.stages[:-1]:
            mine = max(round(stage.share * own_unit), 1)
            updates[of[stage.name]] = min(updates.get(of[stage.name], mine), mine)
    out = []
    for recipe in recipes:
        *inner, last = (names[recipe.name, stage.name] for stage in recipe.stages)
        left_s = 60 * minutes - sum(updates[name] * seconds[name] for name in inner)
        count = int(left_s / seconds[last])
        if count < 1:
            raise InputError(
                f"{recipe.name} in {minutes:g} minutes: {max(left_s, 0):.0f} s are left for the last stage, whose update takes {seconds[last]:.2g} s",
                "give more --minutes",
            )
        counts = [*(updates[name] for name in inner), count]
        stages = (
            replace(stage, share=n / unit) for stage, n in zip(recipe.stages, counts, strict=True)
        )
        out.append(replace(recipe, stages=tuple(stages)))
    return tuple(out)
