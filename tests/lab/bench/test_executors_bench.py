"""Measuring what the way over other nodes costs."""

from __future__ import annotations

import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.lab.bench.executors import bench_executor, local_nodes


@pytest.mark.parametrize(
    ("more", "found"),
    [
        (["--workers", "1,32"], "4 nodes of 4 cores hold 16"),
        (["--workers", "1,none"], "no numbers from 1 up"),
        (["--executor", "slurm"], "cannot be started before the clock"),
    ],
)
def test_an_executor_that_cannot_be_measured_is_refused(
    more: list[str], found: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(["bench", "executors", *more]) == 2
    assert found in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.timeout(1200)  # Ray takes long to start
def test_sixteen_workers_on_four_nodes_are_used_for_nine_tenths_of_the_time() -> None:
    pytest.importorskip("ray", reason="the extra [ray] is not installed")
    with local_nodes(4, 4) as made:
        (row,) = bench_executor(made, [16], rollouts=5, seconds=4.0)
    assert row.rollouts == 80
    assert 0.9 <= row.efficiency <= 1.0
