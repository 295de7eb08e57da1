"""Every image arm by the command: what it trains, that it resumes bit for bit, and that its bundle
drives as a fixer.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from alpasim_plugin.block_fixers.sizes import DiTSizes, initial_weights
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.block_fixers.tiny_vae_nets import TinySizes
from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.atomic import write_safetensors
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers import fixer_settings, make_fixer
from alpasim_plugin.fixers.bundle import bundle_fixer
from alpasim_plugin.fixers.network.checkpoints import load_weights
from alpasim_plugin.fixers.refine import refine_frames
from alpasim_plugin.lab.cli.train import app
from alpasim_plugin.lab.training.recipes.image_arms import IMAGE_ARMS
from alpasim_plugin.lab.training.recipes.registry import recipe_of
from alpasim_plugin.lab.training.render_step_task import RenderStepLoss
from alpasim_plugin.lab.training.trainer import Schedule
from tests.fixers.clip_cases import moving_picture, pixels
from tests.lab.training.pair_files import make

TRAINED = {
    "difix": {"dit", "vae.decoder"},
    "harmonizer": {"dit", "vae.encoder", "vae.decoder"},
    "gsfix3d": {"dit"},
    "3dgs-enhancer": {"dit"},
    "harmonizer-temporal": {"dit", "vae.encoder", "vae.decoder"},
    "harmonizer-temporal-teacher": {"dit", "vae.encoder", "vae.decoder"},
}
Train = Callable[..., Path]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("pairs")
    make(root, name="a", frames=31)
    make(root, name="b", frames=26)
    TinyVAE.random(TinySizes(16, 16, 16, 16, 16)).save(root / "vae.safetensors")
    write_safetensors(
        root / "dit.safetensors", initial_weights(DiTSizes(24, 2, 12, 40, 5, 7, 9), 0)
    )
    return root


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("runs")


@pytest.fixture
def train(data: Path, runs: Path) -> Train:
    """Return a function that trains a recipe for some updates by the command and returns its
    folder.
    """

    def run(recipe: str, updates: int, folder: str, *more: str) -> Path:
        torch.set_num_threads(1)
        start = "init-bi" if recipe == "3dgs-enhancer" else "init"
        options = {
            "--vae": data / "vae.safetensors",
            "--weights": f"{start}={data / 'dit.safetensors'}",
            "--out": runs / folder,
            "--recipe": recipe,
            "--steps": 3,
            "--stop-at": updates,
            "--clips": 2,
            "--accumulate": 1,
            "--columns": 4,
            "--latents": 7,
            "--lr": 0.01,
        }
        done = CliRunner().invoke(
            app, ["fixer", str(data), *(str(x) for pair in options.items() for x in pair), *more]
        )
        if done.exception is not None:
            raise done.exception
        return runs / folder

    return run


@pytest.fixture
def trained(train: Train, runs: Path) -> Callable[[str], Path]:
    """Return a function that gives a recipe's bundle, trained once."""

    def bundle(recipe: str) -> Path:
        folder = runs / recipe
        if not (folder / "fixer.safetensors").exists():
            from_frames = f"harmonizer={bundle('harmonizer')}" if "temporal" in recipe else ""
            train(recipe, 2, recipe, *(("--weights", from_frames) if from_frames else ()))
        return folder / "fixer.safetensors"

    return bundle


NAMES = [arm.name for arm in IMAGE_ARMS]
QUICK = (
    "difix",
    "harmonizer-temporal",
    "gsfix3d",
    "3dgs-enhancer",
)  # the temporal one trains harmonizer first


@pytest.mark.parametrize(
    "recipe",
    [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in NAMES],
)
def test_an_arm_trains_its_parts_and_its_bundle_is_a_fixer(
    data: Path, trained: Callable[[str], Path], recipe: str
) -> None:
    path = trained(recipe)
    card = json.loads(path.with_suffix(".card.json").read_text())
    assert (card["training"]["recipe"], set(card["training"]["trained"])) in [
        (recipe, TRAINED[recipe]),
        (recipe, {"dit", "vae"}),
    ]
    after, vae = load_weights(path), load_weights(data / "vae.safetensors")
    learned = [
        key
        for key, value in after.items()
        if key.startswith("vae.") and not torch.equal(value, vae[key[4:]].half())
    ]
    assert {".".join(key.split(".")[:2]) for key in learned} == TRAINED[recipe] - {"dit"}
    name, overrides = bundle_fixer(path)
    fixer = make_fixer(name, fixer_settings(name, overrides), scene_id="scene")
    assert name == recipe.removesuffix("-teacher")
    assert fixer.trained
    assert f"{recipe}, 2 of " in fixer.label
    frames = moving_picture(6)
    fixed = [
        frame
        for block in refine_frames([(frame, None) for frame in frames], fixer)
        for frame in block.fixed
    ]
    assert np.abs(pixels(fixed).astype(int) - pixels(frames)).max() > 0
    assert [frame.t_us for frame in fixed] == [frame.t_us for frame in frames]


def test_the_published_decay_of_gsfix3d_in_the_papers_updates() -> None:
    stage = recipe_of("gsfix3d").stages[0]
    schedule = Schedule(10_000, peak_lr=1.0, decay=stage.decay, last_share=stage.last_share)
    assert schedule.lr(10_000) == pytest.approx(0.1585, abs=1e-4)  # a hundredth after 25,000


@pytest.mark.parametrize(
    "recipe", ["harmonizer-temporal", pytest.param("gsfix3d", marks=pytest.mark.slow)]
)
def test_an_arm_resumes_bit_for_bit(
    train: Train, trained: Callable[[str], Path], recipe: str
) -> None:
    more = ("--weights", f"harmonizer={trained('harmonizer')}") if "temporal" in recipe else ()
    train(recipe, 1, f"{recipe}-cut", *more)
    again = load_weights(train(recipe, 2, f"{recipe}-cut", *more) / "fixer.safetensors")
    whole = load_weights(trained(recipe))
    assert again.keys() == whole.keys()
    assert all(torch.equal(value, whole[key]) for key, value in again.items())


@pytest.mark.slow
def test_windows_fix_recorded_clips_by_both_commands(
    trained: Callable[[str], Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bundle, frames = trained("3dgs-enhancer"), 27  # two windows
    make(tmp_path / "pairs", "val", "a", frames=frames, width=32)
    given, made = tmp_path / "given", tmp_path / "made"
    given.mkdir()
    for i, image in enumerate(pixels(moving_picture(frames, (32, 32)))):
        cv2.imwrite(str(given / f"{i:03d}.png"), image)
    weights = f"fixer.weights.bundle={bundle}"
    assert (
        run_command(
            [
                "refine",
                str(given),
                "-o",
                str(made),
                "--fixer",
                "3dgs-enhancer",
                "--set",
                weights,
                "--anyway",
                "--quiet",
            ]
        )
        == 0
    )
    assert len(list(made.iterdir())) == frames
    command = [
        "bench",
        "quality",
        str(tmp_path / "pairs"),
        "--split",
        "val",
        "--pictures",
        "0",
        "--out",
        str(tmp_path / "q"),
        "--json",
    ]
    capsys.readouterr()
    assert run_command([*command, "--fixer", f"3dgs,e={bundle},g={trained('gsfix3d')}"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["arms"]["e"]["psnr_db"]["mean"] != summary["arms"]["3dgs"]["psnr_db"]["mean"]
    units = summary["run"]["units"]
    assert units["3dgs"] is None
    assert (units["e"]["lookahead_frames"], units["e"]["calls_per_frame"]) == (
        24,
        pytest.approx(8 / 17),
    )
    assert (units["g"]["lookahead_frames"], units["g"]["calls_per_frame"]) == (0, 8)


def test_the_clamp_is_measured_written_down_and_the_temporal_batches_are_of_both_kinds(
    trained: Callable[[str], Path],
) -> None:
    path = trained("harmonizer")
    card = json.loads(path.with_suffix(".card.json").read_text())
    rows = [json.loads(line) for line in (path.parent / "log.jsonl").read_text().splitlines()]
    assert 0 < card["training"]["largest_distance"] == rows[-1]["largest_distance"]
    assert rows[-1]["perceptual"] <= 0.3 * rows[-1]["largest_distance"] + 1e-6
    assert "largest_distance" not in json.loads(
        (trained("difix").parent / "log.jsonl").read_text().splitlines()[0]
    )
    assert RenderStepLoss(weight=0.3, clamp=0.9, references="own").single == 0.5


def test_what_an_arm_cannot_train_on_is_refused(train: Train) -> None:
    with pytest.raises(InputError):
        train("difix", 1, "refused", "--block", "4")
    with pytest.raises(InputError):
        train("difix", 1, "refused", "--fixer", "gsfix3d")
    with pytest.raises(InputError):
        train("gsfix3d", 1, "refused", "--fixer", "onefixer-dit-tiny")
    with pytest.raises(InputError):
        train("3dgs-enhancer", 1, "refused", "--latents", "6")
