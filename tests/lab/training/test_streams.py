"""Training streams: a pure function of the update's number, frames in a row within an episode,
identity where it is promised.
"""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.training.streams import (
    KINDS,
    StreamShares,
    TrainingStreams,
    there_and_back,
)
from tests.lab.training.pair_files import make

ALL_KINDS = StreamShares(0.25, 0.25, 0.25, 0.25)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("streams")
    for i, frames in enumerate((12, 7, 5)):
        make(folder / "pairs", name=f"street_{i:03d}", frames=frames, height=40, width=64)
    make(folder / "video", name="drive", frames=9, height=48, width=48)
    make(folder / "video", split="held-out", name="drive", frames=9, height=48, width=48)
    return folder


def streams(root, **settings):
    chosen = {
        "batch": 3,
        "frames": 2,
        "crop": (32, 48),
        "episode": 4,
        "shares": ALL_KINDS,
    } | settings
    return TrainingStreams(root / "pairs", root / "video", **chosen)  # type: ignore[arg-type]


def equal(a, b):
    return all(torch.equal(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))


def test_update_is_a_pure_function_of_its_number_and_the_seed(root):
    one = streams(root)
    other = streams(root)
    forward = [one.update(i) for i in range(9)]
    for i in (7, 0, 3, 8):  # out of order, by another object
        assert equal(other.update(i), forward[i])
    assert not equal(streams(root, seed=1).update(7), forward[7])


def test_frames_follow_one_another_across_updates(root):
    made = streams(root, shares=StreamShares(1, 0, 0, 0))
    for slot in range(3):
        for i in range(1, 30):
            (episode, at), (before, _) = made.episode_of(slot, i), made.episode_of(slot, i - 1)
            if at == 0:
                continue
            assert replace(episode, levels=before.levels, references=before.references) == before
            length = len(episode.sequence.clip)
            raw = episode.start + episode.step * np.arange(at * 2 - 1, at * 2 + 1)
            assert np.abs(np.diff(there_and_back(raw, length))).max() <= abs(episode.step)


def test_all_kinds_are_drawn_and_only_damaged_ones_differ_from_their_target(root):
    made = streams(root)
    seen = set()
    for i in range(24):
        batch = made.update(i)
        for slot, kind in enumerate(batch.kind.tolist()):
            name = KINDS[kind]
            seen.add(name)
            same = torch.equal(batch.render[slot], batch.target[slot])
            assert same == (name in ("identity", "video"))
            if same:
                assert (batch.opacity[slot] == 1).all()
    assert seen == set(KINDS)


def test_held_out_video_is_never_shown(root):
    made = streams(root, shares=StreamShares(0, 0, 0.5, 0.5))
    shown = {made.episode_of(slot, i)[0].sequence.folder for slot in range(3) for i in range(60)}
    assert shown == {root / "video" / "train" / "drive"}


@pytest.mark.parametrize(
    ("settings", "found"),
    [
        ({"crop": (30, 48)}, "no batch"),
        ({"frames": 0}, "no batch"),
        ({"crop": (48, 48)}, "smaller than the crop"),
    ],
)
def test_what_makes_no_batch_is_refused(root, settings, found):
    with pytest.raises(InputError, match=found):
        streams(root, **settings)
