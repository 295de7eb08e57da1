"""Host services on a port: health, reflection, TLS, a token, and an end that lets running calls finish."""

from __future__ import annotations

import hmac
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent import futures
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.wire import SERVICE_PATHS, health_pb2
from alpasim_plugin.wire.reflection import Reflection
from alpasim_plugin.wire.services import OPTIONS, handlers

DOING = "opening a port"
OPEN_CALLS = (SERVICE_PATHS["Health"],)  # a load balancer has no token


@dataclass(frozen=True)
class Security:
    """How callers are let in.

    Attributes:
        certificate, key: PEM files of this server; both or neither.
        client_ca: PEM file: callers must show a certificate that it signed.
        token: Callers must send ``authorization: Bearer TOKEN``.
    """

    certificate: Path | None = None
    key: Path | None = None
    client_ca: Path | None = None
    token: str | None = None

    def credentials(self) -> Any:
        """Return gRPC's server credentials, or None for plain text.

        Raises:
            InputError: A file is missing, or one of certificate and key.
        """
        if self.certificate is None and self.key is None and self.client_ca is None:
            return None
        if self.certificate is None or self.key is None:
            raise InputError(DOING, "TLS", "one of certificate and key", "give --tls-cert and --tls-key")
        ca = None if self.client_ca is None else read_pem(self.client_ca)
        pair = read_pem(self.key), read_pem(self.certificate)
        return grpc.ssl_server_credentials([pair], root_certificates=ca, require_client_auth=ca is not None)


def read_pem(path: Path) -> bytes:
    """Return a file's bytes, or raise `InputError`."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(DOING, str(path), error.strerror or str(error), "name a PEM file") from error


class Health:
    """The standard health service: the server as a whole (``""``) and every service by its public name."""

    def __init__(self, services: Mapping[str, object]) -> None:
        self._names = {"", *(SERVICE_PATHS[name].strip("/") for name in services)}
        self._serving = True
        self._changed = threading.Condition()

    def stop(self) -> None:
        """Report NOT_SERVING from now on, to watchers as well."""
        with self._changed:
            self._serving = False
            self._changed.notify_all()

    def Check(self, request: health_pb2.HealthCheckRequest, context: Any) -> health_pb2.HealthCheckResponse:
        """Answer once."""
        if request.service not in self._names:
            context.abort(grpc.StatusCode.NOT_FOUND, f"no service {request.service!r} here")
        return health_pb2.HealthCheckResponse(status=self._status(request.service))

    def Watch(self, request: health_pb2.HealthCheckRequest, context: Any) -> Iterator[health_pb2.HealthCheckResponse]:
        """Answer now and whenever the answer changes; it changes once, at the end."""
        yield health_pb2.HealthCheckResponse(status=self._status(request.service))
        with self._changed:
            while self._serving and context.is_active():
                self._changed.wait(0.5)
        yield health_pb2.HealthCheckResponse(status=self._status(request.service))

    def _status(self, service: str) -> Any:
        if service not in self._names:
            return health_pb2.HealthCheckResponse.SERVICE_UNKNOWN
        return health_pb2.HealthCheckResponse.SERVING if self._serving else health_pb2.HealthCheckResponse.NOT_SERVING


class TokenCheck(grpc.ServerInterceptor):  # type: ignore[misc]  # grpc has no types
    """Refuse calls without the token."""

    def __init__(self, token: str) -> None:
        self._wanted = f"Bearer {token}".encode()
        refuse = grpc.unary_unary_rpc_method_handler(
            lambda request, context: context.abort(grpc.StatusCode.UNAUTHENTICATED, "send metadata 'authorization: Bearer TOKEN'")
        )
        self._refuse = refuse

    def intercept_service(self, continuation: Callable[[Any], Any], details: Any) -> Any:
        """Hand the call on if it has the token."""
        given = {key: value for key, value in details.invocation_metadata or ()}.get("authorization", "")
        fine = hmac.compare_digest(given.encode() if isinstance(given, str) else given, self._wanted)
        return continuation(details) if fine or details.method.startswith(OPEN_CALLS) else self._refuse


class Host:
    """A running server.

    Args:
        services: Implementations by the name of the service (`SERVICE_PATHS`).
        listen: ``HOST:PORT``; port 0 takes a free one. Or ``unix:PATH``.
        security: TLS and token.
        workers: Calls that run at the same time; further ones wait.
        every: Called every `every_s` seconds, such as to forget what is old.

    Raises:
        InfrastructureError: The port cannot be had.
    """

    def __init__(
        self,
        services: Mapping[str, object],
        listen: str,
        security: Security = Security(),
        workers: int = 16,
        every: Callable[[], None] | None = None,
        every_s: float = 5.0,
    ) -> None:
        self.health = Health(services)
        interceptors = () if security.token is None else (TokenCheck(security.token),)
        # No maximum_concurrent_rpcs: beyond it gRPC answers RESOURCE_EXHAUSTED, which AlpaSim does not retry. Calls wait instead.
        pool = futures.ThreadPoolExecutor(workers, thread_name_prefix="serve")
        self._server = grpc.server(pool, options=[*OPTIONS, ("grpc.so_reuseport", 0)], interceptors=interceptors)
        made = [handlers(name, service) for name, service in services.items()]
        self._server.add_generic_rpc_handlers((*made, handlers("Health", self.health), *Reflection([*services, "Health"]).handlers()))
        host, _, port = listen.rpartition(":")
        is_socket = listen.startswith("unix:")
        credentials = security.credentials()
        try:
            if not is_socket and (not host or not port.isdigit()):
                raise InputError(DOING, f"--listen {listen}", "no HOST:PORT", "write for example 127.0.0.1:50051, or unix:PATH")
            add = self._server.add_insecure_port(listen) if credentials is None else self._server.add_secure_port(listen, credentials)
        except RuntimeError as error:
            raise InfrastructureError(DOING, listen, str(error), "choose a free port and an address of this machine") from error
        self.address = listen if is_socket else f"{host}:{add}"
        self._ended = threading.Event()
        self._every, self._every_s = every, every_s
        self._upkeep: threading.Thread | None = None

    def start(self) -> Host:
        """Accept calls."""
        self._server.start()
        if self._every is not None:
            self._upkeep = threading.Thread(target=self._repeat, daemon=True, name="serve-upkeep")
            self._upkeep.start()
        return self

    def wait(self) -> None:
        """Wait for the end; a signal interrupts it."""
        while not self._ended.wait(0.5):
            pass

    def stop(self, drain_s: float = 30.0) -> None:
        """Refuse new calls (UNAVAILABLE), let running ones finish within ``drain_s``, and close the port."""
        self.health.stop()
        self._server.stop(drain_s).wait()
        self._ended.set()
        if self._upkeep is not None:
            self._upkeep.join()

    def __enter__(self) -> Host:
        return self.start()

    def __exit__(self, *failure: object) -> None:
        self.stop(0.0 if failure[0] is not None else 5.0)

    def _repeat(self) -> None:
        assert self._every is not None
        while not self._ended.wait(self._every_s):
            self._every()


def is_loopback(listen: str) -> bool:
    """Tell whether an address can only be reached from this machine.

    Example:
        >>> is_loopback("127.0.0.1:50051"), is_loopback("[::1]:0"), is_loopback("0.0.0.0:50051")
        (True, True, False)
    """
    host = listen.rpartition(":")[0]
    return host in ("localhost", "[::1]") or host.startswith("127.")
