"""Twelve drivers with a fault each: what the page of causes names."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.runs.plan import RunOptions, make_plan
from alpasim_plugin.runs.run import execute_run
from scenarios.suite import expand
from tests.runs.painted_renderer import BEND, PAINTED
from tests.runs.test_runs import Announced

NAMED = {
    "SteeringSign": "left and right are exchanged",
    "Latency": "react to a picture 0.8 s late",
    "SwappedChannels": "exchanges red and blue",
    "WrongFocalLength": "focal length for 1.25 times",
    "FrozenFrame": "stop to react to pictures",
    "MirroredPicture": "reads the picture mirrored",
    "WrongUnit": "takes its speed for 0.28 times",
    "WorldAxes": "has the world's axes",
    "WrongPitch": "6 degrees further down",
    "TimeStep": "poses come after 2 times as long",
    "Blind": "do not depend on the pictures",
    "UpsideDown": "reads the picture upside down",
}


@pytest.mark.slow
@pytest.mark.parametrize("bug", NAMED)
def test_the_page_names_the_fault(
    bug: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("alpasim_plugin.runs.trials.MOST_S", math.inf)  # on a busy machine too
    (tmp_path / "bend.yaml").write_text(BEND)
    policy = f"tests.runs.seeded_bugs:{bug}"
    plan = make_plan(expand(str(tmp_path / "bend.yaml")), (PAINTED,), (policy,), (0,), RunOptions())
    execute_run(
        plan, tmp_path / "run", 1, ["simrun"], Announced(), certificate="none", report=False
    )
    (folder,) = (path.parent for path in (tmp_path / "run").glob("rollouts/*/*/*/*/manifest.json"))
    capsys.readouterr()
    assert run_command(["why", str(folder), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    print(json.dumps(found["found"]), found["tried"][:4])
    assert NAMED[bug] in found["found"][0]["text"]
