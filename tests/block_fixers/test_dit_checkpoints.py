"""Weights: every deviation is named, everything a training checkpoint carries besides is tolerated,
nothing but tensors is unpickled.
"""

import io
import json
import pickle
import shlex
import subprocess
import sys

import pytest
import torch
from safetensors.torch import save_file

from alpasim_plugin.block_fixers.dit import FLOAT32_KEYS, CosmosCausalDiT
from alpasim_plugin.block_fixers.factory import blocks
from alpasim_plugin.block_fixers.networks import at_precision
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import file_sha256
from alpasim_plugin.core.files.atomic import write_safetensors
from alpasim_plugin.fixers import fixer_settings
from alpasim_plugin.fixers.network.checkpoints import load_weights
from tests.block_fixers.dit_cases import SMALL, clip, furthest
from tests.block_fixers.dit_reference import random_weights, velocity


def load(sd, **options):
    return CosmosCausalDiT.from_state_dict(sd, **options)


def assert_equal(back, sd):
    torch.testing.assert_close(dict(back), sd, rtol=0, atol=0)


def changed(key, value):
    """Return small weights with one tensor replaced, or left out (None)."""
    sd = random_weights(SMALL) | {key: value}
    return {key: tensor for key, tensor in sd.items() if tensor is not None}


@pytest.mark.parametrize(
    ("sd", "text"),
    [
        (changed("t_embedding_norm.weight", None), "t_embedding_norm.weight"),
        (changed("blocks.1.mlp.layer1.weight", None), "missing: blocks.1.mlp.layer1.weight"),
        (changed("blocks.0.more.weight", torch.zeros(2)), "unexpected: blocks.0.more.weight"),
        (changed("blocks.1.mlp.layer2.weight", torch.zeros(3, 4)), "blocks.1.mlp.layer2.weight is"),
        ({"conv.weight": torch.zeros(3)}, "t_embedding_norm.weight"),
        (changed("blocks.0.self_attn.q_norm.weight", torch.ones(10)), "head width 10"),
    ],
)
def test_weights_that_do_not_fit_are_named(sd, text):
    with pytest.raises(InputError) as caught:
        load(sd, source="weights.safetensors")
    assert text in caught.value.message
    assert "weights.safetensors" in caught.value.message


def dressed(sd):
    """Return the same weights as a training run would store them."""
    out = {
        f"net.{key.replace('blocks.0.', 'blocks.0._checkpoint_wrapped_module.')}": value
        for key, value in sd.items()
    }
    out |= {f"net_ema.{key}": torch.zeros_like(value) for key, value in sd.items()}
    out |= {
        "net.pos_embedder.seq": torch.arange(64.0),
        "net.pos_embedder.dim_spatial_range": torch.zeros(2),
    }
    out |= {
        "net.pos_embedder.dim_temporal_range": torch.zeros(2),
        "net.accum_iteration": torch.tensor(7),
    }
    out |= {
        "net.accum_train_in_hours": torch.tensor(1.5),
        "net.blocks.0.self_attn.q_norm._extra_state": torch.zeros(0),
    }
    return out | {"optim.step": torch.tensor(3), "logvar.0.weight": torch.zeros(4, 4)}


@pytest.mark.parametrize(
    "wrap", [lambda sd: sd, lambda sd: {"model": sd}, lambda sd: {"state_dict": sd, "epoch": 3}]
)
def test_everything_a_training_run_stores_besides_is_tolerated(wrap):
    sd, c = random_weights(SMALL), clip(3)
    with torch.no_grad():
        assert torch.equal(load(wrap(dressed(sd)))(*c), load(sd)(*c))


@pytest.mark.parametrize("prefix", ["module.", "net_ema.", "module.net_ema.", "_orig_mod."])
def test_prefixes_of_wrappers_and_averages_are_stripped(prefix):
    sd = random_weights(SMALL)
    back = load({prefix + key: value for key, value in sd.items()}).state_dict()
    assert_equal(back, sd)


def test_a_network_without_a_map_is_refused():
    sd = changed("additional_patch_embedding.proj.1.weight", None)
    with pytest.raises(InputError) as caught:
        load(sd)
    assert "additional_patch_embedding" in caught.value.message


# --- shards, which the commands of docs/fixers.md join


def of_the_page(repo, word, folder):
    """Return a command of the page that holds a word, for a folder."""
    lines = (repo / "docs" / "fixers.md").read_text().splitlines()
    (line,) = (line for line in lines if line.startswith("python -") and word in line)
    return [sys.executable, *shlex.split(line.replace("FOLDER", str(folder)), comments=True)[1:]]


@pytest.mark.slow
def test_shards_of_safetensors_are_joined_by_the_page(repo, tmp_path):
    sd = random_weights(SMALL)
    folder = tmp_path / "shards"
    folder.mkdir()
    halves = sorted(sd)[::2], sorted(sd)[1::2]
    for number, keys in enumerate(halves):
        write_safetensors(folder / f"net-{number}.safetensors", {key: sd[key] for key in keys})
    index = folder / "net.safetensors.index.json"
    index.write_text(json.dumps({"weight_map": {key: "net-0.safetensors" for key in halves[0]}}))
    for path in (folder, index):
        with pytest.raises(InputError):
            load_weights(path)
        with pytest.raises(InputError):
            describe("onefixer-2b", f"weights.dit={path}")
    subprocess.run(of_the_page(repo, "glob", folder), cwd=tmp_path, check=True)
    back = load(load_weights(tmp_path / "net.safetensors")).state_dict()
    assert_equal(back, sd)


@pytest.mark.slow
def test_shards_of_torch_are_joined_by_the_page(repo, tmp_path):
    sd = random_weights(SMALL)
    folder = tmp_path / "shards"
    from torch.distributed import checkpoint  # its import takes seconds

    checkpoint.save({f"net.{key}": value for key, value in sd.items()}, checkpoint_id=folder)
    with pytest.raises(InputError):
        load_weights(folder)
    subprocess.run(of_the_page(repo, "dcp_to_torch", folder), cwd=tmp_path, check=True)
    back = load(load_weights(tmp_path / "net.pt")).state_dict()
    assert_equal(back, sd)


def describe(name, *overrides):
    return blocks.describe(fixer_settings(name, list(overrides)))


def test_network_owns_a_copy_of_its_weights():
    sd = random_weights(SMALL)
    net = load(sd)
    with torch.no_grad():
        net.t_embedding_norm.weight.zero_()
    assert sd["t_embedding_norm.weight"].any()


def test_state_dict_of_the_network_has_the_original_keys():
    sd = random_weights(SMALL)
    back = load(sd).state_dict()
    assert set(back) == set(sd)
    assert_equal(back, sd)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_tensors_are_widened(dtype):
    sd = random_weights(SMALL)
    c = clip(3)
    mixed = sd | {"blocks.0.mlp.layer1.weight": sd["blocks.0.mlp.layer1.weight"].to(dtype)}
    for weights in (mixed, {key: value.to(dtype) for key, value in sd.items()}):
        net = load(weights)
        assert {p.dtype for p in net.parameters()} == {torch.float32}
        with torch.no_grad():
            assert furthest(net(*c), velocity(weights, *c)) < 1e-5


def test_a_network_is_cast_but_for_what_stays_float32():
    net = at_precision(load(random_weights(SMALL)), "bf16", FLOAT32_KEYS)
    assert net.dtype == torch.bfloat16
    assert net.t_embedding_norm.weight.dtype == torch.float32


@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_weights_that_are_not_finite_are_named(value):
    sd = random_weights(SMALL)
    sd["blocks.1.mlp.layer2.weight"][2, 3] = value
    with pytest.raises(InputError):
        load(sd)


def test_integer_weights_are_named():
    sd = random_weights(SMALL)
    sd["final_layer.linear.weight"] = sd["final_layer.linear.weight"].to(torch.int8)
    with pytest.raises(InputError):
        load(sd)


# --- files


def test_safetensors_round_trip_with_digest_and_precision(tmp_path):
    sd = random_weights(SMALL)
    path = tmp_path / "net.safetensors"
    write_safetensors(path, sd, {"made": "test"})
    assert [p.name for p in tmp_path.iterdir()] == ["net.safetensors"]
    back = load_weights(path, sha256=file_sha256(path).upper())
    assert_equal(back, sd)
    with pytest.raises(InputError):
        load_weights(path, sha256="00")


def test_safetensors_whose_length_begins_like_a_pickle_loads(tmp_path):
    path = tmp_path / "x.safetensors"
    for pad in range(600):
        save_file({"a": torch.ones(2)}, path, {"pad": "x" * pad})
        if path.read_bytes()[:2] == b"\x80\x02":
            break
    assert path.read_bytes()[:2] == b"\x80\x02"
    assert torch.equal(load_weights(path)["a"], torch.ones(2))


@pytest.mark.parametrize("keep", [0, 5, 100, -100])
def test_truncated_safetensors_is_refused(tmp_path, keep):
    path = tmp_path / "net.safetensors"
    write_safetensors(path, random_weights(SMALL))
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(InputError):
        load_weights(path)


def test_text_file_and_missing_file_are_refused(tmp_path):
    (tmp_path / "a.safetensors").write_text("version https://git-lfs.github.com/spec/v1\n")
    with pytest.raises(InputError):
        load_weights(tmp_path / "a.safetensors")
    with pytest.raises(InputError):
        load_weights(tmp_path / "b.safetensors")


@pytest.mark.parametrize("name", ["model.pt", "renamed.safetensors"])
@pytest.mark.parametrize("legacy", [False, True])
def test_torch_file_of_tensors_loads(tmp_path, name, legacy):
    sd = random_weights(SMALL)
    torch.save({"model": dressed(sd)}, tmp_path / name, _use_new_zipfile_serialization=not legacy)
    back = CosmosCausalDiT.from_state_dict(load_weights(tmp_path / name))
    assert_equal(back.state_dict(), sd)


class Trap:
    """Writes a file when unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (str(self.path), "w")


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
@pytest.mark.parametrize("plain", [False, True])
def test_pickle_with_code_is_refused_and_not_run(tmp_path, plain):
    path = tmp_path / "net.safetensors"
    sprung = tmp_path / "sprung"
    content = {"a": torch.zeros(1), "trap": Trap(sprung)}
    if plain:
        path.write_bytes(pickle.dumps({"trap": Trap(sprung)}))
    else:
        torch.save(content, path)
    with pytest.raises(InputError):
        load_weights(path)
    assert not sprung.exists()


def test_pickled_byte_buffers_of_transformer_engine_are_tolerated(tmp_path):
    sd = {**random_weights(SMALL), "blocks.0.self_attn.q_norm._extra_state": io.BytesIO(b"\x80")}
    torch.save(sd, tmp_path / "net.pt")
    assert "blocks.0.self_attn.q_norm._extra_state" not in load_weights(tmp_path / "net.pt")


@pytest.mark.parametrize("content", [[1, 2], {"a": 3}, {"model": {"epoch": 1}}])
def test_torch_file_without_tensors_is_refused(tmp_path, content):
    torch.save(content, tmp_path / "x.pt")
    with pytest.raises(InputError):
        load_weights(tmp_path / "x.pt")


def test_other_things_between_tensors_are_named():
    with pytest.raises(InputError):
        load({**random_weights(SMALL), "config": {}})
