"""Stages of an experiment: what makes their keys, and what is run again."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from alpasim_plugin.core.errors import InputError, Stopped
from alpasim_plugin.lab.paper.stages import MARKER, Stage, place, run_stages

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


def test_a_marker_of_another_stage_is_refused(tmp_path):
    run_stages(place(STAGES, tmp_path), writer([]), lambda *_: None)
    marker = place(STAGES, tmp_path)[0].folder / MARKER
    marker.write_text(json.dumps({"key": "0"}))
    with pytest.raises(InputError, match="key '0'"):
        run_stages(place(STAGES, tmp_path), writer([]), lambda *_: None)


@pytest.mark.parametrize("stages", [(NET, DATA), (DATA, DATA)])
def test_a_stage_before_what_it_reads_and_a_name_twice_are_refused(stages, tmp_path):
    with pytest.raises(InputError, match="stage"):
        place(stages, tmp_path)
