"""The check of a card, tried on the CPU: its sections, and how it reports those that fail."""

import json

import numpy as np
import pytest
import torch

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.runs import gpu_check, gpu_work
from alpasim_plugin.runs.gpu_work import PEAKS
from tests.examples import first_rows_of
from tests.pretended_device import pretended_device


def test_a_section_that_differs_fails_and_says_which_setting_avoids_it(monkeypatch, capsys):
    def differing(levels):
        def make(width, height, name):
            return lambda: np.full((height, width), levels * (name != "cpu"))

        return lambda device: gpu_check.compared(device, make, [(16, 9)])

    sections = {"semantic_map": differing(9), "rasteriser": differing(9), "fixer": differing(0)}
    monkeypatch.setattr(gpu_check, "SECTIONS", sections)
    monkeypatch.setattr(gpu_check, "_child", lambda name, device, left_s: sections[name](device))
    with pretended_device(monkeypatch):
        assert run_command(["doctor", "--gpu", "--json"]) == 4
    found = json.loads(capsys.readouterr().out)["sections"]
    assert [facts["16x9"]["levels"] for facts in found.values()] == [9, 9, 0]
    assert "fixer.uses_map=false" in found["semantic_map"]["do"]
    assert fixer_settings("onefixer", ["uses_map=false"]).uses_map is False
    assert "--device cpu" in found["rasteriser"]["do"]
    assert found["fixer"]["ok"]


@pytest.mark.slow
def test_a_section_that_ends_with_an_error_costs_only_itself(monkeypatch):
    monkeypatch.setattr(gpu_check, "SECTIONS", {"unknown": gpu_check.card, "card": gpu_check.card})
    facts = dict(gpu_check.check_gpu("cpu", 100.0))
    assert not facts["unknown"]["ok"]
    assert "unknown" in facts["unknown"]["why"]
    assert facts["card"] == {"ok": True, "torch": torch.__version__}


def test_a_section_that_the_budget_does_not_reach_is_not_begun(monkeypatch):
    monkeypatch.setattr(gpu_check, "_child", lambda *args: pytest.fail("a section has begun"))
    facts = dict(gpu_check.check_gpu("cpu", 0.0))
    assert facts.keys() == gpu_check.SECTIONS.keys()
    assert not any(section["ok"] for section in facts.values())


@pytest.mark.slow
@pytest.mark.parametrize("section", ["semantic_map", "gradient", "block_fixer"])
def test_a_section_compares_a_card_with_the_processor(section, monkeypatch):
    for name, value in {"SIZES": [(16, 9)], "SPLATS": 40, "REPEATS": 1}.items():
        monkeypatch.setattr(gpu_check, name, value)
    with pretended_device(monkeypatch) as traffic:
        facts = gpu_check.SECTIONS[section]("cuda:0")
        assert traffic.launches
    assert facts["ok"], facts


@pytest.mark.parametrize(
    ("section", "card"),
    first_rows_of(
        [
            ("raster_rate", "NVIDIA L4"),
            ("fixer_rate", "an unknown card"),
        ],
    ),
)
def test_a_rate_is_a_share_of_the_peak_of_a_known_card(section, card, monkeypatch):
    monkeypatch.setattr(gpu_work, "SPLATS", 200)
    sizes = {"MIDDLE": (32, 32), "LARGE": (64, 32), "REPEATS": 1}
    for name, value in (sizes | {"facts_of": lambda device: {"card": card}}).items():
        monkeypatch.setattr(gpu_check, name, value)
    with pretended_device(monkeypatch):
        facts = gpu_check.SECTIONS[section]("cuda:0")
    assert facts.pop("ok")
    assert {isinstance(row["roofline_share"], float) for row in facts.values()} == {card in PEAKS}


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a card")
def test_without_a_card_the_check_ends_with_an_error_of_the_machine():
    assert run_command(["doctor", "--gpu", "--budget", "5"]) == 4
