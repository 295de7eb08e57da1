"""Our loop in front of AlpaSim's services over real sockets: drivers, renderers, and both at
once.
"""

import json
from concurrent import futures

import grpc
import numpy as np
import pytest
import yaml
from numpy.testing import assert_allclose, assert_array_equal

from alpasim_plugin.alpasim.client.channel import Address
from alpasim_plugin.alpasim.server.assembly import Settings, assemble
from alpasim_plugin.alpasim.server.driver_service import DriverService
from alpasim_plugin.alpasim.server.hosting import Host
from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InputError, PolicyError, RendererError
from alpasim_plugin.core.geometry import se2, trajectory_from_poses
from alpasim_plugin.core.parts import build, resolve
from alpasim_plugin.core.types import EgoState, Observation
from alpasim_plugin.log import decode_image
from alpasim_plugin.log.schema import wire_trajectory
from alpasim_plugin.log.wire import (
    FRONT_WIDE,
    SERVICE_PATHS,
    common_pb2,
    egodriver_pb2,
    sensorsim_pb2,
)
from alpasim_plugin.log.wire.services import Stub, handlers
from alpasim_plugin.runs.recorder import Recorder
from alpasim_plugin.runs.renderer import make_renderer
from alpasim_plugin.runs.rollout import run_rollout
from alpasim_plugin.runs.score_logs import scenario_finder
from scenarios.load import load_scenario
from scenarios.suite import shipped_names


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """A short curve, as a file that both sides read."""
    return written_curve(
        tmp_path_factory.mktemp("scenes"), duration_us=1_200_000, warmup_us=300_000
    )


@pytest.fixture(scope="module")
def long_scene(tmp_path_factory):
    """A curve that lasts longer than the warm-up of AlpaSim's own timeline, 1.7 s."""
    return written_curve(tmp_path_factory.mktemp("scenes"), duration_us=2_000_000)


def written_curve(folder, **timing):
    written = yaml.safe_load(shipped_names()["smoke/curve"].read_text())
    path = folder / "curve.yaml"
    path.write_text(yaml.safe_dump(written | {"scene_id": "short-curve", "timing": timing}))
    return str(path)


@pytest.fixture(scope="module")
def scenario(scene):
    return load_scenario(scene)


class Calls(grpc.ServerInterceptor):
    """Notes the order of the calls."""

    def __init__(self):
        self.made = []

    def intercept_service(self, continuation, details):
        self.made.append(details.method.rsplit("/", 1)[1])
        return continuation(details)


def serve(name, implementation, interceptor=None):
    server = grpc.server(
        futures.ThreadPoolExecutor(8), interceptors=(interceptor,) if interceptor else ()
    )
    server.add_generic_rpc_handlers((handlers(name, implementation),))
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    return server, f"127.0.0.1:{port}"


@pytest.fixture
def driver(scene):
    """Our own policy behind AlpaSim's driver service."""
    calls = Calls()
    service = lane_camera_service(scene)
    server, address = serve("EgodriverService", service, calls)
    yield service, address, calls
    server.stop(0)


def lane_camera_service(scene):
    spec = resolve("policy", "lane-camera")
    return DriverService(
        spec.name,
        spec.digest,
        lambda scenario: build(spec, scenario=scenario),
        scenario_finder([scene]),
    )


def drive(scenario, renderer, policy):
    made = build(resolve("policy", policy), scenario=scenario)
    with Recorder(scenario, 0, images="png") as recorder:
        run_rollout(scenario, make_renderer(renderer, scenario, 0), made, 0, recorder)
    return recorder.log(), dict(made.facts())


@pytest.fixture(scope="module")
def inside(scenario):
    return drive(scenario, "clean", "lane-camera")[0]


def test_a_driver_over_sockets_drives_as_the_policy_in_the_process(scenario, inside, driver):
    service, address, calls = driver
    outside, facts = drive(scenario, "clean", f"alpasim://{address}?encoding=png")
    assert np.abs(outside.ego.xyz - inside.ego.xyz).max() < 2e-5  # poses are float32 on the wire
    assert [len(plan.samples) for plan in outside.plans] == [
        len(plan.samples) for plan in inside.plans
    ]
    for one, other in zip(outside.plans, inside.plans, strict=True):
        assert_array_equal(one.trajectory.t_us, other.trajectory.t_us)
        assert_allclose(one.trajectory.xyz, other.trajectory.xyz, atol=1e-3)
    each = ["submit_image_observation", "submit_egomotion_observation", "submit_route", "drive"]
    assert calls.made == ["get_version", "start_session", *each * 12, "close_session"]
    assert service.counts == {"start_session": 1, "drive": 12}
    assert (facts["shortest_plan_s"], facts["empty_plans"], facts["samples_cut"]) == (5.0, 0, 0)


def test_renderer_and_driver_over_sockets_at_once(scenario, scene, inside, driver):
    made = assemble(Settings(renderer="clean", scenes=(scene,)))
    with Host({"SensorsimService": made.service}, "127.0.0.1:0") as host:
        outside, _ = drive(scenario, f"nre://{host.address}", f"alpasim://{driver[1]}?encoding=png")
    assert np.abs(outside.ego.xyz - inside.ego.xyz).max() < 1e-3
    for one, other in zip(
        outside.images[:4], inside.images[:4], strict=True
    ):  # in the warm-up, at equal poses but for their rounding
        difference = np.abs(
            decode_image(one.data).astype(int) - decode_image(other.data).astype(int)
        )
        assert difference.mean() < 0.05
        assert np.percentile(difference, 99.9) <= 2


class Scripted:
    """A driver that answers as told."""

    def __init__(self, *answers):
        self._answers, self.sessions, self.motion = list(answers), [], []

    def get_version(self, request, context):
        return common_pb2.VersionId(version_id="scripted")

    def start_session(self, request, context):
        self.sessions.append(request)
        return common_pb2.SessionRequestStatus()

    def close_session(self, request, context):
        return common_pb2.Empty()

    def submit_image_observation(self, request, context):
        assert request.camera_image.logical_id == FRONT_WIDE
        return common_pb2.Empty()

    def submit_egomotion_observation(self, request, context):
        self.motion.append(request)
        return common_pb2.Empty()

    def submit_route(self, request, context):
        assert len(request.route.waypoints) == 20
        return common_pb2.Empty()

    def drive(self, request, context):
        return self._answers.pop(0) if len(self._answers) > 1 else self._answers[0]


def test_the_first_motion_is_the_whole_context_with_its_speeds(scenario):
    own = Scripted(egodriver_pb2.DriveResponse())
    server, address = serve("EgodriverService", own)
    with pytest.raises(PolicyError, match="an empty plan after the warm-up"):
        drive(scenario, "clean", f"alpasim://{address}")
    server.stop(0)
    first, second = own.motion[:2]
    log = scenario.ego_log
    wanted = [int(t) for t in log.t_us if t < scenario.start_us] + [scenario.start_us]
    assert [p.timestamp_us for p in first.trajectory.poses] == wanted
    assert len(first.dynamic_states) == len(wanted)
    assert all(
        abs(state.linear_velocity.x - first.dynamic_states[-1].linear_velocity.x) < 0.5
        for state in first.dynamic_states
    )
    assert first.dynamic_states[0].linear_velocity.x > 3.0
    assert [p.timestamp_us for p in second.trajectory.poses] == [scenario.start_us + 100_000]
    (camera,) = own.sessions[0].rollout_spec.vehicle.available_cameras
    assert camera.logical_id == camera.intrinsics.logical_id == FRONT_WIDE
    assert own.sessions[0].debug_info.scene_id == scenario.scene_id


def test_the_yaw_rate_of_a_motion_through_180_degrees_is_that_of_its_turn(scenario):
    seconds = np.arange(21) * 0.1
    heading = np.radians(170.0) + 0.2 * seconds
    poses = [se2(-5.0 * t, 0.5 * t**2, yaw) for t, yaw in zip(seconds, heading, strict=True)]
    t_us = scenario.start_us + np.rint(seconds * 1e6).astype(np.int64)
    motion = trajectory_from_poses(t_us, poses)
    scripted = Scripted(
        egodriver_pb2.DriveResponse(trajectory=wire_trajectory(motion, "a plan in the world"))
    )
    server, address = serve("EgodriverService", scripted)
    policy = build(resolve("policy", f"alpasim://{address}"), scenario=scenario)
    policy.reset(0, scenario.route)
    ego = EgoState(int(t_us[-1]), poses[-1], 5.0, yaw_rate_radps=0.2)
    policy.act(Observation(ego.t_us, {}, {}, ego, motion, np.zeros((20, 3))))
    policy.close()
    server.stop(0)
    (request,) = scripted.motion
    rates = [state.angular_velocity.z for state in request.dynamic_states]
    assert_allclose(rates, 0.2, atol=1e-4)


def test_an_end_of_session_and_a_missing_service_are_said(scenario):
    server, address = serve(
        "EgodriverService", Scripted(egodriver_pb2.DriveResponse(terminate_session=True))
    )
    with pytest.raises(PolicyError, match="ends the session"):
        drive(scenario, "clean", f"alpasim://{address}")
    server.stop(0)
    for bad in ("nohost", "host:port", "127.0.0.1:1?colour=red"):
        with pytest.raises(InputError, match="alpasim://"):
            Address.parse("alpasim", bad, ("cameras",))
    server, address = serve("EgodriverService", Scripted(egodriver_pb2.DriveResponse()))
    with pytest.raises(InputError, match="no camera 'left'"):
        drive(scenario, "clean", f"alpasim://{address}?cameras=camera_left:left")


class Failing:
    """A renderer that fails so many times before it answers."""

    def __init__(self, code, times):
        self.code, self.times, self.asked = code, times, 0

    def get_version(self, request, context):
        return common_pb2.VersionId(version_id="failing")

    def get_available_scenes(self, request, context):
        return common_pb2.AvailableScenesReturn(scene_ids=["*"])

    def get_available_cameras(self, request, context):
        return sensorsim_pb2.AvailableCamerasReturn()

    def batch_render_rgb(self, request, context):
        self.asked += 1
        if self.asked <= self.times:
            context.abort(self.code, "not now")
        item = sensorsim_pb2.BatchRGBRenderReturnItem(
            camera_name=request.items[0].camera_name, success=False, error_message="out of film"
        )
        return sensorsim_pb2.BatchRGBRenderReturn(items=[item])


@pytest.mark.parametrize(
    ("code", "asked", "text"),
    [("UNAVAILABLE", 3, "out of film"), ("UNKNOWN", 1, "UNKNOWN: not now")],
)
def test_renders_are_tried_again_as_alpasim_does(scenario, monkeypatch, code, asked, text):
    monkeypatch.setattr("alpasim_plugin.alpasim.client.channel.RETRY_S", (0.0, 0.0))
    own = Failing(getattr(grpc.StatusCode, code), 2)
    server, address = serve("SensorsimService", own)
    with pytest.raises(RendererError, match=text):
        drive(scenario, f"nre://{address}", "lane-camera")
    server.stop(0)
    assert own.asked == asked


def test_our_driver_service_is_tolerant_where_alpasim_needs_it(
    driver,
):
    with grpc.insecure_channel(driver[1]) as channel:
        stub = Stub(channel, "EgodriverService")
        stub.close_session(egodriver_pb2.DriveSessionCloseRequest(session_uuid="never opened"))
        stub.start_session(
            egodriver_pb2.DriveSessionRequest(
                session_uuid="a", debug_info={"scene_id": "short-curve"}
            )
        )
        assert not stub.drive(
            egodriver_pb2.DriveRequest(session_uuid="a", time_now_us=1)
        ).trajectory.poses  # nothing seen yet
        with pytest.raises(grpc.RpcError) as twice:
            stub.start_session(
                egodriver_pb2.DriveSessionRequest(
                    session_uuid="a", debug_info={"scene_id": "short-curve"}
                )
            )
        assert twice.value.code() == grpc.StatusCode.INVALID_ARGUMENT
        with pytest.raises(grpc.RpcError) as unknown:
            stub.drive(egodriver_pb2.DriveRequest(session_uuid="b"))
        assert "call start_session first" in unknown.value.details()
        lens = sensorsim_pb2.CameraSpec(
            logical_id="c", resolution_h=10, resolution_w=10, ftheta_param={"max_angle": 1.0}
        )
        camera = sensorsim_pb2.AvailableCamerasReturn.AvailableCamera(
            logical_id="c", intrinsics=lens
        )
        request = egodriver_pb2.DriveSessionRequest(
            session_uuid="d", debug_info={"scene_id": "short-curve"}
        )
        request.rollout_spec.vehicle.available_cameras.append(camera)
        with pytest.raises(grpc.RpcError) as lensed:
            stub.start_session(request)
        assert "runtime.extra_cameras" in lensed.value.details()
    assert SERVICE_PATHS["EgodriverService"] == "/egodriver.EgodriverService/"


def test_the_pre_flight_check_of_a_good_and_of_a_bad_driver(long_scene, capsys):
    timing = ["--scenario", long_scene, "--limit-ms", "60000", "--json"]
    server, address = serve("EgodriverService", lane_camera_service(long_scene))
    assert run_command(["check", "driver", address, *timing]) == 0
    server.stop(0)
    told = json.loads(capsys.readouterr().out)
    good = {one["name"]: one["result"] for one in told["checks"]}
    assert list(told["scenes"].values()) == ["no event"]
    assert set(good.values()) <= {"passed", "noted"}
    assert good["samples for minADE"] == "passed"
    late = egodriver_pb2.DriveResponse()
    for t in (0, 700_000, 600_000):
        late.trajectory.poses.add(timestamp_us=t, pose={"quat": {"w": 1.0}})
    server, address = serve("EgodriverService", Scripted(late))
    assert run_command(["check", "driver", address, *timing]) == 1
    server.stop(0)
    bad = {
        one["name"]: (one["result"], one["text"])
        for one in json.loads(capsys.readouterr().out)["checks"]
    }
    assert bad["the shape of plans"][0] == "failed"
    assert "not at time_now" in bad["the shape of plans"][1]
    assert "do not increase" in bad["the shape of plans"][1]
    assert bad["a session from start to close"][0] == "failed"
    assert bad["close_session of a session that is not open"][0] == "passed"
