"""The page of a first policy, walked: each command as it stands, each edit as it is told."""

import json
import re
import shlex
from pathlib import Path
from textwrap import indent

import pytest

from alpasim_plugin.cli.main import run_command

INSIDE = " " * 8


@pytest.mark.slow
def test_every_step_of_the_page_does_what_it_says(repo, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    text = (repo / "docs" / "first-policy.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```(bash|python)\n(.*?)^```", text, re.S | re.M)
    seeing, braking = [indent(block, INSIDE) for kind, block in blocks if kind == "python"]
    for number, (kind, block) in enumerate(blocks):
        for line in block.splitlines() if kind == "bash" else ():
            words = shlex.split(line)
            assert words.pop(0) == "simrun"
            assert run_command(words) == 0
        if number == 1:
            endings = outcomes("runs/blind")["clean/my_policy.py:MyPolicy"]
            assert endings == {"reached the end": 2, "collision": 1}
            code = Path("my_policy.py").read_text()
            code = re.sub(r"^ *assert .*\n", lambda _: seeing, code, flags=re.M)
            code = re.sub(r"^( *reached_m = .*\n)", lambda m: m[1] + braking, code, flags=re.M)
            Path("my_second.py").write_text(code)
    endings = outcomes("runs/both")
    assert endings["clean/my_policy.py:MyPolicy"]["collision"] == 1
    assert "collision" not in endings["clean/my_second.py:MyPolicy"]
    assert list(Path("runs/blind").rglob("why.html"))


def outcomes(run):
    summary = json.loads(Path(run, "summary.json").read_text())
    return {name: entry["endings"] for name, entry in summary["outcomes"].items()}
