"""The cache of things that are costly to make: made once, whole or not there, made again when
damaged.
"""

import subprocess
import sys
import textwrap

import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.cache import cached


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("SIMRUN_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def read(folder):
    text = (folder / "text").read_text() if (folder / "text").exists() else ""
    if not text.startswith("good"):
        raise InputError(f"{folder / 'text'}: {text!r}", "make it again")
    return text


def test_is_made_at_the_first_call_and_read_at_the_second(own_cache):
    made = []

    def make(folder):
        made.append(folder)
        (folder / "text").write_text("good 1")

    assert [cached("texts", "k", make, read, "a text") for _ in range(2)] == ["good 1", "good 1"]
    assert len(made) == 1
    assert made[0] != own_cache / "texts" / "k"  # filled beside its place
    assert sorted(p.name for p in (own_cache / "texts").iterdir()) == ["k", "k.lock"]


def test_damaged_folder_is_made_again_with_a_warning(own_cache, capfd):
    def make(folder):
        (folder / "text").write_text("good 2")

    cached("texts", "k", make, read, "a text")
    (own_cache / "texts" / "k" / "text").write_text("bad")
    capfd.readouterr()
    assert cached("texts", "k", make, read, "a text") == "good 2"
    said = capfd.readouterr().err
    assert "warning: a text is damaged" in said
    assert "'bad'" in said
    assert "making it again" in said


def test_failure_while_making_leaves_nothing_and_the_next_call_tries_again(own_cache):
    def fails(folder):
        (folder / "text").write_text("good but unfinished")
        raise RuntimeError("fell over")

    with pytest.raises(RuntimeError, match="fell over"):
        cached("texts", "k", fails, read, "a text")
    assert [p.name for p in (own_cache / "texts").iterdir()] == ["k.lock"]
    assert (
        cached(
            "texts",
            "k",
            lambda folder: (folder / "text").write_text("good") and None,
            read,
            "a text",
        )
        == "good"
    )  # type: ignore[misc]


def test_folder_that_cannot_be_written_names_the_variable(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("SIMRUN_CACHE", str(tmp_path / "file" / "cache"))
    with pytest.raises(InputError, match="SIMRUN_CACHE"):
        cached("texts", "k", lambda folder: None, read, "a text")


def test_of_processes_that_ask_at_once_one_makes_and_the_others_wait(own_cache):
    script = textwrap.dedent(
        """
        import sys, time
        from pathlib import Path
        from alpasim_plugin.core.files.cache import cached

        def make(folder):
            time.sleep(0.4)
            (folder / "text").write_text(sys.argv[1])

        print(cached("texts", "k", make, lambda folder: (folder / "text").read_text(), "a text"))
        """
    )
    command = [sys.executable, "-c", script]
    pipe = subprocess.PIPE
    asking = [
        subprocess.Popen([*command, name], stdout=pipe, stderr=pipe, text=True) for name in "ab"
    ]
    answers = [p.communicate(timeout=250) for p in asking]
    assert {out.strip() for out, _ in answers} in ({"a"}, {"b"})
    assert sum("a text ..." in err for _, err in answers) == 1


def test_an_entry_that_was_moved_aside_when_its_maker_was_killed_is_read_again(own_cache):
    def make(folder):
        (folder / "text").write_text("good 3")

    cached("texts", "k", make, read, "a text")
    (own_cache / "texts" / "k").rename(own_cache / "texts" / ".k.simrun-backup")
    assert cached("texts", "k", pytest.fail, read, "a text") == "good 3"
