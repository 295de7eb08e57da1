"""``simrun gate RUN RUN...``: one verdict on the shards of a run."""

import json
import os
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
import yaml

from alpasim_plugin.cli.main import run_command
from tests.core.checksum_files import vouch_for
from tests.pages.make_run import Plan, make_run

SCENES = tuple(f"scene-{i:02d}" for i in range(9))
GATE = """version: 1
metrics:
  lateral_distance_m: {margin: 2.0}
  offroad: {margin: 0.05}
"""


def set_info(folder, **members):
    """Set members of a run's run.json."""
    path = folder / "run.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | members))
    return vouch_for(folder)


@pytest.fixture(scope="module")
def shards(tmp_path_factory):
    """Make three shards of a run whose ``onefixer`` is as good as ``clean`` in the first two and far
    worse in the third, and a third that is as good.
    """
    folder = tmp_path_factory.mktemp("shards")
    good, bad = {"clean": 0.15, "onefixer": 0.15}, {"clean": 0.15, "onefixer": 12.0}
    made = {}
    for name, number, harm in (("1", 1, good), ("2", 2, good), ("3", 3, bad), ("good", 3, good)):
        scenes = SCENES[number - 1 :: 3]
        plan = Plan(
            renderers=("clean", "onefixer"),
            scenes=scenes,
            seeds=(0, 1),
            steps=40,
            clips=False,
            invalid=(),
            harm=harm,
        )
        made[name] = set_info(make_run(folder / name, plan), shard=f"{number}/3")
    return made


@pytest.fixture
def gate(tmp_path):
    path = tmp_path / "gate.yaml"
    path.write_text(GATE)

    def call(capsys, *folders, extra=()):
        words = ["gate", *map(str, folders), "--gate", str(path), *extra, "--json"]
        code = run_command(words)
        return code, json.loads(capsys.readouterr().out)

    return call


def test_all_shards_have_one_verdict_and_the_worst_scene_of_any_is_in_it(
    shards, gate, capsys, tmp_path
):
    out = tmp_path / "verdict"
    code, facts = gate(capsys, shards["3"], shards["1"], shards["2"], extra=["--out", str(out)])
    assert code == 1
    worse = [check for check in facts["checks"] if check["cause"] == "regression"]
    assert {pair["scene"] for check in worse for pair in check["entry"]["worst"]} <= set(
        SCENES[2::3]
    )
    page = (out / "gate.md").read_text()
    assert "Gate: " in page
    assert all(str(shards[name]) in page for name in "123")
    cases = ET.parse(out / "gate.junit.xml").getroot().iter("testcase")
    rollouts = [case for case in cases if not case.get("classname").startswith("gate.")]
    assert len(rollouts) == 2 * 2 * len(SCENES)
    assert not any((folder / "gate.json").exists() for folder in shards.values())


def test_shards_that_are_all_good_pass_in_any_order(shards, gate, capsys):
    names = ("good", "1", "2")
    code, facts = gate(capsys, *(shards[name] for name in names))
    assert code == 0
    assert facts["files"] == []
    again, other = gate(capsys, *(shards[name] for name in reversed(names)))
    assert again == 0
    assert [check["text"] for check in other["checks"]] == [
        check["text"] for check in facts["checks"]
    ]


@pytest.mark.parametrize(
    ("names", "sentence"),
    [
        (("1",), "shards 2/3 and 3/3 are missing"),
        (("1", "good"), "shard 2/3 is missing"),
    ],
)
def test_some_shards_alone_are_incomplete_and_say_which_are_missing(
    shards, gate, capsys, names, sentence
):
    code, facts = gate(capsys, *(shards[name] for name in names))
    assert code == 2
    assert facts["outcome"]["cause"] == "incomplete"
    assert sentence in " ".join(facts["outcome"]["reasons"])


def test_a_shard_alone_becomes_no_baseline_and_all_of_them_do(shards, gate, capsys, tmp_path):
    stored = str(tmp_path / "baseline.json")
    assert run_command(["gate", str(shards["1"]), "--write-baseline", stored]) == 2
    assert "shards 2/3 and 3/3 are missing" in capsys.readouterr().err
    folders = [shards[name] for name in ("1", "2", "good")]
    assert run_command(["gate", *map(str, folders), "--write-baseline", stored]) == 0
    capsys.readouterr()
    code, _ = gate(capsys, *folders, extra=["--baseline-file", stored])
    assert code == 0
    code, _ = gate(capsys, shards["1"], shards["2"], shards["3"], extra=["--baseline-file", stored])
    assert code == 1


def test_runs_that_are_no_shards_of_one_are_refused(shards, tmp_path, capsys, gate):
    same = str(shards["1"])
    assert run_command(["gate", same, same]) == 2
    assert "shard 1/3 is there twice" in capsys.readouterr().err
    assert run_command(["gate", str(shards["3"]), str(shards["good"])]) == 2
    assert "shard 3/3 is there twice" in capsys.readouterr().err
    whole = make_run(tmp_path / "whole", Plan(renderers=("clean", "onefixer"), scenes=SCENES[:1]))
    assert run_command(["gate", same, str(vouch_for(whole))]) == 2
    assert "shards of different runs: 1/3, not divided" in capsys.readouterr().err
    copied = make_run(tmp_path / "copied", Plan(renderers=("clean", "onefixer"), scenes=SCENES[:1]))
    assert run_command(["gate", str(whole), str(vouch_for(copied))]) == 2
    assert "both have" in capsys.readouterr().err


def test_shards_of_other_code_are_not_joined(shards, tmp_path, gate, capsys):
    plan = Plan(
        renderers=("clean", "onefixer"), scenes=SCENES[2::3], seeds=(0, 1), steps=40, clips=False
    )
    part = {
        "name": "mine",
        "target": "m:Mine",
        "label": "mine",
        "digest": "0" * 12,
        "trained": None,
        "files": {},
        "code": {},
        "unseen": "",
        "settings": None,
    }
    first = set_info(make_run(tmp_path / "first", plan), shard="1/2", parts={"policy mine": part})
    plan = Plan(
        renderers=("clean", "onefixer"), scenes=SCENES[1::3], seeds=(0, 1), steps=40, clips=False
    )
    second = set_info(
        make_run(tmp_path / "second", plan),
        shard="2/2",
        parts={"policy mine": part | {"digest": "1" * 12}},
    )
    assert run_command(["gate", str(first), str(second)]) == 2
    assert "policy mine has other code, settings or files" in capsys.readouterr().err


ACTION = Path(__file__).parents[2] / ".github" / "actions" / "simrun-gate" / "action.yml"


def test_the_action_judges_all_folders_that_a_pattern_names(shards, tmp_path):
    action = yaml.safe_load(ACTION.read_text())
    defaults = {name: facts["default"] for name, facts in action["inputs"].items()}
    (step,) = [step for step in action["runs"]["steps"] if step.get("id") == "gate"]
    inputs = defaults | {"runs": "runs/part-*", "gate": "gate.yaml"}
    environment = {
        name: inputs[text.removeprefix("${{ inputs.").removesuffix(" }}")]
        for name, text in step["env"].items()
    }
    (tmp_path / "gate.yaml").write_text(GATE)
    for name in "123":
        shutil.copytree(shards[name], tmp_path / "runs" / f"part-{name}")
    output = tmp_path / "output"
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-e", "-c", step["run"]],
        cwd=tmp_path,
        env={**os.environ, **environment, "GITHUB_OUTPUT": str(output), "PATH": path},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 1, done.stderr
    assert output.read_text() == "exit-code=1\n"
    assert (tmp_path / "gate" / "gate.junit.xml").is_file()
