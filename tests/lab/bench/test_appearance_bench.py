"""The appearance experiment on one small clip: controls by the formula, values of every style and
arm, nothing measured twice.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from alpasim_plugin.block_fixers.settings import STYLES
from alpasim_plugin.block_fixers.sizes import DiTSizes, initial_weights
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers.bundle import save_bundle
from alpasim_plugin.lab.bench.appearance import AppearanceRun, measure_appearance
from alpasim_plugin.lab.bench.judged import Judging
from alpasim_plugin.lab.training.pair_store import PairSequence
from tests.block_fixers.fixer_cases import small_settings
from tests.lab.training.corner import make_corner

pytestmark = pytest.mark.slow  # pictures of a study that no drive needs


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AppearanceRun:
    monkeypatch.setenv("SIMRUN_CACHE", str(tmp_path / "cache"))
    folder = make_corner(tmp_path / "scenes", tmp_path / "pairs", "val", 400_000)
    settings = small_settings("window=4", "holes=noise")
    sizes = DiTSizes(**settings.dit.model_dump())
    prompts = {style: torch.full((1, sizes.text_width), float(i)) for i, style in enumerate(STYLES)}
    parts = {
        "dit": initial_weights(sizes, 3),
        "vae": TinyVAE.random(seed=3).state_dict(),
        "prompt": prompts,
    }
    save_bundle(
        tmp_path / "fixer.safetensors",
        parts,
        settings.model_copy(update={"prompt": "clear"}),
        trained=True,
    )
    sequence = PairSequence(folder)
    return AppearanceRun(
        (sequence,),
        tmp_path / "fixer.safetensors",
        (),
        tmp_path / "scenes",
        tmp_path / "out",
        Judging((0,)),
        frames=5,
        shown=frozenset({"corner"}),
    )


def test_every_style_has_its_arm_its_control_and_its_target(run: AppearanceRun) -> None:
    told: list[str] = []
    found = measure_appearance(run, lambda i, n, name: told.append(f"{i}/{n} {name}"))
    assert told == ["1/1 corner"]
    assert set(found) == {"appearance", "appearance-night", "appearance-fog", "appearance-snow"}
    for style in STYLES[1:]:
        values = found[f"appearance-{style}"].values
        assert set(values) == {"appearance", "3dgs + formula", "target"}
        control = values["3dgs + formula"]["corner"]
        assert control["psnr_db"] > 60, (
            "the render is the clean frame here, and the formula is the target's"
        )
        assert values["appearance"]["corner"]["psnr_db"] < 40
        assert "psnr_db" not in values["target"]["corner"]
        assert 0.0 <= values["target"]["corner"]["style_acc_syn"] <= 1.0
        assert (run.out / "sheets" / f"corner-{style}.png").is_file()
    mean = np.mean(
        [
            found[f"appearance-{style}"].values["appearance"]["corner"]["psnr_db"]
            for style in STYLES[1:]
        ]
    )
    assert found["appearance"].values["appearance"]["corner"]["psnr_db"] == pytest.approx(mean)
    row = run.out / "clips" / "corner.json"
    first = row.stat().st_mtime_ns, json.loads(row.read_text())
    measure_appearance(run, lambda *_: None)
    assert (row.stat().st_mtime_ns, json.loads(row.read_text())) == first
    with pytest.raises(InputError, match="--scenes"):
        measure_appearance(
            replace(run, scenes=None, out=run.out.with_name("other")), lambda *_: None
        )
    with pytest.raises(InputError, match="not among the frozen judges"):
        measure_appearance(replace(run, judging=Judging((7,))), lambda *_: None)
