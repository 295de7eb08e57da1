"""The wire messages equal AlpaSim's in number, type and byte."""

from google.protobuf.unknown_fields import UnknownFieldSet

from alpasim_plugin.log import wire
from alpasim_plugin.log.asl import AslReader

GRPC = ("health_pb2", "reflection_pb2")  # gRPC's own services
MODULES = [
    getattr(wire, name) for name in wire.__all__ if name.endswith("_pb2") and name not in GRPC
]


def messages(descriptors):
    for descriptor in descriptors:
        if not descriptor.GetOptions().map_entry:
            yield descriptor
            yield from messages(list(descriptor.nested_types))


def all_messages():
    return [
        m
        for module in MODULES
        for m in messages(list(module.DESCRIPTOR.message_types_by_name.values()))
    ]


def test_counts_are_those_of_the_published_interface():
    """0.54.0 has 108 messages and 357 fields; `ScenePrefetchRequest` (twice) and two fields of
    `RolloutSpec` are newer.
    """
    assert len(all_messages()) == 108 + 2
    assert sum(len(m.fields) for m in all_messages()) == 357 + 2 + 2
    assert sum(len(module.DESCRIPTOR.services_by_name) for module in MODULES) == 7
    top = sum(len(module.DESCRIPTOR.enum_types_by_name) for module in MODULES)
    assert top + sum(len(m.enum_types) for m in all_messages()) == 10


def test_packages_are_private():
    assert all(m.full_name.startswith("simrun.wire.") for m in all_messages())


def test_every_service_has_the_path_that_is_dialled():
    services = {name for module in MODULES for name in module.DESCRIPTOR.services_by_name}
    assert services | {"Health", "ServerReflection"} == set(wire.SERVICE_PATHS)


def test_time_stamps_are_eight_fixed_bytes():
    entry = wire.logging_pb2.LogEntry()
    entry.actor_poses.timestamp_us = 1_689_697_803_493_732
    stamp = (1_689_697_803_493_732).to_bytes(8, "little")
    assert entry.SerializeToString() == b"\x12\x09" + b"\x09" + stamp


def test_foreign_entries_come_back_byte_for_byte(shared_data):
    """Parsing and serialising again changes nothing, and no field is unknown at the top."""
    logs = sorted((shared_data / "alpasim-golden" / "rollouts").rglob("rollout.asl"))
    kinds = set()
    for log in logs[::7]:
        data = log.read_bytes()
        at = 0
        for entry in AslReader(log):
            size = int.from_bytes(data[at : at + 4], "big")
            assert entry.SerializeToString() == data[at + 4 : at + 4 + size]
            kind = entry.WhichOneof("log_entry")
            assert not UnknownFieldSet(getattr(entry, kind))
            kinds.add(kind)
            at += 4 + size
        assert at == len(data)
    assert len(kinds) == 16
