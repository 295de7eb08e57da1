"""What every call to a server passes: the token, then its message, then a place among those that
are worked on; and the health service.

A caller may be hostile. So whatever waits for it has a limit, and none of it is on a thread that
renders or drives: those are for calls whose message is here.
"""

from __future__ import annotations

import hmac
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import grpc
from google.protobuf.message import DecodeError

from alpasim_plugin.alpasim.server.status import CallTime, Late
from alpasim_plugin.log.wire import SERVICE_PATHS, health_pb2
from alpasim_plugin.log.wire.services import V1ALPHA

OPEN_CALLS = SERVICE_PATHS["Health"]  # a load balancer has no token
LIGHT_CALLS = (OPEN_CALLS, SERVICE_PATHS["ServerReflection"], V1ALPHA)
LIGHT = 32  # threads for calls that never render nor drive
AWAITED, LIGHT_AWAITED = (
    64,
    16,
)  # calls whose message has not come: for one more, the oldest is dropped
MESSAGE_S = 30.0  # how long a message may take to come
WATCHERS = 64  # streams that are sent every change of the health


class Health:
    """The standard health service: the server as a whole (``""``) and every service by its public
    name.
    """

    def __init__(self, services: Mapping[str, object]) -> None:
        self._names = {"", *(SERVICE_PATHS[name].strip("/") for name in services)}
        self._serving = True
        self._watchers: dict[
            Callable[[Any], None], str
        ] = {}  # what sends to a caller, and the service that it asked for
        self._lock = threading.Lock()

    def stop(self) -> None:
        """Report NOT_SERVING from now on, to watchers as well."""
        with self._lock:
            self._serving = False
            watchers, self._watchers = self._watchers, {}
        for send, service in watchers.items():
            send(health_pb2.HealthCheckResponse(status=self._status(service)))
            send(None)

    def Check(
        self, request: health_pb2.HealthCheckRequest, context: Any
    ) -> health_pb2.HealthCheckResponse:
        """Answer once."""
        if request.service not in self._names:
            context.abort(grpc.StatusCode.NOT_FOUND, f"no service {request.service!r} here")
        return health_pb2.HealthCheckResponse(status=self._status(request.service))

    def Watch(
        self,
        request: health_pb2.HealthCheckRequest,
        context: Any,
        send_response_callback: Callable[[Any], None],
    ) -> None:
        """Answer now and whenever the answer changes; it changes once, at the end. No thread waits
        for that.
        """
        with self._lock:
            is_full, is_serving = len(self._watchers) >= WATCHERS, self._serving
            if (
                not is_full
                and is_serving
                and context.add_callback(lambda: self._watchers.pop(send_response_callback, None))
            ):
                self._watchers[send_response_callback] = request.service
        if is_full:
            context.abort(
                grpc.StatusCode.RESOURCE_EXHAUSTED, f"{WATCHERS} callers watch already; call Check"
            )
        send_response_callback(health_pb2.HealthCheckResponse(status=self._status(request.service)))
        if not is_serving:
            send_response_callback(None)

    def _status(self, service: str) -> Any:
        if service not in self._names:
            return health_pb2.HealthCheckResponse.SERVICE_UNKNOWN
        return (
            health_pb2.HealthCheckResponse.SERVING
            if self._serving
            else health_pb2.HealthCheckResponse.NOT_SERVING
        )


class Messages:
    """Messages that calls wait for: a caller that never sends one holds a thread, so there is a
    most of them and a longest time.
    """

    def __init__(self, most: int) -> None:
        self._most, self._lock = most, threading.Lock()
        self._awaited: dict[Any, float] = {}  # the longest waiting first

    def next(self, messages: Iterator[bytes], context: Any) -> bytes | None:
        """Return a call's next message; None where there is no more."""
        with self._lock:
            self._awaited[context] = time.monotonic()
            oldest = next(iter(self._awaited)) if len(self._awaited) > self._most else None
        if oldest is not None:
            oldest.cancel()
        try:
            return next(messages, None)
        finally:
            with self._lock:
                self._awaited.pop(context, None)

    def expire(self) -> None:
        """End the calls whose message takes too long."""
        with self._lock:
            late = [
                context
                for context, since_s in self._awaited.items()
                if time.monotonic() - since_s > MESSAGE_S
            ]
        for context in late:
            context.cancel()


class Gate(grpc.ServerInterceptor):  # type: ignore[misc]  # grpc has no types
    """What every call passes: the token, then its message, then a place among those that are worked
    on.

    gRPC reads a message on the thread that shall answer it. So calls are registered as streams of
    messages, which are the same on the wire, and read here, where a message that never comes has a
    limit.

    Args:
        token: None: whoever calls is let in.
        workers: Calls that are worked on at the same time.
    """

    def __init__(self, token: str | None, workers: int) -> None:
        self._wanted = None if token is None else f"Bearer {token}".encode()
        self._places = threading.Semaphore(workers)
        self._messages, self._light_messages = Messages(AWAITED), Messages(LIGHT_AWAITED)
        self._light_pool = ThreadPoolExecutor(LIGHT, thread_name_prefix="serve-light")
        self._refuse = grpc.stream_unary_rpc_method_handler(self._light(unauthenticated))

    def intercept_service(self, continuation: Callable[[Any], Any], details: Any) -> Any:
        """Return what answers a call: refused without the token, health and reflection on threads
        of their own.
        """
        if not (
            details.method.startswith(OPEN_CALLS) or self._lets_in(details.invocation_metadata)
        ):
            return self._refuse
        handler = continuation(details)
        if handler is None:
            return None
        write = handler.response_serializer
        if handler.request_streaming:
            return grpc.stream_stream_rpc_method_handler(
                self._light(partial(self._exchange, handler)), None, write
            )
        if handler.response_streaming:
            behaviour = self._light(partial(self._watch, handler))
            behaviour.experimental_non_blocking = True  # type: ignore[attr-defined]  # gRPC's own health service relies on it too
            return grpc.stream_stream_rpc_method_handler(behaviour, None, write)
        if details.method.startswith(LIGHT_CALLS):
            return grpc.stream_unary_rpc_method_handler(
                self._light(partial(self._answer_at_once, handler)), None, write
            )
        return grpc.stream_unary_rpc_method_handler(partial(self._answer, handler), None, write)

    def expire(self) -> None:
        """End what waits for a message for too long."""
        self._messages.expire()
        self._light_messages.expire()

    def close(self) -> None:
        """Let the threads go; calls have ended by now."""
        self._light_pool.shutdown(wait=False)

    def _lets_in(self, metadata: Any) -> bool:
        if self._wanted is None:
            return True
        given = dict(metadata or ()).get("authorization", "")
        return hmac.compare_digest(
            given.encode() if isinstance(given, str) else given, self._wanted
        )

    def _light(self, behaviour: Callable[..., Any]) -> partial[Any]:
        made = partial(behaviour)
        made.experimental_thread_pool = self._light_pool  # type: ignore[attr-defined]
        return made

    def _answer(self, handler: Any, messages: Iterator[bytes], context: Any) -> Any:
        request = parsed(handler, self._messages.next(messages, context), context)
        try:
            with CallTime(context).holding(self._places):
                return handler.unary_unary(request, context)
        except Late as late:
            context.abort(grpc.StatusCode.CANCELLED, str(late))

    def _answer_at_once(self, handler: Any, messages: Iterator[bytes], context: Any) -> Any:
        return handler.unary_unary(
            parsed(handler, self._light_messages.next(messages, context), context), context
        )

    def _watch(
        self,
        handler: Any,
        messages: Iterator[bytes],
        context: Any,
        send_response_callback: Callable[[Any], None],
    ) -> None:
        request = parsed(handler, self._light_messages.next(messages, context), context)
        handler.unary_stream(request, context, send_response_callback)

    def _exchange(self, handler: Any, messages: Iterator[bytes], context: Any) -> Iterator[Any]:
        following = iter(partial(self._light_messages.next, messages, context), None)
        return handler.stream_stream(  # type: ignore[no-any-return]
            (parsed(handler, data, context) for data in following), context
        )


def unauthenticated(messages: Iterator[bytes], context: Any) -> None:
    """Refuse a call; its message is not waited for."""
    context.abort(grpc.StatusCode.UNAUTHENTICATED, "send metadata 'authorization: Bearer TOKEN'")


def parsed(handler: Any, data: bytes | None, context: Any) -> Any:
    """Return a call's message, or answer INVALID_ARGUMENT."""
    try:
        if data is not None:
            return handler.request_deserializer(data)
    except DecodeError:
        context.abort(
            grpc.StatusCode.INVALID_ARGUMENT,
            f"{len(data or b'')} bytes that are no message of this call",
        )
    context.abort(grpc.StatusCode.INVALID_ARGUMENT, "a call without its message")
