"""How the program begins and ends: plug-in verbs, what no part of it has foreseen, lost outputs,
signals during imports, a Tab.
"""

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from alpasim_plugin.cli import main
from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InternalError
from tests.examples import first_of, first_rows_of

MANY_DIGITS = "9" * 5000
PLUGIN = '''
import errno, os, signal
from typing import Annotated

import typer

EPILOG = "Example: `simrun greet`"


def greet(name: str = "you") -> None:
    """Greet somebody.

    With a line more.
    """
    print("hello", name)


def fails() -> None:
    """Fail in a way that nobody has foreseen."""
    raise ValueError("seven")


def hungry() -> None:
    """Ask for more memory than there is."""
    raise MemoryError("of 1 TB")


def full() -> None:
    """Write on a full disk."""
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/somewhere/file")


several = typer.Typer(help="Do several things.")


@several.command("one")
def one() -> None:
    """Do one thing."""
    print("one done")


@several.command("two")
def two() -> None:
    """Do two things."""
    print("two done")
'''
SIGNALLED = """
import os, signal

os.kill(os.getpid(), signal.SIGINT)
"""
VERBS = {
    **{name: f"greeting:{name}" for name in ("greet", "fails", "hungry", "full", "several")},
    "slow-import": "signalled:command",
    "no-source": "nowhere.at.all:command",
}


@pytest.fixture(scope="module")
def packages(tmp_path_factory):
    """Give a folder of the import path in which a package with verbs is installed."""
    folder = tmp_path_factory.mktemp("packages")
    (folder / "greeting.py").write_text(PLUGIN)
    (folder / "signalled.py").write_text(SIGNALLED)
    install(folder, VERBS)
    return folder


def install(folder: Path, verbs: dict[str, str]) -> None:
    info = folder / "greeting-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: greeting\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "\n".join(["[simrun.commands]", *(f"{name} = {target}" for name, target in verbs.items())])
    )


def with_packages(packages: Path) -> dict[str, str]:
    return os.environ | {
        "PYTHONPATH": os.pathsep.join([str(packages), os.environ.get("PYTHONPATH", "")])
    }


def simrun(packages: Path, *words: str, **more: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "alpasim_plugin.cli.main", *words]
    given = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | more
    return subprocess.run(command, env=with_packages(packages), text=True, check=False, **given)  # type: ignore[call-overload,no-any-return]


def two_parts(text: str) -> tuple[str, str]:
    """Return message and hint of a printed error."""
    error, hint = text.strip().splitlines()
    assert error.startswith("error: ")
    assert hint.startswith("  hint: ")
    return error.removeprefix("error: "), hint.removeprefix("  hint: ")


# --- verbs of installed packages


def test_a_verb_of_an_installed_package_runs_and_is_listed_without_being_imported(
    packages,
):
    done = simrun(packages, "greet", "--name", "Ada")
    assert (done.stdout, done.returncode) == ("hello Ada\n", 0)
    assert simrun(packages, "several", "two").stdout == "two done\n"
    shown = simrun(packages, "--help").stdout  # slow-import would end it
    assert "From installed packages" in shown
    for verb in VERBS:
        assert f"simrun {verb} --help" in shown
    own = simrun(packages, "greet", "--help").stdout
    assert "With a line more." in own
    assert "Example: simrun greet" in own
    assert "--debug" in own


def test_a_package_that_claims_a_verb_of_ours_is_refused(tmp_path):
    install(tmp_path, {"gate": "greeting:greet"})
    done = simrun(tmp_path, "list", "renderers")
    assert done.returncode == 2
    assert "alpasim_plugin.cli.gate:gate" in two_parts(done.stderr)[0]


def test_a_verb_of_an_extra_that_is_not_installed_says_which_brings_it(monkeypatch, capsys):
    monkeypatch.setattr(main, "verbs", lambda: {"run": "alpasim_plugin.cli.run:run"})
    assert run_command(["train", "fixer"]) == 2
    assert "alpasim_plugin/lab" in two_parts(capsys.readouterr().err)[1]


# --- what nothing has foreseen


def test_an_exception_that_is_not_ours_has_a_place_and_an_exit_code_of_its_own(
    packages,
):
    done = simrun(packages, "fails")
    assert done.returncode == InternalError.exit_code == 70
    message, hint = two_parts(done.stderr)
    assert "ValueError: seven at " in message
    assert "greeting.py:" in message
    assert "--debug" in hint
    traced = simrun(packages, "fails", "--debug")
    assert traced.returncode == 70
    assert "Traceback" in traced.stderr
    assert 'raise ValueError("seven")' in traced.stderr


def test_with_json_it_is_one_document(monkeypatch, capsys):
    def broken(args: list[str]) -> int:
        raise RecursionError("too deep")

    monkeypatch.setattr(main, "_run", broken)
    assert run_command(["list", "renderers", "--json"]) == 70
    document = json.loads(capsys.readouterr().out)
    assert document["exit_code"] == 70
    assert document["error"]["failure_class"] == "internal"
    assert "RecursionError: too deep" in document["error"]["message"]


@pytest.mark.parametrize(
    ("verb", "found"),
    [("hungry", "of address space: of 1 TB"), ("full", "No space left on device: /somewhere/file")],
)
def test_too_little_memory_or_disk_is_a_failure_of_the_machine(packages, verb, found):
    done = simrun(packages, verb)
    assert done.returncode == 4
    assert found in two_parts(done.stderr)[0]


@pytest.mark.parametrize(
    "error",
    [
        ImportError("/lib/_compute.so: failed to map segment from shared object"),
        ImportError("libx.so: cannot allocate memory in static TLS block"),
        RuntimeError("can't start new thread"),
        OSError(errno.ENOMEM, "Cannot allocate memory"),
        OSError(errno.EAGAIN, "Resource temporarily unavailable"),  # of a fork
        OSError(errno.EROFS, "Read-only file system"),  # of a lock in /dev/shm
    ],
    ids=repr,
)
def test_what_the_machine_refuses_is_its_failure(monkeypatch, capsys, error):
    def refused(args: list[str]) -> int:
        raise error

    monkeypatch.setattr(main, "_run", refused)
    assert run_command(["list", "renderers"]) == 4
    assert len(two_parts(capsys.readouterr().err)) == 2


@pytest.mark.parametrize(
    "words",
    [
        ["--seeds", MANY_DIGITS],
        ["--seeds", f"1,{MANY_DIGITS}"],
        ["--set", f"timing.duration_us={MANY_DIGITS}"],
        ["--set", f"actors.{MANY_DIGITS}.speed_mps=1"],
        ["--workers", MANY_DIGITS],
        ["--time-limit", MANY_DIGITS],
    ],
    ids=lambda words: words[0],
)
def test_numbers_of_thousands_of_digits_are_bad_input(capsys, words):
    assert run_command(["run", "--dry-run", *words, "smoke/lead_car"]) == 2
    assert max(map(len, two_parts(capsys.readouterr().err))) < 700


@pytest.mark.skipif(
    not Path("/dev/full").exists(), reason="this system has no device that is always full"
)
@pytest.mark.parametrize(
    "words",
    first_of([["list", "scenarios"], ["list", "scenarios", "--json"], ["--version"], ["--help"]]),
)
def test_a_full_disk_under_the_output_is_seen_even_at_the_very_end(packages, words):
    with Path("/dev/full").open("w") as full:
        done = simrun(packages, *words, stdout=full)
    assert done.returncode == 4
    if "--json" not in words:
        assert "No space left on device" in two_parts(done.stderr)[0]


@pytest.mark.parametrize(
    "words",
    first_of(
        [["list", "scenarios"], ["list", "scenarios", "--json"], ["--help"], ["report", "--help"]]
    ),
)
def test_a_reader_that_has_gone_is_no_failed_gate(packages, words):
    reader, writer = os.pipe()
    os.close(reader)
    done = simrun(packages, *words, stdout=writer)
    os.close(writer)
    assert (done.returncode, done.stderr) == (141, "")


def test_an_interrupt_during_imports_leaves_without_a_traceback(packages):
    # A process that a shell put into the background ignores the signal, and so would its children;
    # a function that subprocess calls after a fork would have gRPC, where a test before has loaded
    # it, write to stderr.
    begin = "import os, signal, sys as s; signal.signal(signal.SIGINT, signal.SIG_DFL); os.execv(s.executable, [s.executable, *s.argv[1:]])"
    command = [sys.executable, "-c", begin, "-m", "alpasim_plugin.cli.main", "slow-import"]
    done = subprocess.run(
        command, env=with_packages(packages), text=True, check=False, capture_output=True
    )
    assert (done.returncode, done.stderr) == (130, "")


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (["--rendrer", "clean", "smoke/straight"], "--renderer"),
        (["list", "renderes"], "'renderers'"),
        (["list", "--workers"], "--workers"),
    ],
)
def test_an_error_of_usage_says_what_helps(words, found, capsys):
    assert run_command(words) == 2
    message, hint = two_parts(capsys.readouterr().err)
    assert found in message
    assert "--help" in hint
    assert run_command([*words, "--json"]) == 2
    assert json.loads(capsys.readouterr().out)["exit_code"] == 2


# --- a Tab


def offered(packages: Path, *words: str) -> list[str]:
    """Return what bash gets for the last of the words."""
    environment = {
        "COMP_WORDS": "\n".join(["simrun", *words]),
        "COMP_CWORD": str(len(words)),
        "_SIMRUN_COMPLETE": "complete_bash",
    }
    code = "import os, sys; os.environ.update(%r); sys.argv = ['simrun']; from alpasim_plugin.cli.main import main; main()"
    path = os.pathsep.join([str(packages), os.environ.get("PYTHONPATH", "")])
    command = [sys.executable, "-c", code % environment]
    done = subprocess.run(
        command, env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True, check=True
    )
    assert done.stderr == ""
    return done.stdout.split()


@pytest.mark.parametrize(
    ("words", "among"),
    first_rows_of(
        [
            (["chec"], ["check"]),
            (["check", ""], ["run", "policy", "renderer", "driver"]),
            (["gree"], ["greet"]),
            (["run", "--re"], ["--renderer", "--resume"]),
            (["run", "--renderer", "clean,one"], ["clean,onefixer"]),
            (["run", "--policy", "lane-camera", "smoke/c"], ["smoke/curve"]),
            (["several", "t"], ["two"]),
        ]
    ),
)
def test_a_tab_offers_verbs_options_and_names(packages, words, among):
    assert set(among) <= set(offered(packages, *words))
