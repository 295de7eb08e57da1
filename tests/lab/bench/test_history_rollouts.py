"""Rollouts on histories of three kinds."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers.network.pixel_generator import PixelGenerator, PixelSizes
from alpasim_plugin.lab.bench import regime
from alpasim_plugin.lab.bench.quality import Variant


def test_a_history_is_the_own_output_the_truth_or_nothing() -> None:
    net = PixelGenerator.random(PixelSizes((8, 8, 8)), 0).eval()
    rng = torch.Generator().manual_seed(0)
    render, sdmap, truth = (torch.rand(3, 16, 32, 3, generator=rng) * 2 - 1 for _ in range(3))
    opacity = torch.ones(3, 16, 32, 1)
    made = {
        history: regime._rollout(net, render, sdmap, truth, opacity, history)
        for history in regime.HISTORIES
    }
    assert {video.shape for video in made.values()} == {(3, 16, 32, 3)}
    first = made["own"][0]
    assert all(np.array_equal(video[0], first) for video in made.values()), "nothing came before"
    assert not np.array_equal(made["own"][2], made["oracle"][2])
    assert not np.array_equal(made["own"][2], made["empty"][2])
    again = regime._rollout(net, render[2:], sdmap[2:], truth[2:], opacity[2:], "own")
    assert np.array_equal(made["empty"][2], again[0])


def test_the_shift_is_the_distance_from_the_recorded_path(monkeypatch: pytest.MonkeyPatch) -> None:
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = 0.0, 10.0, 20.0
    here = np.tile(np.eye(4), (2, 1, 1))
    here[:, :2, 3] = (5.0, -1.5), (12.0, 2.0)
    sequence = SimpleNamespace(
        clip=SimpleNamespace(T_world_camera=here), folder=Path("pairs/val/street")
    )
    monkeypatch.setattr(
        regime, "open_references", lambda _: SimpleNamespace(rgb_T_world_camera=poses)
    )
    assert regime.lateral_shift_m(sequence) == pytest.approx([1.5, 2.0])  # type: ignore[arg-type]
    monkeypatch.setattr(regime, "open_references", lambda _: None)
    with pytest.raises(InputError, match="recorded poses"):
        regime.lateral_shift_m(sequence)  # type: ignore[arg-type]


def test_an_arm_of_another_kind_is_refused() -> None:
    with pytest.raises(InputError, match="no generator in pixels"):
        regime.measure_regime([], [Variant("3dgs")], lambda *_: None)
