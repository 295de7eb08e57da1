"""Fields of a rollout log: the lists hold each field of the wire once, and what is newer is named."""

import struct

from alpasim_plugin.log import read_asl
from alpasim_plugin.log.asl import AslFile, AslReader
from alpasim_plugin.log.fields import ASL, holder_name
from alpasim_plugin.log.wire import logging_pb2

NEWER = b"\xfa\x3e\x02\x08\x01"  # field 1007, two bytes


def messages_that_are_read(message):
    """Yield a message of each kind that the reader looks into."""
    yield message
    for field in message.DESCRIPTOR.fields:
        if field.message_type and f"{holder_name(message)}/{field.name}" in ASL.names():
            yield from messages_that_are_read(field.message_type._concrete_class())


def test_each_field_of_the_wire_is_in_one_list_and_the_lists_have_no_other():
    fields = {
        f"{holder_name(message)}/{field.name}"
        for message in messages_that_are_read(logging_pb2.LogEntry())
        for field in message.DESCRIPTOR.fields
    }
    assert fields == ASL.names() | ASL.names(harmless=True)
    assert not ASL.names() & ASL.names(harmless=True)


def test_a_log_of_this_version_has_no_newer_field(log):
    assert log.warnings == ()


def test_newer_fields_in_what_is_read_are_named_and_others_are_not(path):
    entries = list(AslReader(path))
    with AslFile(path) as file:
        for entry in entries:
            for pose in entry.actor_poses.actor_poses:
                pose.actor_pose.MergeFromString(NEWER)
            if entry.HasField("controller_request"):
                entry.controller_request.MergeFromString(NEWER)
            file.write(entry)
    poses = sum(len(entry.actor_poses.actor_poses) for entry in entries)
    (warning,) = read_asl(path).warnings
    assert warning == f"{path}: rollout log: not read are Pose/field 1007 ({poses})"


def test_an_entry_of_a_newer_kind_is_named_and_the_others_are_read(path, log):
    path.write_bytes(path.read_bytes() + struct.pack(">I", len(NEWER)) + NEWER)
    newer = read_asl(path)
    assert newer.warnings == (f"{path}: rollout log: not read are LogEntry/field 1007 (1)",)
    assert len(newer.images) == len(log.images)
