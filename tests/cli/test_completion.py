"""Completion scripts: what they offer is what the command line takes, and a Tab in bash offers it."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
import typer

from alpasim_plugin.cli.completion import RENDERERS, Completed, commands, known_names
from alpasim_plugin.cli.completion_shells import SCRIPTS
from alpasim_plugin.cli.main import VERBS, make_app, run_command

ASK = """
source "$1"; shift
COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMPREPLY=()
_simrun
printf '%s\\n' "${COMPREPLY[@]}"
"""


@pytest.fixture(scope="module")
def known() -> list[Completed]:
    return commands()


@pytest.fixture(scope="module")
def script(known: list[Completed], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("completion") / "simrun.bash"
    path.write_text(SCRIPTS["bash"](known, known_names()))
    return path


def offered(script: Path, *words: str) -> list[str]:
    done = subprocess.run(["bash", "-c", ASK, "bash", script, "simrun", *words], capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return done.stdout.split()


def test_every_option_of_every_command_is_offered_and_no_other(known: list[Completed]) -> None:
    for one in known:
        command = typer.main.get_command(make_app(one.words[0]))
        for word in one.words:
            command = command.commands[word]
        taken = {flag for param in command.params for flag in (*param.opts, *param.secondary_opts) if flag.startswith("-")}
        assert {flag for flag in one.options if flag != "--help"} == taken, one.words
    assert {one.words[0] for one in known} == set(VERBS)


def test_a_tab_in_bash_offers_verbs_options_and_names(script: Path) -> None:
    assert offered(script, "chec") == ["check", "check-driver", "check-policy"]
    assert "--renderer" in offered(script, "--re")
    assert offered(script, "--renderer", "clean,one")[0] == "clean,onefixer"
    assert offered(script, "run", "--policy", "lane") == ["lane-camera"]
    assert offered(script, "--policy", "lane-camera", "smoke/c") == ["smoke/curve"]
    assert offered(script, "--video", "") == ["none", "failures", "all"]
    assert offered(script, "gate", "--self") == ["--self-test"]
    assert "fixer" in offered(script, "train", "")
    assert offered(script, "train", "fixer", "--varia") == ["--variant"]
    assert offered(script, "list", "rend") == ["renderers"]
    assert not any(":" in name for name in offered(script, "--policy", ""))


def test_a_tab_starts_no_program(script: Path) -> None:
    bash = shutil.which("bash")
    assert bash is not None
    words = [bash, "-c", ASK, "bash", script, "simrun", "--renderer", "cle"]
    done = subprocess.run(words, capture_output=True, text=True, check=True, env={"PATH": "/nowhere"})
    assert (done.stdout, done.stderr) == ("clean\n", "")


def test_a_file_with_a_space_and_the_readers_own_scenarios_are_offered(
    script: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine.yaml").touch()
    monkeypatch.chdir(tmp_path)
    assert offered(script, "mi") == ["mine.yaml"]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_the_verb_prints_a_script_that_the_shell_reads(
    shell: str, known: list[Completed], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(["completion", shell]) == 0
    text = capsys.readouterr().out
    assert text == SCRIPTS[shell](known, known_names())
    assert known_names()[RENDERERS] in text
    if shutil.which(shell):
        path = tmp_path / "script"
        path.write_text(text)
        subprocess.run([shell, "-n", path], check=True)
