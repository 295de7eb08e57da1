"""A pack of pairs: small, nearly what was packed, and all that training needs."""

import shutil
import zipfile
from dataclasses import replace

import numpy as np
import pytest

from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.block_fixers.tiny_vae_nets import TinySizes
from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.training import pair_pack
from alpasim_plugin.lab.training.pair_pack import (
    depth_of_levels,
    levels_of_depth,
    unpack,
    write_pack,
)
from alpasim_plugin.lab.training.pair_store import PairDataset
from tests.interrupted_folder import kill_between_renames
from tests.lab.cli.small_training import FEW, SIZES
from tests.lab.training.pair_files import make


@pytest.fixture
def pack(tmp_path):
    """Two sequences, the first with depths, in a file; the folder is gone."""
    folders = [make(tmp_path / "all", name=f"street_00{i}", frames=14).folder for i in (0, 1)]
    depth = np.full((14, 32, 48), 8.0, dtype=np.float16)
    np.save(folders[0] / "depth.npy", depth)
    np.save(folders[0] / "boxes.npy", np.ones((1, 3)))
    path = tmp_path / "pairs.pack"
    facts = write_pack(folders, path)
    assert (facts.sequences, facts.frames, facts.left_out) == (2, 28, 0)
    assert (
        facts.bytes
        == path.stat().st_size
        < sum(f.stat().st_size for f in folders[0].iterdir() if f.is_file())
    )
    assert facts.psnr_db["rgb_gt"] > 20
    shutil.move(tmp_path / "all", tmp_path / "was")
    return path


def test_a_sequence_whose_replacement_was_killed_is_kept(pack, tmp_path):
    folder = unpack(pack, tmp_path / "new") / "train" / "street_000"
    (folder / "mine.txt").write_text("mine")
    kill_between_renames(folder)
    unpack(pack, tmp_path / "new")
    assert (folder / "mine.txt").read_text() == "mine"
    assert not folder.with_name(".street_000.simrun-backup").exists()


def test_sequences_come_back_nearly_as_they_were(pack, tmp_path):
    found = PairDataset(unpack(pack, tmp_path / "new"), "train").sequences
    wanted = PairDataset(tmp_path / "was", "train").sequences
    for one, other in zip(found, wanted, strict=True):
        assert one.content != other.content
        assert np.array_equal(one.clip.T_world_camera, other.clip.T_world_camera)
        assert np.array_equal(one.clip.t_us, other.clip.t_us)
        assert np.abs(one.clip.rgb_gt.astype(float) - other.clip.rgb_gt).mean() < 16
    depth = np.load(found[0].folder / "depth.npy")
    assert np.abs(depth.astype(float) / 8 - 1).max() < 0.03
    assert np.load(found[0].folder / "boxes.npy").shape == (1, 3)
    written = {path: path.stat().st_mtime_ns for path in (tmp_path / "new").rglob("*.npy")}
    unpack(pack, tmp_path / "new")
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "new").rglob("*.npy")} == written


def test_depths_keep_their_logarithm_and_their_holes():
    depth = np.array([0, 0.25, 1, 9, 120, 1000, 5000], dtype=np.float16)
    found = depth_of_levels(levels_of_depth(depth)).astype(float)
    assert found[0] == 0
    assert np.abs(found[1:-1] / depth[1:-1].astype(float) - 1).max() < 0.02


def test_what_has_no_room_is_left_out(pack, tmp_path):
    folders = [s.folder for s in PairDataset(tmp_path / "was", "train").sequences]
    facts = write_pack(folders, tmp_path / "one.pack", pack.stat().st_size - 1000)
    assert (facts.sequences, facts.left_out) == (1, 1)
    with pytest.raises(InputError):
        write_pack(folders, tmp_path / "none.pack", 1000)
    assert not (tmp_path / "none.pack").exists()


@pytest.mark.parametrize("name", ["train/../sequence.json", "../x/sequence.json", "sequence.json"])
def test_a_pack_writes_nowhere_else(name, tmp_path):
    with zipfile.ZipFile(tmp_path / "bad.pack", "w") as archive:
        archive.writestr(name, "{}")
    with pytest.raises(InputError):
        unpack(tmp_path / "bad.pack", tmp_path / "new" / "folder")
    assert not (tmp_path / "new").exists()


def test_a_pack_that_unpacks_to_too_much_is_refused(pack, tmp_path, monkeypatch):
    was = pair_pack.SEQUENCE_BYTES
    monkeypatch.setattr(pair_pack, "SEQUENCE_BYTES", replace(was, high=14 * 32 * 48 * 3 - 1))
    with pytest.raises(InputError, match="unpacked size of a sequence"):
        unpack(pack, tmp_path / "new")
    monkeypatch.undo()
    with zipfile.ZipFile(pack, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("train/street_000/more.npy", bytes(5_000_000))
    monkeypatch.setattr(pair_pack, "SEQUENCE_BYTES", replace(was, high=5_000_000))
    with pytest.raises(InputError, match="unpacked size of a sequence"):
        unpack(pack, tmp_path / "new")


def test_a_video_with_more_images_than_stated_is_damaged(pack, tmp_path):
    with zipfile.ZipFile(pack) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    name = "train/street_000/sequence.json"
    files[name] = files[name].replace(b"[14, ", b"[13, ")
    with zipfile.ZipFile(tmp_path / "bad.pack", "w") as archive:
        for entry, data in files.items():
            archive.writestr(entry, data)
    with pytest.raises(InputError, match="more than 13 images"):
        unpack(tmp_path / "bad.pack", tmp_path / "new")


def test_training_needs_nothing_but_the_pack(pack, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.rmtree(tmp_path / "was")
    fixer = ["per-frame", "pairs.pack", "--out", "runs/a", "--steps", "1", *SIZES, *FEW]
    assert run_command(["train", *fixer]) == 0
    TinyVAE.random(TinySizes(16, 16, 16, 16, 16)).save(tmp_path / "vae.safetensors")
    block = ["fixer", "pairs.pack", "--out", "runs/b", "--recipe", "base", "--steps", "1"]
    few = ["--latents", "3", "--clips", "1", "--accumulate", "1", "--threads", "1"]
    assert run_command(["train", *block, "--vae", "vae.safetensors", *few]) == 0
