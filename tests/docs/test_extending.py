"""The parts of docs/extending.md work as they stand on the page."""

import json
import re
from pathlib import Path

import pytest

from alpasim_plugin.cli.main import run_command

PAGE = Path(__file__).resolve().parents[2] / "docs" / "extending.md"
REST = (
    "--seeds",
    "1",
    "--workers",
    "1",
    "--images",
    "none",
    "--no-report",
    "--json",
)
SHORT = ("--set", "timing.duration_us=1200000")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    (tmp_path / "my_parts.py").write_text("\n".join(blocks))
    (tmp_path / "drive.csv").write_text("\n".join(f"{100_000 * i},{0.5 * i},0" for i in range(26)))
    (tmp_path / "weights.npz").write_bytes(b"weights")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    "words",
    [
        (
            "--renderer",
            "my_parts.py:Brighten+my_parts.py:Night",
            "--policy",
            "lane-camera",
            *SHORT,
            "smoke/curve",
        ),
        (
            "--renderer",
            "clean",
            "--policy",
            "my_parts.py:Weighted",
            "--controller",
            "my_parts.py:Lag",
            "--evaluator",
            "my_parts.py:Jerk",
            *SHORT,
            "smoke/curve",
        ),
        (
            "--renderer",
            "clean",
            "--policy",
            "log-replay",
            "--source",
            "my_parts.py:Csv",
            "drive.csv",
        ),
    ],
    ids=["renderer and fixer", "policy, controller and metric", "source"],
)
def test_parts_of_the_page_drive(folder, words, capsys):
    assert run_command([*words, "--out", "run", *REST]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["summary"]["failures"]["n_failed"] == 0
    (metrics,) = result["summary"]["metrics"].values()
    assert ("jerk_max_mps3" in metrics) == any("Jerk" in word for word in words)
