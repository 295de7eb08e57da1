"""The frozen test scenes: what is drawn today is what was frozen, and any change is noticed."""

import json
from dataclasses import asdict

import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.atomic import write_json
from alpasim_plugin.lab.training.frozen_scenes import (
    RECORD,
    check_scenes,
    hash_scenes,
)
from alpasim_plugin.lab.training.scenes import SPLITS, TEST_SPLITS, write_scenes


def freeze(scenes, record):
    frozen = {split: asdict(hash_scenes(scenes / split)) for split in TEST_SPLITS}
    write_json(record, frozen)


@pytest.fixture
def scenes(tmp_path):
    for split in TEST_SPLITS:
        (tmp_path / "scenes" / split).mkdir(parents=True)
        for name in ("a", "b"):
            (tmp_path / "scenes" / split / f"{name}.yaml").write_text(f"scene_id: {split}-{name}\n")
    return tmp_path / "scenes"


def test_frozen_scenes_pass_their_check(scenes, tmp_path):
    record = tmp_path / "record.json"
    freeze(scenes, record)
    checked = check_scenes(scenes, record)
    assert len({split.sha256 for split in checked.values()}) == len(TEST_SPLITS)


def test_a_changed_a_missing_and_a_further_scene_are_each_noticed(scenes, tmp_path):
    record = tmp_path / "record.json"
    one = scenes / TEST_SPLITS[1] / "b.yaml"
    freeze(scenes, record)
    before = one.read_text()
    one.write_text(before + "seed: 1\n")
    with pytest.raises(InputError):
        check_scenes(scenes, record)
    one.unlink()
    with pytest.raises(InputError):
        check_scenes(scenes, record)
    one.write_text(before)
    (one.parent / "c.yaml").write_text("scene_id: c\n")
    with pytest.raises(InputError):
        check_scenes(scenes, record)


def test_a_record_that_cannot_be_read_is_said(scenes, tmp_path):
    for text in ("{", '{"test-known": {"sha256": "x"}}', "[1]"):
        (tmp_path / "record.json").write_text(text)
        with pytest.raises(InputError):
            check_scenes(scenes, tmp_path / "record.json")


def test_first_scene_of_each_split_is_drawn_as_it_was_frozen(tmp_path):
    known = json.loads(RECORD.read_text())
    for split in TEST_SPLITS:
        assert len(known[split]["scenes"]) == SPLITS[split].count
        (path,) = write_scenes(tmp_path, split, 1, SPLITS[split].duration_s)
        assert hash_scenes(path.parent).scenes[path.stem] == known[split]["scenes"][path.stem]


def test_other_scenes_than_the_shipped_ones_are_refused(scenes):
    assert run_command(["train", "scenes", "--out", str(scenes), "--check"]) != 0


@pytest.mark.slow
def test_all_test_scenes_are_drawn_as_they_were_frozen(tmp_path):
    for split in TEST_SPLITS:
        list(write_scenes(tmp_path, split, SPLITS[split].count, SPLITS[split].duration_s))
    check_scenes(tmp_path)
