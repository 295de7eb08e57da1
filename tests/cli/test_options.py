"""What is given on the command line reaches the job: every group of options, by what the job
receives.
"""

from __future__ import annotations

import inspect
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import pytest
import typer

from alpasim_plugin.cli import decide, gate, run, serve
from alpasim_plugin.cli.main import run_command
from alpasim_plugin.cli.options import Json, Only, command_of
from alpasim_plugin.core.flags import Flag, Positional


class Reached(Exception):
    """The job was called."""


@pytest.fixture
def called(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Give a function that puts something in a job's place and returns what it was called with."""

    def watch(module: Any, name: str, *words: str) -> dict[str, Any]:
        job, found = getattr(module, name), {}

        def instead(*args: Any, **kwargs: Any) -> None:
            found.update(inspect.signature(job).bind(*args, **kwargs).arguments)
            raise Reached

        monkeypatch.setattr(module, name, instead)
        assert run_command(list(words)) == 70
        return found

    return watch


def test_a_run_gets_its_cluster_its_store_its_limit_and_its_retries(
    called: Any, tmp_path: Path
) -> None:
    cluster = ("--executor", "slurm:cpu?cores=2&gpus=0.5&memory=7.5", "--store", str(tmp_path))
    more = (
        "--time-limit",
        "90",
        "--retry",
        "--certify",
        "none",
        "--no-report",
        "--wait",
        "--workers",
        "3",
    )
    given = called(
        run,
        "execute_run",
        "--renderer",
        "clean",
        *cluster,
        *more,
        "--out",
        str(tmp_path / "out"),
        "smoke/straight",
    )
    resources = given["executor"].resources
    assert (str(given["executor"]), resources.cores, resources.gpus, resources.memory_gib) == (
        "slurm:cpu",
        2,
        0.5,
        7.5,
    )
    assert (given["store"], given["workers"], given["limit_s"], given["retry"]) == (
        str(tmp_path),
        3,
        90.0,
        True,
    )
    assert (given["certificate"], given["report"], given["wait"], given["resume"]) == (
        "none",
        False,
        True,
        False,
    )


def test_what_a_worker_of_a_cluster_needs_is_refused_without_one(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert (
        run_command(
            ["--renderer", "clean", "--executor", "local?cores=1", "--dry-run", "smoke/straight"]
        )
        == 2
    )
    assert "--executor local?cores=1" in capsys.readouterr().err


def test_a_decision_gets_its_question_and_its_design(called: Any) -> None:
    asked = (
        "--metric",
        "progress=0.05",
        "--alpha",
        "0.01",
    )
    scenes = (
        "--min-scenes",
        "7",
        "--order-seed",
        "5",
        "--max-missing",
        "0.1",
        "--budget",
        "40",
    )
    given = called(
        decide,
        "decide_into",
        "decide",
        "--renderer",
        "clean,3dgs",
        *asked,
        *scenes,
        "--seeds",
        "3",
        "smoke/straight",
    )
    question = given["question"]
    design = given["design"]
    plan = given["plan"]
    (metric,) = question.metrics
    assert (metric.metric, metric.margin) == ("progress", 0.05)
    assert (question.alpha, question.min_scenes) == (0.01, 7)
    assert (design.order_seed, design.max_missing, design.budget) == (5, 0.1, 40)
    assert (plan.seeds, plan.options.baseline, plan.asked) == (
        (0, 1, 2),
        "clean",
        ("smoke/straight",),
    )


def test_a_gate_that_drives_takes_the_options_of_a_decision(called: Any, tmp_path: Path) -> None:
    words = (
        "gate",
        str(tmp_path),
        "--until-decided",
        "--scenes",
        "smoke/straight",
        "--renderer",
        "clean,3dgs",
    )
    given = called(
        gate,
        "decide_into",
        *words,
        "--budget",
        "12",
        "--set",
        "timing.duration_us=1000000",
    )
    assert given["design"].budget == 12
    assert [cell.ref.overrides for cell in given["plan"].cells] == [
        ("timing.duration_us=1000000",)
    ] * 2


def test_a_server_gets_its_bounds_and_whom_it_trusts(called: Any, tmp_path: Path) -> None:
    (tmp_path / "token").write_text(" secret \n")
    bounds = ("--history-mb", "16", "--expiry-s", "60", "--prefetch", "--shutter", "rolling")
    upstream = ("--upstream", f"host:1?ca=ca.pem&token_file={tmp_path / 'token'}&image=as-asked")
    settings = called(serve, "assemble", "serve", *bounds, *upstream)["settings"]
    assert (settings.history_bytes, settings.expiry_s, settings.upstream.as_png) == (
        16 << 20,
        60.0,
        False,
    )
    assert settings.shutter == "rolling"
    assert (settings.upstream.token, settings.upstream.ca) == ("secret", Path("ca.pem"))


@pytest.mark.parametrize(
    "words",
    [("serve", "--renderer", "identity", "--upstream", "host:1"), ("serve-policy", "lane-camera")],
)
def test_callers_of_every_server_are_let_in_as_asked(
    called: Any, tmp_path: Path, words: tuple[str, ...]
) -> None:
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
    given = called(serve, "Host", *words, "--drain-s", "1", "--expiry-s", "9", *files)["policy"]
    assert (given.tls_cert, given.tls_key, given.tls_client_ca) == (
        Path("cert.pem"),
        Path("key.pem"),
        Path("callers.pem"),
    )
    assert (given.token_file, given.drain_s, given.expiry_s) == (tmp_path / "token", 1.0, 9.0)


# --- from a dataclass to options


@dataclass(frozen=True)
class Job:
    """A job."""

    files: Annotated[tuple[str, ...], Positional("Files.", required=True)] = ()
    times: Annotated[int, Flag("How often.", min=1, also="-t")] = 2
    names: Annotated[tuple[str, ...], Flag("Names.", "--name")] = ()
    loud: Annotated[bool, Flag("Whether.", "--loud/--quiet")] = True
    inner: int = 7  # no flag


def call(function: Any, *words: str) -> Any:
    app = typer.Typer()
    app.command()(command_of(function))
    return app(list(words), standalone_mode=False)


def test_a_dataclass_becomes_options_and_comes_back_whole() -> None:
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


def test_a_verb_may_take_a_part_of_a_jobs_options() -> None:
    found = []

    def work(
        job: Annotated[Job, Only("times")], more: Annotated[tuple[Path, ...], Flag("More.")] = ()
    ) -> None:
        found.append((job, more))

    call(work, "--times", "4", "--more", "p")
    assert found == [(Job(times=4), (Path("p"),))]
    with pytest.raises(Exception, match="No such option"):
        call(work, "--name", "x")
