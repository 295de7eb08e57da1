"""The last lines of a run on the terminal."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from evaluators.metrics.outcomes import outcomes_of
from evaluators.opening import Run, read_run
from evaluators.report.overview import overview_of
from evaluators.report.terminal import next_command
from tests.docs.test_commands import parse
from tests.report.make_run import Plan, make_run


def words_of(run: Run) -> list[str]:
    """Return the next command; it is one that the command line understands."""
    words, why = next_command(run, overview_of(run))
    assert why
    assert words[0] == "simrun"
    parse(words[1:])
    return words


def test_a_drive_that_ended_with_an_event_leads_to_its_cause(usual_run: Path) -> None:
    run = read_run(usual_run)
    assert words_of(run)[1] == "check"  # some rollouts failed: that comes first
    run = dataclasses.replace(
        run, rollouts=tuple(rollout for rollout in run.rollouts if rollout.ok)
    )
    words = words_of(run)
    assert words[1] == "why"
    renderer, policy, *scene, seed = words[2].removeprefix(f"{run.folder}/").split("/")
    (ended,) = (
        one for one in run.rollouts if one.cell == (renderer, policy, "/".join(scene), int(seed))
    )
    assert outcomes_of(ended)


def test_every_next_command_of_any_set_of_arms_can_be_given(tmp_path: Path) -> None:
    for number, (renderers, policies, harm) in enumerate(
        [
            (("clean",), ("lane-camera", "pure-pursuit", "learned"), 0.8),
            (("clean",), ("lane-camera", "pure-pursuit"), 0.0),
            (("clean", "3dgs"), ("lane-camera", "pure-pursuit"), 2.6),
            (("clean", "3dgs", "onefixer"), ("lane-camera",), 0.0),
            (("clean", "3dgs", "onefixer"), ("lane-camera", "pure-pursuit"), 0.0),
            (("onefixer",), ("lane-camera",), 0.4),
        ]
    ):
        plan = Plan(
            renderers,
            policies,
            seeds=(0,),
            steps=30,
            harm=dict.fromkeys(renderers, harm),
            pictures=False,
            clips=False,
        )
        run = read_run(make_run(tmp_path / str(number), plan))
        words = words_of(run)
        for flag, known in (
            ("--renderer", [*run.renderers, "clean", "3dgs"]),
            ("--policy", [*run.policies, "lane-camera"]),
        ):
            if flag in words and words[1] == "fork":
                assert {*words[words.index(flag) + 1].split(",")} <= {*known}
        if words[1] in ("why", "fork"):
            assert words[2] in {
                f"{run.folder}/{'/'.join(map(str, rollout.cell))}" for rollout in run.rollouts
            }
        if len(renderers) == 1 and len(policies) > 1:
            assert words[1] in ("why", "fork", "view", "--renderer")


def test_one_renderer_leads_to_a_comparison_and_a_failing_policy_to_its_check(
    tmp_path: Path,
) -> None:
    alone = read_run(make_run(tmp_path / "a", Plan(renderers=("clean",), seeds=(0,), steps=30)))
    alone = dataclasses.replace(
        alone, rollouts=tuple(one for one in alone.rollouts if not outcomes_of(one))
    )
    assert words_of(alone)[:3] == ["simrun", "--renderer", "clean,3dgs"]
    broken = [
        dataclasses.replace(r, status="failed", failure_class="policy") for r in alone.rollouts
    ]
    assert words_of(dataclasses.replace(alone, rollouts=tuple(broken))) == [
        "simrun",
        "check",
        "policy",
        alone.policies[0],
    ]


@pytest.mark.parametrize("renderers", [("clean", "3dgs")])
def test_what_is_undecided_leads_to_more_scenes(tmp_path: Path, renderers: tuple[str, ...]) -> None:
    run = read_run(
        make_run(
            tmp_path,
            Plan(
                renderers=renderers,
                scenes=("a",),
                seeds=(0,),
                steps=20,
                harm={"clean": 0.1, "3dgs": 0.1},
            ),
        )
    )
    run = dataclasses.replace(
        run, rollouts=tuple(one for one in run.rollouts if not outcomes_of(one))
    )
    if run.rollouts:
        assert words_of(run)[-1] == "suites/urban"


def test_the_next_command_keeps_scenes_settings_and_preset(tmp_path: Path) -> None:
    run = read_run(
        make_run(
            tmp_path, Plan(renderers=("clean",), seeds=(0,), steps=20, pictures=False, clips=False)
        )
    )
    run = dataclasses.replace(
        run, rollouts=tuple(one for one in run.rollouts if not outcomes_of(one))
    )
    given = [
        "simrun",
        "--set",
        "timing.duration_us=600000",
        "--set=actors=[]",
        "--preset",
        "strict",
        "suites/smoke",
    ]
    run = dataclasses.replace(run, info={**run.info, "command": given, "asked": ["suites/smoke"]})
    assert words_of(run)[7:] == [
        "--set",
        "timing.duration_us=600000",
        "--set",
        "actors=[]",
        "--preset",
        "strict",
        "suites/smoke",
    ]
    elsewhere = words_of(dataclasses.replace(run, info={**run.info, "asked": []}))
    assert elsewhere[7:] == [
        "--set",
        "timing.duration_us=600000",
        "--preset",
        "strict",
        "suites/urban",
    ]


def test_a_policy_without_a_camera_leads_to_one_that_looks(tmp_path: Path) -> None:
    run = read_run(make_run(tmp_path, Plan(renderers=("clean",), seeds=(0,), steps=20)))
    blind = dataclasses.replace(
        run, rollouts=tuple(dataclasses.replace(r, frames=0) for r in run.rollouts if r.ok)
    )
    words = words_of(blind)
    assert words[words.index("--policy") + 1] == "lane-camera"
    assert words[words.index("--renderer") + 1] == "clean,3dgs"
