"""Decisions over real rollouts: resumed, by other numbers of workers, at a ceiling, with failures,
and as a gate.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from alpasim_plugin.cli.decide import plan_of as plan_for
from alpasim_plugin.cli.main import run_command
from alpasim_plugin.cli.options import What
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.log.run_folder.schema import CONTENTS, MANIFEST
from alpasim_plugin.runs.decide import (
    Decided,
    Design,
    arms_asked,
    drawing_order,
    execute_decision,
    key_of,
)
from alpasim_plugin.runs.plan import RunOptions, RunPlan, make_plan
from evaluators.opening import read_run
from evaluators.report.html import render_report
from evaluators.statistics.decision import DECISION, Question, metric_question, read_decision
from scenarios.suite import ScenarioRef, expand
from tests.runs.grey_policy import BY_GREY
from tests.runs.grey_renderer import GREY
from tests.runs.test_runs import Announced

DARKER = GREY.replace("Grey", "Darker")
SHORT = ("timing.duration_us=700000", "timing.warmup_us=100000")
SAME = Question((metric_question("offroad", 0.6),), alpha=0.2)
WORSE = Question(
    (
        metric_question("offroad_margin_m", 0.0001),
        metric_question("offroad", 0.6),
    ),
    population="suite",  # of others a few might be far better, which eight scenes cannot exclude
)


class Looks(Announced):
    """Remembers looks, too."""

    def __init__(self) -> None:
        super().__init__()
        self.looks: list[tuple[int, str]] = []

    def looked(self, state, rollouts: int, ceiling: int) -> None:
        self.looks.append((state.n_scenes, state.answer))


def plan_of(
    scenes: int = 8,
    renderers: tuple[str, str] = (GREY, DARKER),
    policy: str = BY_GREY,
    seeds: tuple[int, ...] = (0,),
) -> RunPlan:
    ref = expand("smoke/straight", SHORT)[0]
    refs = [ScenarioRef(ref.path, seed, ref.overrides) for seed in range(1, scenes + 1)]
    return make_plan(
        refs, renderers, (policy,), seeds, RunOptions(images="none", baseline=renderers[0])
    )


def decide(
    root: Path,
    question: Question,
    plan: RunPlan,
    design: Design,
    workers: int = 1,
    report: bool = False,
) -> tuple[Decided, Looks]:
    announced = Looks()
    asked = replace(plan, question=key_of(question, design))
    return execute_decision(
        asked,
        question,
        design,
        root,
        workers,
        ["simrun"],
        announced,
        certificate="none",
        report=report,
    ), announced


@pytest.fixture(scope="module")
def worse(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Decided, Looks]:
    """Drive until the darker renderer is shown to be worse."""
    root = tmp_path_factory.mktemp("worse") / "run"
    return root, *decide(root, WORSE, plan_of(), Design(look_every=2))


def told(root: Path) -> dict:
    return {key: value for key, value in (read_decision(root) or {}).items()}


def test_a_renderer_that_is_worse_is_found_before_all_scenes_are_driven(worse) -> None:
    root, decided, announced = worse
    assert (decided.outcome.exit_code, decided.record["verdict"], decided.record["stopped"]) == (
        1,
        "worse",
        "decided",
    )
    assert decided.outcome.reasons == ("offroad_margin_m is worse",)
    assert announced.looks == [(2, "open"), (4, "open"), (6, "bad")]
    assert decided.record["order"] == drawing_order(list(plan_of().scenarios), 0)[:6]
    assert (decided.record["rollouts"], decided.record["ceiling"]) == (
        12,
        {"scenes": 8, "rollouts": 16},
    )
    assert len(read_run(root).rollouts) == 12


def test_the_order_depends_on_the_seed_and_the_names_alone() -> None:
    names = [f"s{i}" for i in range(20)]
    assert drawing_order(names, 3) == drawing_order(names[::-1], 3)
    assert drawing_order(names, 3) != drawing_order(names, 4)
    assert sorted(drawing_order(names, 3)) == sorted(names)


def test_an_interrupted_decision_continues_and_decides_the_same(worse, tmp_path: Path) -> None:
    before = told(worse[0])
    root = tmp_path / "again"
    shutil.copytree(worse[0], root)
    (root / CONTENTS).unlink()
    for scene in before["order"][2:]:  # as after a kill during the second batch
        for manifest in root.glob(f"rollouts/*/*/{scene}/0/{MANIFEST}"):
            manifest.unlink()
            break
    decided, announced = decide(root, WORSE, plan_of(), Design(look_every=2))
    assert sorted(announced.results) == [("ok", False)] * 4 + [("ok", True)] * 8
    assert told(root) == before
    assert decided.record == before


def test_another_question_in_the_same_folder_is_refused(worse) -> None:
    with pytest.raises(InputError, match="it holds another run"):
        decide(worse[0], SAME, plan_of(), Design(look_every=2))


def test_other_commands_read_the_run_and_the_report_shows_the_decision(worse, capsys) -> None:
    root = str(worse[0])
    assert run_command(["check", root]) == 0
    assert run_command(["compare", root]) == 0
    said = capsys.readouterr()
    assert "lateral_distance_m" in said.out
    assert "was driven until it was decided" in said.err
    page = render_report(read_run(worse[0]))
    assert 'id="decision"' in page
    assert "after 6 of 8 scenes, 12 of at most 16 rollouts" in page
    assert "wrong in at most 5 % of runs, over all interim analyses" in page
    assert page.count("<svg") >= 2


def test_a_damaged_decision_is_not_repaired_by_driving_all_its_scenes(
    worse, tmp_path: Path, capsys
) -> None:
    root = tmp_path / "run"
    shutil.copytree(worse[0], root)
    next(root.glob("rollouts/*/*/*/0/rollout.asl")).unlink()
    assert run_command(["check", str(root), "--repair"]) == 2
    assert "its scenes were drawn one after another" in capsys.readouterr().err


def test_a_damaged_record_is_named(worse, tmp_path: Path) -> None:
    (tmp_path / DECISION).write_text((worse[0] / DECISION).read_text().replace("worse", "better"))
    with pytest.raises(InputError, match="not the content that was written"):
        read_decision(tmp_path)


def test_at_the_ceiling_the_decision_is_undecided(tmp_path: Path) -> None:
    decided, announced = decide(
        tmp_path, SAME, plan_of(renderers=(GREY, DARKER)), Design(look_every=3, budget=5)
    )
    assert (decided.outcome.exit_code, decided.record["rollouts"]) == (3, 4)
    assert decided.outcome.reasons == ("offroad undecided: the budget of 5 rollouts is spent",)
    assert announced.looks == [(2, "open")]


def test_a_failed_rollout_ends_the_decision(tmp_path: Path) -> None:
    broken = "tests.runs.broken_policies:Raises"
    decided, announced = decide(tmp_path, SAME, plan_of(policy=broken), Design(look_every=1))
    assert decided.outcome.exit_code == 2  # the policy's own fault
    assert announced.looks == [(1, "open")]
    assert "rollouts failed" in decided.record["stopped"]


@pytest.mark.slow
def test_the_command_line_decides_and_says_so_in_its_exit_code(tmp_path: Path, capsys) -> None:
    words = [
        "decide",
        "--renderer",
        f"{GREY},{DARKER}",
        "--policy",
        BY_GREY,
        "--metric",
        "offroad=0.6",
        "--alpha",
        "0.4",
        "--look-every",
        "1",
    ]
    words += [word for text in SHORT for word in ("--set", text)]
    words += [
        "--images",
        "none",
        "--certify",
        "none",
        "--no-report",
        "--quiet",
        "--workers",
        "1",
        "smoke/straight",
        "smoke/curve",
        "--out",
    ]
    assert run_command([*words, str(tmp_path / "run")]) == 0
    out = capsys.readouterr().out
    assert out.startswith("verdict  ")
    assert "non-inferior, after 2 of 2 scenes" in out
    assert "wrong in at most 40 % of runs, over all interim analyses" in out
    assert run_command([*words, str(tmp_path / "run"), "--json"]) == 0
    both = json.loads(capsys.readouterr().out)["decision"]
    assert both["verdict"] == "non-inferior"
    # The same with that run as the baseline: the renderer in question alone is driven, onto the
    # same decision.
    alone = [DARKER if word == f"{GREY},{DARKER}" else word for word in words]
    alone += [str(tmp_path / "alone"), "--json", "--baseline-file", str(tmp_path / "run")]
    assert run_command([*alone, "--baseline", GREY]) == 0
    one = json.loads(capsys.readouterr().out)["decision"]
    assert [look["metrics"] for look in one["looks"]] == [look["metrics"] for look in both["looks"]]
    assert (both["rollouts"], one["rollouts"], one["baseline"]) == (
        4,
        2,
        f"{GREY} of {tmp_path / 'run'}",
    )
    assert run_command([*alone, "--baseline", "clean"]) == 2
    assert "baseline 'clean'" in capsys.readouterr().out
    assert run_command([*alone, "smoke/lead_car"]) == 2
    assert "1 of the 3 scenes and seeds that may be driven are not in it" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("more", "found"),
    [
        (["--renderer", GREY], "1 renderers"),
        (["--renderer", f"{GREY},{DARKER}", "--metric", "progress=much"], "no number"),
        (["--renderer", f"{GREY},{DARKER}", "--metric", "progress,progress"], "named twice"),
        (
            [
                "--renderer",
                f"{GREY},{DARKER}",
                "--metric",
                "progress",
                "--population",
                "suite",
                "--max-missing",
                "0.1",
            ],
            "left out of the suite",
        ),
    ],
)
def test_questions_that_cannot_be_asked_are_refused(more, found, tmp_path: Path, capsys) -> None:
    scenes = ["smoke/straight", "smoke/curve"]
    assert (
        run_command(
            ["decide", *more, "--policy", "log-replay", *scenes, "--out", str(tmp_path / "run")]
        )
        == 2
    )
    assert found in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def test_fewer_scenes_than_a_decision_takes_are_refused_before_one_is_driven(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [
        "gate",
        str(tmp_path / "run"),
        "--until-decided",
        "--scenes",
        "smoke/straight",
        "--renderer",
        f"{GREY},{DARKER}",
    ]
    assert run_command(words) == 2
    assert "nothing is decided on fewer than 20 (min_scenes)" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_a_gate_drives_until_its_margins_are_decided(tmp_path: Path, capsys) -> None:
    gate = tmp_path / "gate.yaml"
    gate.write_text(
        "version: 1\nmetrics:\n  offroad: {margin: 0.6}\n  lateral_distance_m: {margin: 0.1, must_decide: false}\n  progress: {min: 0.0}\n"
    )
    words = [
        "gate",
        str(tmp_path / "run"),
        "--until-decided",
        "--gate",
        str(gate),
        "--scenes",
        "smoke/straight",
        "--scenes",
        "smoke/curve",
    ]
    words += [
        "--renderer",
        f"{GREY},{DARKER}",
        "--policy",
        BY_GREY,
        "--images",
        "none",
        "--workers",
        "1",
        "--alpha",
        "0.4",
    ]
    words += [word for text in SHORT for word in ("--set", text)]
    assert run_command(words) == 0
    out = capsys.readouterr().out
    assert "at every look, margin 60): non-inferior after 2 scenes" in out
    assert "PASS (exit code 0)" in out
    assert (tmp_path / "run" / "gate.md").read_text().startswith("## Gate: PASS")
    # The same with the earlier run as the baseline: only the change is driven, onto the same
    # decision.
    alone = [
        str(tmp_path / "alone")
        if word == str(tmp_path / "run")
        else DARKER
        if word == f"{GREY},{DARKER}"
        else word
        for word in words
    ]
    gate.write_text(gate.read_text() + f"baseline: {GREY}\n")
    assert run_command([*alone, "--baseline-file", str(tmp_path / "run")]) == 0
    assert "PASS (exit code 0)" in capsys.readouterr().out
    both, one = (read_decision(tmp_path / name) for name in ("run", "alone"))
    assert (both["rollouts"], one["rollouts"]) == (4, 2)
    assert [look["metrics"] for look in one["looks"]] == [look["metrics"] for look in both["looks"]]
    assert one["baseline"] == f"{GREY} of {tmp_path / 'run'}"
    assert (
        run_command(
            [*alone, "--scenes", "smoke/lead_car", "--baseline-file", str(tmp_path / "run")]
        )
        == 2
    )
    assert "1 of the 3 scenes and seeds that may be driven are not in it" in capsys.readouterr().err
    assert run_command([*words, "--baseline-file", str(tmp_path / "run")]) == 2
    assert "renderers and 1 policies beside a stored baseline" in capsys.readouterr().err
    # Of the suite itself: each file with two seeds.
    suite = tmp_path / "suite.yaml"
    entries = "".join(
        f"  - {{path: smoke/{name}, seeds: [1, 2]}}\n" for name in ("straight", "curve")
    )
    suite.write_text(f"version: 1\nscenarios:\n{entries}")
    asked = [
        str(tmp_path / "suite")
        if word == str(tmp_path / "run")
        else str(suite)
        if word == "smoke/straight"
        else word
        for word in words
    ]
    asked = [
        word
        for at, word in enumerate(asked)
        if word != "smoke/curve" and not (word == "--scenes" and asked[at + 1] == "smoke/curve")
    ]
    assert run_command([*asked, "--population", "suite"]) == 1  # exact after the last scene
    assert "about the mean over the 4 scenes of this suite" in capsys.readouterr().out
    assert run_command(["gate", str(tmp_path / "run"), "--scenes", "smoke/curve"]) == 2
    assert run_command(["gate", str(tmp_path / "run"), "--until-decided"]) == 2
    capsys.readouterr()
    assert run_command(["gate", str(tmp_path / "run"), "--executor", "ray", "--store", "here"]) == 2
    assert "with: --executor, --store" in capsys.readouterr().err


@pytest.mark.slow
def test_one_and_two_workers_reach_the_same_decision(worse, tmp_path: Path) -> None:
    decide(tmp_path / "two", WORSE, plan_of(), Design(look_every=2), workers=2)
    assert told(tmp_path / "two") == told(worse[0])


@pytest.mark.slow
def test_two_policies_behind_one_renderer_are_decided_between(tmp_path: Path) -> None:
    ref = expand("smoke/straight", SHORT)[0]
    refs = [ScenarioRef(ref.path, seed, ref.overrides) for seed in range(1, 5)]
    plan = make_plan(
        refs,
        (GREY,),
        ("constant-velocity", BY_GREY),
        (0,),
        RunOptions(images="none", baseline="constant-velocity"),
    )
    decided, _ = decide(tmp_path / "run", SAME, plan, Design(look_every=2, budget=4))
    assert (decided.record["baseline"], decided.record["candidate"]) == (
        "constant-velocity",
        BY_GREY,
    )
    assert len(read_run(tmp_path / "run").rollouts) == 4


@pytest.mark.parametrize(
    ("renderers", "policies", "baseline", "arms"),
    [
        (
            "clean",
            "constant-velocity,pure-pursuit",
            None,
            ("clean/constant-velocity", "clean/pure-pursuit"),
        ),
        (
            "clean",
            "constant-velocity,pure-pursuit",
            "pure-pursuit",
            ("clean/pure-pursuit", "clean/constant-velocity"),
        ),
        ("clean,3dgs", "pure-pursuit", None, ("clean/pure-pursuit", "3dgs/pure-pursuit")),
        (
            "clean,3dgs",
            "constant-velocity,pure-pursuit",
            "3dgs/pure-pursuit",
            ("3dgs/pure-pursuit", "clean/constant-velocity"),
        ),
    ],
)
def test_any_two_arms_can_be_asked_about(
    renderers: str, policies: str, baseline: str | None, arms: tuple[str, str]
) -> None:
    plan = plan_for(
        What(("smoke/straight",), renderers, policies), RunOptions(images="none", baseline=baseline)
    )
    assert tuple(arm.name for arm in arms_asked(plan)) == arms
    assert {f"{cell.renderer.name}/{cell.policy.name}" for cell in plan.cells} == {*arms}


def test_four_arms_without_one_of_them_as_baseline_are_refused() -> None:
    for baseline in (None, "clean"):
        with pytest.raises(InputError, match="which of four arms is in question"):
            plan_for(
                What(("smoke/straight",), "clean,3dgs", "constant-velocity,pure-pursuit"),
                RunOptions(baseline=baseline),
            )
