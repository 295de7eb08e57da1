"""Build step: compile the wire messages.

``python setup.py build_protos`` compiles them in place, for a checkout that is used without being installed.
"""

from __future__ import annotations

from pathlib import Path

from setuptools import Command, setup
from setuptools.command.build_py import build_py

ROOT = Path(__file__).resolve().parent
PROTOS = Path("alpasim_plugin/alpasim/protos")


def compile_protos(target: Path) -> list[Path]:
    """Compile every ``.proto`` into a ``_pb2`` module and its type stub under `target`; return the modules."""
    # Imported here so that metadata can be read without the compiler.
    from grpc_tools import protoc

    sources = sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / PROTOS).glob("*.proto"))
    target.mkdir(parents=True, exist_ok=True)
    options = [f"--proto_path={ROOT}", f"--python_out={target}", f"--pyi_out={target}"]
    if protoc.main(["protoc", *options, *sources]) != 0:
        raise SystemExit(f"error: protoc failed on {', '.join(sources)}; its message stands above")
    return [target / source.replace(".proto", "_pb2.py") for source in sources]


class BuildPy(build_py):
    """Compile the messages into the build folder, or into the source tree for an editable install."""

    def run(self) -> None:
        super().run()
        target = ROOT if self.editable_mode else Path(self.build_lib)
        self._compiled = compile_protos(target)

    def get_outputs(self, include_bytecode: bool = True) -> list[str]:
        return [*super().get_outputs(include_bytecode), *map(str, getattr(self, "_compiled", []))]


class BuildProtos(Command):
    """Compile the messages in place."""

    description = "compile the wire messages in place"
    user_options: list[tuple[str, str | None, str]] = []  # noqa: RUF012 - the base class wants a plain list

    def initialize_options(self) -> None: ...

    def finalize_options(self) -> None: ...

    def run(self) -> None:
        compiled = compile_protos(ROOT)
        print(f"compiled {len(compiled)} modules into {PROTOS}")


setup(cmdclass={"build_py": BuildPy, "build_protos": BuildProtos})
