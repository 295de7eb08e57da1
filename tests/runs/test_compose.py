"""Renderer names, and what of a fixer enters a run's content keys."""

import json
import subprocess
import sys

import pytest

from alpasim_plugin import make_renderer
from alpasim_plugin.block_fixers.chunk import ChunkRenderer
from alpasim_plugin.block_fixers.speculation import SpeculativeRenderer
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import file_sha256
from alpasim_plugin.core.parts import resolve, resolve_renderer, spec
from alpasim_plugin.fixers.settings import FixerSettings
from alpasim_plugin.log.run_folder.records import json_of
from alpasim_plugin.runs.plan import RunOptions, make_plan
from alpasim_plugin.runs.provenance import part_facts
from scenarios.suite import expand


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("clean", "clean"),
        ("onefixer", "onefixer+3dgs"),
        ("onefixer@2", "onefixer@2+3dgs"),
        ("identity+clean", "identity+clean"),
        ("onefixer-dit-tiny@2+broken-black", "onefixer-dit-tiny@2+broken-black"),
    ],
)
def test_a_name_is_a_renderer_or_a_fixer_over_one(name, meant):
    assert str(resolve_renderer(name)) == meant


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("onefixr", "did you mean 'onefixer'?"),
        ("onefixr+3dgs", "did you mean 'onefixer'?"),
        ("onefixer+3dg", "did you mean '3dgs'?"),
        ("3dgs+onefixer", "onefixer+3dgs"),
        ("identity+onefixer", "--renderer onefixer"),
        ("3dgs@2", "did you mean '3dgs'?"),
        ("onefixer@0", "NAME@STEPS"),
        ("onefixer@x", "NAME@STEPS"),
        ("nosuch://host:50051", "known: clean"),
        ("onefixer+nosuch://host:50051", "known: clean"),
        ("+clean", "known"),
        ("onefixer+", "known"),
    ],
)
def test_a_name_that_stands_for_nothing_is_refused_with_the_nearest(name, hint):
    with pytest.raises(InputError) as caught:
        resolve_renderer(name)
    assert hint in caught.value.hint


def test_the_mode_decides_the_kind_of_session(straight_road):
    assert isinstance(make_renderer("identity+clean", straight_road), SpeculativeRenderer)
    assert isinstance(
        make_renderer("identity+clean", straight_road, overrides=("mode=chunk",)), ChunkRenderer
    )


def test_resolving_a_renderer_or_a_fixer_does_not_load_torch():
    code = (
        "import sys; from alpasim_plugin.core.parts import resolve_renderer;"
        "resolve_renderer('3dgs'); resolve_renderer('onefixer'); print('torch' in sys.modules)"
    )
    assert (
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        ).stdout.strip()
        == "False"
    )


def plan(renderers, fixer=()):
    refs = expand("smoke/straight", ("timing.duration_us=1200000",))
    return make_plan(refs, renderers, ("log-replay",), (0,), RunOptions(fixer=fixer))


def keys(renderers, fixer=()):
    return [cell.rollout_key for cell in plan(renderers, fixer).cells]


def test_settings_of_a_fixer_enter_its_rollouts_key_and_no_other():
    plain, fixed = keys(("3dgs", "onefixer-dit-tiny"))
    plain_too, changed = keys(("3dgs", "onefixer-dit-tiny"), ("tolerance_m=0.5",))
    assert plain == plain_too
    assert fixed != changed
    assert keys(("onefixer-dit-tiny",), ("tolerance_m=0.02", "tolerance_deg=0.1")) == [
        fixed
    ]  # the defaults, said aloud


def test_the_code_of_a_renderer_enters_the_keys_of_its_rollouts_alone(
    monkeypatch,
):
    before = keys(("clean", "3dgs", "identity", "identity+clean"))
    digest = spec.code_digest
    monkeypatch.setattr(
        spec,
        "code_digest",
        lambda file: (
            digest(file) + ("edited" if str(file).endswith("renderers/reconstruction.py") else "")
        ),
    )
    after = keys(("clean", "3dgs", "identity", "identity+clean"))
    assert [a == b for a, b in zip(before, after, strict=True)] == [True, False, False, True]


def test_one_renderer_under_two_names_is_refused():
    with pytest.raises(InputError):
        plan(("onefixer", "onefixer+3dgs"))


def test_a_setting_for_one_renderer_is_that_of_its_fixer_alone():
    names = ("identity+clean", "identity")
    settings = [
        spec.fixer.settings
        for spec in plan(names, ("tolerance_m=0.5", "identity+clean:mode=chunk")).renderers
        if spec.fixer
    ]
    assert [(of.mode, of.tolerance_m) for of in settings if isinstance(of, FixerSettings)] == [
        ("chunk", 0.5),
        ("speculative", 0.5),
    ]


@pytest.mark.parametrize(
    ("override", "found", "do"),
    [
        ("tolerance_n=1", "tolerance_n", "did you mean 'tolerance_m'"),
        ("mode=chunks", "chunks", "chunk"),
        ("window=0", "0", ""),
    ],
)
def test_a_bad_setting_is_named_with_the_nearest(override, found, do):
    with pytest.raises(InputError) as caught:
        plan(("onefixer-dit-tiny",), (override,))
    assert found in str(caught.value)
    assert do in caught.value.hint
    assert "--set fixer." in caught.value.message


def test_weights_enter_the_key_by_their_content_and_not_by_their_time(tmp_path):
    path = tmp_path / "net.safetensors"
    path.write_bytes(b"one")
    first = keys(("onefixer-dit-tiny",), (f"weights.dit={path}",))
    path.write_bytes(b"one")
    assert keys(("onefixer-dit-tiny",), (f"weights.dit={path}",)) == first
    path.write_bytes(b"two")
    assert keys(("onefixer-dit-tiny",), (f"weights.dit={path}",)) != first
    fixer = resolve("fixer", "onefixer-dit-tiny", (f"weights.dit={path}",))
    assert dict(fixer.files) == {str(path): file_sha256(path)}
    json.dumps(json_of(part_facts(fixer)))


def test_settings_for_a_fixer_that_is_not_there_are_refused():
    with pytest.raises(InputError):
        plan(("3dgs",), ("mode=chunk",))
    with pytest.raises(InputError):
        plan(("3dgs", "identity+clean"), ("identity:mode=chunk",))
    with pytest.raises(InputError):
        plan(("3dgs", "identity+clean"), ("3dgs:mode=chunk",))
