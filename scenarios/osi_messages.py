"""Messages of the Open Simulation Interface, as far as they are read here: a subset of names, field
numbers and types of OSI 3, and the file that holds them.

Of other fields those of the first message are named, in either version of the wire's syntax.

Source: ASAM OSI 3.7, osi_groundtruth, osi_sensorview, osi_object, osi_lane, osi_common; trace files
have a length of four bytes, little-endian, before each message, or are MCAP.
"""

import io
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError, Message
from google.protobuf.unknown_fields import UnknownFieldSet

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import parsing
from alpasim_plugin.core.files.fields import Fields, field_name
from alpasim_plugin.core.lazy import require_library
from scenarios.recorded import SourceFiles

PACKAGE = "simrun.osi"
# Message to its fields: name, number, type; a star stands for a repeated one.
FIELDS = {
    "Identifier": ("value 1 uint64",),
    "Timestamp": ("seconds 1 int64", "nanos 2 uint32"),
    "Vector": ("x 1 double", "y 2 double", "z 3 double"),
    "Dimension": ("length 1 double", "width 2 double", "height 3 double"),
    "Orientation": ("roll 1 double", "pitch 2 double", "yaw 3 double"),
    "Base": ("dimension 1 Dimension", "position 2 Vector", "orientation 3 Orientation"),
    "Attributes": ("bbcenter_to_rear 4 Vector", "bbcenter_to_front 5 Vector"),
    "VehicleClass": ("type 1 int32",),
    "MovingObject": (
        "id 1 Identifier",
        "base 2 Base",
        "type 3 int32",
        "vehicle_attributes 5 Attributes",
        "vehicle_classification 6 VehicleClass",
    ),
    "BoundaryPoint": ("position 1 Vector",),
    "BoundaryClass": ("type 1 int32", "color 2 int32"),
    "LaneBoundary": (
        "id 1 Identifier",
        "boundary_line 2 *BoundaryPoint",
        "classification 3 BoundaryClass",
    ),
    "LanePairing": ("antecessor_lane_id 1 Identifier", "successor_lane_id 2 Identifier"),
    "LaneClass": (
        "type 1 int32",
        "centerline 3 *Vector",
        "centerline_is_driving_direction 4 bool",
        "left_adjacent_lane_id 5 *Identifier",
        "right_adjacent_lane_id 6 *Identifier",
        "lane_pairing 7 *LanePairing",
        "right_lane_boundary_id 8 *Identifier",
        "left_lane_boundary_id 9 *Identifier",
        "subtype 12 int32",
    ),
    "Lane": ("id 1 Identifier", "classification 2 LaneClass"),
    "Unread": (),
    "GroundTruth": (
        "timestamp 2 Timestamp",
        "host_vehicle_id 3 Identifier",
        "stationary_object 4 *Unread",
        "moving_object 5 *MovingObject",
        "traffic_sign 6 *Unread",
        "traffic_light 7 *Unread",
        "road_marking 8 *Unread",
        "lane_boundary 9 *LaneBoundary",
        "lane 10 *Lane",
    ),
    "SensorView": ("global_ground_truth 7 GroundTruth", "host_vehicle_id 8 Identifier"),
    "Detected": ("base 2 Base",),
    "SensorData": ("sensor_view 8 *SensorView", "moving_object 13 *Detected"),
    "TrafficUpdate": ("update 3 *MovingObject",),
}
TRUTH_KINDS = ("GroundTruth", "SensorView")
MCAP_SCHEMAS = tuple(f"osi3.{name}" for name in TRUTH_KINDS)
# Fields of OSI 3.8 that are not in `FIELDS`, by their number.
OTHERS = {
    "GroundTruth": """1 version 11 occupant 12 environmental_conditions 13 country_code
        14 proj_string 15 map_reference 16 model_reference 17 reference_line
        18 logical_lane_boundary 19 logical_lane 20 proj_frame_offset""",
    "MovingObject": """4 assigned_lane_id 7 model_reference 8 future_trajectory
        9 moving_object_classification 10 source_reference 11 color_description
        12 pedestrian_attributes""",
    "Base": """4 velocity 5 acceleration 6 orientation_rate 7 base_polygon
        8 orientation_acceleration 9 bounding_box_section""",
    "Attributes": """1 driver_id 2 radius_wheel 3 number_wheels 6 ground_clearance 7 wheel_data
        8 steering_wheel_angle""",
    "VehicleClass": "2 light_state 3 has_trailer 4 trailer_id 5 role",
    "Lane": "3 source_reference",
    "LaneClass": "2 is_host_vehicle_lane 10 free_lane_boundary_id 11 road_condition",
    "LaneBoundary": "4 source_reference 5 color_description",
    "BoundaryPoint": "2 width 3 height 4 dash",
    "BoundaryClass": "3 limiting_structure_id",
}
OSI = Fields(
    "OSI",
    read={
        name: " ".join(text.split()[0] for text in fields)
        for name, fields in FIELDS.items()
        if fields and name not in ("Detected", "SensorData", "TrafficUpdate")
    },
    harmless={
        # Coordinates are local; motion is that of the places; what stands beside the road and the
        # logical view of the lanes change no drive.
        "GroundTruth": """version occupant country_code proj_string map_reference model_reference
            reference_line logical_lane_boundary logical_lane""",
        "MovingObject": """assigned_lane_id model_reference future_trajectory source_reference
            color_description pedestrian_attributes""",
        "Base": "velocity acceleration orientation_rate orientation_acceleration base_polygon",
        "Attributes": """driver_id radius_wheel number_wheels ground_clearance wheel_data
            steering_wheel_angle""",
        "VehicleClass": "light_state role",
        "Lane": "source_reference",
        "LaneClass": "is_host_vehicle_lane free_lane_boundary_id road_condition",
        "LaneBoundary": "source_reference color_description",
        "BoundaryPoint": "width height dash",
        "BoundaryClass": "limiting_structure_id",
    },
)
UNREAD = ("stationary_object", "traffic_sign", "traffic_light", "road_marking")


@dataclass(frozen=True)
class Truth:
    """A ground truth, and the host vehicle of the view that holds it; None where none is named."""

    message: Any
    host: int | None


def ground_truths(files: SourceFiles, path: Path) -> Iterator[Truth]:
    """Yield the messages of a trace as `GroundTruth`, in file order; of a trace of `SensorView` the
    ground truth in it.

    Raises:
        InputError: A message is broken or of another kind, or the file ends inside one.
    """
    data = files.read_bytes(path)
    parts = _in_mcap(data, path) if path.suffix == ".mcap" else _in_trace(data, path)
    classes = message_classes()
    for number, part in enumerate(parts):
        location = f"{path}, message {number}"
        try:
            yield _truth_of(part, classes, location)
        except DecodeError as error:
            raise InputError(
                f"{location}: no readable OSI message", "give a binary .osi trace"
            ) from error


def _in_trace(data: bytes, path: Path) -> Iterator[bytes]:
    start = 0
    number = 0
    while start < len(data):
        length = int.from_bytes(data[start : start + 4], "little")
        part = data[start + 4 : start + 4 + length]
        if len(part) < length or length == 0:
            fault = f"{path}, message {number}: {len(part)} of {length} bytes"
            raise InputError(fault, "fetch the file again; it may be truncated")
        yield part
        start += 4 + length
        number += 1


def _in_mcap(data: bytes, path: Path) -> list[bytes]:
    """Return the messages of the channel of an MCAP file that holds a ground truth."""
    require_library("mcap", str(path), "Install the extra [mcap], or mcap.")
    from mcap.reader import make_reader

    with parsing(path, "fetch the file again; it may be damaged", "no readable MCAP"):
        listed = [
            (schema.name if schema else "without schema", channel.topic, message.data)
            for schema, channel, message in make_reader(io.BytesIO(data)).iter_messages()
        ]
    topics = sorted({(name, topic) for name, topic, _ in listed})
    read = [topic for topic in topics if topic[0] in MCAP_SCHEMAS]
    if len(read) != 1:
        channels = ", ".join(f"{topic} ({name})" for name, topic in topics) or "no messages"
        raise InputError(
            f"{path}: {len(read)} channels of a ground truth among {channels}",
            f"give a file with one channel of {' or '.join(MCAP_SCHEMAS)}",
        )
    return [part for name, topic, part in listed if (name, topic) == read[0]]


def _truth_of(part: bytes, classes: Mapping[str, Any], location: str) -> Truth:
    """Return the ground truth in a message, by the fields that its kind alone has.

    Raises:
        InputError: It is of a kind without ground truth.
    """
    message = classes["GroundTruth"].FromString(part)
    # In other kinds the same number holds parts of other types.
    if any(entry.base.HasField("position") for entry in message.moving_object):
        return Truth(message, _host_of(message))
    update = classes["TrafficUpdate"].FromString(part)
    if any(entry.base.HasField("position") for entry in update.update):
        raise _without_truth(location, "TrafficUpdate")
    detected = classes["SensorData"].FromString(part)
    if any(entry.base.HasField("position") for entry in detected.moving_object) or any(
        entry.HasField("global_ground_truth") for entry in detected.sensor_view
    ):
        raise _without_truth(location, "SensorData")
    view = classes["SensorView"].FromString(part)
    if not view.HasField("global_ground_truth"):
        return Truth(message, _host_of(message))
    host = _host_of(view)
    inside = view.global_ground_truth
    return Truth(inside, _host_of(inside) if host is None else host)


def met_fields(message: Any) -> Iterator[str]:
    """Yield the names of the fields that a message and those in it have beyond `FIELDS`."""
    kind = message.DESCRIPTOR.name
    names = OTHERS.get(kind, "").split()
    by_number = dict(zip(names[::2], names[1::2], strict=True))
    if kind == "Unread":
        return
    for field in UnknownFieldSet(message):
        number = str(field.field_number)
        yield field_name(kind, by_number.get(number, f"field {number}"))
    for described, value in message.ListFields():
        if described.message_type is not None:
            parts = [value] if isinstance(value, Message) else value
            for part in parts:
                yield from met_fields(part)


def _host_of(message: Any) -> int | None:
    return int(message.host_vehicle_id.value) if message.HasField("host_vehicle_id") else None


def _without_truth(location: str, kind: str) -> InputError:
    return InputError(
        f"{location}: a {kind} message, which holds no ground truth",
        f"record a trace of {' or '.join(TRUTH_KINDS)}",
    )


@cache
def message_classes() -> dict[str, Any]:
    """Return the classes of messages by the names of their kinds."""
    proto = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="simrun/osi.proto", package=PACKAGE)
    for name, fields in FIELDS.items():
        message = file.message_type.add(name=name)
        for text in fields:
            field_name, number, kind = text.split()
            label = proto.LABEL_REPEATED if kind.startswith("*") else proto.LABEL_OPTIONAL
            field = message.field.add(name=field_name, number=int(number), label=label)
            kind = kind.lstrip("*")
            if kind in FIELDS:
                field.type = proto.TYPE_MESSAGE
                field.type_name = f".{PACKAGE}.{kind}"
            else:
                field.type = getattr(proto, f"TYPE_{kind.upper()}")
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return {
        name: message_factory.GetMessageClass(pool.FindMessageTypeByName(f"{PACKAGE}.{name}"))
        for name in (*TRUTH_KINDS, "SensorData", "TrafficUpdate")
    }
