"""``runs/index.html``: the list of runs."""

import json
import re

import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.runs.reports import list_runs
from evaluators.pages.run_list import change_text, run_lines
from evaluators.pages.runs import find_runs
from evaluators.results import Change
from evaluators.statistics.history import PastRun, changes_between
from tests.core.checksum_files import vouch_for
from tests.pages.browser import Browser, find_chromium
from tests.pages.make_run import Plan, make_run

SCENES = ("scene-a", "scene-b", "scene-c")
GOOD, BAD = {"clean": 0.1, "onefixer": 0.1}, {"clean": 0.1, "onefixer": 12.0}


def stored(root, name, began, **fields):
    """Store a run of three scenes that began on a day."""
    small = {"seeds": (0,), "steps": 40, "clips": False, "invalid": ()}
    plan = Plan(**{"renderers": ("clean", "onefixer"), "scenes": SCENES, **small, **fields})
    folder = make_run(root / name, plan)
    path = folder / "run.json"
    info = json.loads(path.read_text()) | {"started_at": f"2026-03-0{began}T10:00:00+00:00"}
    path.write_text(json.dumps(info))
    return vouch_for(folder)


def lines_of(root):
    """Lay out the runs of a folder as its list does."""
    entries = find_runs([root])
    past = [e.summary and PastRun(e.info, e.summary) for e in entries]
    return run_lines(entries, changes_between(past), root)


def failed(line, renderer):
    (variant,) = [variant for variant in line.variants if variant.name.startswith(renderer)]
    return sum(n for name, n in variant.endings.items() if name in ("collision", "off-road"))


@pytest.fixture
def runs(tmp_path):
    """Give a folder of three runs: good, then with a bad onefixer, then of other scenes."""
    root = tmp_path / "runs"
    stored(root, "first", 1, harm=GOOD)
    stored(root, "second", 2, harm=BAD)
    stored(root, "third <b>", 3, harm=GOOD, scenes=SCENES[:2])
    return root


def test_a_run_is_compared_with_the_last_one_of_the_same_scenes_and_variant(runs):
    third, second, first = lines_of(runs)
    assert (first.name, second.name, third.name) == ("first", "second", "third <b>")
    more = failed(second, "onefixer") - failed(first, "onefixer")
    assert more > 0
    changes = {line.name.split(" ")[0]: line.change for line in second.variants}
    assert changes == {"clean": "as many failed", "onefixer": f"{more} more failed"}
    assert {line.earlier for line in second.variants} == {first.link}
    assert {line.change for line in (*first.variants, *third.variants)} == {""}


def test_a_change_has_its_direction_and_colour():
    assert change_text(Change(1, 3, 1, -2)) == ("2 fewer failed", "better")
    assert change_text(Change(1, 1, 3, 2)) == ("2 more failed", "worse")
    assert change_text(Change(1, 3, 3, 0)) == ("as many failed", "unclear")


def test_the_page_lists_unfinished_and_damaged_runs_and_escapes_names(runs):
    (runs / "second" / "summary.json").unlink()
    (runs / "first" / "run.json").write_text("{")
    page = list_runs(runs).read_text()
    assert "third &lt;b&gt;" in page
    assert "third <b>" not in page
    assert "unfinished" in page
    assert "damaged: " in page
    assert "http:" not in page
    assert "https:" not in page


@pytest.mark.slow
def test_the_bars_of_outcomes_have_their_colours_in_a_browser(runs):
    executable = find_chromium()
    if executable is None:
        pytest.skip("no Chromium is installed")
    with Browser(executable) as browser:
        browser.open(list_runs(runs))
        colours = browser.evaluate(
            "[...document.querySelectorAll('.ended > *')].map(e => getComputedStyle(e).backgroundColor)"
        )
    assert colours
    assert "rgba(0, 0, 0, 0)" not in colours  # transparent: white words would be on white


def test_a_page_of_somebody_else_is_left_as_it_is(runs, capsys):
    own = runs / "index.html"
    own.write_text("<h1>mine</h1>")
    assert list_runs(runs) is None
    assert own.read_text() == "<h1>mine</h1>"
    assert "left as it is" in capsys.readouterr().err


def test_a_gate_is_in_the_list_until_other_rollouts_take_the_place_of_those_it_saw(
    runs, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    gate = tmp_path / "gate.yaml"
    gate.write_text("version: 1\nmetrics:\n  offroad: {margin: 0.05}\n")
    assert run_command(["gate", "runs/second", "--gate", str(gate)]) == 1
    capsys.readouterr()
    titles = {line.name: line.gate for line in lines_of(runs)}
    assert titles["second"][1] == "worse"
    assert titles["first"] is None
    (runs / "second" / "rollouts.parquet").write_bytes(
        (runs / "first" / "rollouts.parquet").read_bytes()
    )
    assert lines_of(runs)[1].gate is None


def test_a_run_below_runs_is_in_the_list_and_one_elsewhere_is_not(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    scene = tmp_path / "short.yaml"
    scene.write_text("version: 1\nroad: {segments: [{kind: straight, length_m: 60}]}\n")
    words = [
        "--renderer",
        "clean",
        "--policy",
        "constant-velocity",
        "--set",
        "timing.duration_us=1000000",
    ]
    common = [*words, "--images", "none", "--no-report", "--quiet", str(scene)]
    assert run_command([*common, "--out", str(tmp_path / "elsewhere" / "run")]) == 0
    assert not (tmp_path / "elsewhere" / "index.html").exists()
    assert run_command(common) == 0
    page = (tmp_path / "runs" / "index.html").read_text()
    assert re.search(r'href="short-[0-9a-f]+/"', page)
