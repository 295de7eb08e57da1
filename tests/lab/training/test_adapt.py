"""`simrun adapt`: weights are kept only where held-out photographs gain, and nothing is written
otherwise.
"""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.lab.cli import adapt as command
from alpasim_plugin.lab.training.adapt import adapt, compared
from tests.renderers.recorded_drive import recorded_drive


def drive(folder, count):
    made = recorded_drive(folder, count)
    front = [one for one in made.recording if one.camera == "front"]
    return replace(
        made,
        recording=tuple(
            replace(one, use="held-out" if i % 4 == 2 else "fitted") for i, one in enumerate(front)
        ),
    )


def shipped():
    return Path(str(fixer_settings("onefixer", []).weights.bundle))  # type: ignore[attr-defined]


def test_a_gain_is_accepted_where_most_photographs_have_it():
    before = np.linspace(20, 25, 8)
    assert compared(before, before + np.linspace(0.1, 0.3, 8)).accepted
    assert not compared(before, before + np.array([0.5, -0.5] * 4)).accepted
    assert not compared(before, before - 0.2).accepted
    assert not compared(before, before).accepted
    # one photograph that gains 9 dB moves the mean, and is one of eight
    few = compared(before, before + np.array([9.0] + [-0.1] * 7))
    assert few.gain_db > 1.0
    assert few.n_better == 1
    assert not few.accepted
    most = compared(before, before + np.array([0.1] * 6 + [-0.05] * 2))
    assert most.n_better == 6
    assert most.accepted


def test_a_drive_without_enough_photographs_is_refused_and_nothing_is_written(
    tmp_path,
):
    with pytest.raises(InputError):
        adapt(drive(tmp_path, 7), shipped(), tmp_path / "new.safetensors", updates=1, distance=None)
    assert not (tmp_path / "new.safetensors").exists()


def test_the_command_trains_judges_and_keeps_what_there_was(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(command, "load_scenario", lambda _: drive(tmp_path, 20))
    out = tmp_path / "new.safetensors"
    assert (
        run_command(
            ["train", "adapt", str(tmp_path), "--out", str(out), "--updates", "1", "--json"]
        )
        == 0
    )
    document = json.loads(capsys.readouterr().out)
    assert len(document["before"]) == len(document["after"]) == 5
    assert document["accepted"] == out.exists()
    gains = np.subtract(document["after"], document["before"])
    assert document["gain_db"] == pytest.approx(gains.mean())
    assert document["n_better"] == (gains > 0).sum()
    out.write_bytes(b"mine")
    assert run_command(["train", "adapt", str(tmp_path), "--out", str(out)]) == 2
    assert out.read_bytes() == b"mine"
