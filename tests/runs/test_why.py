"""``simrun why``: the page that shows why a drive failed."""

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core import parts
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import Plan, SensorSpec
from alpasim_plugin.runs.plan import RunOptions, make_plan
from alpasim_plugin.runs.reports import failure_cause
from alpasim_plugin.runs.run import execute_run
from evaluators.metrics.outcomes import SHORT_OF_END
from evaluators.statistics.opening import read_run
from scenarios.suite import expand
from tests.runs.faulty_policies import CAUSES, FAULTS
from tests.runs.grey_renderer import GREY
from tests.runs.short_runs import Announced

HERE = "tests.runs.test_why"
OTHER_CAMERA = "tests.runs.faulty_policies:OtherCamera"
BEND = """
version: 1
description: A bend.
road: {segments: [{kind: straight, length_m: 12}, {kind: arc, length_m: 60, curvature_per_m: 0.05}]}
ego: {speed_mps: 9, cruise_mps: 9, max_lateral_accel_mps2: 5}
environment: {buildings: 0, trees_per_100m: 0, poles_spacing_m: 0}
cameras: [{width: 64, height: 36}, {name: left, width: 32, height: 16, yaw_deg: 60}]
timing: {duration_us: 3_000_000}
"""


class ByRoute:
    """Follows the route; the sign of its plan is wrong."""

    sensors: Sequence[SensorSpec] = (SensorSpec("front"), SensorSpec("left"))

    def reset(self, seed, route): ...

    def act(self, observation):
        ahead = observation.route_rig[np.isfinite(observation.route_rig[:, 0]), :2]
        ahead = np.concatenate([np.zeros((1, 2)), ahead[ahead[:, 0] > 0.5]])
        way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(ahead, axis=0).T))])
        times = observation.t_us + 100_000 * np.arange(41, dtype=np.int64)
        reached = 9e-6 * (times - observation.t_us)
        xy = np.stack([np.interp(reached, way, ahead[:, k]) for k in (0, 1)], axis=1) * [1.0, -1.0]
        debug = {
            "mode": "route",
            "heat": observation.frames["front"].rgb[::4, ::4, 0].astype(float),
            "boxes_car": np.array([[4, 5, 20, 15]]),
        }
        return Plan(
            observation.t_us, times, xy, np.arctan2(*np.gradient(xy, axis=0).T[::-1]), debug=debug
        )


class Blind(ByRoute):
    """Goes straight on."""

    def act(self, observation):
        plan = super().act(observation)
        x = np.hypot(*plan.xy.T)
        return replace(plan, xy=np.stack([x, 0 * x], axis=1), yaw=0 * x)


class Right(ByRoute):
    """Follows the route."""

    def act(self, observation):
        plan = super().act(observation)
        return replace(plan, xy=plan.xy * [1.0, -1.0], yaw=-plan.yaw)


class Stands(Right):
    """Never sets off."""

    def act(self, observation):
        plan = super().act(observation)
        return replace(plan, xy=0 * plan.xy, yaw=0 * plan.yaw)


class Raises(Right):
    """Raises at its first query."""

    def act(self, observation):
        raise ValueError("seven")


class RaisesLater(Right):
    """Raises after a second."""

    def act(self, observation):
        if observation.t_us > observation.history.t_us[0] + 1_500_000:
            raise ValueError("eight")
        return super().act(observation)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Give a run of the three in a bend."""
    folder = tmp_path_factory.mktemp("why")
    (folder / "bend.yaml").write_text(BEND)
    plan = make_plan(
        expand(str(folder / "bend.yaml")),
        (GREY,),
        tuple(f"{HERE}:{one}" for one in ("ByRoute", "Blind", "Right")),
        (0,),
        RunOptions(),
    )
    execute_run(plan, folder / "run", 1, ["simrun"], Announced())
    return folder / "run"


def rollout(run, policy):
    """Return the folder of a policy's drive."""
    return next(
        path.parent
        for path in run.glob("rollouts/*/*/*/*/manifest.json")
        if json.loads(path.read_text())["policy"] == f"{HERE}:{policy}"
    )


def queries_of(page):
    """Return the queries that a page draws."""
    found = re.search(r'<script type="application/json" id="cause">(.*?)</script>', page)
    return list(json.loads(found[1])["queries"])


def test_the_page_holds_the_route_and_the_debug_output_and_runs_nothing(run, monkeypatch, capsys):
    monkeypatch.setattr(parts, "build", pytest.fail)
    monkeypatch.setattr(ByRoute, "act", pytest.fail)
    assert run_command(["why", str(rollout(run, "ByRoute")), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    page = Path(found["page"]).read_text()
    assert "http" not in page.replace("http://www.w3.org/2000/svg", "").replace("http-equiv", "")
    query = queries_of(page)[-1]
    assert len(query["route"][0]) > 1
    assert query["said"]["boxes"] == [["boxes_car", 4.0, 5.0, 20.0, 15.0]]
    assert 'data-key="f"' in page
    assert page.count('class="card scroll"') == page.count(
        'class="card scroll" tabindex="0" role="region"'
    )


def test_a_run_stands_for_its_worst_failure_and_no_name_for_the_newest_run(
    run, monkeypatch, capsys
):
    (run.parent / "runs").mkdir(exist_ok=True)
    if not (run.parent / "runs" / "one").exists():
        (run.parent / "runs" / "one").symlink_to(run)
    monkeypatch.chdir(run.parent)
    shown = []
    for words in ([str(run)], [], ["."]):
        assert run_command(["why", *words, "--json"]) == 0
        shown.append(json.loads(capsys.readouterr().out)["rollout"])
    assert len(set(shown)) == 1
    assert "Right" not in shown[0]


@pytest.mark.slow
def test_a_rollout_that_broke_off_shows_its_error(tmp_path, capsys):
    (tmp_path / "bend.yaml").write_text(BEND)
    both = tuple(f"{HERE}:{name}" for name in ("Raises", "RaisesLater"))
    plan = make_plan(expand(str(tmp_path / "bend.yaml")), (GREY,), both, (0,), RunOptions())
    execute_run(plan, tmp_path / "run", 1, ["simrun"], Announced())
    for name, text, some in (("Raises", "seven", False), ("RaisesLater", "eight", True)):
        assert run_command(["why", str(rollout(tmp_path / "run", name)), "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert any(text in line for line in found["found"])
        page = Path(found["page"]).read_text()
        assert text in page
        assert bool(queries_of(page)) == some
        for query in queries_of(page):
            assert [name for name, _ in query["beside"]] == ["left"]


def test_a_drive_that_ended_short_says_so_and_that_its_plans_stand(tmp_path, capsys):
    (tmp_path / "bend.yaml").write_text(BEND.replace("3_000_000", "1_000_000"))
    plan = make_plan(
        expand(str(tmp_path / "bend.yaml")), (GREY,), (f"{HERE}:Stands",), (0,), RunOptions()
    )
    execute_run(plan, tmp_path / "run", 1, ["simrun"], Announced())
    assert run_command(["why", str(rollout(tmp_path / "run", "Stands")), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["outcome"] == SHORT_OF_END
    assert any("before the end stands" in line for line in found["found"])
    assert found["found"][-1] == "The rollout ended since its time was up."


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_no_page_names_a_false_cause_and_most_show_the_right_evidence_first(
    tmp_path,
):
    bend = BEND.replace("length_m: 12", "length_m: 30").replace("3_000_000", "6_000_000")
    (tmp_path / "bend.yaml").write_text(bend)
    missed = []
    for scenario, faults in FAULTS.items():
        renderer = "clean"
        source = scenario
        if scenario == "bend":
            renderer = GREY
            source = str(tmp_path / "bend.yaml")
        names = {f"tests.runs.faulty_policies:{one.__name__}": word for one, word in faults.items()}
        plan = make_plan(expand(source), (renderer,), tuple(names), (0,), RunOptions())
        folder = tmp_path / scenario.replace("/", "-")
        if scenario == "bend":
            other = make_plan(expand(source), (renderer,), (OTHER_CAMERA,), (0,), RunOptions())
            with pytest.raises(InputError, match="rear"):  # nothing is driven
                execute_run(other, tmp_path / "other", 1, ["simrun"], Announced())
        execute_run(plan, folder, 1, ["simrun"], Announced())
        read = read_run(folder)
        for one in read.rollouts:
            sentences = failure_cause(read, one).sentences
            word = names[one.policy]
            if not sentences or word not in sentences[0]:
                missed.append((one.policy, sentences[:2]))
            for sentence in sentences:
                named = [cause for cause in CAUSES if cause in sentence and cause not in word]
                assert not named or word in sentence, (one.policy, sentence)
    # Plans that jitter, exchanged channels, and late images: that stands second, as the check notes it.
    assert len(missed) <= 3, missed
