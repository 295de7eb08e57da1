"""Compile the ``.proto`` files of `alpasim_plugin.log.wire.protos`. Generated modules are checked
in: no installation needs a compiler.

The generator is the oldest that writes code for Python 3.11; what it writes loads under protobuf
4.25 up to 6. It cannot be installed beside a newer protobuf, so it gets an environment of its own::

    python3.11 -m venv /tmp/protoc
    /tmp/protoc/bin/pip install grpcio-tools==1.62.3 "setuptools<81"
    /tmp/protoc/bin/python tests/alpasim/compile_protos.py

With a folder as argument the modules are written there instead. ``checksums.json`` holds the
digests of sources and results, so that a test without the compiler sees a forgotten run.
"""

import hashlib
import json
import re
import sys
import tempfile
from importlib import metadata
from pathlib import Path

PROTOS = Path(__file__).resolve().parents[2] / "alpasim_plugin" / "log" / "wire" / "protos"
GENERATOR = "1.62.3"
IMPORTS = (
    "simrun/wire"  # how the files import each other; also their names in protobuf's descriptor pool
)
CHECKSUMS = "checksums.json"


def digests(folder):
    """Return the sha256 of every source and generated file of a folder, by name."""
    names = sorted(
        path.name
        for pattern in ("*.proto", "*_pb2.py", "*_pb2.pyi")
        for path in folder.glob(pattern)
    )
    return {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in names}


def compile_protos(target):
    """Write the modules, their type stubs and the checksums into `target`; return the names of the
    modules.

    The packages' own name is not written into the code (``from . import common_pb2``): the bridge
    distribution carries the same files under another name.
    """
    from grpc_tools import protoc

    sources = sorted(PROTOS.glob("*.proto"))
    with tempfile.TemporaryDirectory() as scratch:
        root = Path(scratch)
        inside = root / IMPORTS
        inside.mkdir(parents=True)
        for source in sources:
            (inside / source.name).write_bytes(source.read_bytes())
        options = [f"--proto_path={root}", f"--python_out={root}", f"--pyi_out={root}"]
        if (
            protoc.main(["protoc", *options, *(f"{IMPORTS}/{source.name}" for source in sources)])
            != 0
        ):
            raise SystemExit("error: protoc failed; its message stands above")
        for made in sorted(inside.glob("*_pb2.py*")):
            text = re.sub(
                rf"^from {IMPORTS.replace('/', '[.]')} import",
                "from . import",
                made.read_text(),
                flags=re.MULTILINE,
            )
            (target / made.name).write_text(text)
    for source in sources:
        if target != PROTOS:
            (target / source.name).write_bytes(source.read_bytes())
    (target / CHECKSUMS).write_text(json.dumps(digests(target), indent=1) + "\n")
    return sorted(path.name for path in target.glob("*_pb2.py"))


if __name__ == "__main__":
    found = metadata.version("grpcio-tools")
    if found != GENERATOR:
        raise SystemExit(
            f"error: grpcio-tools {found}; take {GENERATOR}, as the head of {Path(__file__).name} says"
        )
    made = compile_protos(Path(sys.argv[1]) if len(sys.argv) > 1 else PROTOS)
    print(f"compiled {len(made)} modules with grpcio-tools {found}")
