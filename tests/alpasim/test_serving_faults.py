"""What a server must survive: faulty upstreams, callers that leave or send nonsense; and how it
lets callers in and ends.
"""

import contextlib
import re
import socket
import subprocess
import threading
import time

import grpc
import numpy as np
import pytest

from alpasim_plugin.alpasim.server import hosting
from alpasim_plugin.alpasim.server.assembly import Settings, Upstream, assemble
from alpasim_plugin.alpasim.server.hosting import Host, HostPolicy
from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.log.images import encode_image
from alpasim_plugin.log.wire import common_pb2, health_pb2, reflection_pb2
from alpasim_plugin.log.wire.services import Stub, methods
from tests.alpasim.service_cases import (
    answers,
    channel_to,
    drive,
    hosted,
    in_front_of,
)

EMPTY = common_pb2.Empty()
Code = grpc.StatusCode


def failure(call):
    with pytest.raises(grpc.RpcError) as caught:
        call()
    return caught.value.code(), caught.value.details()


@pytest.mark.parametrize(
    ("sent", "text", "code", "details"),
    [
        (Code.UNAVAILABLE, "away", Code.UNAVAILABLE, "upstream: UNAVAILABLE: away"),
        (
            Code.RESOURCE_EXHAUSTED,
            "queue full",
            Code.UNAVAILABLE,
            "upstream: RESOURCE_EXHAUSTED: queue full",
        ),
        (Code.DEADLINE_EXCEEDED, "slow", Code.UNAVAILABLE, "upstream: DEADLINE_EXCEEDED: slow"),
        (
            Code.DEADLINE_EXCEEDED,
            "Stopped waiting for backend",
            Code.DEADLINE_EXCEEDED,
            "Stopped waiting for backend",
        ),
        (
            Code.UNKNOWN,
            "Exception calling application",
            Code.UNKNOWN,
            "upstream: UNKNOWN: Exception calling application",
        ),
        (Code.UNKNOWN, "Stream removed", Code.UNAVAILABLE, "upstream: UNKNOWN: Stream removed"),
        (Code.NOT_FOUND, "no such scene", Code.NOT_FOUND, "upstream: NOT_FOUND: no such scene"),
    ],
)
@pytest.mark.parametrize("served", ["onefixer", "identity"])
def test_an_upstreams_failure_arrives_as_the_status_that_is_retried_or_not(
    upstream,
    renderer,
    overrides,
    sent,
    text,
    code,
    details,
    served,
):
    frames = drive(3)
    options = {"overrides": overrides} if served == "onefixer" else {}
    with in_front_of(upstream, renderer=served, **options) as (stub, made):
        (first,) = answers(stub, frames[:1])
        renderer.fault = lambda asked, context, data: context.abort(sent, text)
        assert failure(lambda: stub.render_rgb(frames[1])) == (code, details)
        renderer.fault = None
        assert answers(stub, frames) == [first, *answers(stub, frames[1:])]
        assert sum(made.service.statuses.values()) == 1


@pytest.mark.parametrize(
    ("spoil", "found"),
    [
        (lambda data: data[: len(data) // 2], "no whole PNG"),
        (lambda data: b"", "0 bytes"),
        (lambda data: b"<html>busy</html>", "no whole PNG"),
        (lambda data: data[:60] + bytes(40) + data[100:], "image"),
        (
            lambda data: encode_image(np.zeros((20, 70, 3), dtype=np.uint8)),
            r"\(20, 70\) after \(32, 48\)",
        ),
    ],
)
def test_a_broken_or_resized_picture_is_retried_and_never_enters_a_history(
    upstream,
    renderer,
    overrides,
    spoil,
    found,
):
    frames = drive(3)
    with in_front_of(upstream, overrides=overrides) as (stub, _):
        whole = answers(stub, frames)
    with in_front_of(upstream, overrides=overrides) as (stub, made):
        answers(stub, frames[:1])
        renderer.fault = lambda asked, context, data: spoil(data)
        code, text = failure(lambda: stub.render_rgb(frames[1]))
        assert code == Code.UNAVAILABLE
        assert re.search(found, text), text
        renderer.fault = None
        assert answers(stub, frames) == whole
        assert made.tree.counts.frames == 3


def test_an_upstream_that_dies_and_comes_back_goes_on_where_it_was(renderer, overrides):
    frames = drive(4)
    with (
        hosted({"SensorsimService": renderer}) as first,
        in_front_of(first, overrides=overrides) as (stub, _),
    ):
        whole = answers(stub, frames)
    dying = Host({"SensorsimService": renderer}, "127.0.0.1:0").start()
    with in_front_of(dying, overrides=overrides) as (stub, _):
        before = answers(stub, frames[:2])
        dying.stop(0.0)
        assert failure(lambda: stub.render_rgb(frames[2]))[0] == Code.UNAVAILABLE
        again = Host({"SensorsimService": renderer}, dying.address).start()
        try:
            after = []
            while not after:  # as the runtime does, after pauses
                with contextlib.suppress(grpc.RpcError):
                    after = answers(stub, frames[2:])
                time.sleep(0.1)
            assert before + after == whole
        finally:
            again.stop(0.0)


def test_a_caller_that_leaves_or_is_late_costs_nobody_else(upstream, renderer, overrides):
    frames = drive(2)
    entered = threading.Event()
    leave = threading.Event()

    def slow(asked, context, data):
        entered.set()
        leave.wait(30)
        return data

    with in_front_of(upstream, overrides=overrides) as (stub, _):
        renderer.fault = slow
        late = stub.render_rgb.future(frames[0], timeout=0.3)
        gone = stub.render_rgb.future(frames[1])
        assert entered.wait(10)
        time.sleep(0.1)
        gone.cancel()
        assert failure(late.result)[0] == Code.DEADLINE_EXCEEDED
        renderer.fault = None
        leave.set()
        assert len(answers(stub, frames)) == 2


@pytest.mark.parametrize("count", [44, pytest.param(200, marks=pytest.mark.slow)])
def test_malformed_messages_change_nothing(upstream, overrides, count):
    frames = drive(3)
    rng = np.random.default_rng(7)
    whole = frames[0].SerializeToString()
    with in_front_of(upstream, overrides=overrides) as (stub, made):
        before = answers(stub, frames)
        with hosted({"SensorsimService": made.service}) as host, channel_to(host) as channel:
            codes = set()
            for i in range(count):
                method = list(methods("SensorsimService").values())[i % 11]
                data = bytearray(whole if i % 3 else rng.bytes(1 + i))
                for at in rng.integers(0, len(data), 1 + i % 9):
                    data[at] = rng.integers(256)
                data = data[: rng.integers(1, len(data) + 1)] if i % 2 else data
                raw = channel.unary_unary(method.path)
                try:
                    raw(bytes(data), timeout=20)
                    codes.add(Code.OK)
                except grpc.RpcError as error:
                    codes.add(error.code())
            assert codes <= {
                Code.OK,
                Code.INVALID_ARGUMENT,
                Code.INTERNAL,
                Code.NOT_FOUND,
                Code.UNIMPLEMENTED,
                Code.UNAVAILABLE,
            }
            assert not any("Traceback" in key for key in made.service.statuses)
        assert answers(stub, frames) == before


def test_a_message_that_is_no_protobuf_is_one_line_of_the_log(upstream, caplog):
    method = methods("SensorsimService")["render_rgb"]
    with channel_to(upstream) as channel, pytest.raises(grpc.RpcError) as refused:
        channel.unary_unary(method.path)(b"\xff\xff\xff", timeout=30)
    assert refused.value.code() == Code.INVALID_ARGUMENT
    (record,) = [record for record in caplog.records if "no protobuf" in record.getMessage()]
    assert not record.exc_info


def test_health_and_reflection_answer_under_public_names(upstream):
    service = assemble(Settings(renderer="identity", upstream=Upstream(upstream.address))).service
    with hosted({"SensorsimService": service}) as host, channel_to(host) as to:
        health = Stub(to, "Health")
        name = "nre.grpc.protos.sensorsim.SensorsimService"
        ask = health_pb2.HealthCheckRequest
        assert [health.Check(ask(service=s)).status for s in ("", name)] == [1, 1]
        assert failure(lambda: health.Check(ask(service="other")))[0] == Code.NOT_FOUND
        reflect = Stub(to, "ServerReflection")
        question = reflection_pb2.ServerReflectionRequest
        listed, file, missing = reflect.ServerReflectionInfo(
            iter(
                [
                    question(list_services="*"),
                    question(file_containing_symbol=name),
                    question(file_containing_symbol="nobody.Service"),
                ]
            )
        )
        assert name in [s.name for s in listed.list_services_response.service]
        assert (
            b"nre.grpc.protos.sensorsim" in file.file_descriptor_response.file_descriptor_proto[0]
        )
        assert (
            b"simrun.wire.sensorsim" not in file.file_descriptor_response.file_descriptor_proto[0]
        )
        assert missing.error_response.error_code == 5


def test_running_calls_finish_while_the_server_stops(upstream, renderer, overrides):
    frame = drive(1)[0]
    entered = threading.Event()
    leave = threading.Event()
    renderer.fault = lambda asked, context, data: (entered.set(), leave.wait(30), data)[2]
    made = assemble(Settings(upstream=Upstream(upstream.address), overrides=overrides))
    host = Host({"SensorsimService": made.service}, "127.0.0.1:0").start()
    with channel_to(host) as channel:
        running = Stub(channel, "SensorsimService").render_rgb.future(frame)
        assert entered.wait(10)
        ending = threading.Thread(target=host.stop, args=(30.0,))
        ending.start()
        time.sleep(0.2)
        leave.set()
        assert running.result(timeout=30).image_bytes
        ending.join(30)
        assert (
            failure(lambda: Stub(channel, "SensorsimService").get_version(EMPTY, timeout=5))[0]
            == Code.UNAVAILABLE
        )
    made.close()


def test_only_callers_with_the_token_are_served_but_health_is_open(upstream, tmp_path):
    (tmp_path / "token").write_text(" secret \n")
    policy = HostPolicy(token_file=tmp_path / "token")
    with in_front_of(upstream, policy, renderer="identity") as (stub, made):
        assert failure(lambda: stub.get_version(EMPTY))[0] == Code.UNAUTHENTICATED
        assert (
            failure(lambda: stub.get_version(EMPTY, metadata=[("authorization", "Bearer wrong")]))[
                0
            ]
            == Code.UNAUTHENTICATED
        )
        assert (
            "identity"
            in stub.get_version(EMPTY, metadata=[("authorization", "Bearer secret")]).version_id
        )
        with (
            hosted({"SensorsimService": made.service}, policy=policy) as host,
            channel_to(host) as channel,
        ):
            assert Stub(channel, "Health").Check(health_pb2.HealthCheckRequest()).status == 1


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """Return a key and a certificate that signs itself."""
    key, cert = (tmp_path_factory.mktemp("tls") / name for name in ("key.pem", "cert.pem"))
    made = [
        "openssl",
        "req",
        "-x509",
        "-newkey",
        "ec",
        "-pkeyopt",
        "ec_paramgen_curve:P-256",
        "-nodes",
        "-days",
        "2",
    ]
    extra = [
        "-subj",
        "/CN=localhost",
        "-addext",
        "subjectAltName=DNS:localhost,IP:127.0.0.1",
        "-keyout",
        str(key),
        "-out",
        str(cert),
    ]
    subprocess.run([*made, *extra], check=True, capture_output=True)
    return key, cert


HELLO = bytes.fromhex(
    "1603010200010001fc0303"
)  # a TLS client's first bytes, of more that never come


@pytest.mark.parametrize("with_tls", [True, False], ids=["tls", "plain"])
def test_handshakes_that_never_end_hold_nobody_up_and_are_ended(
    pair,
    renderer,
    monkeypatch,
    with_tls,
):
    monkeypatch.setattr(hosting, "HANDSHAKE_S", 1.0)
    key, cert = pair
    ways = (
        grpc.insecure_channel,
        lambda address: grpc.secure_channel(
            address, grpc.ssl_channel_credentials(cert.read_bytes())
        ),
    )
    right = ways[with_tls]
    wrong = ways[not with_tls]
    with contextlib.ExitStack() as stack:
        policy = HostPolicy(cert, key) if with_tls else HostPolicy()
        host = stack.enter_context(hosted({"SensorsimService": renderer}, policy=policy))
        place = host.address.rpartition(":")
        opened = [
            stack.enter_context(socket.create_connection((place[0], int(place[2]))))
            for _ in range(90)
        ]
        for i, one in enumerate(opened):
            one.sendall((b"", HELLO, b"GET / HTTP/1.1\r\n\r\n")[i % 3])
        with wrong(host.address) as channel:
            assert (
                failure(lambda: Stub(channel, "SensorsimService").get_version(EMPTY, timeout=5))[0]
                == Code.UNAVAILABLE
            )
        with right(host.address) as channel:
            assert Stub(channel, "SensorsimService").get_version(EMPTY, timeout=20)
        for one in opened:
            one.settimeout(20.0)
            with contextlib.suppress(ConnectionResetError):
                while one.recv(4096):
                    pass


def test_tls_with_an_upstream_behind_tls_and_a_token(pair, renderer, tmp_path):
    key, cert = pair
    (tmp_path / "token").write_text("secret")
    with hosted(
        {"SensorsimService": renderer}, policy=HostPolicy(cert, key, token_file=tmp_path / "token")
    ) as behind:
        service = assemble(
            Settings(renderer="identity", upstream=Upstream(behind.address, cert, "secret"))
        )
        with hosted(
            {"SensorsimService": service.service}, policy=HostPolicy(cert, key, tls_client_ca=cert)
        ) as host:
            trusted = cert.read_bytes()
            own = grpc.ssl_channel_credentials(trusted, key.read_bytes(), trusted)
            with grpc.secure_channel(host.address, own) as channel:
                assert len(answers(Stub(channel, "SensorsimService"), drive(1))) == 1
            with grpc.secure_channel(
                host.address, grpc.ssl_channel_credentials(trusted)
            ) as channel:  # shows no certificate
                assert (
                    failure(
                        lambda: Stub(channel, "SensorsimService").get_version(EMPTY, timeout=5)
                    )[0]
                    == Code.UNAVAILABLE
                )
        service.close()
    with pytest.raises(InputError, match="one of certificate and key"):
        HostPolicy(cert).credentials()
    with pytest.raises(InputError, match="a token over plain text"):
        Upstream("127.0.0.1:1", token="secret").channel()


@pytest.mark.parametrize(
    ("args", "found"),
    [
        ([], "neither --scenes nor --upstream"),
        (["--upstream", "h:1", "--renderer", "3dgs"], "renders itself"),
        (["--upstream", "h:1", "--renderer", "onefixer-dit-tiny"], "blocks of frames"),
        (["--upstream", "127.0.0.1:1", "--render-width", "640"], "the upstream chooses the size"),
        (["--upstream", "h:1", "--mask", "front"], "no NAME=VALUE"),
        (["--upstream", "h:1?colour=red"], "no option 'colour'"),
        (["--upstream", "h:1?token_file=/none"], "No such file"),
        (["--upstream", "h:1", "--tls-cert", "/none.pem"], "one of certificate and key"),
    ],
)
def test_options_that_do_not_fit_are_refused_before_the_port_opens(args, found, capsys):
    assert run_command(["serve", *args]) == 2
    assert found in capsys.readouterr().err
