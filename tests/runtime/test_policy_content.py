"""A rollout's key knows what its policy loads: other weights are another rollout."""

from __future__ import annotations

from pathlib import Path

import pytest

from alpasim_plugin.errors import InputError
from alpasim_plugin.runtime.plan import RunOptions, make_plan
from policies.base import loaded_by
from policies.learned import Learned
from scenarios.suite import expand


def keys() -> list[str]:
    refs = expand("smoke/straight", ("timing.duration_us=1200000",))
    plan = make_plan(refs, ("clean",), ("pure-pursuit", "learned"), (0,), RunOptions(images="none"))
    return [cell.rollout_key for cell in plan.cells]


def test_other_weights_are_another_rollout_of_that_policy_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blind, seeing = keys()
    assert keys() == [blind, seeing]
    monkeypatch.setattr(Learned, "loads", tmp_path / "other.safetensors")
    with pytest.raises(InputError, match="policy 'learned'"):
        keys()
    (tmp_path / "other.safetensors").write_bytes(b"other")
    assert keys()[0] == blind
    assert keys()[1] != seeing
    assert loaded_by("pure-pursuit") == ""
