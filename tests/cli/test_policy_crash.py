"""A policy that raises: where it did is in the terminal, the traceback in a log that is named, and
the check finds it.
"""

import numpy as np
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import PolicyError
from alpasim_plugin.core.parts.source import load
from alpasim_plugin.core.types import Route
from alpasim_plugin.runs.guards import reset_policy
from policies.conformance import check_policy

LATE = """
from policies.simple import ConstantVelocity

class Late(ConstantVelocity):
    queries = 0

    def reset(self, seed, route):
        self.queries = 0
        super().reset(seed, route)

    def act(self, observation):
        self.queries += 1
        return self.lookup([]) if self.queries > 18 else super().act(observation)

    def lookup(self, found):
        return found[0]
"""


@pytest.fixture
def late(tmp_path):
    path = tmp_path / "late.py"
    path.write_text(LATE)
    return f"{path}:Late"


def test_the_check_drives_long_enough_to_find_a_policy_that_raises_after_a_while(late):
    fault, *_ = check_policy(late).failures
    assert "in query 19: IndexError: list index out of range" in fault
    assert "late.py:16" in fault


def test_a_call_that_does_not_fit_is_blamed_on_the_method_of_the_policy(tmp_path):
    path = tmp_path / "short.py"
    path.write_text(LATE.replace("def reset(self, seed, route)", "def reset(self)"))
    fault, *_ = check_policy(f"{path}:Late").failures
    assert f"{path}:7" in fault
    made = load(f"{path}:Late", "policy")
    policy = made.__new__(made)
    with pytest.raises(PolicyError, match=f"{path}:7"):
        reset_policy(policy, 0, Route(np.zeros((2, 3))))


def test_the_terminal_has_file_line_and_the_end_of_the_traceback(late, tmp_path, capfd):
    drive = [
        "--renderer",
        "clean",
        "--policy",
        late,
        "--set",
        "timing.duration_us=2000000",
        "--workers",
        "1",
    ]
    assert run_command(["run", *drive, "--out", str(tmp_path / "run"), "smoke/straight"]) == 2
    said = capfd.readouterr().err
    assert f"IndexError: list index out of range at {tmp_path}/late.py:16, in lookup" in said
    assert "return found[0]" in said
    (log,) = (tmp_path / "run").glob("rollouts/*/*/*/*/output.log")
    assert f"log {log}" in said
    assert "IndexError: list index out of range" in log.read_text()
