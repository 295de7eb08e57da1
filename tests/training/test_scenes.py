"""Scenes of the splits: apart by seed and, for the test, by family; all of them can be driven."""

import itertools
from pathlib import Path

import pytest
import yaml

from alpasim_plugin.training.scene_families import FAMILIES, TEST_FAMILIES, TRAIN_FAMILIES, draw_spec
from alpasim_plugin.training.scenes import DEFAULT_COUNTS, DRAWS, FIRST_SEED, write_scenes
from scenarios.load import load_scenario


def test_families_of_training_and_test_are_disjoint_and_all_known() -> None:
    assert not set(TRAIN_FAMILIES) & set(TEST_FAMILIES)
    assert set(FAMILIES) == set(TRAIN_FAMILIES) | set(TEST_FAMILIES)


def test_seeds_of_splits_do_not_meet() -> None:
    ranges = [(FIRST_SEED[s], FIRST_SEED[s] + DEFAULT_COUNTS[s] * DRAWS) for s in FIRST_SEED]
    assert all(a[1] <= b[0] for a, b in itertools.pairwise(ranges))


@pytest.mark.parametrize("family", FAMILIES)
def test_draws_repeat_and_differ_by_seed(family: str) -> None:
    one, again, other = (draw_spec(family, "s", seed, 10.0) for seed in (3, 3, 4))
    assert one == again
    assert one["road"] != other["road"]


def test_every_family_can_be_driven_and_files_are_kept(tmp_path: Path) -> None:
    paths = [*write_scenes(tmp_path, "train", 5, 6.0), *write_scenes(tmp_path, "test", 5, 6.0)]
    assert {p.stem.rsplit("_", 1)[0] for p in paths} == set(FAMILIES)
    for path in paths:
        scenario = load_scenario(path)
        assert scenario.end_us - scenario.start_us == 6_000_000
    paths[0].write_text(paths[0].read_text() + "# touched\n")
    list(write_scenes(tmp_path, "train", 1, 6.0))
    assert paths[0].read_text().endswith("# touched\n")
    assert yaml.safe_load(paths[1].read_text())["tags"][0] == "training"
