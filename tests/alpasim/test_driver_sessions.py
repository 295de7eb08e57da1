"""What `simrun check driver` tries with several sessions of one driver."""

import json
import os
import shutil
import sys
import tempfile
from concurrent import futures
from pathlib import Path

import grpc
import pytest

from alpasim_plugin.cli.driver_sessions import (
    ANEW,
    INTERLEAVED,
    READ_ONLY,
    session_findings,
)
from alpasim_plugin.cli.main import run_command
from alpasim_plugin.log.wire.services import handlers
from scenarios.load import load_scenario
from tests.alpasim.straight_driver import StraightDriver

SCENE = """
version: 1
scene_id: sessions
road: {segments: [{kind: straight, length_m: 120}]}
cameras: [{width: 32, height: 24}]
timing: {duration_us: 2200000, timeline: alpasim}
"""
PROGRAM = Path(__file__).with_name("straight_driver.py")
KEPT = Path("/var/tmp")  # neither below /tmp nor below /run, as a checkout may be
NO_KEPT_FOLDER = not os.access(KEPT, os.W_OK) or Path(tempfile.gettempdir()).is_relative_to(KEPT)


@pytest.fixture
def kept_folder():
    """A folder that a driver with a read-only root cannot write."""
    if NO_KEPT_FOLDER:
        pytest.skip(f"{KEPT} cannot be written, or temporary files lie there")
    with tempfile.TemporaryDirectory(dir=KEPT) as folder:
        yield Path(folder)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("sessions") / "scene.yaml"
    path.write_text(SCENE)
    return str(path)


@pytest.mark.parametrize(("apart", "result"), [(True, "passed"), (False, "failed")])
def test_a_session_plans_as_alone_while_another_one_is_open(scene, apart, result):
    server = grpc.server(futures.ThreadPoolExecutor(4))
    server.add_generic_rpc_handlers((handlers("EgodriverService", StraightDriver(apart)),))
    address = f"127.0.0.1:{server.add_insecure_port('127.0.0.1:0')}"
    server.start()
    findings = {one.name: one for one in session_findings(load_scenario(scene), address)}
    server.stop(0)
    assert findings[INTERLEAVED].result == result, findings[INTERLEAVED].text
    assert findings[READ_ONLY].result == findings[ANEW].result == "noted"


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("unshare") is None, reason="no unshare")
def test_a_driver_that_is_started_here_is_tried_with_a_read_only_root_and_anew(
    scene, capsys, kept_folder
):
    results = {}
    needs = f" needs-folder={kept_folder}"
    for argument in ("", needs):
        words = f"exec:{sys.executable} {PROGRAM}{argument}"
        limits = ["--scenario", scene, "--limit-ms", "60000", "--json"]
        code = run_command(["check", "driver", words, *limits])
        document = json.loads(capsys.readouterr().out)
        checks = {check["name"]: (check["result"], check["text"]) for check in document["checks"]}
        assert checks[ANEW][0] == checks[INTERLEAVED][0] == "passed"
        results[argument] = code, *checks[READ_ONLY]
    if results[""][1] == "noted":
        pytest.skip("this machine makes no read-only root")
    assert results[""][:2] == (0, "passed")
    assert results[needs][:2] == (1, "failed")
    assert "cannot write to" in results[needs][2]


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("unshare") is None, reason="no unshare")
def test_a_driver_that_writes_and_one_that_remembers_earlier_processes_fail(
    scene, tmp_path, kept_folder
):
    written = kept_folder / "written_by_a_session.txt"
    words = f"{sys.executable} {PROGRAM} writes-to={written} counts-in={tmp_path / 'processes'}"
    findings = {one.name: one for one in session_findings(load_scenario(scene), f"exec:{words}")}
    assert written.exists()
    assert findings[ANEW].result == "failed"
    assert "plans of a new process differ by up to" in findings[ANEW].text
    if findings[READ_ONLY].result == "noted":
        pytest.skip("this machine makes no read-only root")
    assert findings[READ_ONLY].result == "failed"
    assert "Read-only file system" in findings[READ_ONLY].text
