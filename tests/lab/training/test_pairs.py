"""How a sequence of pairs is drawn and made: real renderers on a tiny street."""

import json
from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import Degradation, Environment
from alpasim_plugin.fixers.warp import VALID
from alpasim_plugin.lab.training.pair_store import PairSequence
from alpasim_plugin.lab.training.pairs import PairRecipe, lateral_offsets, make_sequence
from alpasim_plugin.lab.training.reference_store import open_references
from alpasim_plugin.renderers.gaussian import clear_cache
from tests.gaussians.scene_maps import parked, straight, with_camera
from tests.pretended_device import pretended_device

EMPTY = Environment(buildings=0.0, trees_per_100m=0.0, poles_spacing_m=0.0)


@pytest.fixture
def street(tmp_path, monkeypatch):
    """Give 0.4 s of a bare street, 64 x 36 pixels, with a cache of its own."""
    monkeypatch.setenv("SIMRUN_CACHE", str(tmp_path / "cache"))
    scenario = with_camera(straight(actors=(parked("car", 22.0, -1.8),), environment=EMPTY), 64, 36)
    log = scenario.ego_log
    log = replace(log, t_us=log.t_us[:4], xyz=log.xyz[:4], quat=log.quat[:4])
    return replace(scenario, ego_log=log, end_us=400_000)


def test_camera_drifts_beside_a_reconstruction_and_stays_on_the_path_of_a_cycle_render(
    street,
):
    def largest(scenario):
        return [
            float(np.abs(lateral_offsets(scenario, PairRecipe(), seed)).max()) for seed in range(60)
        ]

    aside = largest(street)
    assert max(aside) > 0.4
    assert max(aside) <= 2.5
    assert 4 <= aside.count(0.0) <= 22  # a fifth stays on the path
    assert aside == largest(street) != largest(replace(street, scene_id="another"))
    assert set(largest(replace(street, degradation=Degradation("cycle")))) == {0.0}


def test_sequence_holds_both_renders_opacity_map_and_how_it_was_made(street, tmp_path):
    recipe = PairRecipe()
    folder = tmp_path / "pairs" / "val" / "s"
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
    other = replace(street, degradation=Degradation("none"))
    assert make_sequence(other, folder, recipe, 0, split="val", family="street")
    assert json.loads((folder / "sequence.json").read_text())["degradation"]["kind"] == "none"


def test_recorded_frames_lie_beside_the_channels_and_carry_the_truth_into_the_view(
    street, tmp_path
):
    folder = tmp_path / "pairs" / "val" / "s"
    exact = replace(street, degradation=Degradation("reconstruction", share=0.02))
    make_sequence(exact, folder, PairRecipe(offset_m=0.4), 0, split="val", family="street")
    sequence = PairSequence(folder)
    recorded = open_references(sequence)
    assert recorded.t_us.tolist() == sequence.clip.t_us.tolist()
    assert recorded.rgb_t_us.tolist() == [50_000, 550_000]
    for i, (image,) in enumerate(recorded.warped(len(sequence.clip), 1)):
        held = image[..., 3] == VALID
        assert held.mean() > 0.5
        error = np.abs(image[..., :3].astype(float) - sequence.clip.rgb_gt[i]).mean(axis=-1)
        assert np.median(error[held]) < 3  # the same surfaces, seen from beside


@pytest.mark.slow
def test_a_device_that_draws_a_sequence_is_waited_for_once_a_frame(street, tmp_path, monkeypatch):
    with pretended_device(monkeypatch, computes=False) as traffic:
        options = {"split": "val", "family": "street", "device": "cuda"}
        assert make_sequence(street, tmp_path / "s", PairRecipe("clean"), 0, **options)
    assert sum(traffic.waits.values()) == 10  # five frames of two renderers


def test_a_sequence_without_a_recording_has_no_references_and_a_damaged_one_is_refused(
    street, tmp_path
):
    folder = tmp_path / "pairs" / "val" / "s"
    make_sequence(street, folder, PairRecipe(source="clean"), 0, split="val", family="street")
    assert open_references(PairSequence(folder)) is None
    again = tmp_path / "pairs" / "val" / "t"
    make_sequence(
        replace(street, degradation=Degradation("reconstruction", share=0.02)),
        again,
        PairRecipe(),
        0,
        split="val",
        family="street",
    )
    (again / "references" / "t_us.npy").unlink()
    with pytest.raises(InputError):
        open_references(PairSequence(again))
