"""Decisions over real rollouts: resumed, by other numbers of workers, at a ceiling, with failures,
and as a gate.
"""

import json
import shutil
from dataclasses import replace

import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.log.run_folder.schema import MANIFEST, SUMMARY
from alpasim_plugin.runs.decide import SequentialTest, drawing_order, plan_of_two
from alpasim_plugin.runs.plan import RunOptions, make_plan
from alpasim_plugin.runs.run import execute_search
from evaluators.pages.html import render_report
from evaluators.statistics.decision import (
    DECISION,
    Question,
    metric_question,
    read_decision,
)
from evaluators.statistics.opening import read_run
from scenarios.suite import ScenarioRef, expand
from tests.runs.grey_policy import BY_GREY
from tests.runs.grey_renderer import GREY
from tests.runs.short_runs import Announced

DARKER = GREY.replace("Grey", "Darker")
SHORT = ("timing.duration_us=700000", "timing.warmup_us=100000")
SAME = Question((metric_question("offroad", 0.6),), alpha=0.1)
CLOSER = replace(SAME, alpha=0.001)
SCENES_PER_LOOK = 2


class Looks(Announced):
    """Remembers looks, too."""

    def __init__(self):
        super().__init__()
        self.looks = []

    def looked(self, state, rollouts, ceiling):
        self.looks.append((state.n_scenes, state.answer))


def plan_of(
    scenes=16,
    renderers=(GREY, DARKER),
    policy=BY_GREY,
    seeds=(0,),
):
    ref = expand("smoke/straight", SHORT)[0]
    refs = [ScenarioRef(ref.path, seed, ref.overrides) for seed in range(1, scenes + 1)]
    return make_plan(
        refs, renderers, (policy,), seeds, RunOptions(images="none", baseline=renderers[0])
    )


def decide(root, question, plan):
    return search(root, question, plan_of_two(plan, question, SCENES_PER_LOOK))


def search(root, question, plan):
    announced = Looks()
    test = SequentialTest(plan, question, SCENES_PER_LOOK)
    execute_search(test, root, 1, ["simrun"], announced, report=False)
    return test, announced


@pytest.fixture(scope="module")
def decided_run(tmp_path_factory):
    """Drive until the darker renderer is shown to be non-inferior."""
    root = tmp_path_factory.mktemp("decided_run") / "run"
    return root, *decide(root, SAME, plan_of())


@pytest.mark.slow
def test_a_question_is_decided_before_all_scenes_are_driven(decided_run):
    root, decided, announced = decided_run
    assert (decided.outcome.exit_code, decided.record()["verdict"]) == (0, "non-inferior")
    assert decided.record()["stopped"] == "decided"
    driven = announced.looks[-1][0]
    assert announced.looks[-1][1] == "good"
    assert driven < 16
    assert decided.record()["order"] == drawing_order(list(plan_of().scenarios))[:driven]
    assert decided.record()["rollouts"] == 2 * driven == len(read_run(root).rollouts)
    assert decided.record()["ceiling"] == {"scenes": 16, "rollouts": 32}


def test_the_order_depends_on_the_names_alone():
    names = [f"s{i}" for i in range(20)]
    assert drawing_order(names) == drawing_order(names[::-1])
    assert sorted(drawing_order(names)) == sorted(names)


@pytest.mark.slow
@pytest.mark.slow
def test_an_interrupted_decision_continues_and_decides_the_same(decided_run, tmp_path):
    before = read_decision(decided_run[0])
    root = tmp_path / "again"
    shutil.copytree(decided_run[0], root)
    (root / SUMMARY).unlink()
    for scene in before["order"][2:]:  # as after a kill during the second batch
        for manifest in root.glob(f"rollouts/*/*/{scene}/0/{MANIFEST}"):
            manifest.unlink()
            break
    decided, announced = decide(root, SAME, plan_of())
    assert sorted(announced.results) == [("ok", False)] * 2 + [("ok", True)] * 6
    assert read_decision(root) == before
    assert decided.record() == before


@pytest.mark.slow
def test_another_question_in_the_same_folder_is_refused(decided_run):
    with pytest.raises(InputError):
        decide(decided_run[0], CLOSER, plan_of())


@pytest.mark.slow
def test_other_commands_read_the_run_and_the_report_shows_the_decision(decided_run, capsys):
    root = str(decided_run[0])
    assert run_command(["check", "run", root]) == 0
    assert run_command(["compare", root]) == 0
    said = capsys.readouterr()
    assert "lateral_distance_m" in said.out
    assert "was driven until it was decided" in said.err
    page = render_report(read_run(decided_run[0]))
    assert 'id="decision"' in page
    assert 'class="chart"' in page


@pytest.mark.slow
def test_a_damaged_record_is_refused(decided_run, tmp_path):
    text = (decided_run[0] / DECISION).read_text()
    (tmp_path / DECISION).write_text(text[: len(text) // 2])
    with pytest.raises(InputError):
        read_decision(tmp_path)


def test_when_all_scenes_are_driven_the_decision_is_undecided(tmp_path):
    with pytest.raises(InputError):
        decide(tmp_path, CLOSER, plan_of(2))
    decided, announced = search(tmp_path, CLOSER, plan_of(2))
    assert (decided.outcome.exit_code, decided.record()["rollouts"]) == (3, 4)
    assert announced.looks == [(2, "open")]


def test_a_failed_rollout_ends_the_decision(tmp_path):
    broken = "tests.runs.broken_policies:Raises"
    decided, announced = decide(tmp_path, SAME, plan_of(policy=broken))
    assert decided.outcome.exit_code == 2  # the policy's own fault
    assert announced.looks == [(2, "open")]
    assert "rollouts failed" in decided.record()["stopped"]


@pytest.mark.slow
def test_the_command_line_decides_and_says_so_in_its_exit_code(tmp_path, capsys):
    words = ["--renderer", f"{GREY},{DARKER}", "--policy", BY_GREY, "--images", "none"]
    words += ["--until-decided", "--metric", "offroad=0.6", "--no-report", "--workers", "1"]
    words += [word for text in SHORT for word in ("--set", text)]
    scenes = ["smoke/straight", "smoke/curve", "hard/sharp_s_curve", "urban/s_bend"]
    words += ["--quiet", *scenes, "--out", str(tmp_path / "run")]
    assert run_command(words) == 2  # four scenes do not decide
    assert run_command([*words, "urban/dusk_street"]) == 0
    assert capsys.readouterr().out.startswith("verdict  ")
    assert run_command([*words, "urban/dusk_street", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["decision"]["verdict"] == "non-inferior"


@pytest.mark.parametrize(
    "words",
    [
        ["--renderer", GREY],
        ["--renderer", f"{GREY},{DARKER}", "--metric", "progress=much"],
        ["--renderer", f"{GREY},{DARKER}", "--metric", "progress=-1"],
        ["--renderer", f"{GREY},{DARKER}", "--metric", "progress", "--metric", "progress"],
        # The default gate wants more scenes; the search for how many takes seconds.
        pytest.param(["--renderer", f"{GREY},{DARKER}"], marks=pytest.mark.slow),
    ],
)
def test_questions_that_cannot_be_asked_are_refused_before_driving(words, tmp_path):
    scenes = ["smoke/straight", "smoke/curve"]
    more = ["--until-decided", "--policy", "log-replay", "--out", str(tmp_path / "run")]
    assert run_command([*words, *more, *scenes]) == 2
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("renderers", "policies", "baseline", "variants"),
    [
        (
            ("clean",),
            ("constant-velocity", "pure-pursuit"),
            "pure-pursuit",
            {"clean/pure-pursuit", "clean/constant-velocity"},
        ),
        (
            ("clean", "3dgs"),
            ("pure-pursuit",),
            None,
            {"clean/pure-pursuit", "3dgs/pure-pursuit"},
        ),
        (
            ("clean", "3dgs"),
            ("constant-velocity", "pure-pursuit"),
            "3dgs/pure-pursuit",
            {"3dgs/pure-pursuit", "clean/constant-velocity"},
        ),
    ],
)
def test_any_two_variants_can_be_asked_about(renderers, policies, baseline, variants):
    options = RunOptions(images="none", baseline=baseline)
    one = replace(SAME, alpha=0.7)  # of which one scene is enough
    plan = make_plan(expand("smoke/straight", SHORT), renderers, policies, (0,), options)
    part = plan_of_two(plan, one)
    assert {f"{cell.renderer.name}/{cell.policy.name}" for cell in part.cells} == variants


def test_four_variants_without_one_of_them_as_baseline_are_refused():
    for baseline in (None, "clean"):
        plan = make_plan(
            expand("smoke/straight", SHORT),
            ("clean", "3dgs"),
            ("constant-velocity", "pure-pursuit"),
            (0,),
            RunOptions(baseline=baseline),
        )
        with pytest.raises(InputError):
            plan_of_two(plan, replace(SAME, alpha=0.7))
