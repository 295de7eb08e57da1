"""Call and serve the services generically.

The methods are read off the compiled descriptors, the path from `SERVICE_PATHS`. No generated
``_pb2_grpc`` modules are needed: a path, a serialiser and a parser are all that gRPC wants.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import grpc
from google.protobuf.descriptor_pb2 import ServiceDescriptorProto
from google.protobuf.message import Message
from google.protobuf.message_factory import GetMessageClass

from . import MODULES, SERVICE_PATHS

MESSAGE_BYTES = 64 << 20  # AlpaSim opens its renderer channels with this limit, both ways
OPTIONS: tuple[tuple[str, int], ...] = (
    ("grpc.max_receive_message_length", MESSAGE_BYTES),
    ("grpc.max_send_message_length", MESSAGE_BYTES),
)


#: What gRPC says, as UNKNOWN or INTERNAL, where a connection broke in the middle of a call.
BROKEN_TRANSPORT = ("Stream removed", "Connection reset", "RST_STREAM", "Socket closed", "GOAWAY")


def is_lost_connection(error: Any) -> bool:
    """Tell whether a call failed because its peer is away, or went away, and not by the peer's own
    answer.
    """
    code, text = error.code(), error.details() or ""
    broken = code in (grpc.StatusCode.UNKNOWN, grpc.StatusCode.INTERNAL) and any(
        sign in text for sign in BROKEN_TRANSPORT
    )
    return broken or code in (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.CANCELLED)


@dataclass(frozen=True)
class Method:
    """One call of a service."""

    name: str
    path: str  # "/package.Service/method"
    request: type[Message]
    response: type[Message]
    client_streams: bool = False
    server_streams: bool = False

    @property
    def arity(self) -> str:
        """How gRPC names the call: ``unary_unary``, ``unary_stream``, ``stream_stream``,
        ``stream_unary``.
        """
        return "_".join(
            "stream" if streams else "unary"
            for streams in (self.client_streams, self.server_streams)
        )


@lru_cache
def methods(service: str) -> Mapping[str, Method]:
    """Return the calls of a service by name.

    Raises:
        KeyError: No service of that name.

    Example:
        >>> methods("EgodriverService")["drive"].path
        '/egodriver.EgodriverService/drive'
    """
    prefix = SERVICE_PATHS[service]
    descriptor = next(
        d
        for module in MODULES
        if (d := module.DESCRIPTOR.services_by_name.get(service)) is not None
    )
    written = ServiceDescriptorProto()
    descriptor.CopyToProto(written)
    return {
        m.name: Method(
            m.name,
            prefix + m.name,
            GetMessageClass(m.input_type),
            GetMessageClass(m.output_type),
            p.client_streaming,
            p.server_streaming,
        )
        for m, p in zip(descriptor.methods, written.method, strict=True)
    }


class Stub:
    """Client of one service: every call is an attribute, as on a generated stub.

    Args:
        channel: An open channel; `grpc.aio` channels work as well.
        service: Name of the service, as in `SERVICE_PATHS`.

    Example:
        >>> with grpc.insecure_channel("127.0.0.1:1") as channel:
        ...     callable(Stub(channel, "EgodriverService").drive)
        True
    """

    def __init__(self, channel: Any, service: str) -> None:
        for method in methods(service).values():
            call = getattr(channel, method.arity)
            serialise = method.request.SerializeToString
            setattr(
                self,
                method.name,
                call(
                    method.path,
                    request_serializer=serialise,
                    response_deserializer=method.response.FromString,
                ),
            )

    def __getattr__(self, name: str) -> Callable[..., Any]:
        raise AttributeError(f"the service has no call {name!r}")


def handlers(service: str, implementation: object) -> grpc.GenericRpcHandler:
    """Return the handler of a service for `grpc.Server.add_generic_rpc_handlers`.

    Args:
        service: Name of the service, as in `SERVICE_PATHS`.
        implementation: Has a method ``name(request, context)`` for each call that it serves; the
            others answer UNIMPLEMENTED.
    """
    made = {}
    for method in methods(service).values():
        serve = getattr(implementation, method.name, None)
        if serve is not None:
            handler = getattr(grpc, f"{method.arity}_rpc_method_handler")
            made[method.name] = handler(
                serve,
                request_deserializer=method.request.FromString,
                response_serializer=method.response.SerializeToString,
            )
    return grpc.method_handlers_generic_handler(SERVICE_PATHS[service].strip("/"), made)
