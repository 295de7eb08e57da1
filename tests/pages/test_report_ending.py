"""The last lines of a run on the terminal."""

import dataclasses

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
