"""A damaged run folder: damage is reported, only the damaged part is made again, and the tables are
as before.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.atomic import temporary_path
from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.log.run_folder.check import inspect_run
from alpasim_plugin.log.run_folder.writer import remove_left_overs
from alpasim_plugin.runs.logged_rollout import find_rollout
from alpasim_plugin.runs.plan import RunOptions, RunPlan, make_plan
from alpasim_plugin.runs.run import execute_run
from alpasim_plugin.runs.score_logs import check_vouched
from scenarios.suite import expand
from tests.runs.test_runs import Announced, comparable

CELL = "rollouts/clean/constant-velocity/smoke-straight/0"


def plan_of(seeds: tuple[int, ...] = (0, 1)) -> RunPlan:
    refs = expand("smoke/straight", ("timing.duration_us=600000",))
    return make_plan(
        refs, ("clean", "broken-black"), ("constant-velocity",), seeds, RunOptions(images="none")
    )


def run(root: Path, plan: RunPlan | None = None) -> Announced:
    announced = Announced()
    execute_run(
        plan or plan_of(),
        root,
        1,
        ["simrun", "--seeds", "2"],
        announced,
        certificate="none",
        report=False,
    )
    return announced


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Give a finished run of two renderers and two seeds."""
    root = tmp_path_factory.mktemp("run") / "made"
    run(root)
    return root


@pytest.fixture
def root(made: Path, tmp_path: Path) -> Path:
    """Give a copy of the run to be damaged; as ``cp -r`` makes it, with other times."""
    return Path(shutil.copytree(made, tmp_path / "run", copy_function=shutil.copyfile))


def remove(path: Path) -> None:
    path.unlink()


def cut(path: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))


def becomes(text: str) -> Callable[[Path], None]:
    return lambda path: path.write_text(text) and None  # type: ignore[return-value]


DRIVE = "driving again"
SCORE = "scoring again"
TABLES = "writing it again"
DAMAGES = {
    "log removed": (f"{CELL}/rollout.asl", remove, DRIVE),
    "log cut": (f"{CELL}/rollout.asl", cut, DRIVE),
    "log changed": (f"{CELL}/rollout.asl", flip, DRIVE),
    "frames removed": (f"{CELL}/frames.jsonl", remove, DRIVE),
    "manifest a list": (f"{CELL}/manifest.json", becomes("[]"), DRIVE),
    "manifest changed": (f"{CELL}/manifest.json", flip, DRIVE),
    "manifest removed": (f"{CELL}/manifest.json", remove, DRIVE),
    "steps removed": (f"{CELL}/steps.parquet", remove, SCORE),
    "steps cut": (f"{CELL}/steps.parquet", cut, SCORE),
    "run.json a list": ("run.json", becomes("[]"), TABLES),
    "run.json of other types": ("run.json", becomes('{"scenes": 5}'), TABLES),
    "summary changed": ("summary.json", flip, TABLES),
    "table removed": ("rollouts.parquet", remove, TABLES),
    "scene file a list": ("scenes/smoke-straight.json", becomes("[]"), TABLES),
}
# One of each kind by default, all with -m slow.
QUICK = ("log changed", "manifest a list", "steps cut", "run.json a list", "summary changed")
of_damage = pytest.mark.parametrize(
    ("file", "damage", "remedy"),
    [
        pytest.param(*case, id=name, marks=[] if name in QUICK else pytest.mark.slow)
        for name, case in DAMAGES.items()
    ],
)


@of_damage
def test_the_next_run_tells_what_is_damaged_and_makes_only_that_again(
    made: Path, root: Path, file: str, damage: Callable[[Path], None], remedy: str
) -> None:
    damage(root / file)
    announced = run(root)
    assert len(announced.notices) == 1
    assert announced.notices[0].startswith(f"damaged: {file}: ")
    assert announced.notices[0].endswith(remedy)
    assert announced.results.count(("ok", False)) == (remedy == DRIVE)
    assert comparable(root) == comparable(made)
    assert inspect_run(root, full=True).whole
    assert run(root).notices == []


@of_damage
def test_check_finds_the_damage_and_its_repair_is_one(
    made: Path,
    root: Path,
    file: str,
    damage: Callable[[Path], None],
    remedy: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    damage(root / file)
    assert run_command(["check", str(root), "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert [f"{row['cell']}/{row['file']}".strip("/") for row in found["damage"]] == [file]
    assert (found["whole"], found["damage"][0]["done"]) == (False, None)
    assert run_command(["check", str(root), "--repair", "--workers", "1", "--json"]) == 0
    done = json.loads(capsys.readouterr().out)["damage"][0]["done"]
    assert (
        done
        in (
            {
                DRIVE: ("run again",),
                SCORE: ("scored again",),
                TABLES: ("written again", "restored"),
            }[remedy]
        )
    )
    assert run_command(["check", str(root)]) == 0
    assert "4 rollouts, 0 findings: whole" in capsys.readouterr().out
    assert comparable(root) == comparable(made)


@pytest.mark.slow
def test_readers_make_damaged_tables_again_and_name_damaged_rollouts(
    made: Path, root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run_command(["compare", str(made)]) == 0
    wanted, told = capsys.readouterr()
    assert told == ""
    for name in ("summary.json", "rollouts.parquet", "steps.parquet", "contents.json"):
        cut(root / name)
        assert run_command(["compare", str(root)]) == 0
        shown, told = capsys.readouterr()
        assert shown == wanted
        assert f"damaged: {root}/{name}: " in told
    remove(root / CELL / "rollout.asl")
    assert run_command(["compare", str(root)]) == 0
    shown, told = capsys.readouterr()
    assert shown == wanted
    assert (
        told
        == f"warning: damaged: {root}/{CELL}/rollout.asl: missing; the tables are whole; simrun check {root} --repair\n"
    )
    remove(root / "summary.json")
    assert run_command(["compare", str(root)]) == 2
    told = capsys.readouterr().err
    assert f"found: {CELL}/rollout.asl: missing" in told
    assert f"do: simrun check {root} --repair" in told


def test_a_fork_and_a_scoring_need_the_log_itself(root: Path) -> None:
    flip(root / CELL / "rollout.asl")
    with pytest.raises(InputError, match="not the content that was written") as caught:
        find_rollout(root, CELL)
    assert f"simrun check {root} --repair" in caught.value.hint
    with pytest.raises(InputError, match="not the content that was written") as caught:
        check_vouched(root / CELL / "rollout.asl")
    assert f"simrun check {root} --repair" in caught.value.hint


def test_a_run_that_was_stopped_is_not_read_until_it_is_finished(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (root / "contents.json").unlink()
    shutil.rmtree(root / CELL)
    assert run_command(["gate", str(root)]) == 2
    told = capsys.readouterr().err
    assert "the run is not finished: 3 of 4 rollouts are finished" in told
    assert "do: give its command again: simrun --seeds 2" in told
    assert run(root).results.count(("ok", False)) == 1
    assert inspect_run(root).whole


def test_what_has_neither_run_nor_contents_can_only_be_run_again(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    becomes("{")(root / "run.json")
    becomes("[1]")(root / "contents.json")
    assert run_command(["check", str(root), "--repair"]) == 2
    assert (
        f"give the command of the run again: finished rollouts are kept (with --out {root})"
        in capsys.readouterr().err
    )
    assert run(root).results == [("ok", True)] * 4
    assert inspect_run(root).whole


def test_tables_that_were_copied_without_their_rollouts_can_be_read(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shutil.rmtree(root / "rollouts")
    assert run_command(["compare", str(root)]) == 0
    assert "has no rollouts, only tables" in capsys.readouterr().err


def test_a_read_only_folder_is_read_and_a_finished_run_in_it_is_its_own_result(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    inspect_run(root)  # sets the copy's times
    before = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
    monkeypatch.setattr("alpasim_plugin.runs.run.os.access", lambda path, mode: False)
    assert run(root).results == []
    assert {path: path.stat().st_mtime_ns for path in root.rglob("*")} == before
    with pytest.raises(InfrastructureError, match="read-only, and 2 of 6 rollouts are missing"):
        run(root, plan_of((0, 1, 2)))


def test_left_overs_of_killed_writers_are_removed_and_nothing_else(root: Path) -> None:
    def named(pid: int, at: Path = root / CELL) -> Path:
        return at / temporary_path(Path("a.json")).name.replace(f".{os.getpid()}.", f".{pid}.")

    gone = [named(2**22 + 1), named(2**22 + 2, root), named(2**22 + 3, root)]
    kept = [
        named(os.getppid()),
        root / CELL / ".a.json.12.tmp",
        root / CELL / "note.tmp",
        root / "forks" / "f" / named(2**22 + 1).name,
    ]
    kept[-1].parent.mkdir(parents=True)
    (root / "forks" / "f" / ".simrun.lock").touch()  # a run folder of its own
    for path in [*gone[:2], *kept]:
        path.write_text("")
    gone[2].mkdir()
    (gone[2] / "inside").write_text("")
    younger = named(2**22 + 4)
    younger.write_text("")
    limit_ns = max(path.stat().st_mtime_ns for path in [*gone, *kept]) + 1
    os.utime(younger, ns=(limit_ns + 1, limit_ns + 1))
    assert set(remove_left_overs(root, limit_ns)) == set(gone)
    assert all(path.exists() for path in [*kept, younger])
