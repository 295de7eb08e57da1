"""Precision and threads are measured: what is faster is taken, and the measurements are kept."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch

from alpasim_plugin.core import cache
from alpasim_plugin.core.cache import share_measurements
from alpasim_plugin.fixers.network import machine_probe
from alpasim_plugin.fixers.network.machine_probe import (
    Probe,
    choose_precision,
    choose_threads,
    probe_precision,
)


def test_the_probe_measures_time_and_error_of_both_precisions():
    probe = probe_precision()
    assert min(probe.fp32_ms, probe.bf16_ms) > 0
    assert 1e-9 < probe.fp32_error < 1e-5
    assert 5e-4 < probe.bf16_error < 1e-2  # a mantissa of 8 bits


@pytest.mark.parametrize(
    ("bf16_ms", "name"),
    [(1.0, "bf16"), (6.0, "bf16"), (6.2, "fp32"), (9.0, "fp32"), (80.0, "fp32")],
)
def test_the_faster_precision_is_taken_and_its_error_recorded(monkeypatch, bf16_ms, name):
    monkeypatch.setattr(machine_probe, "probe_precision", lambda: Probe(9.0, bf16_ms, 1e-7, 3e-3))
    choice = machine_probe.choose_precision("auto")
    assert choice.name == name
    assert choice.as_dict()["error"] == (3e-3 if name == "bf16" else 1e-7)
    assert choice.as_dict()["probe"]["bf16_ms"] == bf16_ms


def test_the_precision_does_not_depend_on_what_else_the_machine_does(monkeypatch):
    """Convolutions take 3 and 1 ms of the processor; in wall time, the second kind is interrupted
    for a second each time.
    """
    convolve, clocks = machine_probe._convolve, {"processor": 0.0, "wall": 0.0}

    def interrupted(image, kernel):
        quick = image.dtype == torch.bfloat16
        clocks["processor"] += 0.001 if quick else 0.003
        clocks["wall"] += 1.0 if quick else 0.003
        return convolve(image, kernel)

    monkeypatch.setattr(machine_probe, "_convolve", interrupted)
    both = SimpleNamespace(
        process_time=lambda: clocks["processor"], perf_counter=lambda: clocks["wall"]
    )
    monkeypatch.setattr(machine_probe, "time", both)
    probe = machine_probe._time_precisions()
    assert (probe.fp32_ms, probe.bf16_ms) == pytest.approx((3.0, 1.0))


@pytest.mark.parametrize(
    ("slowdown", "number"), [({1: 4.0, 2: 2.5}, 2), ({1: 4.0, 2: 3.8}, 1), ({1: 4.0, 2: 300.0}, 1)]
)
def test_threads_that_do_not_pay_are_left_unused(monkeypatch, slowdown, number):
    monkeypatch.setattr(machine_probe, "_ms", lambda *pair: slowdown[torch.get_num_threads()])
    before = torch.get_num_threads()
    found = machine_probe._time_threads(2)
    assert (found.number, found.ms) == (number, slowdown)
    assert torch.get_num_threads() == before
    assert choose_threads(1).ms == {}


def test_processes_of_a_run_on_a_node_choose_what_the_first_one_measured(monkeypatch, tmp_path):
    share_measurements(tmp_path / "run")
    try:
        mine = choose_threads(2), probe_precision()
        monkeypatch.setattr(cache, "_taken", {})  # as in another process
        monkeypatch.setattr(machine_probe, "_ms", lambda *pair: pytest.fail("measured again"))
        assert (choose_threads(2), probe_precision()) == mine
        assert choose_precision().probe == mine[1]
    finally:
        share_measurements(None)
