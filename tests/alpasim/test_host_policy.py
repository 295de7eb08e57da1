"""Callers that mean harm, at every server alike: whatever they leave open, others are served, and
what they leave behind ends.
"""

import itertools
import threading
import time
from contextlib import ExitStack, contextmanager
from types import SimpleNamespace

import grpc
import numpy as np
import pytest

from alpasim_plugin.alpasim.server import caches, hosting, senders
from alpasim_plugin.alpasim.server.assembly import Settings, Upstream, assemble
from alpasim_plugin.alpasim.server.caches import SceneCache
from alpasim_plugin.alpasim.server.driver_service import MOST_POSES, DriverService, _unknown_scene
from alpasim_plugin.alpasim.server.frames import FrameServer
from alpasim_plugin.alpasim.server.hosting import Host, HostPolicy, Sessions
from alpasim_plugin.alpasim.server.status import CallTime, Full, Late
from alpasim_plugin.alpasim.server.views import read_sides, read_view, straight_of
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.interfaces import Policy
from alpasim_plugin.core.types import Plan, SensorSpec
from alpasim_plugin.log.images import encode_image
from alpasim_plugin.log.wire import (
    common_pb2,
    egodriver_pb2,
    health_pb2,
    reflection_pb2,
    sensorsim_pb2,
)
from alpasim_plugin.log.wire.services import Stub, methods
from tests.alpasim.service_cases import (
    START_US,
    StandInRenderer,
    channel_to,
    hosted,
    pinhole,
    request,
)
from tests.alpasim.wire_lenses import ftheta

EMPTY = common_pb2.Empty()
Code = grpc.StatusCode
SERVICES = ("SensorsimService", "EgodriverService")


class Cruise(Policy):
    """Drives straight on, and remembers how much past it was shown."""

    sensors = (SensorSpec("front"),)

    def __init__(self):
        self.poses = 0
        self.is_closed = False

    def reset(self, seed, route):
        pass

    def act(self, observation):
        self.poses, self.cameras, self.frames = (
            len(observation.history),
            observation.cameras,
            observation.frames,
        )
        times = observation.t_us + 100_000 * np.arange(41)
        x = 10e-6 * (times - observation.t_us)
        return Plan(observation.t_us, times, np.stack([x, 0 * x], axis=1), 0 * x)

    def close(self):
        self.is_closed = True


def driver_service(**options):
    made = []

    def make(scenario):
        made.append(Cruise())
        return made[-1]

    return DriverService("cruise", None, make, _unknown_scene, **options), made


@contextmanager
def served(name, workers=2, **options):
    """Run one of our two servers with little to spare."""
    with ExitStack() as stack:
        if name == "EgodriverService":
            service = driver_service()[0]
        else:
            upstream = stack.enter_context(hosted({name: StandInRenderer()}))
            made = assemble(Settings(renderer="identity", upstream=Upstream(upstream.address)))
            stack.callback(made.close)
            service = made.service
        yield stack.enter_context(hosted({name: service}, workers=workers, **options))


def failure(call):
    with pytest.raises(grpc.RpcError) as caught:
        call()
    return caught.value.code(), caught.value.details()


def is_served(host, name, **options):
    """Tell whether somebody else, over a connection of their own, gets an answer."""
    with grpc.insecure_channel(host.address, [("grpc.use_local_subchannel_pool", 1)]) as channel:
        answer = Stub(channel, name).get_version(EMPTY, timeout=20, **options)
        status = Stub(channel, "Health").Check(health_pb2.HealthCheckRequest(), timeout=20).status
    return bool(answer.version_id) and status == health_pb2.HealthCheckResponse.SERVING


def wait_until(holds):
    """Wait until a condition holds, and fail where it does not in a minute."""
    until_s = time.monotonic() + 60
    while not holds():
        assert time.monotonic() < until_s
        time.sleep(0.01)


class Silence:
    """The request stream of a caller that stays silent and then closes."""

    def __init__(self):
        self.over = threading.Event()

    def __iter__(self):
        self.over.wait(60)
        yield from ()


def say_nothing(service, method):
    return lambda channel, silence: channel.stream_stream(methods(service)[method].path)(
        iter(silence)
    )


def reflect(channel, silence):
    def questions():
        yield reflection_pb2.ServerReflectionRequest(list_services="*")
        yield from silence

    call = Stub(channel, "ServerReflection").ServerReflectionInfo(questions())
    next(call)
    return call


@pytest.mark.parametrize("name", SERVICES)
def test_streams_that_stay_open_hold_nobody_up(name):
    silence = Silence()
    with served(name) as host, channel_to(host) as channel:
        calls = [reflect(channel, silence) for _ in range(40)]
        assert is_served(host, name)
        for call in calls:
            call.cancel()
        silence.over.set()


@pytest.mark.parametrize("name", SERVICES)
@pytest.mark.parametrize(
    "of",
    [("Health", "Check"), ("ServerReflection", "ServerReflectionInfo"), None],
    ids=lambda of: of and of[1],
)
def test_calls_whose_message_never_comes_hold_nobody_up(name, of):
    silence = Silence()
    open_call = say_nothing(*(of or (name, "get_version")))
    with served(name) as host, channel_to(host) as channel:
        calls = [open_call(channel, silence) for _ in range(100)]
        time.sleep(0.5)  # all are there before the next caller
        assert is_served(host, name)
        for call in calls:
            call.cancel()
        silence.over.set()


def test_messages_wait_at_their_callers_until_there_is_a_place_and_slow_ones_are_cancelled(
    monkeypatch,
):
    monkeypatch.setattr(hosting, "RECEIVING", 4)
    monkeypatch.setattr(hosting, "SENDING_S", 0.5)
    monkeypatch.setattr(hosting, "UPKEEP_S", 0.1)
    name = "EgodriverService"
    silence = Silence()
    with served(name) as host, channel_to(host) as channel:
        calls = [say_nothing(name, "get_version")(channel, silence) for _ in range(8)]
        assert is_served(host, name)
        for call in calls:
            assert failure(lambda call=call: next(call))[0] is Code.CANCELLED
        silence.over.set()


def test_slow_senders_are_cancelled_soon_where_others_wait_for_their_places(monkeypatch):
    monkeypatch.setattr(hosting, "RECEIVING", 4)
    monkeypatch.setattr(hosting, "SENDING_S", 3600.0)
    monkeypatch.setattr(senders, "CROWDED_S", 0.2)
    entered = []
    enter = senders.Senders.enter

    def watched(callers, context):
        enter(callers, context)
        entered.append(context)

    monkeypatch.setattr(senders.Senders, "enter", watched)
    name = "SensorsimService"
    silence = Silence()

    def take_a_place(channel):
        call = say_nothing(name, "get_version")(channel, silence)
        wait_until(lambda: len(entered) > len(calls))
        calls.append(call)

    calls = []
    own = [("grpc.use_local_subchannel_pool", 1)]  # a connection of its own
    with (
        served(name) as host,
        channel_to(host) as channel,
        grpc.insecure_channel(host.address, own) as other,
    ):
        for connection in (other, channel, channel, channel):
            take_a_place(connection)
        assert is_served(host, name)
        alone, first, *later = calls
        assert failure(lambda: next(first))[0] is Code.CANCELLED
        assert all(call.is_active() for call in (alone, *later))
        for call in calls:
            call.cancel()
        silence.over.set()


def test_a_server_that_ends_does_not_wait_for_messages_that_do_not_come():
    name = "EgodriverService"
    silence = Silence()
    with ExitStack() as stack:
        service = driver_service()[0]
        host = Host({name: service}, "127.0.0.1:0").start()
        channel = stack.enter_context(channel_to(host))
        calls = [say_nothing(name, "get_version")(channel, silence) for _ in range(8)]
        assert is_served(host, name)
        host.stop(drain_s=3600.0)
        assert all(failure(lambda call=call: next(call))[0] for call in calls)
        silence.over.set()


def test_a_message_to_a_renderer_has_a_limit_of_its_own():
    name = "SensorsimService"
    crowd = sensorsim_pb2.RGBRenderRequest(dynamic_objects=[sensorsim_pb2.DynamicObject()] * 600)
    with served(name, message_bytes=1_000) as host, channel_to(host) as channel:
        render = Stub(channel, name).render_rgb
        assert failure(lambda: render(crowd))[0] is Code.RESOURCE_EXHAUSTED
        del crowd.dynamic_objects[400:]
        assert failure(lambda: render(crowd))[0] is not Code.RESOURCE_EXHAUSTED
        assert is_served(host, name)


class Call:
    """The context of a call, which takes its time to end."""

    is_cancelled = False

    def peer(self):
        return "somebody"

    def cancel(self):
        self.is_cancelled = True


def test_no_more_senders_are_cancelled_than_calls_wait(monkeypatch):
    monkeypatch.setattr(senders, "CROWDED_S", -1.0)  # at once
    callers = senders.Senders()
    calls = [Call() for _ in range(3)]
    for call in calls:
        callers.enter(call)
    with callers.waiting():
        callers.make_room()
        callers.make_room()  # the first one has not given its place back
        assert [call.is_cancelled for call in calls] == [True, False, False]
        callers.left(calls[0])
        callers.make_room()
        assert [call.is_cancelled for call in calls] == [True, True, False]
    callers.make_room()  # nobody waits
    assert not calls[2].is_cancelled


class LargeImages:
    """A renderer whose images are 8 MiB."""

    def get_version(self, request, context):
        return common_pb2.VersionId(version_id="large")

    def render_rgb(self, request, context):
        return sensorsim_pb2.RGBRenderReturn(image_bytes=bytes(8 << 20))


@pytest.mark.parametrize(
    ("budget_mb", "reading_s", "left_mb"), [(36, 600.0, 32), (1000, 0.5, 0)], ids=["full", "late"]
)
def test_answers_that_callers_do_not_take_are_bounded_and_hold_nobody_up(
    monkeypatch, budget_mb, reading_s, left_mb
):
    monkeypatch.setattr(hosting, "UNREAD_BYTES", budget_mb << 20)
    monkeypatch.setattr(hosting, "READING_S", reading_s)
    monkeypatch.setattr(hosting, "UPKEEP_S", 0.1)
    answers = []
    enter = hosting.Unread.enter

    def watched(unread, context, size):
        enter(unread, context, size)
        answers.append(unread)

    monkeypatch.setattr(hosting.Unread, "enter", watched)
    name = "SensorsimService"
    wanted = sensorsim_pb2.RGBRenderRequest()
    options = [("grpc.http2.bdp_probe", 0)]  # which would let whole answers come unasked
    with (
        hosted({name: LargeImages()}, workers=2) as host,
        grpc.insecure_channel(host.address, options) as channel,
    ):
        # the caller of a stream takes no answer before it asks for it
        ask = channel.stream_stream(methods(name)["render_rgb"].path)
        calls = [ask(iter([wanted.SerializeToString()])) for _ in range(12)]
        until_s = time.monotonic() + 60
        while len(answers) < len(calls) or answers[0].held >> 20 != left_mb:
            assert time.monotonic() < until_s, [one.held for one in answers]
            time.sleep(0.02)
        assert is_served(host, name)
        with channel_to(host) as other:
            image = Stub(other, name).render_rgb(wanted, timeout=20).image_bytes
        assert len(image) == 8 << 20
        for call in calls:
            call.cancel()


@pytest.mark.parametrize("name", SERVICES)
def test_callers_without_the_token_are_refused_without_a_thread_that_works(name, tmp_path):
    (tmp_path / "token").write_text("secret\n")
    silence = Silence()
    with (
        served(name, policy=HostPolicy(token_file=tmp_path / "token")) as host,
        channel_to(host) as channel,
    ):
        for _ in range(40):
            assert (
                failure(lambda: next(say_nothing(name, "get_version")(channel, silence)))[0]
                is Code.UNAUTHENTICATED
            )
        assert is_served(host, name, metadata=[("authorization", "Bearer secret")])
        silence.over.set()


@pytest.mark.parametrize("listen", ["0.0.0.0:0", "[::]:0"])
def test_a_server_that_everybody_reaches_says_so_unless_callers_are_checked(
    listen, tmp_path, caplog
):
    (tmp_path / "token").write_text("secret")
    for near, policy, said in (
        (listen, HostPolicy(), 1),
        (listen, HostPolicy(token_file=tmp_path / "token"), 0),
        ("127.0.0.1:0", HostPolicy(), 0),
        (f"unix:{tmp_path}/socket", HostPolicy(), 0),
    ):
        caplog.clear()
        Host({"EgodriverService": driver_service()[0]}, near, policy).stop(0.0)
        assert caplog.text.count("open to everybody who can reach it") == said


def test_a_frame_of_too_many_pixels_is_refused_before_it_takes_memory():
    identity = np.eye(4)
    with pytest.raises(InputError, match="in all"):
        read_view(request(identity, identity, START_US, size=(8192, 4096)))
    with pytest.raises(InputError, match="in all"):
        read_sides(pinhole(8192, 4096), 8192, 4096)
    assert read_view(request(identity, identity, START_US, size=(3848, 2168))).width == 3848


def test_frames_of_too_many_pixels_together_are_refused_before_any_is_made():
    asked = [request(np.eye(4), np.eye(4), START_US + i, size=(4096, 2048)) for i in range(5)]
    frames = FrameServer(None, None, None, None)  # type: ignore[arg-type]  # nothing of it is reached
    with pytest.raises(InputError, match="41943040 pixels"):
        frames.answers(asked, CallTime())


def test_a_loaded_scene_is_served_while_another_loads_and_who_has_gone_does_not_wait(
    monkeypatch,
):
    scenes = SceneCache(["smoke/straight", "smoke/curve"], None, False)
    loaded, other = scenes.ids
    first = scenes.get(loaded)
    entered = threading.Event()
    leave = threading.Event()
    monkeypatch.setattr(scenes, "_load", lambda source: [entered.set(), leave.wait(30)])
    loading = threading.Thread(target=scenes.get, args=(other,))
    loading.start()
    assert entered.wait(10)
    assert scenes.get(loaded) is first
    gone = SimpleNamespace(time_remaining=lambda: None, is_active=lambda: False)
    with pytest.raises(Late):
        scenes.get(other, CallTime(gone))
    leave.set()
    loading.join(10)
    assert scenes.loaded == [loaded, other]


def test_the_scene_that_was_not_used_for_longest_goes_first(monkeypatch):
    monkeypatch.setattr(caches, "KEPT_SCENES", 2)
    scenes = SceneCache(["smoke/straight", "smoke/curve", "urban/s_bend"], None, False)
    monkeypatch.setattr(scenes, "_load", lambda source: SimpleNamespace(source=source))
    first, second, third = scenes.ids
    kept = scenes.get(first)
    scenes.get(second)
    assert scenes.get(first) is kept
    scenes.get(third)
    assert scenes.loaded == [first, third]
    assert scenes.get(first) is kept


# --- sessions of a driver


def opening(name):
    request = egodriver_pb2.DriveSessionRequest(session_uuid=name)
    mount = common_pb2.Pose(quat=common_pb2.Quat(w=1.0))
    request.rollout_spec.vehicle.available_cameras.add(
        logical_id="front", intrinsics=pinhole(name="front"), rig_to_camera=mount
    )
    return request


def seen(name, t_us, size=(48, 32)):
    picture = encode_image(np.zeros((*size[::-1], 3), dtype=np.uint8))
    camera_image = {"logical_id": "front", "frame_end_us": t_us, "image_bytes": picture}
    return egodriver_pb2.RolloutCameraImage(session_uuid=name, camera_image=camera_image)


def moved(name, *times_us):
    poses = [
        {"timestamp_us": t_us, "pose": {"vec": {"x": t_us * 1e-5}, "quat": {"w": 1.0}}}
        for t_us in times_us
    ]
    return egodriver_pb2.RolloutEgoTrajectory(session_uuid=name, trajectory={"poses": poses})


def test_abandoned_sessions_end_and_give_back_what_they_hold():
    now = [0.0]
    service, made = driver_service(expiry_s=60.0, most_sessions=64, clock=lambda: now[0])
    with hosted({"EgodriverService": service}) as host, channel_to(host) as channel:
        stub = Stub(channel, "EgodriverService")
        for i in range(64):
            stub.start_session(opening(str(i)))
        stub.submit_image_observation(seen("7", 1))
        stub.submit_egomotion_observation(moved("7", 1))
        stub.drive(egodriver_pb2.DriveRequest(session_uuid="7", time_now_us=1))
        code, text = failure(lambda: stub.start_session(opening("one more")))
        assert (code, "60 s" in text) == (Code.RESOURCE_EXHAUSTED, True)
        now[0] = 40.0
        stub.submit_image_observation(seen("0", 2))  # still in use
        now[0] = 61.0
        stub.start_session(opening("one more"))
        assert len(service.sessions) == 2
        assert [policy.is_closed for policy in made] == [True]
        assert "expired" in failure(lambda: stub.submit_image_observation(seen("7", 3)))[1]


def test_a_sessions_past_has_an_end_and_so_have_the_times_that_are_kept():
    service, made = driver_service()
    with hosted({"EgodriverService": service}) as host, channel_to(host) as channel:
        stub = Stub(channel, "EgodriverService")
        stub.start_session(opening("a"))
        stub.submit_image_observation(seen("a", 1))
        for block in range(3):
            stub.submit_egomotion_observation(
                moved("a", *range(block * MOST_POSES + 1, (block + 1) * MOST_POSES))
            )
        stub.drive(egodriver_pb2.DriveRequest(session_uuid="a", time_now_us=3 * MOST_POSES))
    assert made[0].poses == MOST_POSES


def test_a_policy_is_shown_the_pinhole_of_a_camera_with_an_f_theta_lens_and_one_size():
    service, made = driver_service()
    asked = opening("a")
    asked.rollout_spec.vehicle.available_cameras[0].intrinsics.CopyFrom(ftheta(False))
    with hosted({"EgodriverService": service}) as host, channel_to(host) as channel:
        stub = Stub(channel, "EgodriverService")
        stub.start_session(asked)
        stub.submit_image_observation(seen("a", 1, (160, 90)))
        stub.submit_egomotion_observation(moved("a", 1))
        assert stub.drive(
            egodriver_pb2.DriveRequest(session_uuid="a", time_now_us=1)
        ).trajectory.poses
        assert (
            failure(lambda: stub.submit_image_observation(seen("a", 2, (320, 180))))[0]
            is Code.INVALID_ARGUMENT
        )
    (shown,) = made[0].cameras.values()
    straight = straight_of(ftheta(False), 160, 90)
    assert (shown.width, shown.height) == straight.size == made[0].frames["front"].rgb.shape[1::-1]
    np.testing.assert_array_equal(shown.K, straight.K)


def test_times_that_no_rollout_has_are_the_callers_fault():
    service, _ = driver_service()
    with hosted({"EgodriverService": service}) as host, channel_to(host) as channel:
        stub = Stub(channel, "EgodriverService")
        stub.start_session(opening("a"))
        stub.submit_image_observation(seen("a", 1))
        stub.submit_egomotion_observation(moved("a", 1))
        for t_us in (2**62, 2**63, 2**64 - 1):
            for call, request in (
                (stub.drive, egodriver_pb2.DriveRequest(session_uuid="a", time_now_us=t_us)),
                (stub.submit_egomotion_observation, moved("a", t_us)),
                (stub.submit_image_observation, seen("a", t_us)),
            ):
                assert (
                    failure(lambda call=call, request=request: call(request))[0]
                    is Code.INVALID_ARGUMENT
                )
        assert stub.drive(
            egodriver_pb2.DriveRequest(session_uuid="a", time_now_us=2)
        ).trajectory.poses


def test_one_budget_of_bytes_closes_the_sessions_that_nobody_used_for_longest():
    clock = itertools.count()
    sessions = Sessions(budget=100, clock=lambda: float(next(clock)))
    for name in "abc":
        sessions.open(name, name)
    sessions.hold("a", 40)
    sessions.hold("b", 40)
    sessions.get("a")
    sessions.hold("c", 40)
    with pytest.raises(Full):
        sessions.get("b")
    assert sessions.get("a") == "a"
    with pytest.raises(Full), sessions.working("a", 30):
        pass
    with sessions.working("a", 20):
        assert sessions.held == 100
    with pytest.raises(Full):
        sessions.hold("a", 101)
    assert sessions.held == 0
