"""A container of two cores on a machine of many runs two threads."""

import os

import pytest

from alpasim_plugin.core.cores import usable_cores
from alpasim_plugin.runs import execute


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """Give folders of a machine of 64 cores, and what writes a file there."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(64)), raising=False)

    def write(name, text):
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)

    def cores():
        return usable_cores(tmp_path / "groups", tmp_path / "own")

    return write, cores


@pytest.mark.parametrize(
    ("own", "files", "expected"),
    [
        ("0::/\n", {"cpu.max": "200000 100000\n"}, 2),
        ("0::/\n", {"cpu.max": "max 100000\n"}, 64),
        ("0::/\n", {}, 64),
        ("0::/\n", {"cpu.max": "50000 100000\n"}, 1),
        ("0::/pod/of\n", {"cpu.max": "max 100000", "pod/cpu.max": "350000 100000"}, 3),
        ("0::/host/path\n", {"cpu.max": "400000 100000"}, 4),
        (
            "4:cpu,cpuacct:/box\n0::/\n",
            {
                "cpu,cpuacct/box/cpu.cfs_quota_us": "200000\n",
                "cpu,cpuacct/box/cpu.cfs_period_us": "100000\n",
            },
            2,
        ),
        (  # the kernel names the two in another order than the folder does
            "4:cpuacct,cpu:/box\n",
            {
                "cpu,cpuacct/box/cpu.cfs_quota_us": "200000\n",
                "cpu,cpuacct/box/cpu.cfs_period_us": "100000\n",
            },
            2,
        ),
        (
            "4:cpu:/\n",
            {"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"},
            64,
        ),
    ],
)
def test_cores_are_those_of_the_container(machine, own, files, expected):
    write, cores = machine
    write("own", own)
    for name, text in files.items():
        write(f"groups/{name}", text)
    assert cores() == expected


def test_workers_and_their_threads_are_no_more_than_the_cores(monkeypatch):
    monkeypatch.setattr(execute, "usable_cores", lambda: 2)
    assert execute.thread_budget(None, 10) == execute.Threads(2, 1)
    assert execute.thread_budget(1, 10) == execute.Threads(1, 2)
