"""Runs joined into lines: which are comparable, what a step says, and which change it names."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from alpasim_plugin.cli.main import run_command
from evaluators.opening import read_run
from evaluators.report.runs import RunEntry, find_runs
from evaluators.report.trend import Trend, changes, trend
from evaluators.report.trend_page import render_trend
from evaluators.statistics.across import compare_runs
from tests.runs.make_many import COMMITS, SCENES, Many, info_of, make_one, unfinish

DAYS = tuple(f"2026-03-0{day}T02:00:00+00:00" for day in range(1, 8))
BETTER, WORSE = {"onefixer": -0.1}, {"onefixer": 0.3}
OTHER_SCENE = {**SCENES, "smoke-curve": "ff" * 32}
NIGHTS = (
    Many("a", DAYS[0], COMMITS[0], committed_at=DAYS[0], noise_m=0.01),
    Many(
        "b",
        DAYS[1],
        COMMITS[1],
        committed_at=DAYS[1],
        noise_m=0.01,
        shift_m=BETTER,
        weights="abc123" + "0" * 58,
    ),
    Many(
        "c",
        DAYS[2],
        COMMITS[2],
        committed_at=DAYS[2],
        noise_m=0.01,
        shift_m=WORSE,
        weights="abc123" + "0" * 58,
        code="b" * 64,
    ),
    Many(
        "d",
        DAYS[3],
        COMMITS[2],
        committed_at=DAYS[2],
        noise_m=0.01,
        shift_m=WORSE,
        renderers=("onefixer",),
        code="b" * 64,
    ),
    Many("other-scene", DAYS[4], scenes=OTHER_SCENE),
    Many("other-seeds", DAYS[4], seeds=(0, 1, 2)),
    Many("other-preset", DAYS[4], preset="strict"),
    Many("other-policy", DAYS[4], policies=("mine:Policy",)),
    Many("forked", DAYS[5], more={"kind": "fork"}),
)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("nights") / "runs"
    for one in NIGHTS:
        make_one(root, one)
    unfinish(make_one(root, Many("killed", DAYS[6])))
    return root


@pytest.fixture(scope="module")
def found(root: Path) -> Trend:
    return trend(find_runs([root], True), ["lateral_distance_m", "progress"])


def test_only_comparable_runs_are_joined_and_the_others_are_named(found: Trend) -> None:
    (series,) = found.series
    assert [run.folder.name for run in series.runs] == ["a", "b", "c", "d"]
    assert found.by_commit  # "d" has the commit of "c" and was begun later
    lines = {
        (line.metric, line.renderer): [run.folder.name for run in line.runs]
        for line in series.lines
    }
    assert lines["lateral_distance_m", "clean"] == ["a", "b", "c"]  # "d" did not drive clean
    assert lines["lateral_distance_m", "onefixer"] == ["a", "b", "c", "d"]
    alone = "no other run has its scenes, seeds, policy and preset"
    reasons = {entry.folder.name: why for entry, why in found.left_out}
    assert reasons == {
        f"other-{what}": alone for what in ("scene", "seeds", "preset", "policy")
    } | {
        "forked": "a fork of one rollout",
        "killed": "unfinished",
    }


def test_a_step_has_the_numbers_of_simrun_compare(root: Path, found: Trend) -> None:
    (line,) = (
        line
        for line in found.series[0].lines
        if (line.metric, line.renderer) == ("lateral_distance_m", "onefixer")
    )
    for step in (*line.steps, line.whole):
        other = compare_runs(read_run(step.before.folder), read_run(step.after.folder)).paired[
            "onefixer"
        ]["lateral_distance_m"]
        same = ("diff", "ci95", "p_value", "verdict", "difference", "n_cells", "n_scenes")
        assert {key: step.entry[key] for key in same} == {key: other[key] for key in same}
    assert {step.entry["difference"] for step in line.steps} == {"none shown"}, (
        "of scenes that were not drawn little is known"
    )
    assert [step.moved for step in line.steps] == [True, True, False]
    assert (line.whole.before.folder.name, line.whole.after.folder.name) == ("a", "d")
    assert line.whole.moved


def test_each_step_names_what_could_have_moved_it(found: Trend) -> None:
    (line,) = (
        line
        for line in found.series[0].lines
        if (line.metric, line.renderer) == ("lateral_distance_m", "onefixer")
    )
    said = [[change.what for change in step.changes] for step in line.steps]
    assert said[:2] == [
        ["weights onefixer.safetensors", "commit"],
        ["policy lane-camera: code", "commit"],
    ]
    assert said[2] == ["weights onefixer.safetensors"]  # back to the first ones
    (clean,) = (
        line
        for line in found.series[0].lines
        if (line.metric, line.renderer) == ("lateral_distance_m", "clean")
    )
    assert [change.what for change in clean.steps[0].changes] == [
        "commit"
    ]  # the fixer's weights are no part of clean


def entry_of(**facts: Any) -> RunEntry:
    one = Many("x", more=facts.pop("more", {}), **facts)
    return RunEntry(Path("x"), "finished", "", info_of(one))


def settings_of(**values: Any) -> Mapping[str, Any]:
    fixer = {"name": "onefixer", "digest": str(values), "files": {}, "settings": values}
    return {"fixers": {"onefixer": fixer}, "parts": {"fixer onefixer": fixer}}


@pytest.mark.parametrize(
    ("before", "after", "named"),
    [
        (entry_of(), entry_of(), []),
        (
            entry_of(),
            entry_of(
                more={
                    "started_at": DAYS[6],
                    "config": {"images": "jpeg", "workers": 8, "video": "all"},
                }
            ),
            [],
        ),
        (entry_of(), entry_of(dirty=True), ["commit 3f2a9c1 → 3f2a9c1+"]),
        (entry_of(), entry_of(more={"config": {"images": "png"}}), ["--images jpeg → png"]),
        (
            entry_of(),
            entry_of(more={"versions": {"torch": "2.14.0"}}),
            ["version of torch 2.13.0 → 2.14.0"],
        ),
        (entry_of(), entry_of(more={"hardware": {"cpu": "y", "cores": 2}}), ["machine: cpu x → y"]),
        (
            entry_of(),
            entry_of(more={"code": {"loop": "3" * 12, "scoring": "2" * 12}}),
            [f"code of the loop {'1' * 12} → {'3' * 12}"],
        ),
        (
            entry_of(more=settings_of(steps=[1000.0])),
            entry_of(more=settings_of(steps=[500.0])),
            ["fixer onefixer: steps [1000.0] → [500.0]"],
        ),
        (
            entry_of(
                more={"scenes": {"s": {"content_hash": "a" * 64, "reconstruction": "1" * 32}}}
            ),
            entry_of(
                more={"scenes": {"s": {"content_hash": "a" * 64, "reconstruction": "2" * 32}}}
            ),
            [f"reconstruction of s {'1' * 12} → {'2' * 12}"],
        ),
    ],
)
def test_a_change_is_named(before: RunEntry, after: RunEntry, named: list[str]) -> None:
    assert [str(change) for change in changes(before, after, "onefixer", "lane-camera")] == named


def test_rollouts_that_differ_without_a_cause_are_listed(tmp_path: Path) -> None:
    for name, shift in (("a", 0.0), ("b", 0.02)):
        make_one(tmp_path, Many(name, DAYS[0], shift_m={"clean": shift}, renderers=("clean",)))
    (series,) = trend(find_runs([tmp_path], True), ["lateral_distance_m"]).series
    ((step,),) = (line.steps for line in series.lines)
    assert step.changes == ()
    assert step.unexplained
    assert "nothing that run.json keeps" in render_trend(
        trend(find_runs([tmp_path], True), ["lateral_distance_m"]), [tmp_path], tmp_path
    )


def test_the_page_holds_its_numbers_as_text_and_asks_for_nothing(root: Path, found: Trend) -> None:
    page = render_trend(found, [root], root.parent)
    assert re.search(r"default-src 'none'.*script-src 'sha256-[A-Za-z0-9+/=]+'", page)
    assert not re.findall(
        r"(?:src|href)=\"(?!#|data:)[^\"]*\"", page
    )  # none of these runs has a report to link to
    assert page.count('role="img"') == page.count('role="img" aria-label="') == 2
    assert "2 steps of 10 moved a metric" in page.replace("\u00a0", " ")
    (line,) = (
        line
        for line in found.series[0].lines
        if (line.metric, line.renderer) == ("lateral_distance_m", "onefixer")
    )
    for run in line.runs:
        mean = run.metric("lateral_distance_m", "onefixer", "lane-camera")["mean"]
        assert f">{mean:.3f} m (" in page
    assert "weights onefixer.safetensors 99bf50000000 \u2192 abc123000000" in page


def test_the_page_links_to_reports_beside_it(tmp_path: Path) -> None:
    for k, name in enumerate("ab"):
        (make_one(tmp_path / "my runs", Many(name, DAYS[k])) / "report.html").touch()
    assert (
        run_command(
            [
                "runs",
                str(tmp_path / "my runs"),
                "--trend",
                str(tmp_path / "t.html"),
                "--metric",
                "progress",
            ]
        )
        == 0
    )
    assert 'href="my%20runs/b/report.html"' in (tmp_path / "t.html").read_text()


def test_the_command_prints_the_steps(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "160")
    command = ["runs", str(root), "--steps", "--metric", "lateral_distance_m"]
    assert run_command(command) == 0
    out = capsys.readouterr().out
    assert "lateral_distance_m behind onefixer: lane-camera, preset paper" in out
    assert re.search(r" b +8b07ee4 .* undecided +weights onefixer.safetensors", out)
    assert "left out  killed: unfinished" in out
    assert run_command([*command, "--json"]) == 0
    (series,) = json.loads(capsys.readouterr().out)["series"]
    assert [len(line["steps"]) for line in series["lines"]] == [2, 3]
    assert series["lines"][1]["steps"][0]["changes"][0] == {
        "what": "weights onefixer.safetensors",
        "before": "99bf50000000",
        "after": "abc123000000",
    }
    (tmp_path / "t.html").touch()
    for words, said in (
        (("--scene", "smoke-curve", "--preset", "strict", "--steps"), "none to compare"),
        (("--trend", str(tmp_path / "t.html")), "pass --overwrite"),
    ):
        assert run_command(["runs", str(root), *words]) == 2
        assert said in capsys.readouterr().err
