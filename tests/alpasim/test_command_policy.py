"""``--policy exec:COMMAND``: real child processes, how they drive, and how they end."""

import json
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest

from alpasim_plugin.alpasim.client import child as children
from alpasim_plugin.alpasim.client.child import Child, end_children, exit_reason
from alpasim_plugin.alpasim.client.command import Command
from alpasim_plugin.cli.main import run_command
from alpasim_plugin.cli.options import split_policies
from alpasim_plugin.core.errors import InputError, PolicyError
from alpasim_plugin.core.parts import build, resolve
from alpasim_plugin.core.subprocesses import MOST_BYTES, parts_print_to_stderr, say
from alpasim_plugin.log import read_asl
from policies.conformance import STRAIGHT, canned_scenario, observations

REPO = Path(__file__).resolve().parents[2]
HEAVY = "torch numba scipy shapely pydantic yaml pyarrow typer av matplotlib"
PAGE = (REPO / "docs" / "policies.md").read_text(encoding="utf-8")
SHORT = (
    "--set",
    "timing.duration_us=600000",
    "--no-report",
    "--images",
    "none",
    "--workers",
    "1",
)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Give a folder with the script of the page and worse ones."""
    (script,) = re.findall(r"^```python\n([^`]*serve_policy\(.*?)^```", PAGE, re.M | re.S)
    light = f"    import sys\n    print('heavy:', sorted({set(HEAVY.split())!r} & sys.modules.keys()))\n"
    (tmp_path / "remote_policy.py").write_text(
        script.replace("    serve_policy(Cruise)", f"{light}    serve_policy(Cruise)")
    )
    act = "    def act(self, observation):"
    worse = script.replace(act, f"{act}\n        self.fault(observation)").split("if __name__")[0]
    (tmp_path / "worse.py").write_text(
        f"""{worse}
import os, sys, time

def dies(self, observation):
    print("cannot find the road", flush=True)
    os._exit(3)

def raises(self, observation):
    raise RuntimeError("no lane in sight")

def hangs(self, observation):
    time.sleep(60)

Cruise.fault = globals()[sys.argv[1]]
serve_policy(Cruise)
"""
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(REPO))
    yield tmp_path
    end_children()


def python(*words):
    return f"exec:{shlex.join([sys.executable, *words])}"


def made(command):
    policy = build(resolve("policy", command), scenario=canned_scenario())
    return policy


def drive(policy):
    scenario = canned_scenario()
    policy.reset(0, scenario.route)
    return [
        policy.act(one).xy
        for one in observations(STRAIGHT, {camera.name: camera for camera in scenario.cameras})
    ]


def until(condition, seconds=20.0):
    end_s = time.monotonic() + seconds
    while not condition() and time.monotonic() < end_s:
        time.sleep(0.02)
    return condition()


def is_gone(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (
        FileNotFoundError,
        ProcessLookupError,
    ):  # the latter where it ends between opening and reading
        return True


@pytest.mark.slow
def test_the_script_of_the_page_drives_as_in_the_process(folder, capfd):
    logs = []
    for name in (python("remote_policy.py"), "remote_policy.py:Cruise"):
        out = str(len(logs))
        words = [
            "--renderer",
            "clean",
            "--policy",
            name,
            "smoke/straight",
            "--seeds",
            "4,5",
            "--out",
            out,
            *SHORT,
            "--json",
        ]
        assert run_command(words) == 0
        printed = json.loads(
            capfd.readouterr().out
        )  # the command's output does not break the document
        assert printed["summary"]["failures"]["n_failed"] == 0
        logs.append([read_asl(path) for path in sorted((folder / out).rglob("rollout.asl"))])
        assert [
            "rollout with seed 5" in path.read_text()
            for path in sorted((folder / out).rglob("output.log"))
        ] == [False, True]
        if out == "0":
            (first, _) = (path.read_text() for path in sorted((folder / out).rglob("output.log")))
            assert "heavy: []" in first, (
                "the environment of a served policy would need more than the page says"
            )
            (manifest, _) = (
                json.loads(path.read_text())
                for path in sorted((folder / out).rglob("manifest.json"))
            )
            assert manifest["policy_facts"]["command"].endswith("remote_policy.py")
            assert "output.log" in manifest["files"]
    for outside, inside in zip(*logs, strict=True):
        assert (
            np.abs(outside.ego.xyz - inside.ego.xyz).max() < 2e-5
        )  # poses are float32 on the wire
    assert children._running == [], "the command outlives its run"
    cell = f"0/clean/{python('remote_policy.py')}/smoke-straight/5"
    # No command is run because a file names it.
    assert run_command(["fork", cell, "--at", "0.5", "--json"]) == 2


@pytest.mark.slow
def test_check_policy_takes_a_command(folder, capfd):
    assert run_command(["check", "policy", python("remote_policy.py")]) in (0, 1)
    failed = [line for line in capfd.readouterr().out.splitlines() if line.startswith("FAIL")]
    assert all("latency" in line for line in failed)


@pytest.mark.slow
def test_a_command_that_dies_is_told_with_its_last_words_and_starts_anew(folder, capfd):
    command = [
        "--renderer",
        "clean",
        "--policy",
        python("worse.py", "dies"),
        "smoke/straight",
        "--seeds",
        "1,2",
        "--out",
        "out",
        *SHORT,
    ]
    assert run_command([*command, "--json"]) == 2
    (one, two) = json.loads(capfd.readouterr().out)["summary"]["failures"]["cells"]
    for cell in (one, two):
        assert cell["error"]["failure_class"] == "policy"
        assert "exit code 3; its last lines:" in cell["error"]["message"]
        assert cell["error"]["message"].endswith("cannot find the road")
    assert "seed 2 | cannot find the road" in two["error"]["message"], (
        "the second rollout had a command of its own"
    )


def test_a_command_that_hangs_is_ended_and_said_so(folder):
    policy = made(python("worse.py", "hangs").replace("exec:", "exec:?timeout_s=0.5 "))
    with pytest.raises(PolicyError, match="DEADLINE_EXCEEDED"):
        drive(policy)
    assert children._running == []


@pytest.mark.parametrize(
    ("code", "found"),
    [
        ("print('no weights'); raise SystemExit(7)", "exit code 7; its last lines: no weights"),
        ("import os; os.kill(os.getpid(), 9)", r"exit code 137 \(SIGKILL\); it printed nothing"),
        ("import time; time.sleep(60)", "nothing listens at unix:"),
    ],
)
def test_a_command_that_never_serves_is_told_apart(folder, code, found):
    before = set(Path(tempfile.gettempdir()).glob("simrun-policy-*"))
    with pytest.raises(PolicyError, match=found):
        made(python("-S", "-c", code).replace("exec:", "exec:?ready_s=1 "))
    assert children._running == []
    assert set(Path(tempfile.gettempdir()).glob("simrun-policy-*")) <= before


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_command_ends_with_the_process_that_started_it_however_that_ends(tmp_path, number):
    starting = """
import sys, time
from alpasim_plugin.alpasim.client.child import Child
code = "import os, time; print(os.getpid()); time.sleep(60)"
Child([sys.executable, "-S", "-c", code], {}, lambda line: print(line, flush=True), lambda: None)
time.sleep(60)
"""
    with subprocess.Popen(
        [sys.executable, "-c", starting], stdout=subprocess.PIPE, text=True, cwd=REPO
    ) as parent:
        pid = int(parent.stdout.readline())
        assert not is_gone(pid)
        parent.send_signal(number)
        assert until(lambda: is_gone(pid))


def test_a_command_deaf_to_sigterm_is_killed_with_what_it_started(
    monkeypatch,
):
    monkeypatch.setattr(children, "GRACE_S", 0.3)
    deaf = "import os, signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); os.fork(); "
    code = deaf + "os.write(1, b'%d\\n' % os.getpid()); time.sleep(60)"
    heard = []
    ended = []
    one = Child([sys.executable, "-S", "-c", code], {}, heard.append, lambda: ended.append(True))
    assert until(lambda: len(heard) == 2)
    one.stop()
    assert until(lambda: all(is_gone(int(pid)) for pid in heard))
    one.stop()
    assert ended == [True]


def test_commands_are_read_as_a_shell_would_and_refused_before_a_run():
    command = Command.parse("?cameras=front,left&timeout_s=2.5 sh drive.sh --net 'a b.pt'")
    assert (command.words, command.options) == (
        ("sh", "drive.sh", "--net", "a b.pt"),
        {"cameras": "front,left", "timeout_s": "2.5"},
    )
    for text, found in (
        ("", "no program"),
        ("?timeout_s=2", "no program"),
        ("?colour=red python a.py", "no option 'colour'"),
        ("?ready_s=soon python a.py", "ready_s='soon'"),
        ("no-such-program a.py", "no program 'no-such-program'"),
        ("python 'a.py", "No closing quotation"),
    ):
        with pytest.raises(InputError, match=re.escape(found)):
            resolve("policy", f"exec:{text}")
    assert resolve("policy", "exec:sh a.sh").digest is None
    assert split_policies("clean,exec:sh a.sh --size '5,3', learned") == [
        "clean",
        "exec:sh a.sh --size '5,3'",
        "learned",
    ]
    assert (exit_reason(0), exit_reason(143)) == ("exit code 0", "exit code 143 (SIGTERM)")


def test_output_of_parts_goes_to_a_file_that_has_an_end(tmp_path, capsys):
    with parts_print_to_stderr(tmp_path / "none.log"):
        pass
    assert not (tmp_path / "none.log").exists()
    with parts_print_to_stderr(tmp_path / "output.log"):
        print("from the process")
        say("from a command")
        for _ in range(3):
            say("x" * (MOST_BYTES // 2))
    say("later")
    text = (tmp_path / "output.log").read_text()
    assert text.startswith("from the process\nfrom a command\n")
    assert text.endswith("(the rest is left out)\n")
    assert len(text) < MOST_BYTES
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.endswith("later\n")
    assert len(shown.err) < MOST_BYTES + 100
