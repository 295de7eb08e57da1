"""What is given on the command line reaches the job: every group of options, by what the job
receives.
"""

import inspect
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import pytest
import typer

from alpasim_plugin.cli import run, serve
from alpasim_plugin.cli.main import run_command
from alpasim_plugin.cli.options import Json, command_of
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.runs.executor_choice import Executor


class Reached(Exception):
    """The job was called."""


@pytest.fixture
def called(monkeypatch):
    """Give a function that puts something in a job's place and returns what it was called with."""

    def watch(module: Any, name: str, *words: str) -> dict[str, Any]:
        job = getattr(module, name)
        found = {}

        def instead(*args: Any, **kwargs: Any) -> None:
            found.update(inspect.signature(job).bind(*args, **kwargs).arguments)
            raise Reached

        monkeypatch.setattr(module, name, instead)
        assert run_command(list(words)) == 70
        return found

    return watch


def test_a_run_gets_its_cluster_and_its_limit(called, tmp_path):
    words = ["--executor", "ray?cores=2&gpus=0.5&memory=7.5", "--time-limit", "90", "--no-report"]
    words += [
        "--shard",
        "1/1",
        "--workers",
        "3",
        "--out",
        str(tmp_path / "out"),
        "smoke/straight",
    ]
    given = called(run, "execute_run", "--renderer", "clean", *words)
    assert given["executor"] == Executor("ray", "", 2, 0.5, 7.5)
    assert (given["workers"], given["limit_s"]) == (3, 90.0)
    assert (given["report"], given["resume"]) == (False, False)


def test_what_a_worker_of_a_cluster_needs_is_refused_without_one(
    capsys,
):
    assert (
        run_command(
            ["--renderer", "clean", "--executor", "local?cores=1", "--dry-run", "smoke/straight"]
        )
        == 2
    )
    assert "--executor local?cores=1" in capsys.readouterr().err


def test_a_server_gets_its_bounds_and_whom_it_trusts(called, tmp_path):
    (tmp_path / "token").write_text(" secret \n")
    bounds = ("--history-mb", "16")
    upstream = ("--upstream", f"host:1?ca=ca.pem&token_file={tmp_path / 'token'}&image=as-asked")
    settings = called(serve, "assemble", "serve", *bounds, *upstream)["settings"]
    assert (settings.history_bytes, settings.upstream.as_png) == (16 << 20, False)
    assert (settings.upstream.token, settings.upstream.ca) == ("secret", Path("ca.pem"))


@pytest.mark.parametrize(
    "words",
    [
        ("serve", "--renderer", "identity", "--upstream", "host:1"),
        ("serve", "--policy", "lane-camera"),
    ],
)
def test_callers_of_every_server_are_let_in_as_asked(called, tmp_path, words):
    files = (
        "--tls-cert",
        "cert.pem",
        "--tls-key",
        "key.pem",
        "--tls-client-ca",
        "callers.pem",
        "--token-file",
        str(tmp_path / "token"),
    )
    given = called(serve, "Host", *words, *files)["policy"]
    assert (given.tls_cert, given.tls_key, given.tls_client_ca) == (
        Path("cert.pem"),
        Path("key.pem"),
        Path("callers.pem"),
    )
    assert given.token_file == tmp_path / "token"


# --- from a dataclass to options


@dataclass(frozen=True)
class Job:
    """A job."""

    files: Annotated[tuple[str, ...], Positional("Files.")]
    times: Annotated[int, Flag("How often.", min=1, also="-t")] = 2
    names: Annotated[tuple[str, ...], Flag("Names.", "--name")] = ()
    loud: Annotated[bool, Flag("Whether.", "--loud/--quiet")] = True
    inner: int = 7  # no flag


def call(function: Any, *words: str) -> Any:
    app = typer.Typer()
    app.command()(command_of(function))
    return app(list(words), standalone_mode=False)


def test_a_dataclass_becomes_options_and_comes_back_whole():
    found = []

    def work(job: Job, as_json: Json = False) -> None:
        found.append((job, as_json))

    call(work, "a", "b", "-t", "3", "--name", "x", "--name", "y", "--quiet", "--json", "--debug")
    call(work, "a")
    assert found == [(Job(("a", "b"), 3, ("x", "y"), False), True), (Job(("a",)), False)]
    with pytest.raises(Exception, match="Missing"):
        call(work)
    with pytest.raises(Exception, match=r"greater than or equal to 1|not in the range"):
        call(work, "a", "--times", "0")
