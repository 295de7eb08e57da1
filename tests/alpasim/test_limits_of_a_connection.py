"""What a connection carries and where it goes: no fault of a connection is a policy's."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import grpc
import numpy as np
import pytest

from alpasim_plugin.alpasim.client.channel import Service
from alpasim_plugin.alpasim.client.driver import MOST_BYTES_PER_PIXEL
from alpasim_plugin.core.errors import InfrastructureError, InputError, PolicyError
from alpasim_plugin.core.parts import resolve
from alpasim_plugin.log.images import encode_image
from alpasim_plugin.log.wire import common_pb2, egodriver_pb2
from alpasim_plugin.log.wire.services import channel_options, handlers
from alpasim_plugin.runs.execute import HowToRun, Threads
from alpasim_plugin.runs.plan import RunOptions, make_plan
from alpasim_plugin.runs.policy_checks import check_policies
from scenarios.suite import expand
from tests.alpasim.service_cases import hosted


def test_a_time_limit_that_is_no_number_is_bad_input():
    with pytest.raises(InputError, match="timeout_s"):
        resolve("policy", "alpasim://127.0.0.1:1?timeout_s=abc")


@pytest.mark.parametrize(
    ("target", "is_direct"),
    [("127.0.0.1:1", True), ("[::1]:1", True), ("localhost:1", True), ("host:1", False)],
)
def test_a_channel_to_this_machine_goes_through_no_proxy(target, is_direct):
    assert (("grpc.enable_http_proxy", 0) in channel_options(target)) == is_direct


class Driver:
    """A driver that counts the bytes of images."""

    def __init__(self):
        self.received = []

    def get_version(self, request, context):
        return common_pb2.VersionId(version_id="counts")

    def submit_image_observation(self, request, context):
        self.received.append(len(request.camera_image.image_bytes))
        return common_pb2.Empty()


def image_of(size):
    message = egodriver_pb2.RolloutCameraImage()
    message.camera_image.image_bytes = bytes(size)
    return message


def service_at(address):
    return Service("EgodriverService", address, PolicyError, retries=False)


def test_an_image_of_more_than_16_mib_arrives_also_where_a_proxy_is_named(monkeypatch):
    for name in ("http_proxy", "grpc_proxy", "https_proxy"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")
    driver = Driver()
    with hosted({"EgodriverService": driver}) as host:
        service = service_at(host.address)
        service.call("submit_image_observation", image_of(20 << 20))
        service.close()
    assert driver.received == [20 << 20]


def test_an_image_that_the_service_does_not_take_is_no_fault_of_the_policy():
    server = grpc.server(ThreadPoolExecutor(1))  # which takes 4 MiB
    server.add_generic_rpc_handlers((handlers("EgodriverService", Driver()),))
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    service = service_at(f"127.0.0.1:{port}")
    with pytest.raises(InfrastructureError, match="larger than max") as caught:
        service.call("submit_image_observation", image_of(5 << 20))
    assert not isinstance(caught.value, PolicyError)
    service.close()
    server.stop(None)


@pytest.mark.parametrize("encoding", MOST_BYTES_PER_PIXEL)
def test_no_image_takes_more_bytes_than_is_taken_into_account(encoding):
    noise = np.random.default_rng(0).integers(0, 256, (256, 256, 3), dtype=np.uint8)
    size = len(encode_image(noise, encoding))
    assert size / 256**2 < MOST_BYTES_PER_PIXEL[encoding] < 1.6 * size / 256**2


@pytest.mark.parametrize("policy", ["exec:sleep 9", "alpasim://127.0.0.1:1?encoding=png"])
def test_a_camera_whose_images_may_not_fit_is_refused_before_the_run(policy):
    plan = make_plan(expand("smoke/straight"), ("clean",), (policy,), (0,), RunOptions())
    (scenario,) = plan.scenarios.values()
    for size, is_refused in (((4000, 2500), False), ((8000, 3000), True)):
        large = replace(scenario.cameras[0], width=size[0], height=size[1])
        other = replace(plan, scenarios={"a": replace(scenario, cameras=(large,))})
        if is_refused:
            with pytest.raises(InputError, match="a message's 64"):
                check_policies(other, {}, HowToRun(Threads(1, 1)), print)
        else:
            check_policies(other, {}, HowToRun(Threads(1, 1)), print)
