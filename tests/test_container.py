"""The container file: rules that it keeps, and where an engine is at hand, a build that drives."""

import json
import re
import shutil
import subprocess
import tomllib

import pytest


@pytest.fixture
def steps(repo):
    """Give the instructions with their arguments, continued lines joined."""
    text = re.sub(r"^\s*#.*\n", "", (repo / "Dockerfile").read_text(), flags=re.M).replace(
        "\\\n", " "
    )
    return [
        (word, rest.strip())
        for word, _, rest in (line.partition(" ") for line in text.splitlines() if line.strip())
    ]


def test_what_it_copies_is_there_and_is_sent(repo, steps):
    sent = {
        line[1:]
        for line in (repo / ".dockerignore").read_text().splitlines()
        if line.startswith("!")
    }
    copied = {
        name
        for word, rest in steps
        if word == "COPY" and "--from" not in rest
        for name in rest.split()[:-1]
    }
    assert copied == sent
    assert all((repo / name).exists() for name in copied)
    project = tomllib.loads((repo / "pyproject.toml").read_text())
    packages = {
        pattern.rstrip("*")
        for pattern in project["tool"]["setuptools"]["packages"]["find"]["include"]
    }
    assert packages <= copied, "a package that the wheel needs is not copied"
    torch = next(one for one in project["project"]["dependencies"] if one.startswith("torch"))
    assert any(f'"{torch}"' in rest for _, rest in steps), (
        "the range of torch differs from the project's"
    )


def engine():
    """Return a container engine that answers."""
    for name in ("docker", "podman"):
        if (
            shutil.which(name)
            and subprocess.run([name, "info"], capture_output=True, check=False).returncode == 0
        ):
            return name
    return None


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_the_image_builds_and_drives(repo, tmp_path):
    found = engine()
    if found is None:
        pytest.skip("no container engine answers")
    subprocess.run([found, "build", "-q", "-t", "simrun-test", str(repo)], check=True)
    who = subprocess.run(
        [found, "run", "--rm", "--entrypoint", "id", "simrun-test", "-u"],
        check=True,
        capture_output=True,
        text=True,
    )
    assert who.stdout.strip() == "10001"
    words = [
        "--renderer",
        "clean",
        "--policy",
        "pure-pursuit",
        "smoke/straight",
        "--set",
        "timing.duration_us=1200000",
        "--json",
    ]
    drive = subprocess.run(
        [found, "run", "--rm", "simrun-test", *words], check=True, capture_output=True, text=True
    )
    assert json.loads(drive.stdout)["exit_code"] == 0
