"""The check of a card, tried on the CPU: its sections, and how it reports those that fail."""

import json
import re
from functools import partial

import numpy as np
import pytest
import torch

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.runs import gpu_check, gpu_work
from alpasim_plugin.runs.gpu_work import H100, PEAKS, blocks, counted, fixer_work, raster_work
from tests.pretended_device import pretended_device


def test_what_fails_says_why_and_which_setting_avoids_it(monkeypatch, capsys):
    def run_here(name, device, left_s):
        return gpu_check.SECTIONS[name](device)

    def differs(width, height, name):
        return lambda: np.full((height, width), 200 if name == "cpu" else 100)

    monkeypatch.setattr(gpu_check, "_child", run_here)
    monkeypatch.setattr(gpu_check, "SIZES", [(16, 9)])
    sections = {
        "semantic_map": partial(gpu_check.compared, make=differs),
        "rasteriser": partial(gpu_check.compared, make=differs),
        "fixer_rate": lambda device: {"ok": True},
    }
    monkeypatch.setattr(gpu_check, "SECTIONS", sections)
    with pretended_device(monkeypatch):
        assert run_command(["doctor", "--gpu", "--json"]) == 4
    found = json.loads(capsys.readouterr().out)["sections"]
    assert "fixer.uses_map=false" in found["semantic_map"]["do"]
    assert "--device cpu" in found["rasteriser"]["do"]
    assert found["fixer_rate"] == {"ok": True}


def test_what_avoids_a_section_exists():
    for advice in gpu_check.AVOIDED_BY.values():
        for setting in re.findall(r"fixer\.(\S+)", advice):
            fixer_settings("onefixer", [setting])
    assert gpu_check.AVOIDED_BY.keys() <= gpu_check.SECTIONS.keys()


@pytest.mark.slow
def test_a_section_that_ends_with_an_error_costs_only_itself(monkeypatch):
    monkeypatch.setattr(gpu_check, "SECTIONS", {"unknown": gpu_check.card, "card": gpu_check.card})
    facts = dict(gpu_check.check_gpu("cpu", 100.0))
    assert not facts["unknown"]["ok"]
    assert "unknown" in facts["unknown"]["why"]
    assert facts["card"] == {"ok": True, "torch": torch.__version__}


def test_counts_of_a_frame():
    assert fixer_work(1, 960, 544).gflop == pytest.approx(2.06, rel=0.01)
    assert raster_work(1920, 1080).least_ms(H100) == pytest.approx(0.29, rel=0.01)


@pytest.mark.slow
def test_counts_of_a_block_of_the_largest_generator():
    weights, fix = blocks("last-forward", 960, 544, "meta")
    work = counted(fix, "bf16")
    # In 28 blocks: four operations a query, key and channel; two a weight and token.
    tokens, keys, width = 2 * 34 * 60, 6 * 34 * 60, 2048
    assert weights == pytest.approx(2.08e9, rel=0.01)
    assert work.gflop * 1e9 > 28 * (4 * tokens * keys * width + 2 * tokens * 12 * width**2)


def test_a_section_that_the_budget_does_not_reach_is_not_begun(monkeypatch):
    monkeypatch.setattr(gpu_check, "_child", lambda *args: pytest.fail("a section has begun"))
    facts = dict(gpu_check.check_gpu("cpu", 0.0))
    assert facts.keys() == gpu_check.SECTIONS.keys()
    assert not any(section["ok"] for section in facts.values())


@pytest.mark.parametrize("levels", [0, 9])
def test_images_that_differ_fail_the_section(levels, monkeypatch):
    monkeypatch.setattr(gpu_check, "SIZES", [(10, 10)])
    image = np.zeros((10, 10, 3), np.uint8)
    images = {"cpu": image, "cuda": image + levels}
    facts = gpu_check.compared("cuda", lambda width, height, name: lambda: images[name])
    assert (facts["10x10"]["levels"], facts["ok"]) == (levels, levels == 0)


SIZES_2B = {"blocks": 1, "width": 32, "head_width": 16, "mlp_width": 32, "text_width": 8}
SMALL = [f"dit.{name}={value}" for name, value in (SIZES_2B | {"context_width": 8}).items()]
SMALL += ["vae.base=8", "precision=fp32", "codec_precision=fp32"]


@pytest.mark.slow
@pytest.mark.parametrize("section", ["semantic_map", "gradient", "block_fixer"])
def test_a_section_compares_a_card_with_the_processor(section, monkeypatch):
    for name, value in {"SIZES": [(16, 9)], "SPLATS": 40, "REPEATS": 1}.items():
        monkeypatch.setattr(gpu_check, name, value)
    with pretended_device(monkeypatch) as traffic:
        facts = gpu_check.SECTIONS[section]("cuda:0")
        assert traffic.launches
    assert facts["ok"], facts


@pytest.mark.slow
@pytest.mark.parametrize(
    ("section", "card"),
    [
        ("raster_rate", "NVIDIA L4"),
        ("fixer_rate", "an unknown card"),
        ("block_rate", "NVIDIA H200"),
    ],
)
def test_a_rate_is_a_share_of_the_peak_of_a_known_card(section, card, monkeypatch):
    for module, name, value in (
        (gpu_check, "MIDDLE", (32, 32)),
        (gpu_check, "LARGE", (64, 32)),
        (gpu_check, "REPEATS", 1),
        (gpu_check, "facts_of", lambda device: {"card": card}),
        (gpu_work, "SPLATS", 200),
        (
            gpu_work,
            "fixer_settings",
            lambda name, given=(): fixer_settings(name, [*given, *SMALL * ("2b" in name)]),
        ),
    ):
        monkeypatch.setattr(module, name, value)
    with pretended_device(monkeypatch) as traffic:
        facts = gpu_check.SECTIONS[section]("cuda:0")
        assert traffic.launches
    rows = [facts, *(row for row in facts.values() if isinstance(row, dict))]
    shares = [row["roofline_share"] for row in rows if "ms" in row]
    assert shares
    assert all(isinstance(share, float) == (card in PEAKS) for share in shares)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a card")
def test_without_a_card_the_check_ends_with_an_error_of_the_machine():
    assert run_command(["doctor", "--gpu", "--budget", "5"]) == 4
