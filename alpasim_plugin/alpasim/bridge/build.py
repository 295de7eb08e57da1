"""Build the wheel of ``alpasim-onefixer-bridge`` from this checkout: ``python -m
alpasim_plugin.alpasim.bridge.build DIST``.

The presets are copied under the distribution's own package name, so that it can be installed where
this project is not, beside AlpaSim's packages.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from alpasim_plugin import __version__

HERE = Path(__file__).resolve().parent
PACKAGE = "alpasim_onefixer_bridge"
INIT = '"""Presets of OneFixer for AlpaSim."""\n'
PROJECT = f"""[build-system]
requires = ["setuptools>=77"]
build-backend = "setuptools.build_meta"

[project]
name = "alpasim-onefixer-bridge"
version = "{__version__}"
description = "Hydra presets of OneFixer's renderer service, for AlpaSim's environment"
requires-python = ">=3.11"
license = "Apache-2.0"

[project.entry-points."alpasim.configs"]
onefixer = "{PACKAGE}.configs"

[tool.setuptools.packages.find]
include = ["{PACKAGE}*"]

[tool.setuptools.package-data]
"*" = ["*.yaml"]
"""


def stage(target: Path) -> None:
    """Write the distribution's source tree into a folder."""
    package = target / PACKAGE
    for path in sorted((HERE / "configs").rglob("*")):
        if path.suffix in (".py", ".yaml"):
            copy(path, package / path.relative_to(HERE))
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
