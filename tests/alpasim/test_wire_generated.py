"""What is checked in is what the compiler writes, and it loads under every protobuf that the
project allows, beside AlpaSim's own.
"""

import json
import subprocess
import sys

import pytest

from tests.alpasim import compile_protos as compiling
from tests.alpasim.wire_environment import environment

PROTOS = compiling.PROTOS
WIRE = PROTOS.parent

# Loads the package from a copy outside the project under another name, as the bridge distribution
# has it, then a foreign file that defines `common.Vec3` into the default pool, and sends a message
# there and back.
LOADING = """
import sys, google.protobuf
sys.path.insert(0, sys.argv[1])
from google.protobuf import descriptor_pb2, descriptor_pool
from bridge import wire
from bridge.wire.services import public_pool
from bridge.wire.services import methods
assert "alpasim_plugin" not in sys.modules
foreign = descriptor_pb2.FileDescriptorProto(name="alpasim_grpc/v0/common.proto", package="common")
foreign.message_type.add(name="Vec3")
descriptor_pool.Default().AddSerializedFile(foreign.SerializeToString())
entry = wire.logging_pb2.LogEntry()
entry.actor_poses.timestamp_us = 1689697803493732
assert wire.logging_pb2.LogEntry.FromString(entry.SerializeToString()) == entry
assert public_pool().FindMessageTypeByName("common.Vec3").fields_by_name["x"].number == 1
assert sum(len(methods(name)) for name in wire.SERVICE_PATHS) == 42
print(google.protobuf.__version__)
"""


def copied(folder):
    """Copy the package to ``folder/bridge/wire``."""
    for source in [*WIRE.glob("*.py"), *PROTOS.glob("*.py")]:
        target = folder / "bridge" / "wire" / source.relative_to(WIRE)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(source.read_bytes())
    return folder


def test_checked_in_modules_belong_to_the_checked_in_sources():
    assert json.loads((PROTOS / compiling.CHECKSUMS).read_text()) == compiling.digests(PROTOS)


def test_a_changed_source_is_noticed(tmp_path):
    for path in [*PROTOS.glob("*.proto"), *PROTOS.glob("*_pb2.py*")]:
        (tmp_path / path.name).write_bytes(path.read_bytes())
    with (tmp_path / "common.proto").open("a") as file:
        file.write("// more\n")
    found = compiling.digests(tmp_path)
    kept = json.loads((PROTOS / compiling.CHECKSUMS).read_text())
    assert {name for name in kept if kept[name] != found[name]} == {"common.proto"}


def test_the_messages_load_under_another_name_beside_foreign_ones(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", LOADING, str(copied(tmp_path))], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.network
@pytest.mark.parametrize("protobuf", ["==4.25.*", "==5.29.*", ">=6,<7"])
def test_the_messages_load_under_every_allowed_protobuf(tmp_path, protobuf):
    python = environment(tmp_path / "venv", f"protobuf{protobuf}", "grpcio>=1.62")
    done = subprocess.run(
        [python, "-c", LOADING, str(copied(tmp_path))], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(protobuf.lstrip("=>")[0])


@pytest.mark.slow
@pytest.mark.network
def test_the_compiler_writes_what_is_checked_in(tmp_path):
    python = environment(tmp_path / "venv", f"grpcio-tools=={compiling.GENERATOR}", "setuptools<81")
    out = tmp_path / "out"
    out.mkdir()
    subprocess.run([python, compiling.__file__, str(out)], check=True)
    names = [compiling.CHECKSUMS, *compiling.digests(PROTOS)]
    assert {name: (out / name).read_bytes() for name in names} == {
        name: (PROTOS / name).read_bytes() for name in names
    }
