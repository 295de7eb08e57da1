"""A channel to one service, and its failures as errors of the part that it stands for."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, cast, get_args

import grpc

from alpasim_plugin.core.errors import InfrastructureError, InputError, SimrunError
from alpasim_plugin.core.queries import options_of
from alpasim_plugin.log.images import ImageEncoding
from alpasim_plugin.log.wire import common_pb2
from alpasim_plugin.log.wire.services import (
    MESSAGE_BYTES,
    Stub,
    channel_options,
    is_lost_connection,
)

READY_S = 30.0  # how long a service may take to accept its first call
CALL_S = 300.0  # AlpaSim's own deadline of a render
RETRY_S = (0.5, 2.0)  # AlpaSim's own waits before a second and a third attempt
TOO_LARGE = "message larger than max"  # what gRPC says on either side
PASSING_TEXTS = ("Stopped waiting for backend", "A load persistent id instruction was encountered")


@dataclass(frozen=True)
class Address:
    """What stands after ``alpasim://`` or ``nre://``: ``HOST:PORT[?option=value&...]``."""

    target: str
    options: dict[str, str] = field(default_factory=dict)

    @classmethod
    def parse(cls, scheme: str, text: str, option_names: tuple[str, ...]) -> Address:
        """Read an address.

        Example:
            >>> Address.parse("nre", "127.0.0.1:50051?scene=a", ("scene",))
            Address(target='127.0.0.1:50051', options={'scene': 'a'})

        Raises:
            InputError: No host or port, or an unknown option.
        """
        target, _, query = text.partition("?")
        host, _, port = target.rpartition(":")
        options = options_of(query, option_names, f"{scheme}://{text}")
        if not host or not port.isdigit():
            raise InputError(f"{scheme}://{text}: no HOST:PORT", f"write {scheme}://HOST:PORT")
        return cls(target, options)


def encoding_of(address: str, encoding: str) -> ImageEncoding:
    """Return the encoding that an address asks for.

    Raises:
        InputError: It is none that the wire has.
    """
    if encoding not in get_args(ImageEncoding):
        raise InputError(f"{address}: encoding {encoding!r}", "write encoding=jpeg or encoding=png")
    return cast("ImageEncoding", encoding)


class Service:
    """One service behind an address.

    Args:
        name: Name of the service, as in `alpasim_plugin.log.wire.SERVICE_PATHS`.
        target: ``HOST:PORT``.
        error: Class of the errors that a failing call raises; a lost connection is no policy's
            fault: `InfrastructureError`.
        retries: Whether a call that may pass is made again, as AlpaSim does with renders and not
            with drivers.
    """

    def __init__(self, name: str, target: str, error: type[SimrunError], retries: bool) -> None:
        self.name, self.target, self._error, self._retries = name, target, error, retries
        self._channel = grpc.insecure_channel(target, options=channel_options(target))
        self.stub = Stub(self._channel, name)

    def wait_ready(self) -> None:
        """Wait for the service.

        Raises:
            InfrastructureError: Nothing listens there.
        """
        try:
            grpc.channel_ready_future(self._channel).result(timeout=READY_S)
        except grpc.FutureTimeoutError as error:
            raise InfrastructureError(
                f"{self.target}: nothing answers within {READY_S:g} s",
                "start the service, or correct the address",
            ) from error

    def call(
        self, method: str, request: Any, timeout_s: float = CALL_S, at_us: int | None = None
    ) -> Any:
        """Make one call and return its answer.

        Args:
            method: Name of the call.
            request: Its message.
            timeout_s: How long the answer may take.
            at_us: Simulated time, for messages.

        Raises:
            SimrunError: Of the class that the constructor was given: the service answered with an
                error status, or not in time.
            InfrastructureError: Nobody listens there any more, the connection was lost before
                the answer, or a message is larger than the service takes.
        """
        ask: Callable[..., Any] = getattr(self.stub, method)
        for wait_s in (*(RETRY_S if self._retries else ()), None):
            try:
                return ask(request, timeout=timeout_s, wait_for_ready=False)
            except grpc.RpcError as error:
                code = error.code()
                text = error.details() or ""
                passing = code == grpc.StatusCode.UNAVAILABLE or any(
                    phrase in text for phrase in PASSING_TEXTS
                )
                if wait_s is None or not passing:
                    raise self._failure(error, method, at_us) from error
                time.sleep(wait_s)
        raise AssertionError("the last attempt returns or raises")

    def _failure(self, error: Any, method: str, at_us: int | None) -> SimrunError:
        location = (
            self.target if at_us is None else f"{self.target}, at {at_us} us of simulated time"
        )
        problem = f"{self.name}.{method} failed: {error.code().name}: {error.details() or ''}"
        if TOO_LARGE in (error.details() or ""):
            return InfrastructureError(
                f"{location}: {problem}",
                "send smaller images (?encoding=jpeg, a smaller camera), or let the service take "
                f"messages of {MESSAGE_BYTES >> 20} MiB",
            )
        if not is_lost_connection(error) or issubclass(self._error, InfrastructureError):
            return self._error(f"{location}: {problem}", "see the service's own log")
        return InfrastructureError(
            f"{location}: {problem}",
            "see the service's own log, and drive the rollout again with --resume",
        )

    def version(self) -> common_pb2.VersionId:
        """Return the service's version triple, once it is ready."""
        self.wait_ready()
        return self.call("get_version", common_pb2.Empty(), READY_S)

    def close(self) -> None:
        """Close the channel; harmless if closed."""
        self._channel.close()
