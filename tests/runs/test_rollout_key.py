"""A rollout's key knows what its policy and its fixer load: other weights are another rollout, the
same ones elsewhere are not.
"""

import shutil

import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.runs.plan import RunOptions, make_plan
from policies.learned import Learned
from scenarios.suite import expand


def keys():
    refs = expand("smoke/straight", ("timing.duration_us=1200000",))
    plan = make_plan(refs, ("clean",), ("pure-pursuit", "learned"), (0,), RunOptions(images="none"))
    return [cell.rollout_key for cell in plan.cells]


def test_other_weights_are_another_rollout_of_that_policy_alone(tmp_path, monkeypatch):
    blind, seeing = keys()
    assert keys() == [blind, seeing]
    monkeypatch.setattr(Learned, "files", (tmp_path / "other.safetensors",))
    with pytest.raises(InputError):
        keys()
    (tmp_path / "other.safetensors").write_bytes(b"other")
    assert keys()[0] == blind
    assert keys()[1] != seeing


def fixed_key(*overrides):
    refs = expand("smoke/straight", ("timing.duration_us=1200000",))
    return (
        make_plan(
            refs,
            ("onefixer-dit-tiny",),
            ("pure-pursuit",),
            (0,),
            RunOptions(images="none", fixer=overrides),
        )
        .cells[0]
        .rollout_key
    )


def test_a_fixers_weights_count_by_their_bytes_and_not_by_their_place(tmp_path):
    shipped = fixer_settings("onefixer-dit-tiny")
    assert shipped.weights.bundle is not None
    moved = tmp_path / "moved.safetensors"
    other = tmp_path / "other.safetensors"
    shutil.copy(shipped.weights.bundle, moved)
    raw = bytearray(moved.read_bytes())
    raw[-1] ^= 1
    other.write_bytes(raw)
    key = fixed_key()
    assert fixed_key(f"weights.bundle={moved}") == key
    assert fixed_key(f"weights.bundle={other}") != key
    assert fixed_key("history=last-forward") != key


def test_how_images_are_stored_is_part_of_every_key():
    refs = expand("smoke/straight", ("timing.duration_us=1200000",))
    keys = set()
    for images in ("none", "jpeg", "png"):
        plan = make_plan(refs, ("clean",), ("pure-pursuit",), (0, 1), RunOptions(images=images))
        keys |= {cell.rollout_key for cell in plan.cells}
    assert len(keys) == 6
