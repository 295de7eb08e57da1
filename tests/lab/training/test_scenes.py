"""Scenes of the splits: apart by seed and, for the unseen test, by family, look and damage; all of
them can be driven.
"""

import itertools
from dataclasses import fields

import pytest
import yaml

from alpasim_plugin.core.geometry import speeds
from alpasim_plugin.lab.training.held_out import HELD_OUT, held_out_parts
from alpasim_plugin.lab.training.scene_families import KNOWN_FAMILIES
from alpasim_plugin.lab.training.scene_families_unseen import UNSEEN_FAMILIES
from alpasim_plugin.lab.training.scene_looks import KNOWN_DAMAGE, UNSEEN_DAMAGE
from alpasim_plugin.lab.training.scenes import DRAWS, SPLITS, draw_spec, write_scenes
from scenarios.load import load_scenario
from tests.examples import first_of

DRAWN = 60
ALL = [(split, family) for split in ("train", "test-unseen") for family in SPLITS[split].families]  # type: ignore[index]


def drawn(split):
    families = list(SPLITS[split].families)
    return [draw_spec(split, families[i % len(families)], f"s{i}", i, 6.0) for i in range(DRAWN)]


def test_seeds_of_splits_do_not_meet():
    ranges = sorted((r.first_seed, r.first_seed + 10 * r.count * DRAWS) for r in SPLITS.values())
    assert all(a[1] <= b[0] for a, b in itertools.pairwise(ranges))


def drawn_for(split):
    """Return the first drawn specification of every scene of a split."""
    recipe = SPLITS[split]
    families = list(recipe.families)
    specs = []
    for i in range(recipe.count):
        family = families[i % len(families)]
        scene_id = f"{split}-{family}-{i:03d}"
        seed = recipe.first_seed + i * DRAWS
        specs.append(draw_spec(split, family, scene_id, seed, recipe.duration_s))
    return specs


def test_the_fixers_train_on_no_part_that_is_held_out():
    assert not set(KNOWN_FAMILIES) & set(UNSEEN_FAMILIES)
    for split in ("train", "val", "test-known", "beside-known"):
        held_out = {spec["scene_id"]: held_out_parts(spec) for spec in drawn_for(split)}
        assert {name: parts for name, parts in held_out.items() if parts} == {}
    labels = {actor.get("label", "car") for spec in drawn("train") for actor in spec["actors"]}
    assert {"car", "truck", "bus", "motorcycle", "cyclist", "pedestrian"} <= labels


@pytest.mark.parametrize("split", ["test-unseen", "beside-unseen"])
def test_every_unseen_scene_has_a_part_that_is_held_out_and_together_they_have_all(split):
    parts = [held_out_parts(spec) for spec in drawn_for(split)]
    assert all(parts)
    assert {name for names in parts for name in names} == set(HELD_OUT)


@pytest.mark.parametrize("lanes", ["lanes_forward", "lanes_backward", "cross_lanes"])
def test_a_junction_is_held_out_from_three_lanes_an_arm_on(lanes):
    """Two lanes an arm are in training: `composed` and `junction_straight` draw them."""
    for count, is_held_out in ((2, False), (3, True)):
        road = {"segments": [{"kind": "intersection"}]}
        (road if lanes != "cross_lanes" else road["segments"][0])[lanes] = count
        parts = held_out_parts({"road": road, "actors": []})
        assert parts == ["junction with three lanes an arm"] * is_held_out


@pytest.mark.parametrize("family", first_of(["cross_left", "cross_right"]))
def test_the_expert_gives_way_to_who_comes_from_a_side(family, tmp_path):
    """Of five drawn junctions the log slows down in some, for one who comes from the named side."""
    slowed = 0
    for seed in range(5):
        spec = draw_spec("three/train", family, f"s{seed}", seed, 9.0)
        assert [camera["name"] for camera in spec["cameras"]] == ["front", "left", "right"]
        for actor in spec["actors"]:
            other = actor["id"].startswith("crosses-other")
            assert (actor["points"][0][3] < 0) == ((family == "cross_left") != other)
        path = tmp_path / f"{seed}.yaml"
        path.write_text(yaml.safe_dump(spec))
        driven = speeds(load_scenario(path).ego_log)
        slowed += driven.min() < 0.6 * driven[0]
    assert slowed >= 1


def test_every_unseen_scene_is_damaged_beyond_some_range_of_training():
    def beyond(damage):
        names = [f.name for f in fields(KNOWN_DAMAGE) if f.name in damage and f.name != "shift_m"]
        return any(
            not low <= damage[name] <= high
            for name in names
            for low, high in [getattr(KNOWN_DAMAGE, name)]
        )

    unseen, train = (
        [spec["degradation"] for spec in drawn(split)] for split in ("test-unseen", "train")
    )
    assert all(beyond(damage) for damage in unseen)
    assert not any(beyond(damage) for damage in train)
    cycles = [abs(d["shift_m"]) for d in unseen if d["kind"] == "cycle"]
    assert cycles
    assert min(cycles) > KNOWN_DAMAGE.shift_m[1]
    assert len(UNSEEN_DAMAGE) == 4


@pytest.mark.parametrize(("split", "family"), ALL)
def test_draws_repeat_and_differ_by_seed(split, family):
    one, again, other = (draw_spec(split, family, "s", seed, 10.0) for seed in (3, 3, 4))
    assert one == again
    assert one["road"] != other["road"]
    assert one["degradation"] != other["degradation"]


def test_scenes_can_be_driven_and_files_are_kept(tmp_path):
    paths = [
        *write_scenes(tmp_path, "train", 2, 2.0),
        *write_scenes(tmp_path, "test-unseen", 1, 2.0),
    ]
    assert [p.parent.name for p in paths] == ["train", "train", "test-unseen"]
    scenario = load_scenario(paths[0])
    assert scenario.end_us - scenario.start_us == 2_000_000
    assert scenario.degradation.views_per_s != 6.0
    paths[0].write_text(paths[0].read_text() + "# touched\n")
    list(write_scenes(tmp_path, "train", 1, 2.0))
    assert paths[0].read_text().endswith("# touched\n")


@pytest.mark.slow
@pytest.mark.parametrize("split", list(SPLITS))
def test_every_family_can_be_driven(split, tmp_path):
    paths = list(
        write_scenes(tmp_path, split, len(SPLITS[split].families), SPLITS[split].duration_s)
    )
    assert {p.stem.rsplit("_", 1)[0] for p in paths} == set(SPLITS[split].families)
