"""The block of every rollout: what is packed is what the tables say, and it stays small."""

import base64
import dataclasses
import gzip
import json
from urllib.parse import unquote

import pytest

from evaluators.metrics.outcomes import ending_of, outcomes_of
from evaluators.pages.rollouts import HAS_CLIP, HAS_FOLDER, rollout_block
from evaluators.statistics.opening import read_run


def unpacked(data):
    """Read a block as the page's script does."""
    document = json.loads(gzip.decompress(base64.b64decode(data)))
    return document


@pytest.fixture(scope="module")
def run(usual_run):
    return read_run(usual_run)


def test_every_row_and_number_of_the_table_is_in_the_block(run):
    found = unpacked(rollout_block(run).data)
    texts = found["texts"]
    assert len(found["state"]) == len(run.rollouts)
    assert found["coloured"] == ["renderer", run.renderers]
    for i, rollout in enumerate(run.rollouts):
        cell = tuple(texts[name][i] for name in ("renderer", "policy", "scene", "seed"))
        assert cell == (*rollout.cell[:3], str(rollout.seed))
        assert unquote(texts["folder"][i]) == rollout.path
        state = found["state"][i]
        names = {name for k, (name, _) in enumerate(found["kinds"]) if found["had"][i] >> k & 1}
        assert names == outcomes_of(rollout)
        assert texts["ending"][i] == ending_of(rollout)
        assert (texts["tone"][i] == "failed") is not rollout.ok
        assert bool(state & HAS_FOLDER) is (run.folder / rollout.path).is_dir()
        assert texts["note"][i].startswith(rollout.failure_class if not rollout.ok else "")
    for column in found["numbers"][1:]:
        for got, rollout in zip(column["data"], run.rollouts, strict=True):
            exact = rollout.metrics.get(column["name"])
            assert got is None if exact is None else got == pytest.approx(exact, rel=1e-3)


def test_clips_are_linked_where_the_run_made_them(run):
    info = dataclasses.replace(run.info, config=dataclasses.replace(run.info.config, video="all"))
    found = unpacked(rollout_block(dataclasses.replace(run, info=info)).data)
    for state, rollout in zip(found["state"], run.rollouts, strict=True):
        assert bool(state & HAS_CLIP) is (run.folder / rollout.path / "front.mp4").is_file()


def block_of(run, *rollouts):
    return unpacked(rollout_block(dataclasses.replace(run, rollouts=rollouts)).data)


def test_each_outcome_is_a_kind_of_its_own_whatever_else_the_rollout_had(run):
    def rollout(**flags):
        return dataclasses.replace(run.rollouts[0], status="ok", metrics=flags)

    broken = dataclasses.replace(run.rollouts[0], status="failed", failure_class="policy")
    lost = dataclasses.replace(broken, failure_class="renderer")
    both = rollout(collision_any=1.0, offroad=1.0)
    found = block_of(run, broken, both, rollout(stalled=1.0), rollout(left_route=1.0), lost)
    kinds = [name for name, _ in found["kinds"]]
    assert kinds == ["policy", "collision_any", "offroad", "left_route", "stalled"]
    had = [[name for k, name in enumerate(kinds) if mask >> k & 1] for mask in found["had"]]
    assert had == [["policy"], ["collision_any", "offroad"], ["stalled"], ["left_route"], []]
    assert found["texts"]["ending"][:2] == ["policy fault", "collision"]
    assert found["texts"]["ending"][-1] == found["texts"]["outcome"][-1] == "not run"


def test_policies_have_colours_where_there_is_one_renderer(run):
    one = run.rollouts[0]
    other = dataclasses.replace(one, policy="other")
    info = dataclasses.replace(run.info, renderers=(one.renderer,), policies=("other", one.policy))
    found = block_of(dataclasses.replace(run, info=info), one, other)
    assert found["coloured"] == ["policy", ["other", one.policy]]
