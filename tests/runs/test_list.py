"""``simrun list runs``: which folders are runs, what is said of each, and which of them a filter
takes.
"""

import json
import os
from pathlib import Path

import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.files.lock import one_writer
from tests.runs.make_many import COMMITS, Many, make_one, unfinish

OLD = "2026-01-10T08:00:00+00:00"
MIDDLE = "2026-02-10T08:00:00+00:00"
NEW = "2026-03-10T08:00:00+00:00"
RUNS = (
    Many(
        "old",
        OLD,
        COMMITS[0],
        renderers=("clean",),
        asked=("smoke/curve",),
        scenes={"smoke-curve": "0" * 64},
    ),
    Many(
        "team/middle",
        MIDDLE,
        COMMITS[1],
        dirty=True,
        renderers=("clean", "3dgs"),
        preset="strict",
        policies=("lane-camera", "mine:Policy"),
    ),
    Many("team/new", NEW, None, weights="abc123" + "f" * 58, shift_m={"onefixer": 0.5}),
)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    root = tmp_path_factory.mktemp("many") / "runs"
    for one in RUNS:
        make_one(root, one)
    return root


def listed(capsys, *words):
    """Return name -> run of a list, in its order."""
    capsys.readouterr()
    assert run_command(["list", "runs", *words, "--json"]) == 0
    return {
        Path(str(one["folder"])).name: one for one in json.loads(capsys.readouterr().out)["runs"]
    }


def test_runs_are_found_at_any_depth_and_the_newest_comes_first(root, capsys):
    found = listed(capsys, str(root))
    assert list(found) == ["new", "middle", "old"]
    assert [one["rollouts"] for one in found.values()] == [24, 48, 2]
    assert found["middle"]["project"] == {
        "commit": COMMITS[1],
        "dirty": True,
        "reason": "",
    }
    assert list(listed(capsys, str(root / "old"), str(root))) == [
        "new",
        "middle",
        "old",
    ]  # named twice, listed once


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (("--renderer", "3dgs"), ["middle"]),
        (("--renderer", "clean", "--renderer", "one*"), ["new"]),
        (("--policy", "mine:*"), ["middle"]),
    ],
)
def test_a_filter_takes(root, capsys, words, names):
    assert list(listed(capsys, str(root), *words)) == names


def test_what_cannot_be_read_is_listed_as_such(tmp_path, capsys):
    stopped = unfinish(make_one(tmp_path, Many("stopped")))
    (stopped / ".simrun.lock").touch()
    os.truncate(make_one(tmp_path, Many("cut")) / "run.json", 300)
    (make_one(tmp_path, Many("holed")) / "summary.json").unlink()
    (make_one(tmp_path, Many("garbled")) / "summary.json").write_text("{}\n}")
    (tmp_path / "locked-only").mkdir()
    (tmp_path / "locked-only" / ".simrun.lock").touch()
    (tmp_path / "alien").mkdir()
    (tmp_path / "alien" / "run.json").write_text('{"id": "another program\'s"}')
    written = unfinish(make_one(tmp_path, Many("written")))
    with one_writer(written / ".simrun.lock", "writing", "a run"):
        found = listed(capsys, str(tmp_path))
    said = {name: (one["state"], bool(one["problem"])) for name, one in found.items()}
    assert said == {
        "stopped": ("unfinished", False),
        "written": ("running", False),
        "cut": ("damaged", True),
        "holed": ("unfinished", False),
        "garbled": ("damaged", True),
        "locked-only": ("damaged", True),
        "alien": ("damaged", True),
    }
    assert found["stopped"]["rollouts"] == 24  # planned
    assert listed(capsys, str(tmp_path), "--metric", "offroad")["garbled"]["state"] == "damaged"
    capsys.readouterr()
    assert run_command(["list", "runs", str(tmp_path)]) == 0
    out, err = capsys.readouterr()
    assert "cut" in out
    assert sorted(Path(line.split(": ")[1]).name for line in err.splitlines()) == [
        "alien",
        "cut",
        "locked-only",
    ]


def test_the_table_shows_metrics_beside_their_renderers(root, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    assert (
        run_command(
            ["list", "runs", str(root), "--metric", "offroad", "--metric", "lateral_distance_m"]
        )
        == 0
    )
    lines = capsys.readouterr().out.splitlines()
    (first,) = (k for k, line in enumerate(lines) if "team/new" in line)
    row = json.loads((root / "team" / "new" / "summary.json").read_text())["metrics"]["onefixer"][
        "offroad"
    ]
    assert (
        f"{100 * row['mean']:.1f} % ({100 * row['ci95_clustered'][0]:.1f} to {100 * row['ci95_clustered'][1]:.1f})"
        in lines[first + 1]
    )
    assert "onefixer" in lines[first + 1]
    assert run_command(["list", "runs", str(root)]) == 0
    (middle,) = (line for line in capsys.readouterr().out.splitlines() if "team/middle" in line)
    assert "8b07ee4+" in middle
    assert "6 x 2 suites/smoke" in middle
