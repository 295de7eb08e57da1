"""A clock that was set back or forward: folders from the future, and times that no clock shows, are
read as others are.
"""

import json
import os
import shutil

import pytest

from alpasim_plugin.cli.main import run_command
from tests.core.checksum_files import vouch_for
from tests.examples import first_of


@pytest.mark.parametrize("time_s", first_of([-(10**6), 0, 2**33]))
def test_a_folder_of_another_time_is_whole_and_read(tmp_path, usual_run, time_s):
    run = shutil.copytree(usual_run, tmp_path / "run")
    (run / "run.json").write_text(
        json.dumps(
            json.loads((run / "run.json").read_text()) | {"started_at": "2131-01-01T00:00:00+00:00"}
        )
    )
    vouch_for(run)
    for path in (run, *run.rglob("*")):
        os.utime(path, (time_s, time_s))
    for words in (
        ["check", "run", str(run)],
        ["compare", str(run)],
        ["list", "runs", str(tmp_path)],
    ):
        assert run_command(words) == 0
