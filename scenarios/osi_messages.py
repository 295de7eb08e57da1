"""Messages of the Open Simulation Interface, as far as they are read here: a subset of names, field
numbers and types of OSI 3, and the file that holds them.

Fields that are not listed are skipped, in either version of the wire's syntax.

Source: ASAM OSI 3.7, osi_groundtruth, osi_sensorview, osi_object, osi_lane, osi_common; trace files
have a length of four bytes, little-endian, before each message.
"""

from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError

from alpasim_plugin.core.errors import InputError
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
}
UNREAD = ("stationary_object", "traffic_sign", "traffic_light", "road_marking")


def ground_truths(files: SourceFiles, path: Path) -> Iterator[Any]:
    """Yield the messages of a trace as `GroundTruth`, in file order; of a trace of `SensorView` the
    ground truth in it.

    Raises:
        InputError: A message is broken, or the file ends inside one.
    """
    data = files.read_bytes(path)
    truth, view = message_classes()
    start = 0
    number = 0
    while start < len(data):
        length = int.from_bytes(data[start : start + 4], "little")
        part = data[start + 4 : start + 4 + length]
        where = f"{path}, message {number}"
        if len(part) < length or length == 0:
            found = f"{len(part)} of {length} bytes"
            raise InputError(f"{where}: {found}", "fetch the file again; it may be truncated")
        try:
            message = truth.FromString(part)
            # In a view the same number holds a mounting position, whose parts have other types.
            if not any(one.base.HasField("position") for one in message.moving_object):
                inside = view.FromString(part)
                if inside.HasField("global_ground_truth"):
                    message = inside.global_ground_truth
        except DecodeError as error:
            raise InputError(
                f"{where}: no readable OSI message", "give a binary .osi trace"
            ) from error
        yield message
        start += 4 + length
        number += 1


@cache
def message_classes() -> tuple[Any, Any]:
    """Return the classes of GroundTruth and SensorView."""
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
    truth, view = (
        message_factory.GetMessageClass(pool.FindMessageTypeByName(f"{PACKAGE}.{name}"))
        for name in ("GroundTruth", "SensorView")
    )
    return truth, view
