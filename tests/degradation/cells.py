"""Verbs on machines that lack something: each ends with a documented code, never with a traceback,
and leaves nothing half-written.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from alpasim_plugin.cli.main import run_command
from tests.other_user import NOBODY, run_as_nobody

REPO = Path(__file__).resolve().parents[2]
DOCUMENTED = (0, 1, 2, 3, 4, 5)
DRIVE = (
    "run",
    "--renderer",
    "clean",
    "--images",
    "none",
    "--no-report",
    "--policy",
    "constant-velocity",
)
# @run: a finished run; @out: a folder; @new: one in it that can be made, where the machine lets it
# be made.
VERBS: dict[str, tuple[str, ...]] = {
    "list": ("list", "renderers"),
    "compare": ("compare", "@run"),
    "gate": ("gate", "@run"),
    "runs": ("runs", "@runs"),
    "report": ("report", "@run"),
    "check": ("check", "@run"),
    "aggregate": ("aggregate", "@run"),
    "view": ("view", "@run", "--out", "@new.html"),
    "export": ("export", "@run", "--alpasim", "@new"),
    "preview": ("preview", "smoke/straight", "--out", "@new.png"),
    "score": ("score", "@log", "--scene", "smoke/straight", "--out", "@new"),
    "run": (*DRIVE, "--out", "@new", "smoke/straight"),
    "dry run": (*DRIVE, "--dry-run", "smoke/straight"),
    "doctor": ("doctor",),
    "new": ("new", "policy", "mine", "--folder", "@out"),
    "check-policy": ("check-policy", "constant-velocity"),
}
KERNELS = "home/.cache/simrun/numba"
PATIENCE_S = 580


@dataclass(frozen=True)
class Machine:
    """What a machine lacks.

    Attributes:
        what: For the table.
        mounts: Lines of shell that root runs before, in a file system of the command's own;
            ``{work}`` is the folder of the runs.
        variables: Environment; ``{work}`` as above.
        prepare: Damages a copy of the folder of the runs.
        may_be: Exit codes that say that the machine, not the run, is at fault, beside 0 to 5.
    """

    what: str
    mounts: str = ""
    variables: Mapping[str, str] = field(default_factory=lambda: {"HOME": "{work}/home"})
    prepare: Callable[[Path], None] = lambda work: None


def _bait(work: Path) -> None:
    for name in ("colorama", "numexpr", "coverage", "sitecustomize", "usercustomize", "pickle"):
        (work / f"{name}.py").write_text(f"open({str(work / 'ran')!r}, 'a').write('{name} ')\n")


def _closed_run(work: Path) -> None:
    (work / "runs" / "one" / "rollouts").chmod(0o000)
    os.chown(work / "runs" / "one" / "rollouts", 0, 0)


def _hostile_run(work: Path) -> None:
    run = work / "runs" / "one"
    (run / "summary.json").write_text('{"metrics": [1, null], "paired": "x"}')
    (run / "rollouts.parquet").write_bytes(b"PAR1" + b"\0" * 64 + b"PAR1")
    shutil.rmtree(run / "scenes")
    (run / "scenes").symlink_to("/etc")
    os.mkfifo(run / "flips.json")


NO_HOME = {"HOME": "/nonexistent"}
READ_ONLY = (
    "mount --bind /tmp /tmp && mount -o remount,bind,ro /tmp && mount -o remount,bind,ro /\n"
)
TMPFS = "mount -t tmpfs -o size={size},mode=1777 none {{work}}/{folder}\n"
MACHINES: dict[str, Machine] = {
    "another user": Machine("a user who cannot write the source"),
    "no home": Machine("a user without a home", variables=NO_HOME),
    "read-only": Machine(
        "a read-only root, but a folder for temporary files",
        READ_ONLY + TMPFS.format(size="1g", folder="tmp"),
        {**NO_HOME, "TMPDIR": "{work}/tmp"},
    ),
    "nothing": Machine(
        "no folder that can be written", READ_ONLY, {**NO_HOME, "TMPDIR": "/nonexistent"}
    ),
    "full disk": Machine("a full disk where results go", TMPFS.format(size="64k", folder="out")),
    "full temporary": Machine(
        "a full disk for temporary files",
        TMPFS.format(size="64k", folder="tmp"),
        {"HOME": "{work}/home", "TMPDIR": "{work}/tmp"},
    ),
    "hostile folder": Machine("a working directory of baits", prepare=_bait),
    "hostile run": Machine("a damaged run folder, with a pipe and a link", prepare=_hostile_run),
    "closed run": Machine("a run folder of which a part may not be read", prepare=_closed_run),
}


@dataclass(frozen=True)
class Outcome:
    """What came of a cell: its exit code, and what was wrong with the way it ended, if anything."""

    code: int
    wrong: str
    said: str


def make_work(work: Path) -> None:
    """Fill a folder with a finished run of two policies, which need no camera and so no kernel."""
    for name in ("home", "tmp", "out"):
        (work / name).mkdir()
    drive = [
        *DRIVE,
        "--seeds",
        "2",
        "--workers",
        "1",
        "--out",
        str(work / "runs" / "one"),
        "smoke/straight",
    ]
    drive[drive.index("constant-velocity")] = "constant-velocity,pure-pursuit"
    assert run_command(drive) == 0


def outcome(machine: Machine, verb: str, made: Path, work: Path) -> Outcome:
    """Run a verb on a machine, as the user nobody, with a copy of the folder that `make_work`
    filled.

    Args:
        machine: What it lacks.
        verb: Of `VERBS`.
        made: The filled folder.
        work: Where the copy goes; it must not exist.
    """
    shutil.copytree(made, work)
    for path in (work, *work.rglob("*")):
        os.chown(path, NOBODY, NOBODY, follow_symlinks=False)
    machine.prepare(work)
    log = next((made / "runs").rglob("rollout.asl")).relative_to(made)
    words = {
        "@runs": work / "runs",
        "@run": work / "runs" / "one",
        "@log": work / log,
        "@new": work / "out" / "new",
        "@out": work / "out",
    }
    arguments = [_filled(word, words) for word in VERBS[verb]]
    script = f"import sys; sys.path.insert(0, {str(REPO)!r}); from alpasim_plugin.cli.main import main; main()"
    variables = {key: value.format(work=work) for key, value in machine.variables.items()}
    before = _content(work / "runs")
    command = [sys.executable, "-P", "-c", script, *arguments]
    try:
        done = run_as_nobody(
            command,
            cwd=work,
            mounts=machine.mounts.format(work=work),
            timeout=PATIENCE_S,
            **variables,
        )
    except subprocess.TimeoutExpired:
        return Outcome(-1, f"no end within {PATIENCE_S} s", "")
    if (compiled := work / KERNELS).is_dir():
        shutil.copytree(
            compiled, made / KERNELS, dirs_exist_ok=True
        )  # the next cell need not compile them
    wrong = [f"code {done.returncode}"] if done.returncode not in DOCUMENTED else []
    wrong += ["a traceback"] if "Traceback" in done.stderr else []
    wrong += (
        ["its error has no four parts"]
        if done.returncode in (2, 4, 5) and not _has_four_parts(done.stderr + done.stdout)
        else []
    )
    wrong += [f"half-written: {path}" for path in work.rglob("*.tmp")]
    wrong += ["ran what lay in the folder"] if (work / "ran").exists() else []
    lost = before.keys() - _content(work / "runs").keys()
    wrong += [f"lost {sorted(lost)[:3]}"] if lost else []
    return Outcome(done.returncode, "; ".join(wrong), (done.stderr or done.stdout)[-2000:])


def _filled(word: str, words: Mapping[str, Path]) -> str:
    for name, path in words.items():
        if word.startswith(name):
            return f"{path}{word.removeprefix(name)}"
    return word


def _has_four_parts(text: str) -> bool:
    return (
        all(part in text for part in ("error:", "with:", "found:", "do:"))
        or "BROKEN" in text
        or "failed" in text
    )


def _content(folder: Path) -> dict[str, int]:
    return {
        str(path.relative_to(folder)): path.lstat().st_size
        for path in folder.rglob("*")
        if path.is_file() and not path.is_symlink()
    }
