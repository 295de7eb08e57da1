"""The commands of ``simrun train`` as a user meets them: one document with ``--json``, progress
beside it, errors in four parts.
"""

import hashlib
import json
from pathlib import Path

import pytest

from alpasim_plugin.block_fixers.dit import initial_weights
from alpasim_plugin.block_fixers.sizes import DiTSizes
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.cli.main import run_command
from alpasim_plugin.fixers.bundle import save_bundle
from policies.learned_net import load_net
from tests.block_fixers.fixer_cases import small_settings
from tests.lab.training.pair_files import make

BARE = """
version: 1
road: {segments: [{kind: straight, length_m: 80}]}
ego: {speed_mps: 10, cruise_mps: 10}
timing: {warmup_us: 0, duration_us: 200000}
environment: {buildings: 0, trees_per_100m: 0, poles_spacing_m: 0}
"""


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    root = tmp_path_factory.mktemp("pairs")
    for split in ("train", "val"):
        make(root, split, "a", frames=13, height=96, width=160)
    return root


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    path = tmp_path_factory.mktemp("bundle") / "small.safetensors"
    settings = small_settings()
    parts = {
        "dit": initial_weights(DiTSizes(**settings.dit.model_dump()), 3),
        "vae": TinyVAE.random(seed=3).state_dict(),
    }
    save_bundle(path, parts, settings, trained=True)
    return path


def run_train(capsys, *command):
    """Run ``simrun train`` and return its document and what it said beside it."""
    assert run_command(["train", *map(str, command), "--json"]) == 0
    out, err = capsys.readouterr()
    return json.loads(out), err


def test_pairs_made_and_kept_are_counted(tmp_path, capsys):
    (tmp_path / "scenes" / "val").mkdir(parents=True)
    (tmp_path / "scenes" / "val" / "mine.yaml").write_text(BARE)
    command = (
        "pairs",
        tmp_path / "scenes",
        "--out",
        tmp_path / "pairs",
        "--split",
        "val",
        "--source",
        "clean",
    )
    first, again = (run_train(capsys, *command)[0] for _ in range(2))
    assert (first["sequences"], first["made"], again["made"]) == (1, 1, 0)
    assert Path(first["rows"][0]["folder"], "sequence.json").is_file()


def test_weights_come_with_digest_updates_and_time(data, tmp_path, capsys):
    document, err = run_train(
        capsys, "fixer", data, "--recipe", "vae", "--out", tmp_path, "--steps", 1
    )
    weights = tmp_path / "vae.safetensors"
    assert document["weights"] == str(weights)
    assert document["sha256"] == hashlib.sha256(weights.read_bytes()).hexdigest()
    assert (document["bytes"], document["steps"], document["card"]) == (
        weights.stat().st_size,
        1,
        None,
    )
    assert document["hours"] > 0
    assert document["last"]["loss"] > 0
    assert "1/1" in err
    assert f"wrote {weights}" in err.replace("\n", "")


def test_a_policys_card_says_what_made_it_and_how_well_it_does(tmp_path, capsys):
    for split in ("train", "val"):
        folder = tmp_path / "scenes" / split
        folder.mkdir(parents=True)
        (folder / "street_000.yaml").write_text(BARE)
    document, _ = run_train(
        capsys, "policy", tmp_path / "scenes", "--out", tmp_path / "run", "--steps", 1
    )
    card = json.loads(Path(document["card"]).read_text())
    load_net(Path(document["weights"]))
    assert Path(document["card"]).name == "learned.json"
    assert card["sha256"] == document["sha256"]
    assert (card["data"]["scenes"], card["data"]["renderer"]) == ({"street": 1}, "clean")
    assert card["held_out"]["samples"] > 0
    assert card["curves"][-1]["step"] == card["steps"] == 1
