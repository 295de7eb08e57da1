"""Pairs beyond driving: frozen scenes, the hand that carries the camera, and what is written."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.interiors.places import build_place
from alpasim_plugin.lab.training import transfer_pairs
from alpasim_plugin.lab.training.hand_held import Hand, hand_held
from alpasim_plugin.lab.training.pair_store import PairSequence
from alpasim_plugin.lab.training.transfer_pairs import make_transfer_sequence
from alpasim_plugin.lab.training.transfer_scenes import (
    FAMILIES,
    SPLITS,
    check_frozen,
    freeze,
    transfer_scene,
)

EYE, TARGET = (
    np.array([[0.0, 0, 1.5], [1.0, 0, 1.5], [2.0, 0.5, 1.5]]),
    np.array([[3.0, 0, 1], [4.0, 1, 1], [5.0, 1, 1]]),
)
T_S = np.arange(40) / 10


def test_scenes_are_those_that_were_frozen_and_splits_share_none() -> None:
    check_frozen()
    scenes = {
        split: [transfer_scene(split, i) for i in range(SPLITS[split].count)] for split in SPLITS
    }
    assert {split: len(many) for split, many in scenes.items()} == {"train": 32, "test": 8}
    assert {scene.family for scene in scenes["test"]} == set(FAMILIES)
    assert len({scene.seed for many in scenes.values() for scene in many}) == 40
    assert len({scene.digest for many in scenes.values() for scene in many}) == 40


def test_a_scene_that_is_defined_otherwise_is_named(tmp_path: Path) -> None:
    record = tmp_path / "record.json"
    freeze(record)
    with pytest.raises(InputError, match="it exists"):
        freeze(record)
    entries = json.loads(record.read_text())
    entries["test"]["scenes"]["room_000"] = "0" * 64
    record.write_text(json.dumps(entries))
    with pytest.raises(InputError) as caught:
        check_frozen(record)
    assert "room_000" in caught.value.message


def test_a_hand_is_that_of_its_key_and_two_takes_stay_near_each_other() -> None:
    first, same, other, unkeyed = (
        hand_held(EYE, TARGET, T_S, Hand(), "scene", seed, take)
        for seed, take in ((0, "a"), (0, "a"), (0, "b"), (1, "a"))
    )
    np.testing.assert_array_equal(first, same)
    assert np.abs(first - unkeyed).max() > 1e-3
    apart = np.linalg.norm(first[:, :3, 3] - other[:, :3, 3], axis=1)
    assert 0.02 < apart.max() < 0.5
    np.testing.assert_allclose(
        first[:, :3, :3] @ np.swapaxes(first[:, :3, :3], 1, 2),
        np.tile(np.eye(3), (40, 1, 1)),
        atol=1e-9,
    )
    turn = np.degrees(
        np.arccos(
            np.clip((np.einsum("tij,tij->t", first[1:, :3, :3], first[:-1, :3, :3]) - 1) / 2, -1, 1)
        )
    )
    assert 0.1 < turn.mean() < 4.0  # degrees between frames: all three angles move


def test_without_unrest_the_camera_looks_at_its_target_upright() -> None:
    still = Hand(0.0, 0.0, 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    poses = hand_held(EYE, TARGET, np.array([0.0, 1.0, 2.0]), still, "scene", 0, "a")
    np.testing.assert_allclose(poses[:, :3, 3], EYE, atol=1e-12)
    forward = (TARGET - EYE) / np.linalg.norm(TARGET - EYE, axis=1, keepdims=True)
    np.testing.assert_allclose(poses[:, :3, 2], forward, atol=1e-12)
    np.testing.assert_allclose(poses[:, 2, 0], 0.0, atol=1e-12)  # x is level
    assert (poses[:, 2, 1] < 0).all()  # y points down


def test_a_sequence_has_the_form_of_all_pairs_a_black_map_and_is_made_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(transfer_pairs, "build_place", partial(build_place, coarseness=6.0))
    scene = replace(transfer_scene("test", 1), frames=6)
    folder = tmp_path / "test" / scene.name
    assert make_transfer_sequence(scene, folder)
    assert not make_transfer_sequence(scene, folder)
    sequence = PairSequence(folder)
    clip = sequence.clip
    assert clip.rgb_gt.shape == (6, 144, 256, 3)
    assert not clip.sdmap.any()
    assert sequence.info["family"] == "table"
    assert sequence.info["camera"]["K"][0][0] > 100
    assert 1.0 < np.abs(clip.rgb_gt.astype(int) - clip.rgb_input).mean() < 90.0
    assert clip.opacity.max() > 240
    np.testing.assert_array_equal(np.diff(clip.t_us), 100_000)


@pytest.mark.parametrize("split", ["val", "test,test"])
def test_an_unknown_split_is_refused(
    split: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(["train", "transfer", "--out", str(tmp_path), "--split", split]) == 2
    assert "choose from train, test" in " ".join(capsys.readouterr().err.split())
