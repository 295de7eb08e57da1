"""Build the wheel of ``alpasim-onefixer-bridge`` from this checkout: ``python -m
alpasim_plugin.alpasim.bridge.build DIST``.

The wire messages, the client and the presets are copied under the distribution's own package name,
so that it can be installed where this project is not, beside AlpaSim's packages.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

from alpasim_plugin import __version__

HERE = Path(__file__).resolve().parent
WIRE = HERE.parents[1] / "log" / "wire"
PACKAGE = "alpasim_onefixer_bridge"
SUFFIXES = (".py", ".pyi", ".proto", ".yaml", ".json")
INIT = '"""What AlpaSim needs of OneFixer in its own environment: wire messages, presets, a client."""\n'
PROJECT = f"""[build-system]
requires = ["setuptools>=77"]
build-backend = "setuptools.build_meta"

[project]
name = "alpasim-onefixer-bridge"
version = "{__version__}"
description = "Wire messages, Hydra presets and a client of OneFixer's renderer service, for AlpaSim's environment"
requires-python = ">=3.11"
license = "Apache-2.0"
dependencies = ["grpcio>=1.62", "protobuf>=4.25,<7"]

[project.scripts]
onefixer-bridge = "{PACKAGE}.client:main"

[project.entry-points."alpasim.configs"]
onefixer = "{PACKAGE}.configs"

[tool.setuptools.packages.find]
include = ["{PACKAGE}*"]

[tool.setuptools.package-data]
"*" = ["*.yaml", "*.json", "*.proto", "*.pyi"]
"""


def stage(target: Path) -> None:
    """Write the distribution's source tree into a folder."""
    package = target / PACKAGE
    for source, name in ((WIRE, "wire"), (HERE / "configs", "configs")):
        for path in sorted(source.rglob("*")):
            if path.suffix in SUFFIXES and path.name != "compile.py":
                copy(path, package / name / path.relative_to(source))
    # there the messages lie two folders nearer
    client = (HERE / "client.py").read_text().replace("from ...log.wire", "from .wire")
    (package / "client.py").write_text(client)
    (package / "__init__.py").write_text(INIT)
    (target / "pyproject.toml").write_text(PROJECT)


def copy(source: Path, target: Path) -> None:
    """Copy a file, making its folder."""
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(source.read_bytes())


def build(dist: Path) -> Path:
    """Build the wheel into a folder and return it.

    Raises:
        subprocess.CalledProcessError: pip failed; its message stands above.
    """
    with tempfile.TemporaryDirectory() as scratch:
        stage(Path(scratch))
        subprocess.run(
            [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", str(dist), scratch],
            check=True,
        )
    return sorted(dist.glob(f"{PACKAGE}-*.whl"))[-1]


if __name__ == "__main__":
    print(build(Path(sys.argv[1] if len(sys.argv) > 1 else "dist")))
