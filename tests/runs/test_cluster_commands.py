"""Whole commands over a Ray cluster and over jobs, with a store: the same files, tables and
verdicts as on this machine alone.

`pytest -m slow tests/runs/test_cluster_commands.py`, about four minutes on two free cores.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from alpasim_plugin.cli.main import run_command
from evaluators.statistics.decision import read_decision
from tests.runs.cluster_nodes import Nodes
from tests.runs.grey_policy import BY_GREY
from tests.runs.grey_renderer import GREY
from tests.runs.s3_server import s3_line
from tests.runs.test_runs import SHORT, comparable

pytest.importorskip("ray", reason="the extra [ray] is not installed")
pytest.importorskip("submitit", reason="the extra [slurm] is not installed")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(1200),
]  # most of the time goes by while processes start

DARKER = GREY.replace("Grey", "Darker")
SCENES = ("smoke/straight", "smoke/lead_car")
SET = [word for text in SHORT for word in ("--set", text)]
RUN = [
    "--renderer",
    GREY,
    "--policy",
    "constant-velocity,pure-pursuit",
    *SET,
    "--no-report",
    "--quiet",
    *SCENES,
]
PAIR = [
    "--renderer",
    f"{GREY},{DARKER}",
    "--policy",
    BY_GREY,
    *SET,
    "--images",
    "none",
    "--alpha",
    "0.4",
]


@pytest.fixture(scope="module")
def bucket() -> Iterator[str]:
    """Give the URL of a bucket; nodes and jobs that start later find its server, too."""
    with s3_line():
        yield "s3://runs"


@pytest.fixture(scope="module")
def where(request: pytest.FixtureRequest, bucket: str) -> Iterator[str]:
    """Give an ``--executor`` by its kind."""
    if request.param == "slurm":
        yield "slurm:@local"
        return
    nodes = Nodes(2)
    yield f"ray:{nodes.address}"
    nodes.close()


both = pytest.mark.parametrize("where", ["ray", "slurm"], indirect=True)


def rows(root: Path) -> list[dict]:
    return pq.read_table(root / "rollouts.parquet").to_pylist()


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("plain")
    assert run_command([*RUN, "--workers", "1", "--out", str(root)]) == 0
    return root


@both
def test_a_command_gives_the_same_files_and_another_machine_takes_them_from_the_store(
    tmp_path: Path, where: str, bucket: str, plain: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = f"{bucket}/{where.partition(':')[0]}"
    assert (
        run_command(
            [
                *RUN,
                "--executor",
                where,
                "--workers",
                "2",
                "--store",
                store,
                "--out",
                str(tmp_path / "far"),
            ]
        )
        == 0
    )
    assert (
        "equal to the bit" in capsys.readouterr().out
    )  # a rollout of a node, and its repetition here
    assert comparable(tmp_path / "far") == comparable(plain)
    told = json.loads((tmp_path / "far" / "run.json").read_text())["pool"]
    assert (told["executor"], told["store"]) == (where, store)
    assert (
        run_command(
            [
                *RUN,
                "--workers",
                "1",
                "--store",
                store,
                "--out",
                str(tmp_path / "near"),
                "--certify",
                "none",
            ]
        )
        == 0
    )
    assert rows(tmp_path / "near") == rows(tmp_path / "far"), "wall_s too: it is the same drive"
    assert rows(tmp_path / "far") != rows(plain)


@both
def test_a_decision_is_the_same(tmp_path: Path, where: str) -> None:
    words = [
        "decide",
        *PAIR,
        "--metric",
        "offroad=0.6",
        "--look-every",
        "1",
        "--certify",
        "none",
        "--no-report",
        "--quiet",
        *SCENES,
    ]
    assert run_command([*words, "--out", str(tmp_path / "near"), "--workers", "1"]) == 0
    assert (
        run_command(
            [
                *words,
                "--out",
                str(tmp_path / "far"),
                "--executor",
                where,
                "--store",
                str(tmp_path / "store"),
            ]
        )
        == 0
    )
    decided = read_decision(tmp_path / "far")
    assert decided is not None
    assert decided == read_decision(tmp_path / "near")
    assert len(decided["looks"]) == 2
    assert len(list((tmp_path / "store" / "commits").rglob("*.json"))) == 4
    assert comparable(tmp_path / "far") == comparable(tmp_path / "near")


@both
def test_a_gate_drives_until_it_is_decided(
    tmp_path: Path, where: str, capsys: pytest.CaptureFixture[str]
) -> None:
    gate = tmp_path / "gate.yaml"
    gate.write_text("version: 1\nmetrics:\n  offroad: {margin: 0.6}\n")
    words = [
        "gate",
        str(tmp_path / "run"),
        "--until-decided",
        "--gate",
        str(gate),
        *PAIR,
        "--executor",
        where,
    ]
    words += [word for scene in SCENES for word in ("--scenes", scene)]
    assert run_command(words) == 0
    assert "non-inferior after 2 scenes" in capsys.readouterr().out


def at_work(mark: bytes) -> list[int]:
    """Return the processes whose command has a mark."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):  # it has ended
            if mark in path.read_bytes():
                found.append(int(path.parent.name))
    return found


@both
def test_ctrl_c_leaves_no_worker_and_the_same_command_goes_on(
    tmp_path: Path, where: str, repo: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = [
        *RUN,
        "--seeds",
        "4",
        "--executor",
        where,
        "--workers",
        "2",
        "--certify",
        "none",
        "--out",
        str(tmp_path / "run"),
    ]
    monkeypatch.setenv("SIMRUN_SLURM", str(private := tmp_path / "private"))
    environment = {**os.environ, "PYTHONPATH": str(repo)}
    command = [sys.executable, "-m", "alpasim_plugin.cli.main", *words]
    mark = b"ray::Serving" if where.startswith("ray") else str(private).encode()
    driver = subprocess.Popen(command, cwd=repo, env=environment, stderr=subprocess.PIPE, text=True)
    until_s = time.monotonic() + 200
    while not list((tmp_path / "run").rglob("manifest.json")):
        assert time.monotonic() < until_s
        assert driver.poll() is None
        time.sleep(0.02)
    assert at_work(mark)
    driver.send_signal(signal.SIGINT)
    said = driver.communicate(timeout=120)[1]
    assert driver.returncode == 130
    assert "the same command continues" in said
    until_s = time.monotonic() + 30
    while at_work(mark):
        assert time.monotonic() < until_s, "a worker outlives the run"
        time.sleep(0.1)
    assert not private.exists() or list(private.iterdir()) == []
    done = len(list((tmp_path / "run").rglob("manifest.json")))
    assert 1 <= done < 16
    assert run_command(words) == 0
    assert len(rows(tmp_path / "run")) == 16
