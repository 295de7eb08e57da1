"""A damaged run folder: damage is reported, only the damaged part is made again, and the tables are
as before.
"""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.files.atomic import temporary_path
from alpasim_plugin.log.run_folder.check import inspect_run
from alpasim_plugin.log.run_folder.writer import remove_left_overs
from alpasim_plugin.runs.plan import RunOptions, make_plan
from alpasim_plugin.runs.run import default_folder, execute_run
from scenarios.suite import expand
from tests.examples import first_of
from tests.runs.short_runs import Announced, comparable

CELL = "rollouts/clean/constant-velocity/smoke-straight/0"


def plan_of(seeds=(0, 1)):
    refs = expand("smoke/straight", ("timing.duration_us=600000",))
    return make_plan(
        refs, ("clean", "broken-black"), ("constant-velocity",), seeds, RunOptions(images="none")
    )


def run(root, plan=None):
    announced = Announced()
    execute_run(
        plan or plan_of(),
        root,
        1,
        ["simrun", "--seeds", "2"],
        announced,
        report=False,
    )
    return announced


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Give a finished run of two renderers and two seeds."""
    root = tmp_path_factory.mktemp("run") / "made"
    run(root)
    return root


@pytest.fixture
def root(made, tmp_path):
    """Give a copy of the run to be damaged; as ``cp -r`` makes it, with other times."""
    return Path(shutil.copytree(made, tmp_path / "run", copy_function=shutil.copyfile))


def remove(path):
    path.unlink()


def cut(path):
    os.truncate(path, path.stat().st_size // 2)


def flip(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))


def becomes(text):
    return lambda path: path.write_text(text) and None  # type: ignore[return-value]


DRIVE = "drive"
SCORE = "score"
DAMAGES = {
    "log removed": ("rollout.asl", remove, DRIVE),
    "log cut": ("rollout.asl", cut, DRIVE),
    "log changed": ("rollout.asl", flip, DRIVE),
    "frames removed": ("frames.jsonl", remove, DRIVE),
    "manifest a list": ("manifest.json", becomes("[]"), DRIVE),
    "manifest cut": ("manifest.json", cut, DRIVE),
    "steps removed": ("steps.parquet", remove, SCORE),
    "steps cut": ("steps.parquet", cut, SCORE),
}
QUICK = ("log changed", "manifest a list", "steps cut")  # the others with -m slow


@pytest.mark.parametrize(
    ("file", "damage", "remedy"),
    [
        pytest.param(*case, id=name, marks=[] if name in QUICK else pytest.mark.slow)
        for name, case in DAMAGES.items()
    ],
)
def test_the_same_command_makes_only_the_damaged_rollout_again(
    made,
    root,
    file,
    damage,
    remedy,
    capsys,
):
    damage(root / CELL / file)
    assert run_command(["check", "run", str(root), "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert not found["whole"]
    (sentence,) = found["damage"]
    assert CELL in sentence
    assert file in sentence
    announced = run(root)
    assert len(announced.notices) == 1
    assert file in announced.notices[0]
    assert (("ok", False) in announced.results) == (remedy == DRIVE)
    assert comparable(root) == comparable(made)
    assert run_command(["check", "run", str(root)]) == 0
    assert run(root).notices == []


def lengthen(path):
    """Change a file so that a JSON document still says the same."""
    path.write_bytes(path.read_bytes() + b"\n")


SCENE = "scenes/smoke-straight.json"
OF_THE_RUN = ("run.json", "rollouts.parquet", "steps.parquet", "summary.json", "summary.md", SCENE)


@pytest.mark.slow
def test_every_file_of_the_run_is_verified_and_written_again(made, root, capsys):
    for file in (*OF_THE_RUN, "junit.xml", "files.json"):
        (lengthen if file != "files.json" else remove)(root / file)
        capsys.readouterr()
        assert run_command(["check", "run", str(root), "--json"]) == 1
        assert file in json.loads(capsys.readouterr().out)["damage"][0]
        run(root)
        assert run_command(["check", "run", str(root)]) == 0
        assert comparable(root) == comparable(made)


@pytest.mark.parametrize("verb", first_of(["gate", "report", "compare"]))
def test_no_verdict_comes_of_a_file_that_was_changed(root, verb):
    for file in ("run.json", SCENE, f"{CELL}/manifest.json", f"{CELL}/rollout.asl"):
        before = (root / file).read_bytes()
        state = (root / file).stat()
        flip(root / file)
        if CELL not in file:  # it is read in full, whatever its size and time
            os.utime(root / file, ns=(state.st_atime_ns, state.st_mtime_ns))
        assert run_command([verb, str(root)]) == 2, file
        (root / file).write_bytes(before)
    (root / CELL / "manifest.json").write_bytes((root / CELL / "../1/manifest.json").read_bytes())
    assert run_command([verb, str(root)]) == 2


@pytest.mark.parametrize("damage", [becomes("[]"), becomes('{"scenes": 5}'), cut])
def test_a_damaged_description_is_written_again(made, root, damage):
    damage(root / "run.json")
    assert run_command(["check", "run", str(root)]) == 2
    announced = run(root)
    assert len(announced.notices) == 1
    assert announced.results == [("ok", True)] * 4
    assert comparable(root) == comparable(made)


def test_readers_make_missing_tables_again(made, root, capsys):
    """They make them for themselves: a run folder may be read-only."""
    assert run_command(["compare", str(made)]) == 0
    wanted = capsys.readouterr().out
    inspect_run(root)  # sets the copy's times
    for name in ("summary.json", "rollouts.parquet", "steps.parquet"):
        for damage in (cut, remove):
            damage(root / name)
            before = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
            assert run_command(["compare", str(root)]) == 0
            assert capsys.readouterr().out == wanted
            assert {path: path.stat().st_mtime_ns for path in root.rglob("*")} == before
        shutil.copyfile(made / name, root / name)
    table = pq.read_table(root / "rollouts.parquet")
    pq.write_table(table.slice(1), root / "rollouts.parquet")
    assert run_command(["compare", str(root)]) == 0
    assert capsys.readouterr().out == wanted
    shutil.copyfile(made / "rollouts.parquet", root / "rollouts.parquet")
    remove(root / CELL / "rollout.asl")
    assert run_command(["compare", str(root)]) == 0  # the tables are whole
    remove(root / "summary.json")
    assert run_command(["compare", str(root)]) == 2


def test_a_run_that_was_stopped_is_not_read_until_it_is_finished(root):
    (root / "summary.json").unlink()
    shutil.rmtree(root / CELL)
    assert run_command(["gate", str(root)]) == 2
    # The rollout, and its copy behind the other renderer.
    assert run(root).results.count(("ok", False)) == 2
    assert not inspect_run(root).damage
    assert not inspect_run(root).unfinished


def test_left_overs_of_killed_writers_are_removed_and_nothing_else(root):
    def named(pid, at=root / CELL):
        return at / temporary_path(Path("a.json")).name.replace(f".{os.getpid()}.", f".{pid}.")

    gone = [named(2**22 + 1), named(2**22 + 2, root), named(2**22 + 3, root)]
    kept = [
        named(os.getppid()),
        root / CELL / ".a.json.12.tmp",
        root / CELL / "note.tmp",
        named("9" * 30),
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


def test_a_run_folder_is_named_by_what_was_driven_and_a_short_key(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    plan = replace(plan_of(), scenario_names=("suites/first",))
    folder = default_folder(plan)
    assert folder == Path(f"runs/first-{plan.command_key[:4]}")
    run(folder, plan)
    assert default_folder(plan) == folder
    info = json.loads((folder / "run.json").read_text())
    assert all(scene["vehicle"]["friction"] is None for scene in info["scenes"].values())
    (folder / "run.json").write_text(json.dumps(info | {"key": "another"}))
    assert default_folder(plan) == Path(f"runs/first-{plan.command_key}")
    assert plan_of((1, 0)).command_key == plan.command_key != plan_of((1, 2)).command_key
