"""The gate of docs/ci.md, word for word, on the suite that the page names, with policies whose
drives are known: as before, worse, better, with new collisions, and not repeatable.
"""

import re
import shlex
from pathlib import Path

import pytest
import yaml

from alpasim_plugin.cli.main import run_command
from evaluators.statistics.opening import read_run

PAGE = Path(__file__).resolve().parents[2] / "docs" / "ci.md"
MINE = "my_policy:Mine"
NOISY = "tests.runs.broken_policies:ShiversByTheClock"
POLICIES = ("log-replay", "constant-velocity", "pure-pursuit", NOISY)
BASELINES = ("log-replay", "constant-velocity")


def gate_file():
    (text,) = re.findall(r"```yaml\n(# gate\.yaml\n.*?)```", PAGE.read_text(), re.DOTALL)
    return text


def workflow():
    """Return the words of the two commands that the page gives for its job: drive, and gate."""
    lines = re.findall(r"^simrun (.* runs/change\b.*)", PAGE.read_text(), re.MULTILINE)
    drive, gate = (shlex.split(line) for line in lines)
    return drive, gate


def test_the_page_s_action_is_given_what_its_commands_are():
    (job, *_) = re.findall(r"```yaml\n(# \.github.*?)```", PAGE.read_text(), re.DOTALL)
    (step,) = [step for step in yaml.safe_load(job)["jobs"]["drive"]["steps"] if "with" in step]
    drive, gate = workflow()
    assert [*shlex.split(step["with"]["drive"]), "--out", "runs/change"] == drive
    named = ["--gate", step["with"]["gate"], "--baseline-file", step["with"]["baseline-file"]]
    assert ["gate", "runs/change", *named] == gate


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """Drive every policy as the page does, and store two baselines."""
    folder = tmp_path_factory.mktemp("ci")
    (folder / "gate.yaml").write_text(gate_file())
    drive, _ = workflow()
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for policy in POLICIES:
            words = [policy if word == MINE else word for word in drive]
            words[words.index("runs/change")] = f"runs/{policy}"
            quick = ["--quiet", "--no-report", "--video", "none", "--workers", "1"]
            assert run_command([*words, *quick]) == 0
        for policy in BASELINES:
            stored = ["gate", f"runs/{policy}", "--write-baseline", f"{policy}.json"]
            assert run_command(stored) == 0
    return folder


@pytest.mark.slow
@pytest.mark.timeout(1800)  # the suite is driven four times
@pytest.mark.parametrize(
    ("policy", "baseline", "code"),
    [
        ("log-replay", "log-replay", 0),
        ("constant-velocity", "log-replay", 1),
        ("log-replay", "constant-velocity", 0),
        ("pure-pursuit", "log-replay", 1),  # new collisions in 3 of 14 scenes
        (NOISY, "log-replay", 3),
    ],
)
def test_the_page_s_gate_decides_as_common_sense_does(work, monkeypatch, policy, baseline, code):
    monkeypatch.chdir(work)
    _, gate = workflow()
    change = {"runs/change": f"runs/{policy}", "baseline.json": f"{baseline}.json"}
    assert run_command([change.get(word, word) for word in gate]) == code
    assert len(read_run(work / "runs" / policy).rollouts) == 14
