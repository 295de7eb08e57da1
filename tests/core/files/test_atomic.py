"""Files appear complete or not at all, and a disk that refuses is an error with four parts."""

import errno
import json
import os
import re
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.core.files import atomic
from alpasim_plugin.core.files.atomic import (
    atomic_file,
    atomic_folder,
    restore_folders,
    write_array,
    write_bytes,
    write_json,
    write_safetensors,
    write_text,
)
from tests.interrupted_folder import kill_between_renames

WRITERS = {
    "bytes": lambda path, n: write_bytes(path, bytes([n]) * 4),
    "text": lambda path, n: write_text(path, f"é {n}"),
    "json": lambda path, n: write_json(path, {"n": n}),
    "array": lambda path, n: write_array(path, np.full(4, n)),
    "safetensors": lambda path, n: write_safetensors(
        path, {"n": torch.full((4,), n)}, {"of": "test"}
    ),
}


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS])
def test_a_disk_that_refuses_leaves_the_old_file_and_no_litter(
    write, number, tmp_path, monkeypatch
):
    def full(fd):
        raise OSError(number, os.strerror(number))

    path = tmp_path / "out"
    write(path, 1)
    before = path.read_bytes()
    monkeypatch.setattr(atomic.os, "fsync", full)
    with pytest.raises(InfrastructureError) as caught:
        write(path, 2)
    assert caught.value.message.startswith(str(path))
    assert caught.value.exit_code == 4
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["out"]
    monkeypatch.undo()
    write(path, 2)
    assert path.read_bytes() != before


def test_what_is_written_is_what_is_read(tmp_path):
    for name, write in WRITERS.items():
        write(tmp_path / name, 3)
    assert (tmp_path / "bytes").read_bytes() == b"\3\3\3\3"
    assert (tmp_path / "text").read_text(encoding="utf-8") == "é 3"
    assert json.loads((tmp_path / "json").read_text()) == {"n": 3}
    np.testing.assert_array_equal(np.load(tmp_path / "array"), [3, 3, 3, 3])
    assert load_file(tmp_path / "safetensors")["n"].tolist() == [3, 3, 3, 3]


def test_safetensors_of_equal_content_have_equal_bytes_in_every_process(tmp_path):
    code = (
        "import sys, torch\n"
        "from alpasim_plugin.core.files.atomic import write_safetensors\n"
        "facts = {name: f'é \\x01\\x7f\\n\"{name}' for name in 'qwertyuiop'}\n"
        "write_safetensors(sys.argv[1], {'b': torch.ones(3), 'a': torch.zeros(2)}, facts)\n"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "a")], check=True)
    facts = {name: f'é \x01\x7f\n"{name}' for name in "qwertyuiop"}
    write_safetensors(tmp_path / "b", {"b": torch.ones(3), "a": torch.zeros(2)}, facts)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    with safe_open(tmp_path / "a", "pt") as file:
        assert file.metadata() == facts
        assert file.get_tensor("b").tolist() == [1.0, 1.0, 1.0]


def test_a_process_killed_in_the_middle_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.json"
    write_json(path, {"run": 1})
    code = (
        "import os, signal, sys\n"
        "from alpasim_plugin.core.files.atomic import atomic_file\n"
        "with atomic_file(sys.argv[1]) as partial:\n"
        "    partial.write_text('{\"run\":')\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    assert subprocess.run([sys.executable, "-c", code, str(path)], check=False).returncode == -9
    assert json.loads(path.read_text()) == {"run": 1}
    (left,) = set(tmp_path.iterdir()) - {path}
    here = f".{left.name.split('.')[-2][:8]}"
    others = [left.name.replace(here, ".01234567"), re.sub(r"\.\d+\.", f".{'9' * 30}.", left.name)]
    for name in others:  # of another machine, and of no process
        (tmp_path / name).touch()
    code = code.replace("os.kill", "print")
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "b.json")], check=True)
    assert {entry.name for entry in tmp_path.iterdir()} == {"a.json", "b.json", *others}


@pytest.mark.parametrize("error", [ValueError("no"), KeyboardInterrupt()])
def test_a_block_that_raises_leaves_the_old_file(error, tmp_path):
    path = tmp_path / "a.txt"
    write_text(path, "old")
    with pytest.raises(type(error)), atomic_file(path) as partial:  # noqa: PT012 - the block is what fails
        partial.write_text("new")
        raise error
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_a_block_that_fails_leaves_the_old_folder(tmp_path):
    folder = tmp_path / "deep" / "a"
    with atomic_folder(folder) as partial:
        (partial / "x").write_text("old")
    for error, seen in (
        (ValueError("no"), ValueError),
        (OSError(28, "No space left"), InfrastructureError),
    ):
        with pytest.raises(seen), atomic_folder(folder) as partial:  # noqa: PT012 - the block is what fails
            (partial / "x").write_text("new")
            raise error
    assert (folder / "x").read_text() == "old"
    with atomic_folder(folder) as partial:
        (partial / "y").write_text("new")
    assert [path.name for path in folder.iterdir()] == ["y"]
    assert [path.name for path in folder.parent.iterdir()] == ["a"]


def test_the_old_folder_returns_if_the_new_one_cannot_be_renamed(tmp_path, monkeypatch):
    folder = tmp_path / "a"
    folder.mkdir()
    (folder / "x").write_text("old")
    monkeypatch.setattr(atomic, "_change_places", lambda first, second: False)
    rename, refusals = Path.replace, iter([False, True, False])

    def replace(self, target):
        if next(refusals):
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return rename(self, target)

    monkeypatch.setattr(Path, "replace", replace)
    with pytest.raises(InfrastructureError, match="Input/output"), atomic_folder(folder) as partial:
        (partial / "x").write_text("new")
    assert (folder / "x").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


@pytest.mark.parametrize("name", ["array", "safetensors"])
def test_a_missing_folder_is_named_with_advice(name, tmp_path):
    with pytest.raises(InfrastructureError, match="No such file or directory") as caught:
        WRITERS[name](tmp_path / "absent" / "a", 1)
    assert "exists" in caught.value.hint


@pytest.mark.parametrize("name", ["loop/a", "file/a", "x" * 300])
def test_the_folder_of_bytes_is_made_and_a_path_that_cannot_be_is_bad_input(tmp_path, name):
    write_bytes(tmp_path / "new/folder/a", b"a")
    assert (tmp_path / "new/folder/a").read_bytes() == b"a"
    (tmp_path / "file").touch()
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(InputError):
        write_bytes(tmp_path / name, b"a")


def test_a_process_killed_between_the_two_renames_leaves_the_old_folder_to_the_next(tmp_path):
    folder = tmp_path / "a"
    folder.mkdir()
    (folder / "x").write_text("old")
    kill_between_renames(folder)
    with pytest.raises(ValueError, match="no"), atomic_folder(folder):  # noqa: PT012 - the block is what fails
        assert (folder / "x").read_text() == "old"
        raise ValueError("no")
    assert (folder / "x").read_text() == "old"
    with atomic_folder(folder) as partial:
        (partial / "x").write_text("newer")
    assert (folder / "x").read_text() == "newer"
    assert not folder.with_name(".a.simrun-backup").exists()


def test_who_lists_folders_finds_those_whose_replacement_was_killed(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
    kill_between_renames(tmp_path / "a")
    restore_folders(tmp_path)
    assert {path.name for path in tmp_path.iterdir() if path.name[0] != "."} == {"a", "b"}


def test_a_reader_meets_the_old_or_the_new_folder_and_never_none(tmp_path):
    folder = tmp_path / "a"
    folder.mkdir()
    if not atomic._change_places(folder, folder):
        pytest.skip("this file system cannot let two folders change places")

    def replace_often():
        for number in range(50):
            with atomic_folder(folder) as partial:
                (partial / "x").write_text(str(number))

    writer = threading.Thread(target=replace_often)
    writer.start()
    while writer.is_alive():
        assert folder.exists()
    assert (folder / "x").read_text() == "49"
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_a_link_to_a_folder_is_replaced_and_what_it_leads_to_stays(tmp_path):
    (tmp_path / "target").mkdir()
    (tmp_path / "target" / "mine.txt").write_text("mine")
    (tmp_path / "a").symlink_to("target")
    with atomic_folder(tmp_path / "a") as partial:
        (partial / "x").write_text("new")
    assert (tmp_path / "target" / "mine.txt").read_text() == "mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a", "target"]


def test_a_folder_of_a_user_with_a_name_like_a_temporary_one_is_left_alone(tmp_path):
    for name in (".a.old", ".a.tmp"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "mine.txt").write_text("mine")
    with atomic_folder(tmp_path / "a") as partial:
        (partial / "x").write_text("new")
    for name in (".a.old", ".a.tmp"):
        assert (tmp_path / name / "mine.txt").read_text() == "mine"
    assert [path.name for path in (tmp_path / "a").iterdir()] == ["x"]
