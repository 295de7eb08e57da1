"""The policy of a pool's driver, on workers whose fate is written down and a clock that is moved by
hand.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.runs.executors.assignment import differences, identity_of, targets_of
from alpasim_plugin.runs.executors.base import Died, Done, Event, Faulty, Lost, Place, Rules
from alpasim_plugin.runs.executors.choice import LOCAL, parse_executor
from alpasim_plugin.runs.executors.pool import run_jobs

STEP_S = 1.0


class Stage:
    """Workers on nodes; an item takes the seconds that its text begins with, or does what the text
    says.

    ``dies`` kills its worker, ``raises`` fails, ``hangs@a`` never ends on node a, ``bad@a`` is
    faulty on node a.
    """

    rules = Rules(chunk_s=10.0)

    def __init__(self, *nodes: str) -> None:
        self.now_s = 0.0
        self.workers: dict[int, str] = dict(enumerate(nodes))
        self.busy: dict[int, tuple[float, Sequence[str]]] = {}
        self.handed: list[tuple[str, tuple[str, ...]]] = []
        self.ended: list[int] = []
        self.aside: dict[str, str] = {}
        self.to_come: dict[float, str] = {}  # when -> node whose worker is there from then on

    def inherited(self, items: Sequence[str]) -> Iterable[tuple[int, Any]]:
        return [(i, "left over") for i, item in enumerate(items) if item == "inherited"]

    def free(self, wanted: int) -> list[Place]:
        for due_s in [due_s for due_s in self.to_come if due_s <= self.now_s]:
            self.workers[len(self.workers)] = self.to_come.pop(due_s)
        return [Place(n, node) for n, node in self.workers.items() if n not in self.busy]

    def start(self, worker: int, items: Sequence[str]) -> None:
        node = self.workers[worker]
        self.handed.append((node, tuple(items)))
        takes_s = sum(
            float("inf") if item == f"hangs@{node}" else self._takes_s(item) for item in items
        )
        self.busy[worker] = self.now_s + takes_s, items

    def wait(self, timeout_s: float) -> list[Event]:
        self.now_s += timeout_s
        events: list[Event] = []
        for worker, (end_s, items) in list(self.busy.items()):
            if end_s > self.now_s:
                continue
            del self.busy[worker]
            node = self.workers[worker]
            if any(item.startswith("dies") for item in items):
                events.append(Died(worker, node, "killed by SIGKILL"))
            else:
                events.append(Done(worker, node, [self._answer(item, node) for item in items]))
        return events

    def end(self, worker: int) -> None:
        self.ended.append(worker)
        self.busy.pop(worker, None)

    def nodes(self) -> frozenset[str]:
        return frozenset([*self.workers.values(), *self.to_come.values()]) - self.aside.keys()

    def set_aside(self, node: str, why: str) -> None:
        self.aside[node] = why
        self.workers = {n: one for n, one in self.workers.items() if one != node}
        self.busy = {n: one for n, one in self.busy.items() if n in self.workers}

    def _takes_s(self, item: str) -> float:
        return float(item.split("s")[0]) if item[0].isdigit() else STEP_S

    def _answer(self, item: str, node: str) -> Any:
        if item.startswith("raises"):
            return ValueError("no")
        return (
            Faulty(f"{item} failed", "disk full")
            if item.startswith(f"bad@{node}")
            else item.upper()
        )


def drive(stage: Stage, items: list[str], limit_s: float | None = None) -> dict[str, Any]:
    return dict(run_jobs(stage, items, lambda text: None, limit_s, lambda: stage.now_s))


def test_short_items_go_in_chunks_and_the_last_ones_singly() -> None:
    stage = Stage("a", "b")
    found = drive(stage, [f"0.5s {i}" for i in range(100)])
    assert len(found) == 100
    sizes = [len(items) for _, items in stage.handed]
    assert sizes[:2] == [1, 1]
    assert max(sizes) > 5
    assert sizes[-2:] == [1, 1]
    assert sum(sizes) == 100


def test_long_items_go_singly() -> None:
    stage = Stage("a", "b")
    drive(stage, [f"20s {i}" for i in range(6)])
    assert {len(items) for _, items in stage.handed} == {1}


def test_a_worker_has_one_unit_until_its_results_were_taken() -> None:
    stage = Stage("a", "b")
    outcomes = run_jobs(stage, [f"20s {i}" for i in range(50)], print, None, lambda: stage.now_s)
    next(outcomes)
    assert len(stage.handed) <= 3


def test_an_item_that_kills_its_workers_is_given_up_and_the_rest_of_its_chunk_is_not() -> None:
    stage = Stage("a", "b", "c")
    items = [f"0.5s {i}" for i in range(20)] + ["dies"] + [f"0.5s {i}" for i in range(20, 40)]
    found = drive(stage, items)
    lost = found.pop("dies")
    assert isinstance(lost, Lost)
    assert "3 workers died of it (a, b, c)" in lost.found
    assert found == {item: item.upper() for item in items if item != "dies"}
    assert not stage.aside


def test_a_lost_item_goes_to_another_node_first() -> None:
    stage = Stage("a", "b", "c")
    drive(stage, ["dies"])
    assert sorted(node for node, _ in stage.handed) == ["a", "b", "c"]


def test_a_node_that_only_fails_is_set_aside_and_its_work_is_done_elsewhere() -> None:
    stage = Stage("a", "b")
    items = [f"bad@a {i}" for i in range(30)]
    assert drive(stage, items) == {item: item.upper() for item in items}
    assert "3 failures in a row, the last: disk full" in stage.aside["a"]


def test_what_the_only_node_fails_waits_for_one_that_is_starting() -> None:
    stage = Stage("a")
    stage.to_come = {20.0: "b"}
    assert drive(stage, ["bad@a 1", "bad@a 2"]) == {"bad@a 1": "BAD@A 1", "bad@a 2": "BAD@A 2"}
    assert stage.now_s < 30.0


def test_what_waits_for_a_node_that_never_comes_is_tried_again_where_it_failed() -> None:
    stage = Stage("a")
    stage.to_come = {float("inf"): "b"}
    assert isinstance(drive(stage, ["dies"])["dies"], Lost)
    assert [node for node, _ in stage.handed] == ["a", "a", "a"]


def test_what_is_faulty_on_every_node_stands() -> None:
    assert drive(Stage("a"), ["bad@a", "1s"]) == {"bad@a": "bad@a failed", "1s": "1S"}


def test_a_late_item_is_done_again_on_another_node_and_the_first_is_ended() -> None:
    stage = Stage("a", "b")
    found = drive(stage, ["hangs@a", *[f"20s {i}" for i in range(5)]])
    assert found["hangs@a"] == "HANGS@A"
    assert ("b", ("hangs@a",)) in stage.handed
    assert stage.ended == [0]


def test_an_item_that_hangs_is_ended_at_the_limit() -> None:
    stage = Stage("a")
    found = drive(stage, ["hangs@a", "1s"], limit_s=5.0)
    assert found["hangs@a"].hung
    assert found["1s"] == "1S"


def test_a_job_waits_for_those_that_it_depends_on_and_holds_up_no_other() -> None:
    stage = Stage("a", "b")
    items = ["20s first", "1s", "1s after the first", "1s free"]
    found = dict(run_jobs(stage, items, lambda text: None, None, lambda: stage.now_s, {2: [0]}))
    assert found == {item: item.upper() for item in items}
    assert [handed for _, (handed,) in stage.handed] == [
        "20s first",
        "1s",
        "1s free",
        "1s after the first",
    ]


def test_a_backend_without_second_tries_gives_up_what_died_and_copies_nothing() -> None:
    stage = Stage("", "")
    stage.rules = Rules(chunk_s=0.0, most_losses=1, copies=False)
    found = drive(stage, ["dies", *[f"0.5s {i}" for i in range(8)], "100s"])
    assert found["dies"] == Lost("killed by SIGKILL", do_this=stage.rules.after_dying)
    assert {len(items) for _, items in stage.handed} == {1}
    assert len(stage.handed) == 10


def test_an_error_of_the_work_ends_it() -> None:
    with pytest.raises(ValueError, match="no"):
        drive(Stage("a"), ["1s", "raises"])


def test_what_an_earlier_driver_has_left_is_not_done_again() -> None:
    stage = Stage("a")
    assert drive(stage, ["1s", "inherited"]) == {"1s": "1S", "inherited": "left over"}
    assert stage.handed == [("a", ("1s",))]


def test_the_text_of_the_option_is_understood() -> None:
    assert parse_executor("local") is LOCAL
    assert parse_executor("ray:10.0.0.1:6379?gpus=0.5").where == "10.0.0.1:6379"
    assert parse_executor("slurm:cpu?cores=4").resources.cores == 4
    assert str(parse_executor("slurm:cpu")) == "slurm:cpu"


@pytest.mark.parametrize(
    "text",
    [
        "dask",
        "local:a",
        "local?cores=2",
        "",
        "ray?cores=0",
        "ray?cores=1.5",
        "slurm?gpus=nan",
        "ray?memory=0",
        "ray?nodes=2",
    ],
)
def test_an_executor_that_is_not_there_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="choosing an executor"):
        parse_executor(text)


def test_a_node_is_compared_by_name() -> None:
    own = identity_of(())
    assert differences(own, own) == []
    assert differences(own, {**own, "numpy": "0.1"}) == [
        f"numpy is 0.1, the driver has {own['numpy']}"
    ]
    assert {"python", "torch", "code of simrun"} <= own.keys()
    assert targets_of(()) == ()
    assert identity_of(("no_such_module", "/no/such/file.py")) == own | {
        "code of no_such_module": "not there",
        "code of /no/such/file.py": "not there",
    }
