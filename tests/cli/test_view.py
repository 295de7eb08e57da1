"""``simrun view``: which page it writes of which rollouts, and what it refuses."""

import json
import shutil
from pathlib import Path

import pytest

from alpasim_plugin.cli.main import run_command
from tests.pages.make_run import Plan
from tests.pages.make_watched import make_watched, unfinished

PLAN = Plan(
    renderers=("clean", "3dgs"), scenes=("smoke-straight", "urban-left_turn"), seeds=(0,), steps=10
)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    root = make_watched(tmp_path_factory.mktemp("run") / "run", PLAN)
    unfinished(root, ["rollouts/3dgs/lane-camera/urban-left_turn/0"])
    return root


@pytest.fixture
def run(made, tmp_path):
    return Path(shutil.copytree(made, tmp_path / "run"))


def test_an_unfinished_run_is_shown_as_far_as_it_has_got(run, capsys):
    assert run_command(["view", str(run), "--json"]) == 0
    printed = capsys.readouterr()
    facts = json.loads(printed.out)
    assert facts["page"] == str(run / "view.html")
    assert facts["bytes"] == (run / "view.html").stat().st_size
    assert [cell["scene"] for cell in facts["cells"]] == ["smoke-straight", "urban-left_turn"]
    assert "3 of 4 rollouts" in printed.err
    assert run_command(["view", str(run)]) == 0  # its own page is replaced


def test_a_rollout_is_shown_beside_the_others_of_its_cell(run, tmp_path, capsys):
    folder = run / "rollouts/3dgs/lane-camera/smoke-straight/0"
    out = tmp_path / "one.html"
    assert run_command(["view", str(folder), "--out", str(out)]) == 0
    assert "2 of 2 rollouts" in capsys.readouterr().out  # behind both renderers
    text = out.read_text()
    assert '"scene":"smoke-straight"' in text
    assert "urban-left_turn" not in text[text.index('id="index"') :]
    assert run_command(["view", str(folder), "--out", str(out)]) == 2
    assert run_command(["view", str(folder), "--seed", "0"]) == 2


def test_what_cannot_be_shown_is_refused(run, tmp_path):
    for arguments in (
        [str(tmp_path / "nowhere")],
        [str(tmp_path)],
        [str(run), "--scene", "nowhere"],
        [str(run), "--seed", "7"],
        [str(run), "--scene", "urban-left_turn", "--renderer", "3dgs"],
    ):
        assert run_command(["view", *arguments]) == 2
