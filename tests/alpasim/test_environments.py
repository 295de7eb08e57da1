"""The wire, the clients and the services in environments at both ends of what the project allows.

    pytest -m slow tests/alpasim/test_environments.py

Each environment has a package of its own version in front of this environment's packages, and runs
the tests of the wire, of logs, and of clients and services over real sockets. ``SIMRUN_TORCH``
names a wheel of the oldest torch, which no index gives for CPUs everywhere; without it that case
is skipped.
"""

import os
import site
import subprocess
import sys
import venv
from pathlib import Path

import pytest

REPO = Path(__file__).resolve().parents[2]
TESTS = (
    "tests/alpasim/test_wire_messages.py",
    "tests/alpasim/test_wire_generated.py",
    "tests/alpasim/test_asl_framing.py",
    "tests/alpasim/test_clients.py",
    "tests/alpasim/test_sensorsim_service.py",
    "tests/alpasim/test_full_chain.py",
    "tests/log",
)
TORCH = os.environ.get("SIMRUN_TORCH")
WITH_NETWORKS = (
    "tests/alpasim/test_sensorsim_service.py",
    "tests/fixers",
    "tests/block_fixers",
)


@pytest.mark.slow
@pytest.mark.network
@pytest.mark.timeout(7200)
@pytest.mark.parametrize(
    ("packages", "module", "version", "tests"),
    [
        (("protobuf==4.25.*", "grpcio==1.62.*"), "google.protobuf", "4.25", TESTS),
        (("protobuf>=6,<7", "grpcio"), "google.protobuf", "6.", TESTS),
        pytest.param(
            (TORCH,),
            "torch",
            "2.8",
            WITH_NETWORKS,
            marks=pytest.mark.skipif(
                TORCH is None, reason="SIMRUN_TORCH names no wheel of the oldest torch"
            ),
        ),
    ],
    ids=["oldest-protobuf", "newest-protobuf", "oldest-torch"],
)
def test_the_project_works_at_both_ends_of_its_requirements(
    tmp_path, packages, module, version, tests
):
    folder = tmp_path / "venv"
    venv.create(folder, with_pip=True)
    python = folder / "bin" / "python"
    (own,) = folder.glob("lib/python*/site-packages")
    (own / "behind.pth").write_text(
        "\n".join(
            dict.fromkeys([*site.getsitepackages(), *(p for p in sys.path if "site-packages" in p)])
        )
    )
    subprocess.run(
        [python, "-m", "pip", "install", "-q", "--no-deps", "--ignore-installed", *packages],
        check=True,
    )
    told = subprocess.run(
        [python, "-c", f"import {module} as m; print(m.__version__)"],
        check=True,
        capture_output=True,
        text=True,
    )
    assert told.stdout.startswith(version)
    done = subprocess.run(
        [python, "-m", "pytest", "-q", "-p", "no:cacheprovider", *tests],
        cwd=REPO,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout[-6000:] + done.stderr[-2000:]
