"""Settings of fixers: files, overrides, names, and what is refused."""

from importlib import resources
from pathlib import Path

import pytest

from alpasim_plugin.block_fixers.networks import load_networks
from alpasim_plugin.block_fixers.settings import OneFixerSettings
from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.core.parts import names
from alpasim_plugin.fixers import fixer_settings, make_fixer
from alpasim_plugin.fixers.settings import FixerSettings, load_settings
from tests.block_fixers.fixer_cases import small_settings


def refusal(*overrides, name="onefixer-dit-tiny"):
    with pytest.raises(InputError) as caught:
        fixer_settings(name, overrides)
    return str(caught.value)


@pytest.mark.parametrize(
    "name", ["onefixer", "onefixer-dit-tiny", "onefixer-dit-s", "onefixer-2b", "identity"]
)
def test_every_fixer_has_settings_that_load(name):
    assert name in names("fixer")
    assert isinstance(fixer_settings(name), FixerSettings)


def test_step_count_after_the_name():
    four = fixer_settings("onefixer-dit-tiny@4", ["window=8"])
    assert four.steps == (1000, 750, 500, 250)
    assert four.window == 8
    assert "no step count" in refusal(name="onefixer@0")
    assert "no step count" in refusal(name="onefixer@many")
    assert "did you mean 'onefixer'" in refusal(name="onefixr")


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("windw=4", ("--set fixer.windw=4", "did you mean 'window'")),
        ("decoder.kin=latent", ("unknown key 'kin' in decoder", "did you mean 'kind'")),
        ("decoder.kind=rendr", ("did you mean 'render'",)),
        ("window=0", ("window = 0",)),
        ("window=four", ("window = 'four'",)),
        ("sink=7", ("sink 7 in a window of 6",)),
        ("steps=[500]", ("falling from 1000",)),
        ("steps=[1000, 1000]", ("falling from 1000",)),
        ("decoder.kind=taehv", ("vae.kind wan",)),
        ("weights.sha256.ditt=00", ("unknown key 'ditt'", "did you mean 'dit'")),
        ("precision=fp8", ("precision is 'fp8'",)),
        ("precision=int8", ("precision is 'int8'", "fp32")),
        ("tolerance_m=-1", ("tolerance_m = -1",)),
    ],
)
def test_bad_values_are_named_with_their_place(override, words):
    text = refusal(override)
    for word in words:
        assert word in text


def test_a_bundle_and_parts_do_not_go_together():
    assert "give the bundle alone" in refusal("weights.bundle=a", "weights.dit=b")


def test_paths_start_where_they_were_written():
    settings = fixer_settings(
        "onefixer-dit-tiny", ["weights.dit=nets/a.safetensors", "weights.vae=/b.safetensors"]
    )
    assert settings.weights.dit == str(Path.cwd() / "nets/a.safetensors")
    assert settings.weights.vae == "/b.safetensors"


def test_a_bundle_that_ships_steps_aside_for_parts_and_keeps_its_sizes(tmp_path, monkeypatch):
    shipped = tmp_path / "shipped.yaml"
    plain = Path(str(resources.files("configs.fixers"))) / "onefixer-dit-tiny.yaml"
    shipped.write_text(
        plain.read_text().partition("weights:")[0] + "weights: {bundle: here.safetensors}\n"
    )
    monkeypatch.setattr("alpasim_plugin.fixers.settings.resources.files", lambda package: tmp_path)

    def weights(*overrides):
        return load_settings("shipped", OneFixerSettings, overrides).weights

    assert weights().bundle == str(tmp_path / "here.safetensors")
    assert weights("window=4").bundle == str(tmp_path / "here.safetensors")
    assert (weights("weights.dit=/a").bundle, weights("weights.dit=/a").dit) == (None, "/a")
    assert weights("weights.bundle=/b").bundle == "/b"
    assert weights("weights.bundle=null", "dit.width=24").bundle is None
    with pytest.raises(InputError):
        weights("dit.width=24")


def test_the_large_fixer_does_not_go_without_weights():
    with pytest.raises(InputError):
        make_fixer("onefixer-2b", scene_id="scene")


def test_an_untrained_wan_autoencoder_is_no_identity():
    with pytest.raises(InputError):
        load_networks(small_settings("vae.kind=wan", "decoder.kind=latent"))


def test_a_device_that_does_not_work_is_named(monkeypatch):
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(InfrastructureError):
        load_networks(small_settings(), "cuda")


def test_identity_passes_frames_on_and_checks_blocks():
    from tests.fixers.clip_cases import moving_picture

    session = make_fixer("identity", scene_id="scene")
    frames = moving_picture(13)
    assert session.label == "identity, no network"
    assert list(session.step(frames[:5], [])) == frames[:5]
    assert list(session.preview(frames[5:13], [])) == frames[5:13]
    with pytest.raises(InputError):
        session.step(frames[4:13], [])
    session.reset(0)
    with pytest.raises(InputError):
        session.step(frames[5:13], [])


@pytest.mark.parametrize("scale", ["0", "half", "1.5", "true"])
def test_a_scale_is_auto_or_a_whole_number(scale):
    with pytest.raises(InputError):
        fixer_settings("onefixer", [f"scale={scale}"])
    assert fixer_settings("onefixer", ["scale=3"]).scale_of(288, 512) == 3  # type: ignore[attr-defined]
