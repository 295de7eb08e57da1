"""The block of every rollout: what is packed is what the tables say, and it stays small."""

import base64
import dataclasses
import gzip
import json
from urllib.parse import unquote

import pytest

from evaluators.pages.rollouts import (
    COLLIDED,
    FAILED,
    HAS_CLIP,
    HAS_FOLDER,
    OTHERWISE,
    rollout_block,
)
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
    assert found["renderers"] == run.renderers
    for i, rollout in enumerate(run.rollouts):
        cell = tuple(texts[name][i] for name in ("renderer", "policy", "scene", "seed"))
        assert cell == (*rollout.cell[:3], str(rollout.seed))
        assert unquote(texts["folder"][i]) == rollout.path
        state = found["state"][i]
        assert bool(state & FAILED) is not rollout.ok
        assert bool(state & COLLIDED) is (rollout.ok and rollout.flag("collision_any"))
        assert bool(state & OTHERWISE) is (rollout.ok and rollout.flag("offroad"))
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
