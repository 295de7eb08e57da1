"""Distances between sets of clips. `golden.json` holds what the package ``cd-fvd`` 0.1.1 gave for
the same clips with the same random weights of I3D, and for two sets of vectors of full rank.
"""

import numpy as np
import pytest
import torch

from alpasim_plugin.core.errors import EvaluatorError, InputError
from alpasim_plugin.core.seeding import stream
from alpasim_plugin.lab.video_metrics import fvmd, video_features
from alpasim_plugin.lab.video_metrics.frechet import frechet_distance, set_distance
from alpasim_plugin.lab.video_metrics.i3d import I3D, video_tensor
from alpasim_plugin.lab.video_metrics.sets import set_distances
from alpasim_plugin.lab.video_metrics.table import markdown
from alpasim_plugin.lab.video_metrics.torchscript import load_script
from tests.lab.video_metrics.golden_inputs import CLIPS, CLOSE, clip, golden, seed_network


def normal(seed, count, dimensions, scale=1.0, shift=0.0):
    return stream("golden", seed, "set").standard_normal((count, dimensions)) * scale + shift


def scores(net, video):
    with torch.inference_mode():
        return net(video_tensor(torch.from_numpy(video))).double().numpy()


def test_distance_of_full_rank_sets_is_that_of_the_reference():
    a, b = normal(0, 60, 24), normal(1, 50, 24, 1.5, 0.3)
    expected = golden("fvd")["distance_of_full_rank_sets"]
    assert frechet_distance(a, b) == pytest.approx(expected, rel=CLOSE)
    assert frechet_distance(b, a) == pytest.approx(expected, rel=CLOSE)
    few = a[:10]
    assert frechet_distance(few, b) == pytest.approx(frechet_distance(b, few), rel=1e-9)


def test_distance_of_one_shifted_and_scaled_set_has_its_closed_form():
    a = normal(2, 200, 5)
    scales = np.array([1.0, 2.0, 0.5, 3.0, 1.0])
    b = a * scales + 7.0
    shift = np.sum((a.mean(0) - b.mean(0)) ** 2)
    covariance = np.cov(a.T)
    root = np.sqrt(np.linalg.eigvals(covariance @ np.cov(b.T)).real).sum()
    expected = shift + np.trace(covariance) + np.trace(np.cov(b.T)) - 2 * root
    assert frechet_distance(a, b) == pytest.approx(expected, rel=1e-9)
    assert frechet_distance(a, a) == pytest.approx(0.0, abs=1e-9)
    rotation = np.linalg.qr(normal(3, 5, 5))[0]
    assert frechet_distance(a @ rotation, b @ rotation) == pytest.approx(expected, rel=1e-9)


def test_no_more_vectors_than_dimensions_is_no_distance():
    for count, is_known in ((13, False), (128, False), (129, True)):
        distance = set_distance(normal(0, count, 128), normal(1, 300, 128))
        assert (distance.value is not None) == is_known
        assert (distance.vectors, distance.dimensions) == (count, 128)
        assert (distance.reason is None) == is_known
    with pytest.raises(EvaluatorError, match="shapes"):
        frechet_distance(normal(0, 9, 3), normal(0, 9, 4))
    broken = normal(0, 9, 3)
    broken[2, 1] = np.nan
    with pytest.raises(EvaluatorError, match="finite"):
        set_distance(broken, normal(1, 9, 3))


@pytest.mark.slow
def test_twenty_clips_have_the_distance_of_the_reference():
    """Ten true clips against the damaged copies of ten others."""
    net = seed_network(I3D())
    truth, made = (
        np.concatenate([scores(net, clip(i, frames=9)[i % 2]) for i in range(side, CLIPS, 2)])
        for side in (0, 1)
    )
    assert frechet_distance(made, truth) == pytest.approx(golden("fvd")["distance"], rel=CLOSE)
    assert set_distance(made, truth).value is None


class ScriptedMean(torch.nn.Module):
    """A program with the call of the published one: the mean colours of the video, 400 times."""

    def forward(
        self, x: torch.Tensor, rescale: bool, resize: bool, return_features: bool
    ) -> torch.Tensor:
        scaled = x / 127.5 - 1 if rescale else x
        return scaled.mean(dim=(2, 3, 4)).repeat(1, 134)[:, :400]


def write_i3d(folder, name, monkeypatch):
    """Write a made-up file of I3D whose digest is the expected one."""
    i3d = video_features.I3D_FILES[name]
    path = folder / i3d.file
    if i3d.is_script:
        torch.jit.script(ScriptedMean()).save(str(path))
    else:
        torch.save(seed_network(I3D()).state_dict(), path)
    own = video_features.PublishedI3D(i3d.file, video_features.git_blob(path), i3d.is_script)
    monkeypatch.setitem(video_features.I3D_FILES, name, own)


def test_a_file_that_is_no_program_is_said(tmp_path):
    (tmp_path / "net.pt").write_bytes(b"nothing")
    with pytest.raises(InputError, match="TorchScript"):
        load_script(tmp_path / "net.pt")


def test_digests_are_those_of_git(tmp_path):
    (tmp_path / "empty").write_bytes(b"")
    (tmp_path / "hello").write_bytes(b"hello\n")
    assert video_features.git_blob(tmp_path / "empty") == "e69de29bb2d1d6434b8b29ae775ad8c2e48c5391"
    assert video_features.git_blob(tmp_path / "hello") == "ce013625030ba8dba906f756967f9e9ca394464a"


def test_whole_clip_and_windows_of_93_frames_each_have_a_vector(tmp_path, monkeypatch):
    write_i3d(tmp_path, "fvd", monkeypatch)
    video = np.zeros((198, 8, 8, 3), dtype=np.uint8)
    video[:93] = 255
    features = video_features.video_features(video, tmp_path)
    assert sorted(features) == ["fvd", "fvd@0", "fvd@93", "fvmd_lk"]
    assert features["fvd@0"][0] == pytest.approx(1.0)
    assert features["fvd@93"][0] == pytest.approx(-1.0)
    assert features["fvd"][0] == pytest.approx(2 * 93 / 198 - 1)
    assert features["fvmd_lk"].shape == (8, 1024)
    assert sorted(video_features.video_features(video[:20], tmp_path)) == ["fvd", "fvmd_lk"]
    assert not video_features.video_features(video[:8], tmp_path)


def test_state_dict_gives_the_scores_of_the_reference_and_a_modified_file_is_refused(
    tmp_path, monkeypatch
):
    assert video_features.available_i3d(tmp_path) == {}
    torch.save({"weight": torch.zeros(1)}, tmp_path / "i3d_pretrained_400.pt")
    video, _ = clip(0, frames=9)
    with pytest.raises(InputError, match="git blob"):
        video_features.i3d_vector("fvd_state_dict", tmp_path, video)
    write_i3d(tmp_path, "fvd_state_dict", monkeypatch)
    for side in (0, 1):
        vector = video_features.i3d_vector("fvd_state_dict", tmp_path, clip(0, frames=9)[side])
        assert vector[0, :5] == pytest.approx(golden("fvd")["first_scores"][2 * side], rel=CLOSE)


def tracks(velocity, frames=16):
    start = stream("golden", 0, "tracks").integers(0, 200, (400, 2))
    return start + np.arange(frames)[:, None, None] * np.asarray(velocity)


def test_constant_motion_fills_the_bin_of_its_angle_from_the_second_frame_on():
    vector = fvmd.motion_vector(tracks((3.0, 0.0))).reshape(2, 4, 16, 8)
    expected = np.zeros((4, 16, 8))
    expected[..., 6] = 25.0
    expected[0, :, 6] = 18.75
    assert np.array_equal(vector[0], expected)
    assert not vector[1].any()
    back = fvmd.motion_vector(tracks((-3.0, 0.0))).reshape(2, 4, 16, 8)[0]
    assert np.array_equal(np.roll(back, 4, axis=-1), expected)
    assert not fvmd.motion_vector(tracks((0.0, 0.0))).any()


def test_points_follow_a_picture_that_moves():
    wide = clip(3, frames=1, height=256, width=256)[0][0]
    window = np.stack([np.roll(wide, -i, axis=1) for i in range(16)])
    steps = np.diff(fvmd.track(window), axis=0)
    assert np.median(steps.reshape(-1, 2), axis=0) == pytest.approx([-1.0, 0.0], abs=0.1)


def row(vectors):
    return {"features": {name: np.asarray(x).tolist() for name, x in vectors.items()}}


def test_sets_name_their_options_windows_and_number_of_vectors():
    clips = range(6)
    made = {
        i: row({"fvd": normal(i, 1, 4), "fvd@0": normal(i, 1, 4), "other": [[1.0]]}) for i in clips
    }
    truth = {i: row({"fvd": normal(9 + i, 1, 4), "fvd@0": normal(i, 1, 4)}) for i in clips}
    distances = set_distances(made, truth)
    assert list(distances) == ["fvd"]
    fvd = distances["fvd"]
    assert (fvd["vectors"], fvd["dimensions"]) == (6, 4)
    assert fvd["value"] > 0
    assert "squeezed" in fvd["options"]
    assert "n - 1" in fvd["options"]
    assert [w["first_frame"] for w in fvd["windows"]] == [0]
    assert fvd["windows"][0]["value"] == pytest.approx(0.0, abs=1e-9)
    few = set_distances({0: made[0], 1: made[1]}, truth)["fvd"]
    assert few["value"] is None
    summary = {"arms": {}, "paired": {}, "sets": {"f": {"fvd": few}}, "frames": {}, "clips": {}}
    assert "| f | none (2 vectors, 4 dimensions) |" in markdown(summary)
