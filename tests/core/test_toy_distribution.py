"""A package with one part of every kind, installed for real, driven by two workers, edited, driven
again.
"""

import json
import os
import shutil
import subprocess
import sys
import zipfile
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from tests.core.hostile_commands import written_script

pytestmark = pytest.mark.slow
TOY = Path(__file__).parent / "toy"
REPO = Path(__file__).resolve().parents[2]
NAMED = (
    "--renderer",
    "toy-grey,toy-brighten+toy-grey",
    "--policy",
    "toy-straight",
    "--controller",
    "toy-jump",
)
IMPORTED = (
    "--renderer",
    "toy_parts:Grey,toy_parts:Brighten+toy_parts:Grey",
    "--policy",
    "toy_parts:Straight",
    "--controller",
    "toy_parts:Jump",
)


@dataclass(frozen=True)
class Installed:
    """A virtual environment with the toy package, and a folder to work in."""

    python: Path
    package: Path  # folder of the installed modules
    work: Path

    def simrun(self, *arguments, code=0):
        """Run a command in the folder, as the installed one does from a script that lies elsewhere,
        and return its JSON document.
        """
        command = [str(self.python), str(written_script(self.work)), *arguments, "--json"]
        path = os.pathsep.join([str(REPO), *(p for p in sys.path if "site-packages" in p)])
        environment = os.environ | {"PYTHONPATH": path}
        done = subprocess.run(
            command,
            cwd=self.work,
            env=environment,
            capture_output=True,
            text=True,
            check=False,
            timeout=240,
        )
        assert done.returncode == code, done.stdout + done.stderr
        return json.loads(done.stdout)

    def drive(self, out, *parts, workers=1):
        """Drive and return for every rollout whether it was made anew."""
        rest = (
            "--seeds",
            "2",
            "--out",
            out,
            "--images",
            "none",
            "--no-report",
            "--workers",
            str(workers),
        )
        before = self.made(out)
        self.simrun(*parts, *rest, "drive.toycsv")
        return {path: before.get(path) != at for path, at in self.made(out).items()}

    def made(self, out):
        """Return when every rollout's log was written."""
        folder = self.work / out / "rollouts"
        return {
            str(log.parent.relative_to(folder)): log.stat().st_mtime_ns
            for log in sorted(folder.rglob("rollout.asl"))
        }

    def edit(self, name, old, new):
        """Change a file of the installed package."""
        file = self.package / name
        assert old in file.read_text()
        file.write_text(file.read_text().replace(old, new))


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """Install the toy with pip from a wheel; no index is needed, and the libraries are those of
    this environment.
    """
    folder = tmp_path_factory.mktemp("toy")
    wheel = folder / "simrun_toy-1.0-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for name in ("toy_parts.py", "gain.txt"):
            archive.write(TOY / name, name)
        info = "simrun_toy-1.0.dist-info"
        archive.write(TOY / "entry_points.txt", f"{info}/entry_points.txt")
        archive.writestr(
            f"{info}/METADATA", "Metadata-Version: 2.1\nName: simrun-toy\nVersion: 1.0\n"
        )
        archive.writestr(
            f"{info}/WHEEL",
            "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        )
        files = (
            "toy_parts.py",
            "gain.txt",
            *(f"{info}/{name}" for name in ("entry_points.txt", "METADATA", "WHEEL", "RECORD")),
        )
        archive.writestr(f"{info}/RECORD", "".join(f"{name},,\n" for name in files))
    subprocess.run([sys.executable, "-m", "venv", str(folder / "env")], check=True)
    python = folder / "env" / "bin" / "python"
    subprocess.run(
        [str(python), "-m", "pip", "install", "-q", "--no-index", "--no-deps", str(wheel)],
        check=True,
        capture_output=True,
    )
    found = subprocess.run(
        [str(python), "-c", "import site; print(site.getsitepackages()[0])"],
        check=True,
        capture_output=True,
        text=True,
    )
    work = folder / "work"
    work.mkdir()
    (work / "drive.toycsv").write_text("\n".join(f"{100_000 * i},{0.5 * i},0" for i in range(26)))
    return Installed(python, Path(found.stdout.strip()), work)


def test_parts_of_a_package_are_listed(installed):
    listed = {kind: installed.simrun("list", kind) for kind in ("renderers", "metrics")}
    assert {"toy-grey", "toy://"} <= set(listed["renderers"])
    assert "toy_wobble_m" in listed["metrics"]


def test_a_run_is_driven_scored_compared_and_driven_again_where_it_was_edited(
    installed,
):
    anew = installed.drive("run", *NAMED, workers=2)
    assert len(anew) == 4
    assert all(anew.values())
    summary = json.loads((installed.work / "run" / "summary.json").read_text())
    assert set(summary["metrics"]) == {"toy-grey", "toy-brighten+toy-grey"}
    assert summary["metrics"]["toy-grey"]["toy_wobble_m"]["unit"] == "m"
    info = json.loads((installed.work / "run" / "run.json").read_text())
    assert info["fixers"]["toy-brighten+toy-grey"]["label"] == "toy-brighten, trained"
    assert info["metrics"]["toy_wobble_m"]["direction"] == "lower"
    elsewhere = replace(
        installed, python=Path(sys.executable)
    )  # the plug-ins are not installed there
    assert "toy_wobble_m" in json.dumps(elsewhere.simrun("compare", "run"))
    edit_and_drive_again(installed, "run", *NAMED)


def test_parts_named_by_import_path_are_driven_again_where_they_were_edited(
    installed,
):
    installed.edit(
        "simrun_toy-1.0.dist-info/entry_points.txt", "toy-wobble = toy_parts:Wobble\n", ""
    )  # or the metric is given twice
    try:
        parts = (*IMPORTED, "--source", "toy_parts:Csv", "--evaluator", "toy_parts:Wobble")
        assert all(installed.drive("imported", *parts).values())
        edit_and_drive_again(installed, "imported", *parts)
    finally:
        shutil.copy(TOY / "entry_points.txt", installed.package / "simrun_toy-1.0.dist-info")


def edit_and_drive_again(installed, out, *parts):
    """Edit the fixer's weights and then the module of all parts, and check after each what is
    driven anew.
    """
    try:
        installed.edit("gain.txt", "30", "31")
        anew = installed.drive(out, *parts)
        assert anew == {path: "righten" in path for path in anew}, (
            "the fixer's rollouts alone; the others are as they were"
        )
        installed.edit("toy_parts.py", "SPEED_MPS = 5.0", "SPEED_MPS = 4.0")
        assert all(installed.drive(out, *parts).values())
    finally:
        shutil.copy(TOY / "gain.txt", installed.package)
        shutil.copy(TOY / "toy_parts.py", installed.package)


@pytest.mark.parametrize(
    "name", ["policies.mine:Straight", "policies/mine.py:Straight"], ids=["module", "file"]
)
def test_an_edited_policy_file_is_driven_again(installed, name):
    mine = installed.work / "policies"
    mine.mkdir(exist_ok=True)
    (mine / "helper.py").write_text("SPEED_MPS = 3.0\n")
    text = (
        (TOY / "toy_parts.py")
        .read_text()
        .replace("SPEED_MPS = 5.0", "from helper import SPEED_MPS")
    )
    (mine / "mine.py").write_text(text)
    parts = ("--renderer", "toy-grey", "--policy", name)
    out = f"file-{'.py' in name}"
    assert all(installed.drive(out, *parts).values())
    (mine / "helper.py").write_text("SPEED_MPS = 2.5\n")
    assert all(installed.drive(out, *parts).values()), "the policy imports a file that was edited"


def test_folders_named_like_ours_do_not_shadow_them(installed):
    for name in ("policies", "evaluators", "scenarios", "configs"):
        (installed.work / name).mkdir(exist_ok=True)
        (installed.work / name / "__init__.py").write_text(
            "raise ImportError('the wrong package')\n"
        )
    try:
        assert "lane-camera" in installed.simrun("list", "policies")
        assert all(
            installed.drive("shadow", "--renderer", "toy-grey", "--policy", "toy-straight").values()
        )
    finally:
        for name in ("policies", "evaluators", "scenarios", "configs"):
            (installed.work / name / "__init__.py").unlink()
