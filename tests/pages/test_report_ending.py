"""The last lines of a run on the terminal."""

import dataclasses

import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.log.run_folder.rows import Rollout
from alpasim_plugin.runs.logged_rollout import named_rollout
from evaluators.metrics.outcomes import outcomes_of
from evaluators.pages.terminal import next_command
from evaluators.statistics.cause import worst_failure
from evaluators.statistics.opening import read_run
from tests.docs.parsed_commands import parse
from tests.pages.make_run import Plan, make_run


def words_of(run):
    """Return the next command; it is one that the command line understands."""
    words, why = next_command(run)
    assert why
    assert words[0] == "simrun"
    parse(words[1:])
    return words


def test_a_drive_that_ended_with_an_event_leads_to_its_cause(usual_run):
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
    assert worst_failure(run) == ended


def test_a_quiet_run_leads_to_its_replay_and_a_failing_policy_to_its_check(
    tmp_path,
):
    alone = read_run(make_run(tmp_path / "a", Plan(renderers=("clean",), seeds=(0,), steps=30)))
    alone = dataclasses.replace(
        alone, rollouts=tuple(one for one in alone.rollouts if not outcomes_of(one))
    )
    assert words_of(alone) == ["simrun", "view", str(alone.folder)]
    broken = [
        dataclasses.replace(r, status="failed", failure_class="policy") for r in alone.rollouts
    ]
    assert words_of(dataclasses.replace(alone, rollouts=tuple(broken))) == [
        "simrun",
        "check",
        "policy",
        alone.policies[0],
    ]


def test_several_logs_of_one_cell_are_told_apart_by_their_names():
    row = Rollout("clean", "mine", "curve", 0, "ok")
    logs = [
        dataclasses.replace(row, log=name, path=f"rollouts/clean/mine/curve/{name}")
        for name in ("first", "second")
    ]
    assert named_rollout(logs, "clean/mine/curve/second") == logs[1]
    assert named_rollout(logs, "rollouts/clean/mine/curve/first/") == logs[0]
    assert named_rollout(logs, "clean/mine/curve/0/first") == logs[0]
    with pytest.raises(InputError, match="2 logs of it") as refused:
        named_rollout(logs, "clean/mine/curve/0")
    assert "clean/mine/curve/first, clean/mine/curve/second" in refused.value.hint
    assert named_rollout([row], "clean/mine/curve/0") == row
