"""The wire messages equal AlpaSim's in number, type and byte."""

from __future__ import annotations

import importlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from google.protobuf.descriptor import Descriptor
from google.protobuf.unknown_fields import UnknownFieldSet

from alpasim_plugin.alpasim import wire
from alpasim_plugin.alpasim.asl import AslReader

MODULES = [getattr(wire, name) for name in wire.__all__ if name.endswith("_pb2")]


def messages(descriptors: list[Descriptor]) -> Iterator[Descriptor]:
    for descriptor in descriptors:
        if not descriptor.GetOptions().map_entry:
            yield descriptor
            yield from messages(list(descriptor.nested_types))


def all_messages() -> list[Descriptor]:
    return [m for module in MODULES for m in messages(list(module.DESCRIPTOR.message_types_by_name.values()))]


def test_counts_are_those_of_the_published_interface() -> None:
    assert len(all_messages()) == 108
    assert sum(len(m.fields) for m in all_messages()) == 357
    assert sum(len(module.DESCRIPTOR.services_by_name) for module in MODULES) == 7
    top = sum(len(module.DESCRIPTOR.enum_types_by_name) for module in MODULES)
    assert top + sum(len(m.enum_types) for m in all_messages()) == 10


def test_packages_are_private() -> None:
    assert all(m.full_name.startswith("simrun.wire.") for m in all_messages())


def test_every_service_has_the_path_that_is_dialled() -> None:
    services = {name for module in MODULES for name in module.DESCRIPTOR.services_by_name}
    assert services == set(wire.SERVICE_PATHS)


def test_time_stamps_are_eight_fixed_bytes() -> None:
    entry = wire.logging_pb2.LogEntry()
    entry.actor_poses.timestamp_us = 1_689_697_803_493_732
    stamp = (1_689_697_803_493_732).to_bytes(8, "little")
    assert entry.SerializeToString() == b"\x12\x09" + b"\x09" + stamp


def test_foreign_entries_come_back_byte_for_byte(shared_data: Path) -> None:
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


def test_missing_modules_name_the_command(tmp_path: Path) -> None:
    """A checkout whose messages were never compiled says what to run."""
    package = tmp_path / "alpasim_plugin"
    here = Path(importlib.import_module("alpasim_plugin.errors").__file__ or "").parent
    (package / "alpasim" / "protos").mkdir(parents=True)
    for name in ("errors.py", "alpasim/wire.py", "alpasim/protos/__init__.py"):
        (package / name).write_text((here / name).read_text())
    for folder in (package, package / "alpasim"):
        (folder / "__init__.py").write_text("")
    code = "import alpasim_plugin.alpasim.wire"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env={"PYTHONPATH": str(tmp_path)}, capture_output=True, text=True)
    assert done.returncode != 0
    assert "python setup.py build_protos" in done.stderr
    assert "found: compiled modules are missing" in done.stderr


@pytest.mark.parametrize("editable", [False, True])
def test_build_step_compiles_every_message_file(repo: Path, tmp_path: Path, editable: bool) -> None:
    """The build hook works on a bare copy of the sources, as pip runs it for a wheel and for an editable install."""
    pytest.importorskip("grpc_tools")
    source = tmp_path / "source"
    (source / "alpasim_plugin" / "alpasim" / "protos").mkdir(parents=True)
    (source / "setup.py").write_text((repo / "setup.py").read_text())
    (source / "setup.cfg").write_text(
        "[metadata]\nname = x\nversion = 1\n[options]\npackages = alpasim_plugin, alpasim_plugin.alpasim, alpasim_plugin.alpasim.protos\n"
    )
    protos = sorted((repo / "alpasim_plugin/alpasim/protos").glob("*.proto"))
    for file in protos:
        (source / "alpasim_plugin/alpasim/protos" / file.name).write_text(file.read_text())
    for folder in ("alpasim_plugin", "alpasim_plugin/alpasim", "alpasim_plugin/alpasim/protos"):
        (source / folder / "__init__.py").write_text("")
    command = ["build_protos"] if editable else ["build_py", "--build-lib", str(tmp_path / "lib")]
    subprocess.run([sys.executable, "setup.py", "-q", *command], cwd=source, check=True, capture_output=True, text=True)
    target = (source if editable else tmp_path / "lib") / "alpasim_plugin/alpasim/protos"
    assert {p.name for p in target.glob("*_pb2.py")} == {p.stem + "_pb2.py" for p in protos}
    assert len(protos) == 9
    if not editable:
        assert not list(source.rglob("*_pb2.py"))
