"""Stages of an experiment: what makes their keys, and what is run again."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from alpasim_plugin.core.errors import InputError, Stopped
from alpasim_plugin.lab.paper.stages import (
    MARKER,
    Stage,
    keep_stage,
    needed,
    place,
    restore,
    run_stages,
    why_not_restored,
)

DATA = Stage("data", ("make", "--out", "{out}"))
NET = Stage("net", ("train", "{data}", "--steps", "3", "--out", "{out}"), ("data",))
OTHER = Stage("other", ("train", "{data}", "--steps", "4", "--out", "{out}"), ("data",))
TABLE = Stage("table", ("measure", "{net}", "--out", "{out}"), ("net",))
STAGES = (DATA, NET, OTHER, TABLE)


def writer(calls):
    """Return an execution that makes the folder and notes the verb."""

    def execute(words):
        calls.append(words[0])
        folder = words[words.index("--out") + 1]
        Path(folder).mkdir(parents=True, exist_ok=True)

    return execute


def with_products(calls):
    """Return an execution that also writes a net and a table."""
    execute = writer(calls)

    def produce(words):
        execute(words)
        (Path(words[words.index("--out") + 1]) / f"{words[0]}.safetensors").write_text(words[0])

    return produce


KEPT_STAGES = (
    DATA,
    replace(NET, products=("train.safetensors",)),
    replace(TABLE, products=("measure.safetensors",)),
)


def run_and_keep(stages, out, kept, calls):
    run_stages(
        place(stages, out),
        with_products(calls),
        lambda *_: None,
        lambda item: keep_stage(item, kept),
    )


def restored(stages, out, kept):
    placed = place(stages, out)
    for item in placed:
        restore(item, kept)
    return placed


def keys(stages, out):
    return {item.stage.name: item.key for item in place(stages, out)}


def states(stages, out):
    return {item.stage.name: item.state for item in place(stages, out)}


def test_a_changed_budget_changes_the_keys_of_what_depends_on_it_alone(tmp_path):
    before = keys(STAGES, tmp_path)
    longer = replace(NET, command=("train", "{data}", "--steps", "5", "--out", "{out}"))
    after = keys((DATA, longer, OTHER, TABLE), tmp_path)
    assert {name for name in before if before[name] != after[name]} == {"net", "table"}


def test_facts_make_a_key_and_effort_and_place_do_not(tmp_path):
    before = keys(STAGES, tmp_path)
    hurried = tuple(replace(stage, effort=("--jobs", "8"), budget="quick") for stage in STAGES)
    assert keys(hurried, tmp_path / "elsewhere") == before
    newer = replace(TABLE, facts={"version": 8})
    assert keys((DATA, NET, OTHER, newer), tmp_path)["table"] != before["table"]


def test_words_name_the_folders_of_the_stages_that_are_read(tmp_path):
    data, net, *_ = place((DATA, replace(NET, effort=("--threads", "2"))), tmp_path)
    expected = ("train", str(data.folder), "--steps", "3", "--out", str(net.folder))
    assert net.words == (*expected, "--threads", "2")


def test_complete_stages_are_reused_and_the_rest_is_run(tmp_path):
    calls, reports = [], []
    run_stages(place(STAGES, tmp_path), writer(calls), lambda *_: None)
    assert calls == ["make", "train", "train", "measure"]
    marker = json.loads((place(STAGES, tmp_path)[1].folder / MARKER).read_text())
    assert marker["command"][:2] == ["simrun", "train"]
    longer = replace(NET, command=("train", "{data}", "--steps", "5", "--out", "{out}"))
    run_stages(
        place((DATA, longer, OTHER, TABLE), tmp_path),
        writer(calls),
        lambda item, state: reports.append((item.stage.name, state)),
    )
    assert calls[4:] == ["train", "measure"]
    assert reports == [("data", "done"), ("net", "open"), ("other", "done"), ("table", "open")]


def test_a_stage_that_was_stopped_goes_on_and_is_not_taken_for_complete(tmp_path):
    calls = []
    execute = writer(calls)

    def stopped(words):
        execute(words)
        if words[0] == "train":
            raise Stopped(15)

    with pytest.raises(Stopped):
        run_stages(place(STAGES, tmp_path), stopped, lambda *_: None)
    assert states(STAGES, tmp_path) == {
        "data": "done",
        "net": "begun",
        "other": "open",
        "table": "open",
    }
    run_stages(place(STAGES, tmp_path), execute, lambda *_: None)
    assert calls == ["make", "train", "train", "train", "measure"]
    assert set(states(STAGES, tmp_path).values()) == {"done"}
    marker = json.loads((place(STAGES, tmp_path)[1].folder / MARKER).read_text())
    assert marker["was_resumed"] is True


def test_a_kept_network_is_measured_elsewhere_without_training_or_its_data(tmp_path):
    kept, calls = tmp_path / "kept", []
    run_and_keep(KEPT_STAGES[:2], tmp_path / "here", kept, [])
    there = restored(KEPT_STAGES, tmp_path / "there", kept)
    assert [item.stage.name for item in needed(there)] == ["net", "table"]
    run_and_keep(KEPT_STAGES, tmp_path / "there", kept, calls)
    assert calls == ["measure"]
    assert needed(restored(KEPT_STAGES, tmp_path / "third", kept)) == [
        item for item in place(KEPT_STAGES, tmp_path / "third") if item.stage.name == "table"
    ]


def test_a_kept_network_of_another_budget_is_not_taken_and_the_difference_is_said(tmp_path):
    kept = tmp_path / "kept"
    run_and_keep(KEPT_STAGES[:2], tmp_path / "here", kept, [])
    longer = replace(KEPT_STAGES[1], command=("train", "{data}", "--steps", "5", "--out", "{out}"))
    _, net = restored((DATA, longer), tmp_path / "there", kept)
    assert net.state == "open"
    assert "--steps 5, kept 3" in why_not_restored(net, kept)
    other_data = replace(DATA, command=("make", "--more", "--out", "{out}"))
    _, net = restored((other_data, KEPT_STAGES[1]), tmp_path / "there", kept)
    assert net.state == "open"
    assert "on other weights or data" in why_not_restored(net, kept)
    assert "no " in why_not_restored(net, tmp_path / "nothing")


def test_a_marker_of_another_stage_is_refused(tmp_path):
    run_stages(place(STAGES, tmp_path), writer([]), lambda *_: None)
    marker = place(STAGES, tmp_path)[-1].folder / MARKER
    marker.write_text(json.dumps({"key": "0"}))
    with pytest.raises(InputError, match="key '0'"):
        run_stages(place(STAGES, tmp_path), writer([]), lambda *_: None)


@pytest.mark.parametrize("stages", [(NET, DATA), (DATA, DATA)])
def test_a_stage_before_what_it_reads_and_a_name_twice_are_refused(stages, tmp_path):
    with pytest.raises(InputError, match="stage"):
        place(stages, tmp_path)
