"""What a check of a policy found, and plans that take longer and longer, stand on every page of a run
in which nothing failed.
"""

import html
import json
import xml.etree.ElementTree as ET
from dataclasses import replace
from types import SimpleNamespace

import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.runs.summary import drive_calls_of, slowing_of, unlit_frames_of
from evaluators.pages.overview import overview_of
from evaluators.results import DriveCalls, Slowing
from evaluators.statistics.opening import read_run
from tests.run_records import manifest

POLICY = '''
from dataclasses import replace

from policies.simple import ConstantVelocity


class Short(ConstantVelocity):
    """Plans less than a second ahead."""

    def act(self, observation):
        plan = super().act(observation)
        kept = plan.times_us < plan.t_us + 1_000_000
        return replace(plan, times_us=plan.times_us[kept], xy=plan.xy[kept], yaw=plan.yaw[kept])
'''


def durations(values):
    return manifest({"frames": 4, "stage_ms": {"policy": values}})


def test_a_policy_is_slowing_where_nearly_all_rollouts_are():
    steady, growing = [20.0] * 40, [float(5 + query) for query in range(40)]
    noisy = [20.0, 60.0] * 20
    assert slowing_of({"p": [durations(steady)] * 4}) == {}
    assert slowing_of({"p": [durations(noisy)] * 4}) == {}
    assert slowing_of({"p": [durations(growing)] * 2 + [durations(steady)] * 2}) == {}
    assert slowing_of({"p": [durations(growing[:12])] * 4}) == {}
    slowing = slowing_of({"p": [durations(growing)] * 3 + [durations(steady)]})["p"]
    assert slowing.n_rollouts == 3
    assert slowing.early_ms < 12
    assert slowing.late_ms > 35
    few_ms = [0.1 + 0.1 * query for query in range(40)]
    assert slowing_of({"p": [durations(few_ms)] * 4}) == {}


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Drive a policy of the user's own that does not fail."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "mine.py").write_text(POLICY)
    scene = folder / "road.yaml"
    scene.write_text(
        "version: 1\nroad: {segments: [{kind: straight, length_m: 90}]}\n"
        "ego: {speed_mps: 8}\ntiming: {duration_us: 4000000}\n"
    )
    words = ["--renderer", "clean", "--policy", f"{folder}/mine.py:Short"]
    out = folder / "run"
    assert run_command([*words, "--images", "none", "--quiet", "--out", str(out), str(scene)]) == 0
    return out


def test_what_the_check_found_is_on_every_page_though_nothing_failed(run):
    (sentence,) = [
        sentence
        for name, check in json.loads((run / "run.json").read_text())["policy_checks"].items()
        if name.endswith("Short")
        for _, sentence in check["breaches"]
    ]
    words = sentence.split(":")[0]
    assert words in html.unescape((run / "report.html").read_text())
    assert words in (run / "summary.md").read_text()
    cases = ET.parse(run / "junit.xml").getroot().iter("testcase")
    (case,) = [case for case in cases if case.get("classname").startswith("check.")]
    assert case.find("skipped").get("message") == sentence


def test_plans_that_take_longer_and_longer_are_noticed(run):
    driven = read_run(run)
    assert not any("longer and longer" in text for text in overview_of(driven).cautions)
    slowing = {"mine": Slowing(early_ms=5.0, late_ms=40.0, n_rollouts=3)}
    slow = replace(driven, summary=replace(driven.summary, slowing=slowing))
    (caution,) = [text for text in overview_of(slow).cautions if "longer and longer" in text]
    assert "5.00 ms for a plan in the first quarter of a rollout, 40.0 ms in the last" in caution


def test_drive_calls_of_a_driver_are_said_beside_the_challenge_s_budget(run):
    facts = {"drive_calls": 20, "drive_s": 1.5, "drive_longest_s": 0.125, "drive_late": 1}
    timed = SimpleNamespace(policy_facts={**facts, "drive_budget_s": 0.1})
    untimed = SimpleNamespace(policy_facts=None)
    calls = drive_calls_of({"driver": [timed, timed, untimed], "mine": [untimed]})
    assert calls == {
        "driver": DriveCalls(calls=40, seconds=3.0, budget_s=4.0, late=2, longest_s=0.125)
    }
    driven = read_run(run)
    assert not any("drive calls" in text for text in overview_of(driven).cautions)
    timed_run = replace(driven, summary=replace(driven.summary, drive_calls=calls))
    (line,) = [text for text in overview_of(timed_run).cautions if "drive calls" in text]
    assert (
        "40\u00a0drive calls took 3.00 s of the challenge's budget of 4.00 s; 2 took longer" in line
    )
    in_time = {"driver": replace(calls["driver"], late=0)}
    punctual = overview_of(replace(driven, summary=replace(driven.summary, drive_calls=in_time)))
    assert "drive calls" not in " ".join(punctual.cautions).replace("\u00a0", " ")
    assert "0 took longer" in punctual.remarks[0]


def test_traffic_lights_that_a_renderer_without_depth_does_not_show_are_said(run):
    dark = SimpleNamespace(renderer="flat", renderer_facts={"unlit_frames": 3})
    lit = SimpleNamespace(renderer="clean", renderer_facts=None)
    assert unlit_frames_of([dark, dark, lit]) == {"flat": 6}
    driven = read_run(run)
    assert not any("traffic light" in text for text in overview_of(driven).cautions)
    unlit = replace(driven, summary=replace(driven.summary, unlit_frames={"flat": 6}))
    (line,) = [text for text in overview_of(unlit).cautions if "traffic light" in text]
    assert line.startswith("flat gives no depth, so no traffic light was drawn into 6\u00a0frames")
