"""How every server of this package is reached, by whom, and how much of it a caller may take: one
policy for the renderer and the driver service.

A caller may be hostile, so sessions, calls, handshakes and the size of messages have limits.
"""

from __future__ import annotations

import hmac
import ipaddress
import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar

import grpc

from alpasim_plugin.alpasim.server.senders import CROWDED_S, SENDING_S, Senders
from alpasim_plugin.alpasim.server.status import CallTime, Full, Late
from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.core.files import read_bytes, read_text
from alpasim_plugin.core.flags import Flag
from alpasim_plugin.log.wire import SERVICE_PATHS, health_pb2
from alpasim_plugin.log.wire.services import MESSAGE_BYTES, V1ALPHA, Reflection, handlers

OPEN_CALLS = SERVICE_PATHS["Health"]  # a load balancer has no token
LIGHT_CALLS = (OPEN_CALLS, SERVICE_PATHS["ServerReflection"], V1ALPHA)
RENDER_BYTES = 1 << 20  # of a message to a renderer: the poses of some thousand road users
CALLS = 512  # threads for calls that are worked on, wait for that, or send their message
RECEIVING = 32  # calls whose message is in memory and that are not worked on yet
UNREAD_BYTES = 512 << 20  # of all answers that callers have not taken yet
READING_S = 30.0  # a caller that has not taken its answer after so long is cancelled
STREAMS = 256  # calls at a time on one connection; further ones wait at the caller
HANDSHAKE_S = 20.0  # from the connection to the end of the handshakes of TLS and HTTP/2
SESSIONS = 64  # sessions at a time
SESSION_BYTES = 2 << 30  # that all sessions together keep and work on
UPKEEP_S = 2.0
S = TypeVar("S")
log = logging.getLogger("simrun.serve")


@dataclass(frozen=True)
class HostPolicy:
    """Who is let in, and how long what a caller leaves behind is kept.

    Attributes:
        tls_cert, tls_key: PEM files of this server; both or neither.
        tls_client_ca: PEM file: callers must show a certificate that it signed.
        token_file: Callers must send ``authorization: Bearer TOKEN``, with the text of this file.
        expiry_s: Sessions and histories that nobody used for so long are forgotten.
        drain_s: At the end, running calls have so long.
    """

    tls_cert: Annotated[Path | None, Flag("PEM certificate of this server.")] = None
    tls_key: Annotated[Path | None, Flag("PEM key of this server.")] = None
    tls_client_ca: Annotated[Path | None, Flag("Callers must show a certificate signed by it.")] = (
        None
    )
    token_file: Annotated[Path | None, Flag("File with the token that callers must send.")] = None
    expiry_s: float = 900.0
    drain_s: float = 30.0

    def credentials(self) -> Any:
        """Return gRPC's server credentials, or None for plain text.

        Raises:
            InputError: A file is missing, or one of certificate and key.
        """
        if self.tls_cert is None and self.tls_key is None and self.tls_client_ca is None:
            return None
        if self.tls_cert is None or self.tls_key is None:
            raise InputError("TLS: one of certificate and key", "give --tls-cert and --tls-key")
        ca = None if self.tls_client_ca is None else read_bytes(self.tls_client_ca)
        pair = read_bytes(self.tls_key), read_bytes(self.tls_cert)
        return grpc.ssl_server_credentials(
            [pair], root_certificates=ca, require_client_auth=ca is not None
        )

    def warn(self, address: str) -> None:
        """Log a warning if whoever can reach an address is served."""
        if self.token_file is None and self.tls_client_ca is None and not is_local(address):
            log.warning(
                "%s is open to everybody who can reach it; see --token-file and --tls-client-ca",
                address,
            )


def read_token(path: Path | None) -> str | None:
    """Return the token in a file, without the space around it; None without a file.

    Raises:
        InputError: It cannot be read, or is empty.
    """
    if path is None:
        return None
    token = read_text(path).strip()
    if not token:
        raise InputError(f"{path}: an empty file", "write the token into it")
    return token


def is_local(address: str) -> bool:
    """Tell whether an address can only be reached from this machine.

    Example:
        >>> [is_local(a) for a in ("127.0.0.1:50051", "[::1]:0", "unix:/tmp/a", "0.0.0.0:50051", "127.example.org:1")]
        [True, True, True, False, False]
    """
    host = address.rpartition(":")[0].strip("[]")
    if address.startswith("unix:") or host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


@dataclass
class _Open(Generic[S]):
    """An open session, when it was used last, and the bytes that it keeps."""

    session: S
    used_s: float
    held: int = 0


class Sessions(Generic[S]):
    """Open sessions by name: no more than a number of them, none that nobody used for long, and in
    all no more bytes than a budget.

    Args:
        expiry_s: One unused for so long is closed.
        most: How many may be open at a time.
        close: Gives back what a session holds.
        clock: Monotonic seconds.
        budget: Bytes that all sessions together may keep and work on.

    Attributes:
        crowded_out: The newest names of sessions that were closed to make room for others.
    """

    def __init__(
        self,
        expiry_s: float = 900.0,
        most: int = SESSIONS,
        close: Callable[[S], None] = lambda session: None,
        clock: Callable[[], float] = time.monotonic,
        budget: int = SESSION_BYTES,
    ) -> None:
        self._expiry_s, self._most, self._close, self._clock = expiry_s, most, close, clock
        self._budget = budget
        self._working = 0
        self._open: dict[str, _Open[S]] = {}
        self._lock = threading.Lock()
        self.crowded_out: deque[str] = deque(maxlen=1000)

    def __len__(self) -> int:
        return len(self._open)

    @property
    def held(self) -> int:
        """Give the bytes that all sessions keep and work on."""
        return self._working + sum(session.held for session in self._open.values())

    def open(self, name: str, session: S) -> None:
        """Enter a session.

        Raises:
            InputError: One of that name is open.
            Full: As many as may be are open.
        """
        self.expire()
        with self._lock:
            if name in self._open:
                raise InputError(f"session {name!r}: it is open already", "close it first")
            if len(self._open) >= self._most:
                raise Full(
                    f"session {name!r}: {self._most} sessions are open",
                    f"close sessions that are over; abandoned ones end after {self._expiry_s:g} s",
                )
            self._open[name] = _Open(session, self._clock())

    def get(self, name: str) -> S:
        """Return a session, which is used by that.

        Raises:
            InputError: It is not open.
            Full: It was closed to make room for others.
        """
        with self._lock:
            if name in self._open:
                self._open[name].used_s = self._clock()
                return self._open[name].session
        if name in self.crowded_out:
            raise Full(
                f"session {name!r}: it was closed to make room for newer images",
                "open it again with fewer sessions beside it, or give the server more --history-mb",
            )
        raise InputError(
            f"session {name!r}: it is not open, or has expired", "call start_session first"
        )

    def hold(self, name: str, held: int) -> None:
        """Enter how many bytes a session keeps; those that nobody used for longest are closed to
        make room for it, and itself if that is not enough.

        Raises:
            Full: It keeps more than all sessions together may.
        """
        with self._lock:
            if name not in self._open:
                return
            self._open[name].held = held
            oldest = sorted(
                self._open,
                key=lambda session_id: (session_id == name, self._open[session_id].used_s),
            )
            over = self.held - self._budget
            crowded = []
            for session_id in oldest:
                if over > 0:
                    over -= self._open[session_id].held
                    crowded.append(session_id)
            self.crowded_out.extend(crowded)
        for session_id in crowded:
            self.close(session_id)
        self.get(name)

    @contextmanager
    def working(self, name: str, size: int) -> Iterator[None]:
        """Work on some bytes during the block.

        Raises:
            Full: All sessions together would have more than they may.
        """
        with self._lock:
            if self.held + size > self._budget:
                raise Full(
                    f"session {name!r}: its images take {size >> 20} MiB decoded, and "
                    f"{self.held >> 20} of {self._budget >> 20} MiB are in use",
                    "send smaller images, or give the server more --history-mb",
                )
            self._working += size
        try:
            yield
        finally:
            with self._lock:
                self._working -= size

    def close(self, name: str) -> None:
        """Close a session; one that is not open is fine."""
        with self._lock:
            closed = self._open.pop(name, None)
        if closed is not None:
            self._close(closed.session)

    def expire(self) -> None:
        """Close the sessions that nobody used for long."""
        with self._lock:
            now_s = self._clock()
            old = [
                name
                for name, session in self._open.items()
                if now_s - session.used_s > self._expiry_s
            ]
        for name in old:
            self.close(name)


class Health:
    """The standard health service: the server as a whole (``""``) and every service by its public
    name.
    """

    def __init__(self, services: Mapping[str, object]) -> None:
        self._names = {"", *(SERVICE_PATHS[name].strip("/") for name in services)}
        self.is_serving = True

    def Check(
        self, request: health_pb2.HealthCheckRequest, context: Any
    ) -> health_pb2.HealthCheckResponse:
        """Return SERVING until the server is stopped."""
        if request.service not in self._names:
            context.abort(grpc.StatusCode.NOT_FOUND, f"no service {request.service!r} here")
        response = health_pb2.HealthCheckResponse
        return response(status=response.SERVING if self.is_serving else response.NOT_SERVING)


@dataclass(frozen=True)
class _Answer:
    """An answer that its caller has not taken yet.

    Attributes:
        since_s: When it was made.
        size: Its bytes.
    """

    since_s: float
    size: int


class Unread:
    """Answers that their callers have not taken yet, which stay in memory: no more bytes than
    `UNREAD_BYTES`, and none for longer than `READING_S`.
    """

    def __init__(self) -> None:
        self._answers: dict[Any, _Answer] = {}  # by the context of the call, the oldest first
        self._lock = threading.Lock()

    @property
    def held(self) -> int:
        """Give the bytes of all of them."""
        with self._lock:
            return sum(answer.size for answer in self._answers.values())

    def enter(self, context: Any, size: int) -> None:
        """Enter an answer until its call ends. Where all together are too many bytes, the calls
        whose answers have waited for longest are cancelled.
        """
        with self._lock:
            self._answers[context] = _Answer(time.monotonic(), size)
            over = sum(answer.size for answer in self._answers.values()) - UNREAD_BYTES
            crowded = []
            for other, answer in self._answers.items():
                if over > 0 and other is not context:
                    over -= answer.size
                    crowded.append(other)
        if not context.add_callback(partial(self._leave, context)):
            self._leave(context)  # it has ended already
        for other in crowded:
            other.cancel()

    def cancel_slow(self) -> None:
        """Cancel the calls whose answers wait for too long."""
        latest_s = time.monotonic() - READING_S
        with self._lock:
            slow = [call for call, answer in self._answers.items() if answer.since_s < latest_s]
        for context in slow:
            context.cancel()

    def _leave(self, context: Any) -> None:
        with self._lock:
            self._answers.pop(context, None)


class Gate(grpc.ServerInterceptor):  # type: ignore[misc]  # grpc has no types
    """Check the token of every call, and limit how many messages are in memory and how many calls
    are worked on at the same time. A message stays with its caller until there is a place for it.

    Args:
        token: None: no token is asked for.
        workers: Calls that are worked on; health and reflection do not count.
    """

    def __init__(self, token: str | None, workers: int) -> None:
        self._wanted = None if token is None else f"Bearer {token}".encode()
        self._working = threading.Semaphore(workers)
        self._receiving = threading.Semaphore(RECEIVING)
        self._senders = Senders()
        self._unread = Unread()
        # A handler of a stream starts before the message has come: a refused call holds no thread.
        self._refusal = grpc.stream_unary_rpc_method_handler(unauthenticated)

    def intercept_service(self, continuation: Callable[[Any], Any], details: Any) -> Any:
        """Return the handler of a call, or the one that refuses it."""
        if not details.method.startswith(OPEN_CALLS) and not self._admits(
            details.invocation_metadata
        ):
            return self._refusal
        handler = continuation(details)
        if handler is None or details.method.startswith(LIGHT_CALLS):
            return handler
        return grpc.stream_unary_rpc_method_handler(
            partial(self._answer, handler.unary_unary),
            handler.request_deserializer,
            handler.response_serializer,
        )

    def cancel_slow(self) -> None:
        """Cancel the calls that have not sent their message, or taken their answer, in time."""
        self.cancel_slow_senders()
        self._unread.cancel_slow()

    def cancel_slow_senders(self, limit_s: float | None = None) -> None:
        """Cancel the calls that have not sent their message within a time, by default `SENDING_S`."""
        self._senders.cancel_slow(SENDING_S if limit_s is None else limit_s)

    def _admits(self, metadata: Any) -> bool:
        if self._wanted is None:
            return True
        token = dict(metadata or ()).get("authorization", "")
        token = token.encode() if isinstance(token, str) else token
        return hmac.compare_digest(token, self._wanted)

    def _answer(self, call: Callable[[Any, Any], Any], messages: Any, context: Any) -> Any:
        left = CallTime(context)
        try:
            with ExitStack() as working:
                with self._place(left, context):
                    request = self._received(messages, context)
                    working.enter_context(left.holding(self._working))
                answer = call(request, context)
                self._unread.enter(context, answer.ByteSize())
                return answer
        except Late as late:
            context.abort(grpc.StatusCode.CANCELLED, str(late))

    @contextmanager
    def _place(self, left: CallTime, context: Any) -> Iterator[None]:
        """Hold a place for the message of a call."""
        try:
            with ExitStack() as place:
                with self._senders.waiting():
                    place.enter_context(left.holding(self._receiving, self._senders.make_room))
                yield
        finally:
            self._senders.left(context)

    def _received(self, messages: Any, context: Any) -> Any:
        """Wait for the message of a call.

        Raises:
            Late: It did not come.
        """
        self._senders.enter(context)
        try:
            for message in messages:
                return message
        finally:
            self._senders.received(context)
        raise Late("the message did not come")


def unauthenticated(messages: Any, context: Any) -> None:
    """Refuse a call without waiting for its message."""
    context.abort(grpc.StatusCode.UNAUTHENTICATED, "send metadata 'authorization: Bearer TOKEN'")


class Host:
    """A running server.

    Args:
        services: Implementations by the name of the service (`SERVICE_PATHS`).
        listen: ``HOST:PORT``; port 0 takes a free one. Or ``unix:PATH``.
        policy: Who is let in.
        workers: Calls that are worked on at the same time; further ones wait.
        on_interval: Called every `UPKEEP_S` seconds, such as to forget what is old.
        message_bytes: Size of the largest message that is received. Parsed, one may take fifty
            times as much memory.

    Raises:
        InputError: An invalid address, or files of the policy that cannot be read.
        InfrastructureError: The port cannot be had.
    """

    def __init__(
        self,
        services: Mapping[str, object],
        listen: str,
        policy: HostPolicy = HostPolicy(),
        workers: int = 16,
        on_interval: Callable[[], None] = lambda: None,
        message_bytes: int = MESSAGE_BYTES,
    ) -> None:
        self.health = Health(services)
        # No maximum_concurrent_rpcs: beyond it gRPC answers RESOURCE_EXHAUSTED, which AlpaSim does
        # not retry. Calls wait instead.
        options = [
            ("grpc.max_receive_message_length", message_bytes),
            ("grpc.max_send_message_length", MESSAGE_BYTES),
            ("grpc.so_reuseport", 0),
            ("grpc.max_concurrent_streams", STREAMS),
            ("grpc.server_handshake_timeout_ms", round(1000 * HANDSHAKE_S)),
        ]
        self._gate = gate = Gate(read_token(policy.token_file), workers)
        self._server = grpc.server(
            ThreadPoolExecutor(CALLS, thread_name_prefix="serve"),
            options=options,
            interceptors=(gate,),
        )
        made = [handlers(name, service) for name, service in services.items()]
        self._server.add_generic_rpc_handlers(
            (*made, handlers("Health", self.health), *Reflection([*services, "Health"]).handlers())
        )
        host, _, port = listen.rpartition(":")
        is_socket = listen.startswith("unix:")
        credentials = policy.credentials()
        try:
            if not is_socket and (not host or not port.isdigit()):
                raise InputError(
                    f"--listen {listen}: no HOST:PORT",
                    "write for example 127.0.0.1:50051, or unix:PATH",
                )
            if credentials is None:
                bound = self._server.add_insecure_port(listen)
            else:
                bound = self._server.add_secure_port(listen, credentials)
        except RuntimeError as error:
            raise InfrastructureError(
                f"{listen}: {error}", "choose a free port and an address of this machine"
            ) from error
        self.address = listen if is_socket else f"{host}:{bound}"
        policy.warn(self.address)
        self._ended = threading.Event()
        self._on_interval = on_interval
        self._upkeep = threading.Thread(target=self._repeat, daemon=True, name="serve-upkeep")

    def start(self) -> Host:
        """Accept calls."""
        self._server.start()
        self._upkeep.start()
        return self

    def wait(self) -> None:
        """Wait for the end; a signal interrupts it."""
        while not self._ended.wait(0.5):
            pass

    def stop(self, drain_s: float = 30.0) -> None:
        """Refuse new calls (UNAVAILABLE), let running ones finish within ``drain_s``, and close the
        port. Calls whose message does not come are not waited for.
        """
        self.health.is_serving = False
        ended = self._server.stop(drain_s)
        while not ended.wait(CROWDED_S):
            self._gate.cancel_slow_senders(CROWDED_S)
        self._ended.set()
        if self._upkeep.is_alive():
            self._upkeep.join()

    def __enter__(self) -> Host:
        return self.start()

    def __exit__(self, *failure: object) -> None:
        self.stop(0.0 if failure[0] is not None else 5.0)

    def _repeat(self) -> None:
        while not self._ended.wait(UPKEEP_S):
            self._gate.cancel_slow()
            self._on_interval()
