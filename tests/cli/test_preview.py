"""``simrun view SCENARIO``: what the image shows, checked by its pixels."""

import json

import cv2
import numpy as np
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.gaussians import GaussianCloud, write_ply

SCENE = """
version: 1
road: {segments: [{kind: straight, length_m: 120}]}
actors:
  - {kind: drive, id: lead, s_m: 30, speeds: [[0, 8]]}
  - {kind: parked, id: van, s_m: 40, side: right, clearance_m: 0.5}
timing: {duration_us: 3000000}
"""
EGO = (0x0B, 0x6B, 0xB3)
LEAD = (0xC2, 0x54, 0x0A)


def near(picture, rgb):
    """Count pixels of a colour, as strong as the last moment is drawn."""
    return int((np.abs(picture[..., ::-1].astype(int) - rgb).max(axis=2) < 24).sum())


@pytest.mark.slow
def test_a_preview_shows_the_ego_the_others_and_the_camera(tmp_path, capsys):
    (tmp_path / "scene.yaml").write_text(SCENE)
    out = tmp_path / "scene.png"
    assert run_command(["view", str(tmp_path / "scene.yaml"), "--out", str(out), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["actors"], facts["times_s"]) == (2, [0.0, 0.75, 1.5, 2.25, 3.0])
    picture = cv2.imread(str(out))
    assert near(picture, EGO) > 200
    assert near(picture, LEAD) > 200
    assert picture[-200:].std() > 20  # the camera frames are pictures, not emptiness
    assert run_command(["view", str(tmp_path / "scene.yaml"), "--out", str(out)]) == 2


def test_a_background_is_named_with_what_it_covers(tmp_path, capsys):
    n = 400
    means = np.stack([np.linspace(0.0, 40.0, n), np.full(n, -1.8), np.full(n, 0.2)], axis=1)
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    write_ply(
        tmp_path / "s.ply",
        GaussianCloud(means, quats, np.full((n, 3), 0.3), np.full(n, 0.9), np.full((n, 1, 3), 0.5)),
    )
    scene = SCENE + f"background: {{file: {tmp_path / 's.ply'}}}\n"
    (tmp_path / "scene.yaml").write_text(scene.replace("3000000", "1000000"))
    assert (
        run_command(
            ["view", str(tmp_path / "scene.yaml"), "--out", str(tmp_path / "p.png"), "--json"]
        )
        == 0
    )
    (said,) = [
        line
        for line in json.loads(capsys.readouterr().out)["facts"]
        if line.startswith("background ")
    ]
    assert "% of the route" in said
