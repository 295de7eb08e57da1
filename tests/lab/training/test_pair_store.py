"""Pairs on disk: whole or not there, readable while more are written, refused when damaged."""

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.training.pair_store import (
    CHANNELS,
    PairDataset,
    PairSequence,
    is_made,
    write_sequence,
)
from tests.interrupted_folder import kill_between_renames
from tests.lab.training.pair_files import make, pair


def test_sequence_comes_back_as_memory_maps_with_every_value(tmp_path):
    clip = make(tmp_path).clip
    assert len(clip) == 12
    for i in (0, 7, 11):
        for name, value in pair(i)._asdict().items():
            np.testing.assert_array_equal(getattr(clip, name)[i], value)
    assert all(isinstance(getattr(clip, name), np.memmap) for name in CHANNELS)
    with pytest.raises(ValueError, match="read-only"):
        clip.rgb_gt[0, 0, 0] = 1


def test_failure_in_the_middle_leaves_nothing_and_keeps_what_was_there(tmp_path):
    before = make(tmp_path)

    def breaks():
        yield pair(0)
        raise RuntimeError("renderer fell over")

    with pytest.raises(RuntimeError):
        write_sequence(before.folder, breaks(), 9, {})
    assert [p.name for p in before.folder.parent.iterdir()] == ["a"]
    assert len(PairSequence(before.folder).clip) == 12


def test_dataset_sees_finished_sequences_only_and_new_ones_after_refresh(tmp_path):
    make(tmp_path, name="b")
    unfinished = tmp_path / "train" / ".c.1.part"
    unfinished.mkdir()
    dataset = PairDataset(tmp_path, "train")
    first = dataset.sequences[0].clip
    make(tmp_path, name="a")
    dataset.refresh()
    assert [s.name for s in dataset.sequences] == ["a", "b"]
    assert dataset.sequences[1].clip is first
    with pytest.raises(InputError):
        PairDataset(tmp_path, "val")


@pytest.mark.parametrize("reader", ["dataset", "is made"])
def test_a_sequence_whose_replacement_was_killed_is_still_there(tmp_path, reader):
    sequence = make(tmp_path)
    dataset = PairDataset(tmp_path, "train")
    kill_between_renames(sequence.folder)
    if reader == "dataset":
        dataset.refresh()
        assert [s.name for s in dataset.sequences] == ["a"]
        assert len(PairDataset(tmp_path, "train").sequences[0].clip) == 12
    else:
        assert is_made(sequence.folder, {"scene_id": "a"})
        assert not is_made(sequence.folder, {"scene_id": "b"})


def test_a_sequence_that_was_made_again_is_the_new_one_after_refresh(tmp_path):
    make(tmp_path)
    dataset = PairDataset(tmp_path, "train")
    assert len(dataset.sequences[0].clip) == 12
    make(tmp_path, frames=7)
    dataset.refresh()
    assert dataset.sequences[0].info["frames"] == 7
    assert len(dataset.sequences[0].clip) == 7


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: (f / "sdmap.npy").unlink(), "sdmap.npy"),
        (lambda f: np.save(f / "rgb_gt.npy", np.zeros((3, 8, 8, 3))), "float64 with 4 axes"),
        (
            lambda f: np.save(f / "rgb_input.npy", np.zeros((12, 8, 8, 3), dtype=np.uint8)),
            "rgb_input is",
        ),
        (
            lambda f: np.save(f / "t_us.npy", np.zeros(0, dtype=np.int64)),
            "no frame that every channel has",
        ),
        (lambda f: (f / "opacity.npy").write_bytes(b"\x93NUMPY\x01\x00"), "opacity.npy"),
    ],
)
def test_damaged_channel_is_named(tmp_path, damage, message):
    folder = make(tmp_path).folder
    damage(folder)  # type: ignore[operator]
    with pytest.raises(InputError, match=message):
        _ = PairSequence(folder).clip
