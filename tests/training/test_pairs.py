"""How a sequence of pairs is drawn and made: real renderers on a tiny street."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from alpasim_plugin.errors import InputError
from alpasim_plugin.renderers.gaussian import clear_cache
from alpasim_plugin.training.pair_store import PairSequence
from alpasim_plugin.training.pairs import FIT_SHARES, MOVING_M, PairRecipe, draw_degradation, lateral_offsets, make_sequence
from alpasim_plugin.types import Degradation, Environment, Scenario
from tests.gaussians.scene_maps import parked, straight, with_camera

EMPTY = Environment(buildings=0.0, trees_per_100m=0.0, poles_spacing_m=0.0)


@pytest.fixture
def street(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Scenario:
    """Give 0.4 s of a bare street, 64 x 36 pixels, with a cache of its own."""
    monkeypatch.setenv("SIMRUN_CACHE", str(tmp_path / "cache"))
    scenario = with_camera(straight(actors=(parked("car", 22.0, -1.8),), environment=EMPTY), 64, 36)
    log = scenario.ego_log
    log = replace(log, t_us=log.t_us[:4], xyz=log.xyz[:4], quat=log.quat[:4])
    return replace(scenario, ego_log=log, end_us=400_000)


def draws(street: Scenario) -> list[tuple[Degradation, float]]:
    recipe, out = PairRecipe(), []
    for seed in range(60):
        amount = draw_degradation(street, recipe, seed)
        out.append((amount, float(np.abs(lateral_offsets(replace(street, degradation=amount), recipe, seed)).max())))
    return out


def test_half_are_reconstructions_seen_from_beside_the_path_and_half_cycle_renders_on_it(street: Scenario) -> None:
    drawn = draws(street)
    kinds = Counter(amount.kind for amount, _ in drawn)
    assert set(kinds) == {"reconstruction", "cycle"}
    assert 18 <= kinds["cycle"] <= 42
    assert all(size == 0 for amount, size in drawn if amount.kind == "cycle")
    aside = [size for amount, size in drawn if amount.kind == "reconstruction"]
    assert max(aside) > 0.4
    assert max(aside) <= 1.5
    assert {amount.shift_m for amount, _ in drawn if amount.kind == "cycle"} == {1.0, -1.0}
    assert all(FIT_SHARES[0] <= amount.share <= FIT_SHARES[1] for amount, _ in drawn)
    assert len({amount.share for amount, _ in drawn}) > 8


def test_draw_depends_on_scene_and_seed_alone(street: Scenario) -> None:
    again, other = draws(street), draws(replace(street, scene_id="another"))
    assert draws(street) == again != other


def test_as_set_takes_what_the_scenario_says(street: Scenario) -> None:
    assert draw_degradation(street, PairRecipe(degradation="as-set"), 0) == street.degradation


def test_sequence_holds_both_renders_opacity_map_and_how_it_was_made(street: Scenario, tmp_path: Path) -> None:
    recipe, folder = PairRecipe(degradation="as-set"), tmp_path / "pairs" / "val" / "s"
    cycle = replace(street, degradation=Degradation("cycle", share=0.1))
    assert make_sequence(cycle, folder, recipe, 0, split="val", family="street")
    sequence = PairSequence(folder)
    clip = sequence.clip
    assert len(clip) == 5
    assert clip.rgb_gt.shape == (5, 36, 64, 3)
    error = np.abs(clip.rgb_input[0].astype(float) - clip.rgb_gt[0]).mean()
    assert 1.0 < error < 40.0
    assert clip.opacity[0, :4].mean() > 240  # the sky is filled
    assert sequence.info["degradation"]["kind"] == "cycle"
    assert sequence.info["moving_actors"] == 0
    assert not make_sequence(cycle, folder, recipe, 0, split="val", family="street")
    clear_cache()
    other = replace(street, degradation=Degradation("surrogate"))
    assert make_sequence(other, folder, recipe, 0, split="val", family="street")
    assert json.loads((folder / "sequence.json").read_text())["degradation"]["kind"] == "surrogate"


def test_actors_whose_tracks_are_long_count_as_moving(street: Scenario, tmp_path: Path) -> None:
    car = street.actors[0]
    track = replace(car.track, xyz=car.track.xyz + np.array([[0.0, 0, 0], [MOVING_M + 1, 0, 0]]))
    moving = replace(street, actors=(car, replace(car, actor_id="moves", track=track)), degradation=Degradation("none"))
    folder = tmp_path / "pairs" / "val" / "s"
    make_sequence(moving, folder, PairRecipe(degradation="as-set"), 0, split="val", family="street")
    assert PairSequence(folder).info["moving_actors"] == 1
    assert PairSequence(folder).info["actors"] == 2


def test_unknown_camera_names_the_known_ones(street: Scenario, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"has \['front'\]"):
        make_sequence(street, tmp_path / "x", PairRecipe(camera="rear"), 0, split="val", family="street")
