"""``simrun score``: logs of AlpaSim and ours, several at once, errors by cause, exit codes, and the
files of a run.
"""

import json
import shutil

import pyarrow.parquet as pq
import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.runs.score_logs import LogScore, exit_code
from evaluators.pages.html import write_report
from evaluators.pages.overview import overview_of
from evaluators.statistics.opening import read_run
from tests import run_records

GOLDEN_SCENE = "synthetic-cut-in-a"


@pytest.fixture(scope="module")
def golden(request):
    return request.getfixturevalue("shared_data") / "alpasim-golden"


@pytest.fixture(scope="module")
def our_run(tmp_path_factory):
    """A run of ours: one scene, one policy, two seeds, without pictures."""
    root = tmp_path_factory.mktemp("runs") / "own"
    command = [
        "--renderer",
        "clean",
        "--policy",
        "log-replay",
        "--seeds",
        "2",
        "--images",
        "none",
        "--workers",
        "1",
        "--quiet",
    ]
    assert (
        run_command(
            [
                *command,
                "--no-report",
                "--set",
                "timing.duration_us=1500000",
                "--out",
                str(root),
                "smoke/straight",
            ]
        )
        == 0
    )
    return root


def rows(folder):
    return pq.read_table(folder / "rollouts.parquet").to_pylist()


def test_a_log_of_ours_scores_as_its_run_did(our_run, tmp_path, capsys):
    out = tmp_path / "scored"
    assert (
        run_command(
            ["score", str(our_run), "--scene", "smoke/straight", "--out", str(out), "--json"]
        )
        == 0
    )
    printed = json.loads(capsys.readouterr().out)
    assert (printed["out"], printed["exit_code"], printed["summary"]["preset"]) == (
        str(out),
        0,
        "strict",
    )
    before = rows(our_run)
    after = rows(out)
    names = [row["rollout"] for row in after]
    assert names == sorted(names)  # session ids, which sort as the seeds
    assert names == [
        json.loads((our_run / row["path"] / "manifest.json").read_text())["session_uuid"]
        for row in before
    ]
    for one, two in zip(before, after, strict=True):
        for key in one:
            if key not in ("path", "wall_s"):
                assert two[key] == one[key], key
    steps = pq.read_table(out / "steps.parquet")
    assert set(steps["rollout"].to_pylist()) == set(names)
    for name in ("run.json", "summary.json", "summary.md", "junit.xml", "report.html"):
        assert (out / name).stat().st_size > 0
    assert json.loads((out / "run.json").read_text())["config"]["preset"]["name"] == "strict"
    assert json.loads((out / "summary.json").read_text())["exit_code"] == 0


def test_fields_of_a_newer_version_of_the_log_are_said(our_run, tmp_path, capsys):
    log = tmp_path / "a" / "rollout.asl"
    log.parent.mkdir()
    newer = b"\xfa\x3e\x02\x08\x01"  # an entry that is field 1007
    source = sorted(our_run.rglob("rollout.asl"))[0]
    log.write_bytes(source.read_bytes() + len(newer).to_bytes(4, "big") + newer)
    out = str(tmp_path / "scored")
    assert run_command(["score", str(log), "--scene", "smoke/straight", "--out", out]) == 0
    printed = " ".join(capsys.readouterr().err.split())
    assert "rollout log: not read are LogEntry/field 1007 (1)" in printed


@pytest.mark.slow
def test_several_presets_stand_side_by_side_and_say_what_is_missing(our_run, tmp_path, capsys):
    out = tmp_path / "scored"
    presets = "strict,nuplan,navsim"
    command = [
        "score",
        str(our_run),
        "--scene",
        "smoke/straight",
        "--preset",
        presets,
        "--out",
        str(out),
    ]
    assert run_command(command) == 0
    table = capsys.readouterr().out
    assert [
        line.split()[0] for line in table.splitlines() if "pdms" in line or "_score" in line
    ] == ["nuplan", "navsim", "navsim"]
    assert "strict" in table
    assert "speed limits" in table
    assert {path.name for path in out.iterdir()} == {"strict", "nuplan", "navsim"}
    assert run_command([*command, "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert (printed["exit_code"], list(printed["presets"])) == (
        0,
        ["strict", "nuplan", "navsim"],
    )
    assert (
        printed["presets"]["nuplan"]["summary"]["metrics"]["clean"]["nuplan_score_most"]["mean"]
        == 1.0
    )
    assert run_command([*command[:5], "strict,waymax"]) == 2


def test_another_set_of_results_in_the_folder_is_not_overwritten(our_run, tmp_path, capsys):
    out = tmp_path / "scored"
    command = [
        "score",
        str(our_run),
        "--scene",
        "smoke/straight",
        "--out",
        str(out),
    ]
    assert run_command(command) == 0
    assert run_command([*command, "--preset", "paper"]) == 2
    assert "holds other results" in capsys.readouterr().err


def test_golden_logs_by_pattern_with_scenes_by_folder(golden, tmp_path, capsys):
    out = tmp_path / "scored"
    pattern = str(golden / "rollouts" / "synthetic-c*-in-a" / "*" / "rollout.asl")
    command = [
        "score",
        pattern,
        "--scene",
        str(golden / "scenes"),
        "--preset",
        "alpasim",
        "--settings",
        str(golden / "eval-config.yaml"),
    ]
    assert run_command([*command, "--out", str(out)]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("[1/2] ")
    want = {
        row["rollout_id"]: row
        for row in json.loads((golden / "aggregate" / "results-summary.json").read_text())[
            "rollouts"
        ]
    }
    got = {row["rollout"]: row for row in rows(out)}
    assert len(got) == 2
    for name, row in got.items():
        assert row["scene"] == GOLDEN_SCENE
        assert row["scene_score"] == pytest.approx(want[name]["score"], abs=1e-5)
        assert row["collision_at_fault"] == want[name]["metrics"]["collision_at_fault"]
        assert row["offroad_or_collision"] == want[name]["metrics"]["offroad_or_collision"]
    summary = json.loads((out / "aggregate" / "results-summary.json").read_text())
    assert {row["rollout_id"]: row["score"] for row in summary["rollouts"]} == pytest.approx(
        {name: want[name]["score"] for name in got}
    )
    names = pq.read_table(out / "aggregate" / "metrics_results.parquet").column_names
    assert set(names) == set(
        pq.read_table(golden / "aggregate" / "metrics_results.parquet").column_names
    )
    assert summary["metrics_results"][0]["run_name"] == "golden-dev"


def test_an_incomplete_rollout_is_a_failed_row_and_skips_alpasims_aggregation(
    golden, tmp_path, capsys
):
    folder = golden / "cases" / "failed-rollout"
    command = [
        "score",
        str(folder),
        "--scene",
        str(folder / "scenes"),
        "--preset",
        "alpasim",
    ]
    assert run_command([*command, "--out", str(tmp_path / "a")]) == 4
    assert "aggregation was not written" in capsys.readouterr().err
    assert not (tmp_path / "a" / "aggregate").exists()
    allowed = [
        *command,
        "--settings",
        str(folder / "eval-config.yaml"),
        "--out",
        str(tmp_path / "b"),
    ]
    assert run_command(allowed) == 0
    table = rows(tmp_path / "b")
    assert [row["status"] for row in table].count("failed") == 1
    failure = next(row for row in table if row["status"] == "failed")["failure"]
    assert failure.endswith("the rollout ended after 25 of 46 control steps")
    summary = json.loads((tmp_path / "b" / "aggregate" / "results-summary.json").read_text())
    assert [(row["status"], row["score"]) for row in summary["rollouts"]] == [("fail", 0.0)] * 3


def test_a_missing_map_stops_the_scene_score_and_nothing_else(golden, tmp_path, capsys):
    folder = golden / "cases" / "no-map"
    command = ["score", str(folder), "--scene", str(folder / "scenes")]
    assert run_command([*command, "--preset", "alpasim", "--out", str(tmp_path / "a")]) == 5
    assert "missing metric 'offroad'" in capsys.readouterr().err
    assert sorted(p.name for p in (tmp_path / "a" / "aggregate").iterdir()) == [
        "metrics_results.parquet",
        "metrics_unprocessed.parquet",
    ]
    off = [
        "--settings",
        str(folder / "eval-config-no-scene-score.yaml"),
        "--out",
        str(tmp_path / "b"),
    ]
    assert run_command([*command, "--preset", "alpasim", *off]) == 0
    assert run_command([*command, "--preset", "strict", "--out", str(tmp_path / "c")]) == 5
    assert {row["failure_class"] for row in rows(tmp_path / "c")} == {"evaluator"}


def test_one_damaged_log_does_not_lose_the_others(golden, tmp_path, capsys):
    logs = tmp_path / "logs"
    first = sorted((golden / "rollouts" / GOLDEN_SCENE).glob("*/rollout.asl"))[0]
    (logs / "whole").mkdir(parents=True)
    shutil.copy(first, logs / "whole")
    for name, size in (("cut", 150_000), ("beheaded", 900)):
        (logs / name).mkdir()
        (logs / name / "rollout.asl").write_bytes(first.read_bytes()[:size])
    out = tmp_path / "scored"
    scene = str(golden / "scenes" / f"{GOLDEN_SCENE}.usdz")
    assert run_command(["score", str(logs), "--scene", scene, "--out", str(out)]) == 4
    found = {row["rollout"]: (row["status"], row["failure_class"]) for row in rows(out)}
    name = first.parent.name  # the session id, of which the second log is another copy
    assert found == {
        f"{name} (whole)": ("ok", None),
        name: ("failed", "infrastructure"),
        "beheaded": ("failed", "input"),
    }
    said = capsys.readouterr().err
    assert "of 80 control steps" in said
    assert said.count("error: ") == said.count("hint: ") == 2  # for each damaged log


def test_bad_commands_say_what_to_do(our_run, tmp_path, capsys):
    own = ["score", str(our_run), "--out", str(tmp_path / "x")]
    settings = tmp_path / "eval.yaml"
    settings.write_text("vehicle: {vehicle_shrink: 0.1}\n")
    (tmp_path / "nothing").mkdir()
    cases = {
        "another scene": ([*own, "--scene", "smoke/curve"], "not among the 1 scenes"),
        "no such scene": ([*own, "--scene", str(tmp_path / "none.usdz")], "none.usdz"),
        "unknown preset": (
            [*own, "--scene", "smoke/straight", "--preset", "alpasimm"],
            "known: paper, alpasim",
        ),
        "settings of another preset": (
            [*own, "--scene", "smoke/straight", "--settings", str(settings)],
            "--preset alpasim",
        ),
        "unknown setting": (
            [*own, "--scene", "smoke/straight", "--preset", "alpasim", "--settings", str(settings)],
            "vehicle_shrink_factor",
        ),
        "no log": (
            ["score", str(tmp_path / "nothing"), "--scene", "smoke/straight"],
            "a folder without .asl logs",
        ),
        "no match": (
            ["score", str(tmp_path / "*.asl"), "--scene", "smoke/straight"],
            "no such file, folder or match",
        ),
    }
    for situation, (command, _) in cases.items():
        assert run_command(command) == 2, situation
        printed = capsys.readouterr().err
        assert printed.startswith("error: "), situation


def test_a_file_that_is_no_log_is_an_error_without_a_table(tmp_path, capsys):
    path = tmp_path / "notes.txt"
    path.write_text("notes")
    command = ["score", str(path), "--scene", "smoke/straight", "--out", str(tmp_path / "out")]
    assert run_command(command) == 2
    assert "primary rate" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("classes", "wanted"),
    [
        ((), 0),
        (("input",), 2),
        (("infrastructure",), 4),
        (("evaluator",), 5),
        (("input", "evaluator"), 5),
        (("input", "infrastructure"), 4),
        (("infrastructure", "evaluator"), 5),
    ],
)
def test_failures_of_several_kinds_end_with_the_code_that_docs_give_the_gravest(classes, wanted):
    scores = [LogScore(run_records.manifest({}), None)]
    scores += [
        LogScore(run_records.manifest({"status": "failed", "error": {"failure_class": name}}), None)
        for name in classes
    ]
    assert exit_code(scores, False, None) == wanted
    accepted = [name for name in classes if name != "infrastructure"]
    assert exit_code(scores, True, None) == (5 if "evaluator" in accepted else 2 if accepted else 0)
    assert exit_code(scores, True, EvaluatorError("no", "none")) == 5


def test_a_log_that_cannot_be_read_is_no_variant_beside_the_others(our_run, tmp_path, capsys):
    for number, log in enumerate(sorted(our_run.glob("rollouts/*/*/*/*/rollout.asl"))):
        shutil.copy(log, tmp_path / f"{number}.asl")
    (tmp_path / "broken.asl").write_bytes(b"no log")
    logs = [str(path) for path in sorted(tmp_path.glob("*.asl"))]
    scene = next((our_run / "scenes").glob("*.json")).stem.replace("-", "/", 1)
    command = ["score", *logs, "--scene", scene, "--out", str(tmp_path / "scored"), "--json"]
    assert run_command(command) == 2
    capsys.readouterr()
    run = read_run(tmp_path / "scored")
    assert (run.renderers, run.policies) == (["clean"], ["log-replay"])
    assert list(run.summary.metrics) == ["clean"]
    assert (run.summary.failures.n_failed, len(run.rollouts)) == (1, len(logs))
    assert sum(row.n_rollouts for row in overview_of(run).rows) == len(logs)
    write_report(run)
