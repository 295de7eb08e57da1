"""The command line as a user meets it: exit codes, errors, JSON, dry runs."""

import json
import subprocess
import sys

import pytest

from alpasim_plugin.cli.main import main, run_command
from alpasim_plugin.cli.options import parse_seeds
from alpasim_plugin.core.errors import InputError
from evaluators import PRESETS

GOOD = ["--renderer", "clean", "--policy", "log-replay"]


def two_parts(text):
    """Return message and hint of a printed error."""
    error, hint = text.strip().splitlines()
    assert error.startswith("error: ")
    assert hint.startswith("  hint: ")
    return error, hint


def bad_inputs(folder):
    """Return, by situation, a command line and what its error must mention."""
    (folder / "broken.yaml").write_text("version: 1\nroad: [\n")
    (folder / "typo.yaml").write_text("version: 1\nroda: {}\n")
    (folder / "empty").mkdir()
    (folder / "cut.xml").write_text(
        '<?xml version="1.0"?><commonRoad commonRoadVersion="2018b" timeStepSize="0.1"><lanelet id="1">'
    )
    (folder / "notes.txt").write_text("hello")
    scene = ["smoke/straight"]
    return {
        "malformed YAML": ([*GOOD, str(folder / "broken.yaml")], "broken.yaml:"),
        "unknown key": ([*GOOD, str(folder / "typo.yaml")], "road"),
        "missing file": ([*GOOD, str(folder / "none.yaml")], "none.yaml"),
        "misspelt shipped name": ([*GOOD, "smoke/straigth"], "smoke/straight"),
        "folder without scenarios": ([*GOOD, str(folder / "empty")], "empty"),
        "truncated XML": ([*GOOD, str(folder / "cut.xml")], "cut.xml"),
        "file of another kind": ([*GOOD, str(folder / "notes.txt")], "notes.txt"),
        "unknown renderer": (
            ["--renderer", "clena", "--policy", "log-replay", *scene],
            "did you mean 'clean'",
        ),
        "unknown policy": (
            ["--renderer", "clean", "--policy", "lane-cam", *scene],
            "did you mean 'lane-camera'",
        ),
        "policy that does not import": (["--policy", "no.such:Thing", *scene], "no.such:Thing"),
        "unknown preset": ([*GOOD, "--preset", "papr", *scene], "did you mean 'paper'"),
        "scenario named twice": (
            [*GOOD, "smoke/straight", "smoke/straight.yaml"],
            "smoke/straight and smoke/straight.yaml",
        ),
        "no such choice": ([*GOOD, "--video", "yes", *scene], "'--video': 'yes' is not one of"),
        "baseline that is not run": ([*GOOD, "--baseline", "3dgs", *scene], "baseline '3dgs'"),
        "bad seeds": ([*GOOD, "--seeds", "a,b", *scene], "--seeds a,b"),
        "no seeds": ([*GOOD, "--seeds", "0", *scene], "--seeds 0"),
        "misspelt verb": (["scroe", "drive.asl"], "simrun score"),
        "seed named twice": ([*GOOD, "--seeds", "1,2,1", *scene], "seed 1"),
        "renderer named twice": (
            ["--renderer", "clean,clean", "--policy", "log-replay", *scene],
            "renderer clean",
        ),
        "override of an unknown key": ([*GOOD, "--set", "rats.camera_us=1", *scene], "rates"),
        "camera period that is no multiple": (
            [*GOOD, "--set", "rates.camera_us=150001", *scene],
            "multiple",
        ),
        "one-frame scene": ([*GOOD, "--set", "timing.duration_us=1", *scene], "duration_us"),
        "no camera for the policy": (
            ["--renderer", "clean", "--policy", "lane-camera", "--set", "cameras=[]", *scene],
            "camera",
        ),
    }


SITUATIONS = (
    "malformed YAML",
    "unknown key",
    "missing file",
    "misspelt shipped name",
    "folder without scenarios",
    "truncated XML",
    "file of another kind",
    "unknown renderer",
    "unknown policy",
    "policy that does not import",
    "unknown preset",
    "baseline that is not run",
    "bad seeds",
    "no seeds",
    "renderer named twice",
    "scenario named twice",
    "no such choice",
    "override of an unknown key",
    "camera period that is no multiple",
    "one-frame scene",
    "no camera for the policy",
    "misspelt verb",
    "seed named twice",
)


@pytest.mark.parametrize("situation", SITUATIONS)
def test_bad_input_is_an_error_with_exit_code_2(situation, tmp_path, capsys):
    command, mention = bad_inputs(tmp_path)[situation]
    assert run_command([*command, "--out", str(tmp_path / "out")]) == 2
    captured = capsys.readouterr()
    two_parts(captured.err)
    assert mention in captured.err
    assert "Traceback" not in captured.err
    assert not (tmp_path / "out" / "run.json").exists()


def test_json_errors_are_one_document_on_stdout(capsys):
    assert run_command(["--renderer", "nope", "--json", "smoke/straight"]) == 2
    document = json.loads(capsys.readouterr().out)
    assert set(document["error"]) == {"message", "hint", "failure_class"}
    assert document["exit_code"] == 2


def test_a_dry_run_counts_without_running(tmp_path, capsys):
    command = [
        "--renderer",
        "clean,3dgs",
        "--seeds",
        "3",
        "--dry-run",
        "--json",
        "--set",
        "cameras=[{name: front, width: 1900, height: 1080, hfov_deg: 120}]",
        "--out",
        str(tmp_path / "out"),
        "suites/smoke",
    ]
    assert run_command(command) == 0
    plan = json.loads(capsys.readouterr().out)
    assert plan["rollouts"] == 2 * 3 * len(plan["scenes"])
    assert plan["camera_frames"] > 0
    assert " GB" in plan["large_cameras"][0]
    assert not (tmp_path / "out").exists()
    (tmp_path / "file").touch()
    for name in ("n" * 300, "file"):
        command[-2] = str(tmp_path / name)
        assert run_command(command) == 2


def test_a_run_prints_its_table_and_writes_the_contracted_files(tmp_path, capsys):
    command = [
        *GOOD,
        "--workers",
        "1",
        "--set",
        "timing.duration_us=1000000",
        "--out",
        str(tmp_path),
        "smoke/straight",
    ]
    assert run_command(command) == 0
    captured = capsys.readouterr()
    assert "primary" in captured.out
    assert captured.out.splitlines()[-1].startswith(f"next     simrun view {tmp_path} ")
    assert "report.html" in captured.out
    assert f"simrun view {tmp_path}" in captured.out
    names = {
        "run.json",
        "rollouts.parquet",
        "steps.parquet",
        "summary.json",
        "summary.md",
        "junit.xml",
        "report.html",
    }
    assert names <= {p.name for p in tmp_path.iterdir()}
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert {"preset", "metrics", "paired", "censoring", "failures", "speed"} <= set(summary)
    entry = summary["metrics"]["clean"]["collision_any"]
    assert {"mean", "ci95", "ci95_clustered", "n_rollouts", "n_scenes", "unit", "direction"} <= set(
        entry
    )
    assert (
        run_command([*command, "--no-report"]) == 0
    )  # the page of the command before would show another run's numbers
    assert f"simrun report {tmp_path}" in capsys.readouterr().out
    assert not (tmp_path / "report.html").exists()
    assert run_command(["report", str(tmp_path)]) == 0
    assert (tmp_path / "report.html").exists()


def test_a_run_folder_that_cannot_be_made_is_an_error(tmp_path, capsys):
    (tmp_path / "file").write_text("in the way")
    assert run_command([*GOOD, "--out", str(tmp_path / "file"), "--quiet", "smoke/straight"]) == 2
    assert str(tmp_path / "file") in two_parts(capsys.readouterr().err)[0]


def test_policy_of_the_working_directory_is_found(tmp_path, monkeypatch, capsys):
    (tmp_path / "policy_of_this_folder.py").write_text(
        "from policies.simple import ConstantVelocity as Mine\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        sys, "path", [p for p in sys.path if p]
    )  # as a console script finds it: without the working directory
    command = [
        "simrun",
        "--renderer",
        "clean",
        "--policy",
        "policy_of_this_folder:Mine",
        "--dry-run",
        "--json",
        "smoke/straight",
    ]
    monkeypatch.setattr(sys, "argv", command)
    with pytest.raises(SystemExit) as left:
        main()
    assert left.value.code == 0
    assert json.loads(capsys.readouterr().out)["policies"] == ["policy_of_this_folder:Mine"]


def test_threads_that_are_kept_end_with_the_command():
    program = """
import atexit, sys
from alpasim_plugin.cli.main import main
from alpasim_plugin.core.kept_threads import kept_pool

kept_pool(2).submit(len, "").result()
atexit.register(print, "left in order")
sys.argv = ["simrun", "--version"]
main()
"""
    command = [sys.executable, "-c", program]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    assert ended.stdout.splitlines()[-1] == "left in order"


@pytest.mark.parametrize("kind", ["renderers", "policies", "scenarios", "metrics"])
def test_lists_name_every_part_with_help(kind, capsys):
    assert run_command(["list", kind, "--json"]) == 0
    known = json.loads(capsys.readouterr().out)
    assert known
    assert all(known.values()), [name for name, text in known.items() if not text]


def test_every_preset_is_listed_with_what_it_is_the_default_first_and_with_the_contacts_that_it_misses(
    capsys,
):
    assert run_command(["list", "presets", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert next(iter(listed)) == "strict"
    assert set(listed) == set(PRESETS)
    assert all(listed.values())
    assert {name for name, text in listed.items() if "49 % at 500 ms" in text} == {
        "paper",
        "alpasim",
        "alpasim@6f1029c",
    }


def test_doctor_tries_the_parts(capsys):
    assert run_command(["doctor", "--json"]) == 0
    checks = {row["check"]: row for row in json.loads(capsys.readouterr().out)["checks"]}
    assert checks["rasteriser (cpu)"]["ok"]
    assert checks["video"]["ok"]


@pytest.mark.parametrize(
    ("text", "seeds"), [("1", [0]), ("3", [0, 1, 2]), ("4,7", [4, 7]), ("0,", [0])]
)
def test_seeds_are_a_count_or_a_list(text, seeds):
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize(
    "text", ["-1", "", "x", "1,-2", "1.5", f"0,{2**63}", "+2", "1_0", "1, 1_0"]
)
def test_other_seeds_are_refused(text):
    with pytest.raises(InputError):
        parse_seeds(text)


def test_reading_scenes_is_shown_where_it_takes_longer_than_a_moment(monkeypatch, capsys):
    command = [*GOOD, "--dry-run", "smoke/straight", "smoke/curve"]
    assert run_command(command) == 0
    assert "reading scenes" not in capsys.readouterr().err
    monkeypatch.setattr("alpasim_plugin.cli.run.MOMENT_S", -1.0)
    assert run_command(command) == 0
    assert "reading scenes 0/2" in capsys.readouterr().err
    assert run_command([*command, "--json"]) == 0
    assert capsys.readouterr().err == ""
