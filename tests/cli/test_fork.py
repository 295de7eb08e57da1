"""``simrun fork`` as a user meets it."""

from pathlib import Path

import pytest

from alpasim_plugin.cli.main import run_command


@pytest.mark.slow
def test_a_part_of_the_users_own_drives_again_only_if_it_is_named_too(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    base = "from policies.simple import ConstantVelocity\n\n\n"
    Path("own.py").write_text(f"{base}class Own(ConstantVelocity):\n    pass\n")
    short = ["--set", "timing.duration_us=1000000", "--set", "timing.warmup_us=200000"]
    drive = ["run", "--renderer", "clean", "--policy", "own.py:Own", "--images", "none", *short]
    assert run_command([*drive, "--out", "run", "smoke/straight"]) == 0
    (cell,) = Path("run").glob("rollouts/*/*/*/*")
    again = ["fork", str(cell), "--at", "0.5", "--renderer", "clean", "--out", "forked"]
    assert run_command(again) == 2
    assert run_command([*again, "--policy", "pure-pursuit"]) == 2
    assert run_command([*again, "--own", "own.py:Own"]) == 0
