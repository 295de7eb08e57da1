"""Build the wheel of ``alpasim-onefixer-lab`` from this checkout: ``python -m
alpasim_plugin.lab.build DIST``.

It holds the laboratory's folder alone; installed beside the core's wheel, it brings its verbs and
fixers.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

from alpasim_plugin.alpasim.bridge.build import copy

HERE = Path(__file__).resolve().parent
PROJECT = "pyproject.toml"
IN_CHECKOUT = "[tool.setuptools]\npackages = []\n"
IN_WHEEL = """[tool.setuptools.packages.find]
include = ["alpasim_plugin.lab*"]
namespaces = true

[tool.setuptools.package-data]
"*" = ["*.yaml", "*.json", "*.html", "*.css", "*.js", "weights/*"]
"""


def stage(target: Path) -> None:
    """Write the distribution's source tree into a folder."""
    for path in sorted(HERE.rglob("*")):
        if (
            path.is_file()
            and path.name != PROJECT
            and path.suffix != ".pyc"
            and not any(part.endswith(".egg-info") for part in path.parts)
        ):
            copy(path, target / "alpasim_plugin" / "lab" / path.relative_to(HERE))
    text = (HERE / PROJECT).read_text()
    assert IN_CHECKOUT in text, "the packages of a checkout are no longer where they were"
    (target / PROJECT).write_text(text.replace(IN_CHECKOUT, IN_WHEEL))


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
    return sorted(dist.glob("alpasim_onefixer_lab-*.whl"))[-1]


if __name__ == "__main__":
    print(build(Path(sys.argv[1] if len(sys.argv) > 1 else "dist")))
