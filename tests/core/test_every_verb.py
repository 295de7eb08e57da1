"""A run folder is data: every verb is walked in a folder in which run.json, manifests, scene
references, tables, a gate and the lock file are bait, and nothing runs, no address is contacted, no
file outside of the folder changes, no verb that reads writes, and nothing prints raw.
"""

import json
import os
import shutil
import socket
import threading
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from alpasim_plugin.cli.main import run_command, verbs
from alpasim_plugin.core.escape import terminal
from alpasim_plugin.log.run_folder.schema import LOCK
from tests.core.checksum_files import vouch_for

SCENE = "smoke/straight"
SCENE_ID = "smoke-straight"
RENDERERS = ("clean", "identity+clean")
POLICIES = ("constant-velocity", "pure-pursuit")
RAW = "\x1b]0;evil\x07\u202e\x9b2J"  # what a terminal acts upon
SHORT = ("--set", "timing.duration_us=1000000", "--set", "timing.warmup_us=200000")


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    root = tmp_path_factory.mktemp("finished") / "run"
    parts = ["--renderer", ",".join(RENDERERS), "--policy", ",".join(POLICIES)]
    how = ["--images", "none", "--workers", "1", "--quiet", "--out", str(root)]
    assert run_command(["run", *parts, *how, *SHORT, SCENE]) == 0
    return root


class Listener:
    """Counts who connects to an address that a run folder names."""

    def __init__(self):
        self.socket = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self.socket.getsockname()[1]}"
        self.callers = 0
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self):
        while True:
            try:
                self.socket.accept()[0].close()
            except OSError:
                return
            self.callers += 1


@pytest.fixture
def listener():
    one = Listener()
    yield one
    one.socket.close()


def stranger(finished, folder, address, is_all):
    """Return a run folder whose names of parts are bait: all of them, or those of a renderer and of
    a policy beside ones that can be driven again.
    """
    root = folder / "run"
    shutil.copytree(finished, root)
    mark = folder.parent / "ran"
    (folder / "evil.py").write_text(f"open({str(mark)!r}, 'a').write('evil.py ')\n")
    (folder / "evil.yaml").write_text(
        "version: 1\nscene_id: evil\nlog: {source: 'evil.py:Evil', path: evil.py}\n"
    )
    (folder / "gate.yaml").write_text(
        "version: 1\npreset: 'evil.py:Evil'\nmetrics: {'evil.py:Evil': {margin: 0.1}}\n"
    )
    names = {RENDERERS[1]: "evil.py:Evil", POLICIES[1]: f"exec:touch {mark}"}
    if is_all:
        names |= {RENDERERS[0]: f"nre://{address}", POLICIES[0]: f"alpasim://{address}"}
        names |= {SCENE_ID: f"{SCENE_ID}{RAW}"}

    def bait(file):
        text = file.read_text()
        for old, new in names.items():
            text = text.replace(f'"{old}"', json.dumps(new))
        file.write_text(text)

    for pattern in ("run.json", "summary.json", "scenes/*.json", "rollouts/**/manifest.json"):
        for file in root.glob(pattern):
            bait(file)
    info = json.loads((root / "run.json").read_text())
    info["command"] = [RAW, f"; touch {mark}"]
    if is_all:
        info["config"] |= {"evaluators": ["evil.py:Evil"], "controller": "evil.py:Evil"}
        for facts in info["scenes"].values():
            facts["ref"] |= {"path": str(folder / "evil.yaml"), "source": "evil.py:Evil"}
    (root / "run.json").write_text(json.dumps(info))
    for file in root.glob("*.parquet"):
        table = pq.read_table(file)
        for name in ("renderer", "policy", "scene"):
            values = [names.get(one, one) for one in table[name].to_pylist()]
            table = table.set_column(table.column_names.index(name), name, pa.array(values))
        pq.write_table(table, file)
    return vouch_for(root)


def without_tables(root, victim):
    for name in ("rollouts.parquet", "steps.parquet", "summary.json"):
        (root / name).unlink()


def no_regular_files(root, victim):
    for name in ("rollouts.parquet", "gate.json", "output.log"):
        (root / name).unlink(missing_ok=True)
        os.mkfifo(root / name)
    for name, target in {
        "steps.parquet": "/dev/zero",
        "flips.json": "/dev/zero",
        "summary.json": "summary.json",
        "report.html": victim,
        "gate.md": victim,
        "why.html": victim,
    }.items():
        (root / name).unlink(missing_ok=True)
        (root / name).symlink_to(target)


def linked_folders(root, victim):
    cell = next(root.glob("rollouts/*/*/*/*"))
    for number, folder in enumerate((cell, root / "scenes")):
        outside = victim.parent / f"outside/{number}"
        outside.parent.mkdir(exist_ok=True)
        folder.rename(outside)
        folder.symlink_to(outside)


def paths_that_leave(root, victim):
    cells = [{"frames": {"clean": str(victim)}, "t_us": 0}, {"frames": {"clean": "../../mine.txt"}}]
    (root / "flips.json").write_text(json.dumps({"cells": cells}))
    (root / "gate.json").write_text(json.dumps({"files": ["../../mine.txt"]}))
    info = json.loads((root / "run.json").read_text())
    info["rollouts"] = ["../..", str(victim.parent), "rollouts/../../.."]
    (root / "run.json").write_text(json.dumps(info))


def commands(root):
    """Yield commands of the verbs that read a run folder; what the user names is trusted."""
    run = root.name
    every = sorted(root.rglob("manifest.json"))
    cells = [str(path.parent.relative_to(root.parent)) for path in (every[0], every[-1])]
    yield ["compare", run]
    yield ["check", "run", run]
    yield ["list", "runs", "."]
    yield ["score", run, "--scene", SCENE, "--out", "scored"]
    yield ["score", run, "--scene", "evil.yaml", "--out", "scored-2"]
    yield ["export", run, "--alpasim", "exported"]
    yield ["export", cells[0], "--mcap", "exported.mcap"]
    for cell in cells:
        yield ["fork", cell, "--at", "0.5", "--out", "forked"]
        yield ["why", cell]
    yield ["why", run]
    yield ["gate", run]
    yield ["gate", run, "--gate", "gate.yaml"]
    yield ["report", run]
    yield ["view", run]
    yield ["run", "--renderer", "clean", *SHORT, "--out", run, "--resume", SCENE]
    yield ["import", "drive", run, "-o", "imported"]
    yield ["refine", f"{run}/run.json", "-o", "fixed.mp4"]


def other_commands():
    """Yield commands of the verbs that read other files of a stranger's folder, or none."""
    yield ["view", "evil.yaml"]
    yield ["run", "--renderer", "clean", "evil.yaml", "--dry-run"]
    yield ["check", "renderer", "clean", "--scenario", "evil.yaml"]
    yield ["check", "driver", "127.0.0.1:1", "--scenario", "evil.yaml"]
    yield ["serve", "--renderer", "clean", "--scenes", "evil.yaml", "--upstream", "none"]
    yield ["new", "policy", "mine"]
    yield ["docs", "security"]
    yield ["doctor", "--json"]


READING = (["compare"], ["check", "run"], ["list"], ["score"], ["export"], ["fork"])


def state_of(folder):
    """Return size and time of everything in a folder."""
    states = {str(path): path.lstat() for path in folder.rglob("*")}
    return {path: (state.st_size, state.st_mtime_ns) for path, state in states.items()}


Change = Callable[[Path, Path], None]
CASES = {
    "every name": (True, lambda root, victim: None),
    "some names, no tables": (False, without_tables),
    "no regular files": (False, no_regular_files),
    "paths that leave": (True, paths_that_leave),
    "linked folders": (False, linked_folders),
}


LONG = ("some names, no tables", "no regular files")  # readers of files refuse these by themselves


@pytest.mark.parametrize(
    "case",
    [pytest.param(case, marks=[pytest.mark.slow] * (case in LONG)) for case in CASES],
)
def test_nothing_in_a_run_folder_runs_and_reading_writes_nothing(
    case,
    finished,
    listener,
    tmp_path,
    monkeypatch,
    capfd,
):
    folder = tmp_path / "stranger"
    folder.mkdir()
    is_all, change = CASES[case]
    root = stranger(finished, folder, listener.address, is_all)
    victim = tmp_path / "mine.txt"
    victim.write_text("mine")
    (root / LOCK).unlink()
    (root / LOCK).symlink_to(victim)
    change(root, victim)
    monkeypatch.chdir(folder)
    others = other_commands() if case == "every name" else ()
    walked = set()
    outside = tmp_path / "outside"
    outside_before = state_of(outside)
    for command in [*commands(root), *others]:
        before = state_of(root)
        code = run_command(command)
        shown = capfd.readouterr()
        assert not (tmp_path / "ran").exists(), f"{command} ran it"
        assert listener.callers == 0, f"{command} called an address"
        assert victim.read_text() == "mine", f"{command} wrote through a link"
        assert state_of(outside) == outside_before, f"{command} wrote outside of the run folder"
        assert code in (0, 1, 2, 3, 4, 5), (command, shown.err)
        for line in (shown.out + shown.err).split("\n"):
            assert terminal(line) == line, (command, line)
        if any(command[: len(one)] == one for one in READING):
            assert state_of(root) == before, f"{command} wrote into the run folder"
        walked.add(command[0])
    assert not others or walked == {
        name for name, target in verbs().items() if "_plugin.cli." in target
    }
