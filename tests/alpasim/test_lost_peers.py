"""A peer that goes away is a fault of the machine and is driven again; one that answers late or
wrongly is the policy's own fault.
"""

import json
import os
import socket
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import grpc
import pytest

from alpasim_plugin.alpasim.client.channel import Service
from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InfrastructureError, PolicyError, SimrunError
from alpasim_plugin.log.wire import egodriver_pb2
from tests.alpasim.service_cases import hosted

REPO = Path(__file__).resolve().parents[2]
SHORT = (
    "--set",
    "timing.duration_us=600000",
    "--no-report",
    "--images",
    "none",
    "--workers",
    "1",
)
SCRIPT = """
import os, signal, sys
import numpy as np
from alpasim_plugin import serve_policy
from alpasim_plugin.core.types import Plan, SensorSpec

class Cruise:
    sensors = (SensorSpec("front"),)

    def reset(self, seed, route):
        self.asked = 0

    def act(self, observation):
        self.asked += 1
        if "dies" in sys.argv and self.asked == 3:
            os.kill(os.getpid(), signal.SIGKILL)
        times_us = observation.t_us + 100_000 * np.arange(41)
        x = observation.ego.speed_mps * 1e-6 * (times_us - observation.t_us)
        return Plan(observation.t_us, times_us, np.stack([x, 0 * x], axis=1), 0 * x)

serve_policy(Cruise, sys.argv[1])
"""


def free_port():
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


@contextmanager
def driver(address, *more):
    environment = {**os.environ, "PYTHONPATH": str(REPO)}
    with subprocess.Popen(
        [sys.executable, "-c", SCRIPT, address, *more], env=environment
    ) as process:
        try:
            with grpc.insecure_channel(address) as channel:
                grpc.channel_ready_future(channel).result(60)
            yield
        finally:
            process.kill()


@pytest.mark.slow
def test_a_driver_killed_in_the_middle_is_an_infrastructure_failure_and_is_driven_again(
    tmp_path, capsys
):
    address = f"127.0.0.1:{free_port()}"
    out = tmp_path / "out"
    command = [
        "--renderer",
        "clean",
        "--policy",
        f"alpasim://{address}?cameras=front",
        "smoke/straight",
        "--out",
        str(out),
        *SHORT,
        "--json",
    ]
    with driver(address, "dies"):
        assert run_command(command) != 0
    (failed,) = json.loads(capsys.readouterr().out)["summary"]["failures"]["cells"]
    assert failed["error"]["failure_class"] == "infrastructure"
    assert "of simulated time: EgodriverService.drive failed: " in failed["error"]["message"]
    with driver(address):
        assert run_command([*command, "--resume"]) == 0
    assert json.loads(capsys.readouterr().out)["summary"]["failures"]["n_failed"] == 0


class Answering:
    """A driver that fails with a given status."""

    def __init__(self, code, text="as told"):
        self.code = code
        self.text = text

    def drive(self, request, context):
        if self.code is grpc.StatusCode.DEADLINE_EXCEEDED:
            time.sleep(1.0)
        context.abort(self.code, self.text)


@pytest.mark.parametrize(
    ("code", "text", "kind"),
    [
        ("UNAVAILABLE", "as told", InfrastructureError),
        ("CANCELLED", "as told", InfrastructureError),
        ("UNKNOWN", "Stream removed", InfrastructureError),
        ("DEADLINE_EXCEEDED", "as told", PolicyError),
        ("INTERNAL", "ValueError: no road", PolicyError),
        ("UNKNOWN", "Exception calling application", PolicyError),
    ],
)
def test_only_what_a_driver_does_itself_is_its_own_fault(code, text, kind):
    with hosted({"EgodriverService": Answering(grpc.StatusCode[code], text)}) as host:
        service = Service("EgodriverService", host.address, PolicyError, retries=False)
        with pytest.raises(SimrunError) as caught:
            service.call(
                "drive",
                egodriver_pb2.DriveRequest(),
                0.3 if code == "DEADLINE_EXCEEDED" else 10.0,
                at_us=1_700_000,
            )
        service.close()
    assert type(caught.value) is kind
    place = f"{host.address}, at 1700000 us of simulated time"
    assert caught.value.message.startswith(f"{place}: EgodriverService.drive failed: {code}: ")
    assert not getattr(caught.value, "is_final", False) or kind is PolicyError
