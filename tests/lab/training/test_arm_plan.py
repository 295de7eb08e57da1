"""What the comparison's arms have in common, in what order it is made, and how equal time divides
it; nothing is trained.
"""

from __future__ import annotations

import pickle
from dataclasses import replace

import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.training.arms.budget import in_equal_time, related
from alpasim_plugin.lab.training.arms.plan import Plan, comparison, plan, training_names
from alpasim_plugin.lab.training.recipes.recipe import Recipe
from alpasim_plugin.lab.training.recipes.registry import recipe_of
from alpasim_plugin.lab.training.snapshots import snapshot_steps

ALL = comparison()
NAMES = training_names(ALL)
SECONDS = {name: 0.5 + 0.25 * i for i, name in enumerate(sorted(set(NAMES.values())))}
UNIT = 100


def names(found: Plan) -> list[str]:
    return [training.name for training in found.trainings]


def minutes_of(recipe: Recipe) -> float:
    return (
        sum(
            stage.updates(UNIT) * SECONDS[NAMES[recipe.name, stage.name]] for stage in recipe.stages
        )
        / 60
    )


def test_every_training_comes_behind_what_it_starts_from_and_once() -> None:
    found = plan(ALL, [recipe.name for recipe in ALL])
    made: set[str] = set()
    for training in found.trainings:
        assert set(training.after) <= made, training.name
        assert training.name not in made
        made.add(training.name)
    assert names(found)[:3] == ["initial/base", "initial/base-bi", "V9"]
    assert set(found.arms) <= made
    assert sum(len(recipe.stages) for recipe in ALL) + 2 - len(made) == 7, (
        "stages that some arms have in common"
    )


@pytest.mark.parametrize(
    ("arm", "trainings"),
    [
        ("V9", ("V9",)),
        ("self-forcing", ("self-forcing/teacher", "omnidreams", "self-forcing")),
        ("one-forcing", ("self-forcing/teacher", "omnidreams", "one-forcing")),
        ("artifixer", ("artifixer-pre/bidirectional", "artifixer-pre", "artifixer")),
        ("harmonizer-temporal-teacher", ("harmonizer", "harmonizer-temporal-teacher")),
    ],
)
def test_equal_stages_are_one_training_with_the_folder_that_it_has_in_the_whole_comparison(
    arm: str, trainings: tuple[str, ...]
) -> None:
    alone = plan(ALL, [arm])
    assert alone.arms == {arm: trainings}
    assert set(names(alone)) - {"initial/base", "initial/base-bi"} == set(trainings)


def test_given_initial_networks_are_not_trained() -> None:
    assert names(plan(ALL, ["V9", "self-forcing"], ["base", "base-bi"])) == [
        "V9",
        "self-forcing/teacher",
        "omnidreams",
        "self-forcing",
    ]
    with pytest.raises(InputError, match="no such arm"):
        plan(ALL, ["V10"])
    with pytest.raises(InputError, match="no initial network"):
        plan(ALL, ["V9"], ["student"])


@pytest.mark.parametrize(
    "change",
    [
        {"share": 2.0},
        {"latents": 3},
        {"decay": "constant"},
        {"always_float32": True},
        {"objective": replace(recipe_of("self-forcing").stages[1].objective, shift=2.0)},  # type: ignore[type-var]
        {"start": {"dit": "init-bi.dit"}},
    ],
    ids=lambda change: next(iter(change)),
)
def test_a_stage_that_differs_is_a_training_of_its_own(change: dict[str, object]) -> None:
    recipe = recipe_of("self-forcing")
    teacher, student, dmd = recipe.stages
    other = replace(recipe, stages=(teacher, replace(student, **change), dmd))  # type: ignore[arg-type]
    changed = tuple(other if one.name == recipe.name else one for one in ALL)
    assert plan(changed, ["self-forcing"]).arms["self-forcing"][1] == "self-forcing/student"
    assert plan(changed, ["one-forcing"]).arms["one-forcing"][1] == "omnidreams"


def test_every_arm_has_equal_core_minutes_and_related_ones_still_share() -> None:
    given = in_equal_time(ALL, NAMES, SECONDS, 30, UNIT)
    for recipe in given:
        assert minutes_of(recipe) == pytest.approx(30, abs=SECONDS[recipe.name] / 60), recipe.name
    found = plan(given, [recipe.name for recipe in given]).arms
    assert (
        found["self-forcing"][:2]
        == found["one-forcing"][:2]
        == ("self-forcing/teacher", "self-forcing/student")
    )
    assert found["artifixer"][0] == found["artifixer-pre"][0] == "artifixer-pre/bidirectional"


@pytest.mark.parametrize(
    "chosen", [["self-forcing"], ["artifixer-pre"], ["V9", "harmonizer-temporal"]]
)
def test_a_part_of_the_comparison_gets_the_updates_of_the_whole(chosen: list[str]) -> None:
    whole = {recipe.name: recipe for recipe in in_equal_time(ALL, NAMES, SECONDS, 30, UNIT)}
    for recipe in in_equal_time(related(ALL, chosen), NAMES, SECONDS, 30, UNIT):
        assert [stage.updates(UNIT) for stage in recipe.stages] == [
            stage.updates(UNIT) for stage in whole[recipe.name].stages
        ]


def test_a_time_without_an_update_for_the_last_stage_is_refused() -> None:
    with pytest.raises(InputError, match="give more --minutes"):
        in_equal_time(related(ALL, ["self-forcing"]), NAMES, SECONDS, 0.05, UNIT)


def test_trainings_can_be_sent_to_another_process() -> None:
    for training in plan(ALL, [recipe.name for recipe in ALL]).trainings:
        assert pickle.loads(pickle.dumps(training)).name == training.name


def test_one_forcing_alone_is_always_in_float32() -> None:
    assert [
        (recipe.name, stage.name)
        for recipe in ALL
        for stage in recipe.stages
        if stage.always_float32
    ] == [("one-forcing", "dmd")]


def test_snapshots_are_at_equal_intervals() -> None:
    assert sorted(snapshot_steps(20, 4)) == [5, 10, 15, 20]
    assert sorted(snapshot_steps(3, 8)) == [1, 2, 3]
    assert snapshot_steps(20, 0) == frozenset()
