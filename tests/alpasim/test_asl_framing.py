"""Framing of rollout logs: any entries survive, a cut tail is told, damage is an error."""

import struct
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.log.asl import AslFile, AslReader
from alpasim_plugin.log.wire import logging_pb2
from tests.examples import examples


def entry(t_us=7, ids=("EGO",)):
    pose = logging_pb2.ActorPoses.ActorPose
    return logging_pb2.LogEntry(
        actor_poses=logging_pb2.ActorPoses(
            timestamp_us=t_us, actor_poses=[pose(actor_id=i) for i in ids]
        )
    )


def write(path, entries):
    with AslFile(path) as file:
        for e in entries:
            file.write(e)
    return path


entries_strategy = st.lists(
    st.builds(entry, st.integers(0, 2**63), st.lists(st.text(max_size=200), max_size=5).map(tuple)),
    min_size=1,
    max_size=8,
)


@settings(max_examples=examples(60), deadline=None)
@given(entries=entries_strategy)
def test_any_entries_come_back_in_order(tmp_path_factory, entries):
    path = write(tmp_path_factory.mktemp("asl") / "a.asl", entries)
    reader = AslReader(path)
    assert list(reader) == entries
    assert not reader.truncated
    assert path.stat().st_size == sum(4 + e.ByteSize() for e in entries)


@settings(max_examples=examples(60), deadline=None)
@given(entries=entries_strategy, data=st.data())
def test_a_cut_anywhere_loses_only_the_last_entry(
    tmp_path_factory,
    entries,
    data,
):
    path = write(tmp_path_factory.mktemp("asl") / "a.asl", entries)
    whole = path.read_bytes()
    ends = [0]
    for e in entries:
        ends.append(ends[-1] + 4 + e.ByteSize())
    cut = data.draw(st.integers(1, len(whole) - 1))
    path.write_bytes(whole[:cut])
    reader = AslReader(path)
    kept = [e for e, end in zip(entries, ends[1:], strict=True) if end <= cut]
    assert list(reader) == kept
    if cut in ends:
        assert not reader.truncated
    else:
        assert f"at byte {ends[len(kept)]}; {len(kept)} whole" in reader.truncated


def test_length_is_big_endian(tmp_path):
    path = write(tmp_path / "a.asl", [entry()])
    assert (
        struct.unpack(">I", path.read_bytes()[:4])[0]
        == entry().ByteSize()
        == len(path.read_bytes()) - 4
    )


def test_garbage_in_the_middle_is_an_error_with_its_place(tmp_path):
    path = write(tmp_path / "a.asl", [entry(), entry(), entry()])
    size = 4 + entry().ByteSize()
    data = bytearray(path.read_bytes())
    data[size + 4 : 2 * size] = b"\xff" * (size - 4)
    path.write_bytes(bytes(data))
    with pytest.raises(InputError, match="no log entry") as caught:
        list(AslReader(path))
    assert f"entry 1 at byte {size + 4}" in caught.value.message


@pytest.mark.parametrize("length", [0, 2**31])
def test_impossible_length_is_an_error(tmp_path, length):
    path = write(tmp_path / "a.asl", [entry()])
    with path.open("ab") as stream:
        stream.write(struct.pack(">I", length) + bytes(50))
    with pytest.raises(InputError, match=f"a length of {length} bytes"):
        list(AslReader(path))


def test_empty_and_missing_files_are_errors(tmp_path):
    (tmp_path / "a.asl").write_bytes(b"")
    with pytest.raises(InputError, match="an empty file"):
        list(AslReader(tmp_path / "a.asl"))
    with pytest.raises(InputError, match="no such file"):
        list(AslReader(tmp_path / "b.asl"))


def test_entry_of_a_future_kind_is_passed_on_unnamed(tmp_path):
    body = b"\xfa\x01\x02\x08\x01"  # field 31, two bytes
    (tmp_path / "a.asl").write_bytes(struct.pack(">I", len(body)) + body)
    assert [e.WhichOneof("log_entry") for e in AslReader(tmp_path / "a.asl")] == [None]


def test_name_appears_only_when_finished(tmp_path):
    file = AslFile(tmp_path / "a.asl")
    file.write(entry())
    assert [p.name for p in tmp_path.iterdir()] == ["a.asl.part"]
    file.finish()
    assert [p.name for p in tmp_path.iterdir()] == ["a.asl"]
    file.finish()
    with pytest.raises(InfrastructureError, match="already finished"):
        file.write(entry())


def test_failed_writer_leaves_a_readable_part_and_no_log(tmp_path):
    def fail():
        with AslFile(tmp_path / "a.asl") as file:
            file.write(entry())
            raise RuntimeError("the rollout broke")

    with pytest.raises(RuntimeError, match="the rollout broke"):
        fail()
    assert not (tmp_path / "a.asl").exists()
    assert list(AslReader(tmp_path / "a.asl.part")) == [entry()]


def test_failed_attempt_does_not_touch_a_finished_log(tmp_path):
    write(tmp_path / "a.asl", [entry(1)])
    second = AslFile(tmp_path / "a.asl")
    second.write(entry(2))
    second.abandon()
    assert list(AslReader(tmp_path / "a.asl")) == [entry(1)]


def test_full_disk_is_an_infrastructure_failure():
    device = Path("/dev/full")
    if not device.exists():
        pytest.skip("this system has no /dev/full")
    file = AslFile.__new__(AslFile)
    file.path, file.partial, file.entries = device, device, 0
    file._stream = device.open("wb")
    file.write(entry())
    with pytest.raises(InfrastructureError, match="No space left") as caught:
        file.finish()
    assert caught.value.exit_code == 4
    file.abandon()


def test_missing_folder_is_an_infrastructure_failure(tmp_path):
    with pytest.raises(InfrastructureError, match="No such file or directory"):
        AslFile(tmp_path / "absent" / "a.asl")
