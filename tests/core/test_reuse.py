"""Which rollouts the same command makes again, in one process."""

import json

import pytest

from alpasim_plugin.cli.main import run_command

PARTS = """
import numpy as np
from alpasim_plugin.core.types import Frame

class Grey:
    def render(self, request):
        return Frame(request.t_us, request.camera.name, np.full((request.camera.height, request.camera.width, 3), 90, dtype=np.uint8))

class Remote(Grey):
    is_remote = True

class Odd:
    def __init__(self, gain):
        pass
"""
QUICK = (
    "--seeds",
    "1",
    "--workers",
    "1",
    "--images",
    "none",
    "--no-report",
    "--json",
)
SHORT = (*QUICK, "--set", "timing.duration_us=1200000")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    (tmp_path / "parts_of_a_user.py").write_text(PARTS)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def made(folder, renderer, *more):
    """Drive and return when the rollout's log was written."""
    words = (
        "--renderer",
        f"parts_of_a_user.py:{renderer}",
        "--policy",
        "constant-velocity",
        *SHORT,
        "--out",
        "run",
        *more,
        "smoke/straight",
    )
    assert run_command([*words]) == 0
    return next(folder.glob("run/rollouts/*/*/*/0/rollout.asl")).stat().st_mtime_ns


def test_a_remote_part_is_never_reused_unasked(folder, capsys):
    first = made(folder, "Remote")
    second = made(folder, "Remote")
    assert second != first
    assert made(folder, "Remote", "--resume") == second
    run_command(
        [
            "--renderer",
            "parts_of_a_user.py:Remote",
            "--policy",
            "constant-velocity",
            *SHORT,
            "--dry-run",
            "smoke/straight",
        ]
    )
    plan = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert plan["never_reused"] == ["renderer parts_of_a_user.py:Remote"]


def test_a_factory_that_asks_for_something_else_is_told_what_there_is(folder, capsys):
    assert (
        run_command(
            [
                "--renderer",
                "clean",
                "--policy",
                "parts_of_a_user.py:Odd",
                *SHORT,
                "--out",
                "odd",
                "smoke/straight",
            ]
        )
        == 2
    )
    told = json.loads(capsys.readouterr().out)["error"]
    assert "gain" in told["message"]
    assert told["failure_class"] == "policy"
