"""``simrun train per-frame`` as a user meets it: from pairs to a bundle that a renderer's name
takes.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.types import Frame
from alpasim_plugin.fixers import fixer_settings, make_fixer
from tests.lab.cli.small_training import FEW, SIZES
from tests.lab.training.pair_files import make


@pytest.fixture
def pairs(tmp_path):
    make(tmp_path / "pairs", name="street_000", frames=6)
    return tmp_path / "pairs"


def test_pairs_become_a_bundle_with_its_card(pairs, tmp_path, capsys):
    out = tmp_path / "run"
    command = [
        "train",
        "per-frame",
        str(pairs),
        "--out",
        str(out),
        *SIZES,
        *FEW,
        "--keep-every",
        "1",
        "--json",
    ]
    assert run_command([*command, "--steps", "5", "--stop-at", "1"]) == 0
    assert (
        run_command([*command, "--steps", "2", "--decay-from", "2"]) == 0
    )  # prolonged otherwise than planned
    captured = capsys.readouterr()
    document = json.loads(captured.out.splitlines()[-1])
    assert document["steps"] == 2
    card = json.loads(Path(document["card"]).read_text())
    assert card["data"]["pairs"] == 1
    assert card["training"]["updates"] == 2
    assert (out / "fixer-000001.safetensors").is_file()
    settings = fixer_settings("onefixer", [f"weights.bundle={document['weights']}"])
    fixer = make_fixer("onefixer", settings, scene_id="scene")
    assert fixer.trained
    assert fixer.label.startswith("onefixer, hardly trained, 2 updates, ")
    assert fixer.step([Frame(0, "front", np.zeros((20, 30, 3), dtype=np.uint8))], ())[
        0
    ].rgb.shape == (
        20,
        30,
        3,
    )


@pytest.mark.parametrize(
    ("options", "mention"),
    [
        (["--fixer", "onefixer-dit-tiny"], "simrun train fixer"),
        (["--crop", "50x32"], "not two positive multiples of 16"),
        (["--crop", "96x64"], "frames of 48x32"),
    ],
)
def test_what_cannot_be_trained_is_refused(
    pairs,
    tmp_path,
    options,
    mention,
    capsys,
):
    sizes = [] if "--fixer" in options else SIZES
    assert (
        run_command(
            [
                "train",
                "per-frame",
                str(pairs),
                "--out",
                str(tmp_path / "run"),
                *sizes,
                *FEW,
                *options,
            ]
        )
        == 2
    )
    assert mention in capsys.readouterr().err
