"""Call and serve the services generically, and let them be asked what they are.

The methods are read off the compiled descriptors, the path from `SERVICE_PATHS`. No generated
``_pb2_grpc`` modules are needed: a path, a serialiser and a parser are all that gRPC wants.

``grpcurl`` and the like ask a server for its services and messages (reflection). They must see the
names that are dialled (``nre.grpc.protos.sensorsim.SensorsimService``), not our private packages.
So every file is copied with its package renamed into a separate pool; protobuf's default pool never
holds AlpaSim's names, and AlpaSim's own package can be imported into the same process.
"""

import logging
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import grpc
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    FileDescriptorProto,
    ServiceDescriptorProto,
)
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message import DecodeError, Message
from google.protobuf.message_factory import GetMessageClass

from . import MODULES, SERVICE_PATHS, reflection_pb2

MESSAGE_BYTES = 64 << 20  # AlpaSim opens its renderer channels with this limit, both ways
OPTIONS: tuple[tuple[str, int], ...] = (
    ("grpc.max_receive_message_length", MESSAGE_BYTES),
    ("grpc.max_send_message_length", MESSAGE_BYTES),
)
LOOPBACK = re.compile(r"(127\.[0-9.]+|localhost|\[::1\]):[0-9]+|unix:.*")
#: What gRPC says, as UNKNOWN or INTERNAL, where a connection broke in the middle of a call.
BROKEN_TRANSPORT = ("Stream removed", "Connection reset", "RST_STREAM", "Socket closed", "GOAWAY")
#: Packages as AlpaSim names them, by the last part of ours; "" is no package.
PACKAGES = {
    "common": "common",
    "controller": "controller",
    "egodriver": "egodriver",
    "health": "grpc.health.v1",
    "logging": "logging",
    "physics": "physics",
    "reflection": "grpc.reflection.v1",
    "runtime": "",
    "sensorsim": "nre.grpc.protos.sensorsim",
    "traffic": "traffic",
    "video_model": "omnidreams.video_model",
}
OURS = ".simrun.wire."
V1ALPHA = "/grpc.reflection.v1alpha.ServerReflection/"
NOT_FOUND = grpc.StatusCode.NOT_FOUND.value[0]
UNIMPLEMENTED = grpc.StatusCode.UNIMPLEMENTED.value[0]
UNREADABLE = object()  # in place of a message that cannot be read

log = logging.getLogger("simrun.serve")


def channel_options(target: str) -> list[tuple[str, int]]:
    """Return the options of a channel: one to this machine goes through no proxy, whatever
    ``http_proxy`` says.
    """
    is_here = LOOPBACK.fullmatch(target) is not None
    return [*OPTIONS, *([("grpc.enable_http_proxy", 0)] if is_here else [])]


def is_lost_connection(error: Any) -> bool:
    """Tell whether a call failed because its peer is away, or went away, and not by the peer's own
    answer.
    """
    code = error.code()
    text = error.details() or ""
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


def handlers(
    service: str, implementation: object, prefix: str | None = None
) -> grpc.GenericRpcHandler:
    """Return the handler of a service for `grpc.Server.add_generic_rpc_handlers`.

    Args:
        service: Name of the service, as in `SERVICE_PATHS`.
        implementation: Has a method ``name(request, context)`` for each call that it serves; the
            others answer UNIMPLEMENTED.
        prefix: Path to serve under instead of the service's own.
    """
    made = {}
    for method in methods(service).values():
        serve = getattr(implementation, method.name, None)
        if serve is not None:
            handler = getattr(grpc, f"{method.arity}_rpc_method_handler")
            is_one_message = method.arity.startswith("unary")
            made[method.name] = handler(
                partial(_answered, serve, method.path) if is_one_message else serve,
                request_deserializer=(
                    partial(_read, method.request) if is_one_message else method.request.FromString
                ),
                response_serializer=method.response.SerializeToString,
            )
    return grpc.method_handlers_generic_handler((prefix or SERVICE_PATHS[service]).strip("/"), made)


def _read(kind: type[Message], data: bytes) -> object:
    """Return a message, or `UNREADABLE` for what is no message of its kind: gRPC would log each with
    its traceback, and any client may send some.
    """
    try:
        return kind.FromString(data)
    except DecodeError:
        return UNREADABLE


def _answered(
    serve: Callable[[Any, Any], Any], path: str, request: object, context: grpc.ServicerContext
) -> Any:
    """Answer a call, or refuse one whose message cannot be read."""
    if request is UNREADABLE:
        log.warning("%s: a message that is no protobuf of this call", path)
        text = f"{path}: the message is no protobuf of this call"
        context.abort(grpc.StatusCode.INVALID_ARGUMENT, text)
    return serve(request, context)


@lru_cache(maxsize=1)
def public_pool() -> DescriptorPool:
    """Return a pool with every message and service under the names that AlpaSim uses."""
    pool = DescriptorPool()
    files = {module.DESCRIPTOR.name: module.DESCRIPTOR for module in MODULES}
    done: set[str] = set()

    def add(file: FileDescriptor) -> None:
        if file.name in done:
            return
        done.add(file.name)
        for needed in file.dependencies:
            add(needed)
        pool.AddSerializedFile(renamed(file).SerializeToString())

    for file in files.values():
        add(file)
    return pool


def renamed(file: FileDescriptor) -> FileDescriptorProto:
    """Return a file with AlpaSim's package in place of ours, in its own name and in every
    reference.
    """
    proto = FileDescriptorProto()
    file.CopyToProto(proto)
    proto.package = PACKAGES[proto.package.rsplit(".", 1)[1]]
    for message in proto.message_type:
        _rename_fields(message)
    for service in proto.service:
        for method in service.method:
            method.input_type, method.output_type = (
                public_name(method.input_type),
                public_name(method.output_type),
            )
    return proto


def public_name(name: str) -> str:
    """Return AlpaSim's name of one of our messages, both with a leading dot.

    Example:
        >>> public_name(".simrun.wire.sensorsim.CameraSpec"), public_name(".simrun.wire.runtime.RolloutSpec")
        ('.nre.grpc.protos.sensorsim.CameraSpec', '.RolloutSpec')
    """
    package, _, message = name.removeprefix(OURS).partition(".")
    public = PACKAGES[package]
    return f".{public}.{message}" if public else f".{message}"


def _rename_fields(message: DescriptorProto) -> None:
    for field in message.field:
        if field.type_name:
            field.type_name = public_name(field.type_name)
    for nested in message.nested_type:
        _rename_fields(nested)


class Reflection:
    """The reflection service for some services.

    Args:
        services: Names as in `SERVICE_PATHS`; reflection itself is added.
    """

    def __init__(self, services: Iterable[str]) -> None:
        self.names = sorted(
            SERVICE_PATHS[name].strip("/") for name in {*services, "ServerReflection"}
        )

    def handlers(self) -> tuple[grpc.GenericRpcHandler, ...]:
        """Return the handlers of both versions of the protocol, which are equal on the wire."""
        return handlers("ServerReflection", self), handlers("ServerReflection", self, V1ALPHA)

    def ServerReflectionInfo(
        self, requests: Iterator[reflection_pb2.ServerReflectionRequest], context: Any
    ) -> Iterator[reflection_pb2.ServerReflectionResponse]:
        """Answer each question of a stream in turn."""
        for request in requests:
            yield self.answer(request)

    def answer(
        self, request: reflection_pb2.ServerReflectionRequest
    ) -> reflection_pb2.ServerReflectionResponse:
        """Answer one question."""
        response = reflection_pb2.ServerReflectionResponse(
            valid_host=request.host, original_request=request
        )
        kind = request.WhichOneof("message_request")
        pool = public_pool()
        if kind == "list_services":
            response.list_services_response.service.extend(
                reflection_pb2.ServiceResponse(name=name) for name in self.names
            )
            return response
        if kind not in ("file_by_filename", "file_containing_symbol"):
            response.error_response.error_code = UNIMPLEMENTED
            response.error_response.error_message = "there are no extensions here"
            return response
        find = pool.FindFileByName if kind == "file_by_filename" else pool.FindFileContainingSymbol
        try:
            file = find(getattr(request, kind))
        except KeyError:
            response.error_response.error_code = NOT_FOUND
            response.error_response.error_message = (
                f"{kind}: {getattr(request, kind)!r} is not served here"
            )
            return response
        # The file and all that it imports, which comes later, as clients expect.
        files: dict[str, bytes] = {}
        todo = [file]
        while todo:
            descriptor = todo.pop(0)
            if descriptor.name not in files:
                files[descriptor.name] = descriptor.serialized_pb
                todo.extend(descriptor.dependencies)
        response.file_descriptor_response.file_descriptor_proto.extend(files.values())
        return response
