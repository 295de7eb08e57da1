"""The check of a card, tried on the CPU: its sections, and how it reports those that fail."""

import numpy as np
import pytest
import torch

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.runs import gpu_check
from tests.pretended_device import pretended_device


@pytest.mark.slow
def test_what_fails_says_why_and_the_rest_goes_on(monkeypatch):
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


@pytest.mark.parametrize("levels", [0, 9])
def test_images_that_differ_fail_the_section(levels, monkeypatch):
    monkeypatch.setattr(gpu_check, "SIZES", [(10, 10)])
    image = np.zeros((10, 10, 3), np.uint8)
    images = {"cpu": image, "cuda": image + levels}
    facts = gpu_check.compared("cuda", lambda width, height, name: lambda: images[name])
    assert (facts["10x10"]["levels"], facts["ok"]) == (levels, levels == 0)


@pytest.mark.slow
@pytest.mark.parametrize("section", ["semantic_map", "gradient"])
def test_a_section_compares_a_card_with_the_processor(section, monkeypatch):
    for name, value in {"SIZES": [(16, 9)], "SPLATS": 40, "REPEATS": 1}.items():
        monkeypatch.setattr(gpu_check, name, value)
    with pretended_device(monkeypatch) as traffic:
        facts = gpu_check.SECTIONS[section]("cuda:0")
        assert traffic.launches
    assert facts["ok"], facts


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a card")
def test_without_a_card_the_check_ends_with_an_error_of_the_machine():
    assert run_command(["doctor", "--gpu", "--budget", "5"]) == 4
