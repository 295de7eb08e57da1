"""``import simrun``: the names that a user's own code imports."""

import subprocess
import sys

import numpy as np
import pytest

import simrun


def test_every_public_name_is_there_and_has_one_home(repo):
    listed = {name for names in simrun.HOMES.values() for name in names}
    assert listed | {"__version__"} == set(simrun.__all__)
    code = "import sys, simrun; [getattr(simrun, n) for n in ('Plan', 'InputError', 'plan_times')]; print({'torch', 'numba'} & {*sys.modules})"
    told = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=repo, check=True
    )
    assert told.stdout.strip() == "set()"
    assert simrun.load_scenario.__module__ == "scenarios.load"


def test_dir_lists_the_public_names_before_they_are_loaded(repo):
    code = "import simrun; print(dir(simrun) == sorted(simrun.__all__))"
    told = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=repo, check=True
    )
    assert told.stdout.strip() == "True"


def test_a_request_with_one_pose_is_refused_by_a_sentence():
    with pytest.raises(simrun.InputError, match=r"\(4, 4\), where \(2, 4, 4\) is needed"):
        simrun.RenderRequest(0, None, np.eye(4), {})
