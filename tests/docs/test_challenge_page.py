"""The commands of the page of AlpaSim's challenge, in their order, in one folder: two drivers that
run as processes of their own, on short scenes.

Slow: ``pytest -m slow`` on this file. The starter kit is stood for by the driver that the page starts
itself, and by one that goes straight on.
"""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from tests.docs.commands import commands

REPO = Path(__file__).resolve().parents[2]
PAGE = REPO / "docs" / "challenge.md"
PROGRAM = REPO / "tests" / "alpasim" / "straight_driver.py"
SCENE = """
version: 1
road: {segments: [{kind: straight, length_m: 400}]}
cameras: {rig: alpasim-4-and-front, width: 48}
actors: [{kind: drive, id: ahead, s_m: 60, speeds: [[0, 10]]}]
"""
SHORT = ("--set", "timing.duration_us=3000000", "--set", "cameras.width=48")
CODES = {"check": (0, 1), "gate": (0, 1, 3)}  # of a busy machine, or of what was driven


def simrun(words, folder):
    return subprocess.run(
        [sys.executable, "-m", "alpasim_plugin.cli.main", *words],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(REPO)},
    )


@contextmanager
def process(words, folder, **variables):
    with subprocess.Popen(
        words, cwd=folder, env={**os.environ, "PYTHONPATH": str(REPO), **variables}
    ) as running:
        time.sleep(3.0)
        try:
            assert running.poll() is None
            yield
        finally:
            running.send_signal(signal.SIGTERM)


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_page_leads_from_a_driver_to_a_verdict_between_two(tmp_path):
    (tmp_path / "scenes").mkdir()
    for name in ("one", "two"):
        (tmp_path / "scenes" / f"{name}.yaml").write_text(SCENE)
    swapped = {
        "suites/challenge": "scenes",
        "challenge/street_winding": "scenes/one.yaml",
    }
    steps = [
        [swapped.get(word, word) for word in command.words] for command in commands(REPO, [PAGE])
    ]
    verbs = [words[0] for words in steps]
    assert verbs == ["serve", "check", "check", "--settings", "--settings", "gate", "score"]
    serve, *others = steps
    with ExitStack() as drivers:
        served = [sys.executable, "-m", "alpasim_plugin.cli.main", *serve]
        drivers.enter_context(process(served, tmp_path))
        straight = [sys.executable, str(PROGRAM)]
        place = {"SIMRUN_POLICY_ADDRESS": "127.0.0.1:6790"}
        drivers.enter_context(process(straight, tmp_path, **place))
        for words in others:
            if "exec:" in " ".join(words):
                words = ["check", "driver", f"exec:{sys.executable} {PROGRAM}"]
                words += ["--scenario", "scenes/one.yaml"]
            more = SHORT if words[0] == "--settings" else ()
            done = simrun([*words, *more], tmp_path)
            assert done.returncode in CODES.get(words[0], (0,)), (words, done.stdout, done.stderr)
            assert "Traceback" not in done.stderr
            if words[0] == "--settings":
                assert "drive calls took" in done.stdout
    summary = json.loads((tmp_path / "scored" / "aggregate" / "results-summary.json").read_text())
    assert all("score" in rollout for rollout in summary["rollouts"])
