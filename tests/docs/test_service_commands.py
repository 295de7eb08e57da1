"""The commands of the pages that need a service or a bus: each is run as its page says, at its
address, with what it needs beside it.

Slow: ``pytest -m slow`` on this file. AlpaSim's renderer, driver and control unit are stood for by
    ours.
"""

import os
import re
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest

from tests.docs.commands import SHORT, commands, pages

REPO = Path(__file__).resolve().parents[2]
PAGES = (
    "docs/alpasim.md",
    "docs/behind-alpasim.md",
    "docs/can.md",
    "docs/policies.md",
    "docs/renderers.md",
)
# other pages' subjects
ELSEWHERE = r"^(?!.*(127\.0\.0\.1:|can://|^serve)).*$|exec:"
CLEAN = ("serve", "--renderer", "clean", "--scenes", "scenes", "--listen")
BESIDE = {  # address in a command -> what answers there
    "--upstream 127.0.0.1:6789": (*CLEAN, "127.0.0.1:6789"),
    "nre://127.0.0.1:50051": (*CLEAN, "127.0.0.1:50051"),
    "127.0.0.1:6000": (
        "serve",
        "--policy",
        "lane-camera",
        "--scenes",
        "scenes",
        "--scenes",
        "smoke/curve",
        "--listen",
        "127.0.0.1:6000",
    ),
}
CONTROL_UNIT = (
    "can://udp_multicast:239.74.163.2",
    "tests.control.can_ecu",
    "udp_multicast:239.74.163.2",
)
COMMANDS = [
    one
    for one in commands(REPO, pages(REPO))
    if one.page in PAGES and not re.search(ELSEWHERE, " ".join(one.words))
]


@contextmanager
def running(words, folder):
    """Run a service until its caller is done; it must say that it serves, and end well when it is
    stopped.
    """
    command = [sys.executable, "-m", "alpasim_plugin.cli.main", *words]
    with subprocess.Popen(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        said = process.stdout.readline()
        try:
            assert said.startswith("serving "), said + process.stderr.read()
            yield
        finally:
            process.send_signal(signal.SIGTERM)
            code = process.wait(60)
        assert code == 0, process.stderr.read()


@contextmanager
def control_unit(address, unit):
    with subprocess.Popen([sys.executable, "-m", unit, address]) as process:
        time.sleep(
            3.0
        )  # it says nothing; the command waits for its frames, but does not for the interface to be joined
        assert process.poll() is None
        yield
        process.terminate()


@pytest.fixture
def folder(tmp_path):
    """Give a folder with one scene, `scenes/curve.yaml`, of 1.2 s."""
    (tmp_path / "scenes").mkdir()
    text = (REPO / "scenarios" / "smoke" / "curve.yaml").read_text(encoding="utf-8")
    (tmp_path / "scenes" / "curve.yaml").write_text(
        re.sub(r"duration_us: [\d_]+", "duration_us: 1200000", text)
    )
    return tmp_path


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("command", COMMANDS, ids=str)
def test_the_command_works_beside_what_it_needs(folder, command, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    line = " ".join(command.words)
    words = [
        re.sub(r"^(scene\.usdz|smoke/curve)$", "scenes/curve.yaml", word) for word in command.words
    ]
    with ExitStack() as beside:
        for address, service in BESIDE.items():
            if address in line and "--policy" not in words[:2]:
                beside.enter_context(running(service, folder))
        if CONTROL_UNIT[0] in line:
            beside.enter_context(control_unit(CONTROL_UNIT[2], CONTROL_UNIT[1]))
        if words[0] == "serve":
            with running(words, folder):
                return
        more = () if words[0] == "check" else (*SHORT, "--seeds", "1")
        done = subprocess.run(
            [sys.executable, "-m", "alpasim_plugin.cli.main", *words, *more],
            cwd=folder,
            capture_output=True,
            text=True,
            check=False,
        )
        # A check of 100 ms a call says what it found, not whether this machine was busy.
        assert done.returncode in ((0, 1) if words[0] == "check" else (0,)), done.stderr[-3000:]
        assert "Traceback" not in done.stderr
