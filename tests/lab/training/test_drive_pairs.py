"""Pairs of a recorded street: what was held out is never in the recording, and a folder that exists
is kept.
"""

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.gaussians.files.ply import write_points
from alpasim_plugin.lab.training.drive_pairs import make_drive_pairs
from alpasim_plugin.lab.training.pair_store import PairSequence
from alpasim_plugin.lab.training.photograph_pairs import PhotographRecipe
from alpasim_plugin.lab.training.reference_store import open_references
from tests.pretended_device import pretended_device
from tests.renderers.recorded_drive import recorded_drive

RECIPE = PhotographRecipe(width=64, every=3, steps=2, split="train")


@pytest.fixture
def drive(tmp_path):
    """Give a recorded drive along a road of points."""
    xyz = np.random.default_rng(0).uniform((2, -5, 0), (40, 5, 0.1), (400, 3))
    write_points(tmp_path / "points.ply", xyz, np.full((400, 3), 100, dtype=np.uint8))
    return recorded_drive(tmp_path)


@pytest.mark.slow
def test_a_device_that_fits_is_waited_for_once_an_update_and_a_frame(drive, tmp_path, monkeypatch):
    with pretended_device(monkeypatch, computes=False) as traffic:
        made = list(make_drive_pairs(drive, "street", tmp_path / "pairs", RECIPE, "cuda"))
    # Three fits of two updates and their models' parameters; the frames held out of each.
    assert sum(traffic.waits.values()) == 18 * len(made)


def test_each_photograph_is_held_out_once_and_the_others_are_its_recording(drive, tmp_path):
    made = list(make_drive_pairs(drive, "street", tmp_path / "pairs", RECIPE))
    assert [one.folder.name for one in made] == [
        "street_front_0",
        "street_front_1",
        "street_front_2",
    ]
    taken = {one.t_us for one in drive.recording if one.camera == "front"}
    shown = []
    for one in made:
        sequence = PairSequence(one.folder)
        references = open_references(sequence)
        assert sequence.size == (64, 48)
        held = set(sequence.clip.t_us.tolist())
        recorded = set(references.rgb_t_us.tolist())
        assert not held & recorded
        assert held | recorded == taken
        assert (references.depth[0, 40:] > 0).any()
        shown += sorted(held)
    assert sorted(shown) == sorted(taken)
    assert not any(
        one.made for one in make_drive_pairs(drive, "street", tmp_path / "pairs", RECIPE)
    )


def test_too_few_photographs_are_refused(tmp_path):
    write_points(tmp_path / "points.ply", np.zeros((1, 3)), np.zeros((1, 3), dtype=np.uint8))
    with pytest.raises(InputError):
        list(
            make_drive_pairs(
                recorded_drive(tmp_path),
                "street",
                tmp_path / "pairs",
                PhotographRecipe(width=64, every=5),
            )
        )
