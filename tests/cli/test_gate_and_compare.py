"""``simrun compare`` and ``simrun gate`` as a CI job meets them: exit codes, files, baselines that
do not fit.
"""

import json
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.log.run_folder.checksums import sealed
from tests.core.checksum_files import vouch_for
from tests.pages.make_run import Plan, make_run

SCENES = tuple(f"scene-{i:02d}" for i in range(8))
EASY = """version: 1
min_scenes: 5
metrics:
  lateral_distance_m: {margin: 2.0}
  offroad: {margin: 0.05, must_decide: false}
"""


def plan(**fields):
    small = {
        "scenes": SCENES,
        "seeds": (0, 1),
        "steps": 40,
        "clips": False,
        "invalid": (),
    }
    return Plan(**{"renderers": ("clean", "onefixer"), **small, **fields})


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Make a good run, a bad one, one with a failed rollout, one with few scenes, one of other
    scene content.
    """
    folder = tmp_path_factory.mktemp("runs")
    bad = {"clean": 0.15, "onefixer": 12.0}
    plans = {
        "good": plan(harm={"clean": 0.15, "onefixer": 0.15}),
        "bad": plan(harm=bad),
        "failed": plan(fail=[("onefixer", SCENES[3], 1)]),
        "unscored": plan(fail=[("onefixer", SCENES[3], 1)]),
        "few": plan(scenes=SCENES[:3]),
        "noisy": plan(harm={"clean": 0.15, "onefixer": 0.15}),
    }
    made = {name: vouch_for(make_run(folder / name, one)) for name, one in plans.items()}
    for rollout in ("failed", "unscored"):
        summary = json.loads((made[rollout] / "summary.json").read_text())
        assert summary["failures"]["n_failed"] == 1
    info = json.loads((made["noisy"] / "run.json").read_text())
    (made["noisy"] / "run.json").write_text(json.dumps(info | {"repeat": {"repeatable": False}}))
    vouch_for(made["noisy"])
    _set_failure_class(made["unscored"], "evaluator")
    vouch_for(made["unscored"])
    return made


def _set_failure_class(folder, name):
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.read_table(folder / "rollouts.parquet")
    column = table.column_names.index("failure_class")
    classes = [None if value is None else name for value in table["failure_class"].to_pylist()]
    pq.write_table(
        table.set_column(column, "failure_class", pa.array(classes, pa.string())),
        folder / "rollouts.parquet",
    )


@pytest.fixture
def gate_file(tmp_path):
    path = tmp_path / "gate.yaml"
    path.write_text(EASY)
    return str(path)


@pytest.mark.parametrize(
    ("run", "code", "title"),
    [
        ("good", 0, "PASS"),
        ("bad", 1, "FAIL"),
        ("few", 2, "INCOMPLETE"),
        ("failed", 4, "INFRASTRUCTURE FAILURE"),
        ("unscored", 5, "EVALUATOR FAILURE"),
    ],
)
def test_the_exit_code_follows_the_cause_and_agrees_with_what_is_printed(
    runs, gate_file, capsys, run, code, title
):
    assert run_command(["gate", str(runs[run]), "--gate", gate_file]) == code
    last = capsys.readouterr().out.strip().splitlines()[-1]
    assert last.startswith(f"{title} (exit code {code})")
    page = (runs[run] / "gate.md").read_text()
    assert page.startswith(f"## Gate: {title}\n")
    assert f"Exit code {code}." in page


def test_json_is_one_document_with_every_check(runs, gate_file, capsys):
    assert run_command(["gate", str(runs["bad"]), "--gate", gate_file, "--json"]) == 1
    said = json.loads(capsys.readouterr().out)
    assert said["outcome"]["cause"] == "regression"
    assert {c["metric"] for c in said["checks"]} == {"lateral_distance_m", "offroad"}
    assert [c["entry"]["verdict"] for c in said["checks"] if c["cause"] == "regression"] == [
        "worse"
    ]


def test_junit_has_a_failure_for_each_broken_rule_and_keeps_the_rollouts(runs, gate_file, tmp_path):
    run_command(["gate", str(runs["bad"]), "--gate", gate_file, "--out", str(tmp_path)])
    root = ET.parse(tmp_path / "gate.junit.xml").getroot()
    gate, rollouts = root.findall("testsuite")
    assert gate.attrib["name"].startswith("gate ")
    failures = gate.findall("testcase/failure")
    assert [f.attrib["type"] for f in failures] == ["regression"] * len(failures)
    assert len(failures) == int(gate.attrib["failures"]) == int(root.attrib["failures"]) >= 1
    assert len(rollouts.findall("testcase")) == 2 * 8 * 2
    assert int(root.attrib["tests"]) == len(list(root.iter("testcase")))


def test_the_ci_summary_file_is_appended_to_and_stays_below_one_mebibyte(
    runs, gate_file, tmp_path, monkeypatch
):
    page = tmp_path / "step.md"
    page.write_text("earlier step")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(page))
    run_command(["gate", str(runs["good"]), "--gate", gate_file])
    assert page.read_text().startswith("earlier step\n\n## Gate: PASS\n")
    page.write_text("x" * (2**20 - 48_700))  # nearly full: room for 120 bytes
    run_command(["gate", str(runs["good"]), "--gate", gate_file])
    assert page.stat().st_size < 2**20
    page.write_text("x" * (2**20 - 10))
    run_command(["gate", str(runs["good"]), "--gate", gate_file])
    assert page.stat().st_size == 2**20 - 10


def test_a_run_passes_against_its_own_stored_baseline_and_a_worse_one_fails(
    runs, gate_file, tmp_path, capsys
):
    stored = tmp_path / "baseline.json"
    assert run_command(["gate", str(runs["good"]), "--write-baseline", str(stored)]) == 0
    assert (
        run_command(
            ["gate", str(runs["good"]), "--gate", gate_file, "--baseline-file", str(stored)]
        )
        == 0
    )
    assert (
        run_command(["gate", str(runs["bad"]), "--gate", gate_file, "--baseline-file", str(stored)])
        == 1
    )
    assert (
        run_command(["gate", str(runs["few"]), "--gate", gate_file, "--baseline-file", str(stored)])
        == 2
    )  # scenes missing
    content = json.loads(stored.read_text())
    del content["sha256"]
    stored.write_text(json.dumps(content))
    judged = ["gate", str(runs["good"]), "--gate", gate_file, "--baseline-file", str(stored)]
    assert run_command(judged) == 2
    capsys.readouterr()


@pytest.mark.parametrize(
    ("change", "mention"),
    [
        ({"preset": "strict"}, "preset 'strict', the run has 'paper'"),
        ({"weights": {"onefixer": "sha256:1"}}, "other weights: onefixer"),
        ({"scenes": {"scene-00": "another content"}}, "scenes with another content: scene-00"),
        ({"scenes": {"elsewhere": "x"}}, "no scene in common"),
        ({"schema_version": 99}, "not a baseline of version 2"),
    ],
)
def test_a_baseline_made_with_something_else_is_refused(
    runs, gate_file, tmp_path, capsys, change, mention
):
    stored = tmp_path / "baseline.json"
    run_command(["gate", str(runs["good"]), "--write-baseline", str(stored)])
    changed = json.loads(stored.read_text()) | change
    judged = ["gate", str(runs["good"]), "--gate", gate_file, "--baseline-file", str(stored)]
    stored.write_text(json.dumps(sealed(changed)))
    assert run_command(judged) == 2
    assert mention in capsys.readouterr().err
    stored.write_text(json.dumps(changed))
    assert run_command(judged) == 2
    assert str(stored) in capsys.readouterr().err


def test_a_run_with_holes_cannot_become_a_baseline(runs, tmp_path, capsys):
    assert (
        run_command(["gate", str(runs["failed"]), "--write-baseline", str(tmp_path / "b.json")])
        == 2
    )
    assert "1 of 32 rollouts failed" in capsys.readouterr().err
    assert not (tmp_path / "b.json").exists()


def test_a_gate_for_another_preset_and_bad_usage_are_refused(runs, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)  # no runs/ below it
    other = tmp_path / "strict.yaml"
    other.write_text(EASY + "preset: strict\n")
    for command in (
        ["gate", str(runs["good"]), "--gate", str(other)],
        ["gate", str(runs["good"]), "--gate", "no-such-gate"],
        ["gate"],
        ["gate", str(runs["good"]), "--self-test"],
        ["gate", str(tmp_path / "nowhere")],
        ["compare", *[str(runs["good"])] * 3],
        ["compare", str(runs["good"]), "--baseline", "difix"],
    ):
        assert run_command(command) == 2, command
    capsys.readouterr()


# --- compare


def test_compare_within_a_run_is_the_paired_block_of_its_summary(runs, capsys):
    assert run_command(["compare", str(runs["bad"]), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)["paired"]["onefixer"]["lateral_distance_m"]
    stored = json.loads((runs["bad"] / "summary.json").read_text())["paired"]["onefixer"][
        "lateral_distance_m"
    ]
    assert said == stored
    turned = _compare(capsys, str(runs["bad"]), "--baseline", "onefixer")["clean"][
        "lateral_distance_m"
    ]
    assert turned["diff"] == pytest.approx(-said["diff"])


@pytest.mark.parametrize("verb", ["compare", "report"])
def test_every_metric_is_printed_where_all_are_asked_for(runs, capsys, verb):
    printed = []
    for more in ([], ["--all"]):
        assert run_command([verb, str(runs["good"]), *more]) == 0
        printed.append(capsys.readouterr().out)
    assert "plan_deviation" not in printed[0]
    assert "plan_deviation" in printed[1]


def _compare(capsys, *arguments):
    assert run_command(["compare", *arguments, "--json"]) == 0
    return json.loads(capsys.readouterr().out)["paired"]


def test_compare_of_two_runs_pairs_the_same_renderer_on_shared_cells_and_lists_the_rest(
    runs, capsys
):
    found = _compare(capsys, str(runs["good"]), str(runs["few"]))
    entry = found["onefixer"]["lateral_distance_m"]
    assert (entry["n_scenes"], entry["n_missing"]) == (3, 10)
    assert len(entry["missing"]) == 10
    assert {cell["why"] for cell in entry["missing"]} == {"here: not planned"}
    assert entry["baseline"] == f"{runs['good']}: onefixer"
    with_one = _compare(capsys, str(runs["good"]), str(runs["bad"]), "--baseline", "clean")
    assert with_one["onefixer"]["offroad_or_collision_at_fault"]["verdict"] == "worse"


def test_joined_shards_print_the_one_table(tmp_path, capsys):
    shards = [
        vouch_for(
            make_run(tmp_path / name, plan(scenes=scenes, seeds=(0,), harm={"onefixer": 12.0}))
        )
        for name, scenes in (("a", SCENES[:2]), ("b", SCENES[2:5]))
    ]
    assert run_command(["compare", *map(str, shards)]) == 0
    said = capsys.readouterr().out
    assert "5 scenes" in said
    assert "primary rate" in said
    assert "*: only up to an event that ended the scored part" in " ".join(said.split())


def test_two_policies_are_compared_where_each_run_has_one(tmp_path, capsys):
    small = {"renderers": ("clean",), "scenes": SCENES[:4], "seeds": (0,)}
    first = vouch_for(make_run(tmp_path / "a", plan(**small)))
    second = vouch_for(make_run(tmp_path / "b", plan(**small, policies=("pure-pursuit",))))
    assert run_command(["compare", str(first), str(second), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["notes"] == ["policy pure-pursuit is compared with policy lane-camera"]
    assert said["paired"]["clean"]["lateral_distance_m"]["n_cells"] == 4


def test_runs_of_another_preset_or_scene_content_are_not_compared(runs, tmp_path, capsys):
    other = make_run(tmp_path / "other", plan())
    info = json.loads((other / "run.json").read_text())
    info["scenes"][SCENES[2]]["content_hash"] = "changed"
    (other / "run.json").write_text(json.dumps(info))
    vouch_for(other)
    assert run_command(["compare", str(runs["good"]), str(other)]) == 2
    assert f"scenes with another content: {SCENES[2]}" in capsys.readouterr().err
    summary = json.loads((other / "summary.json").read_text()) | {"preset": "strict"}
    (other / "summary.json").write_text(json.dumps(summary))
    vouch_for(other)
    assert run_command(["compare", str(runs["good"]), str(other)]) == 2
    assert "presets 'paper' and 'strict'" in capsys.readouterr().err


def arms_run(folder, renderers, policies):
    return vouch_for(
        make_run(
            folder, plan(renderers=renderers, policies=policies, scenes=SCENES[:4], seeds=(0,))
        )
    )


def test_policies_behind_one_renderer_are_compared_and_judged_within_a_run(tmp_path, capsys):
    run = arms_run(tmp_path / "run", ("clean",), ("a", "b", "c"))
    assert run_command(["compare", str(run), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert {
        name: entries["progress"]["baseline"] for name, entries in said["paired_policies"].items()
    } == {
        "clean/b": "clean/a",
        "clean/c": "clean/a",
    }
    turned = _compare(capsys, str(run), "--baseline", "c")
    assert set(turned) == {"clean/a", "clean/b"}
    forward = said["paired_policies"]["clean/c"]["lateral_distance_m"]["diff"]
    assert turned["clean/a"]["lateral_distance_m"]["diff"] == pytest.approx(-forward)
    gate = tmp_path / "gate.yaml"
    gate.write_text("version: 1\nbaseline: b\nmetrics:\n  progress: {margin: 0.9}\n")
    run_command(["gate", str(run), "--gate", str(gate), "--json"])
    verdict = json.loads(capsys.readouterr().out)
    assert verdict["baseline"] == "policy b of the same run"
    assert [(check["policy"], check["entry"]["baseline"]) for check in verdict["checks"]] == [
        ("a", "b"),
        ("c", "b"),
    ]


def test_another_policy_of_a_stored_baseline_is_named_or_the_only_one(tmp_path, capsys):
    stored = arms_run(tmp_path / "stored", ("clean",), ("a",))
    run = arms_run(tmp_path / "run", ("clean",), ("b",))
    gate = tmp_path / "gate.yaml"
    gate.write_text("version: 1\nmetrics:\n  progress: {margin: 0.9}\n")
    run_command(["gate", str(run), "--gate", str(gate), "--baseline-file", str(stored), "--json"])
    (check,) = json.loads(capsys.readouterr().out)["checks"]
    assert (check["policy"], check["entry"]["baseline"], check["entry"]["n_scenes"]) == (
        "b",
        "a",
        4,
    )
    two = arms_run(tmp_path / "two", ("clean",), ("a", "c"))
    assert run_command(["gate", str(run), "--gate", str(gate), "--baseline-file", str(two)]) == 2
    assert "may be one of: clean/a, clean/c" in capsys.readouterr().err
    assert run_command(["compare", str(two), str(run), "--baseline", "c", "--json"]) == 0
    assert (
        json.loads(capsys.readouterr().out)["paired"]["clean/b"]["progress"]["baseline"]
        == f"{two}: clean/c"
    )


def test_an_undecided_rule_that_need_not_decide_is_skipped_in_junit(runs, gate_file, tmp_path):
    command = ["gate", str(runs["noisy"]), "--gate", gate_file, "--out", str(tmp_path)]
    assert run_command(command) == 0
    gate = ET.parse(tmp_path / "gate.junit.xml").getroot().find("testsuite")
    assert [
        c.attrib["name"] for c in gate.findall("testcase") if c.find("skipped") is not None
    ] == ["offroad margin"]
    assert gate.attrib["skipped"] == "1"
    Path(gate_file).write_text(EASY.replace(", must_decide: false", ""))
    assert run_command(command) == 3


@pytest.mark.parametrize(
    ("population", "suite", "code"),
    [("suite", "suites/urban", 0), ("scenes", "suites/urban", 2), ("scenes", "suites/all", 0)],
)
def test_a_suite_that_has_not_been_driven_is_refused_if_its_scenes_cannot_decide(
    population, suite, code, tmp_path, capsys
):
    gate = tmp_path / "gate.yaml"
    gate.write_text(
        f"version: 1\npopulation: {population}\nmetrics: {{offroad: {{margin: 0.1}}}}\n"
    )
    assert run_command(["gate", suite, "--gate", str(gate)]) == code
    printed = capsys.readouterr()
    assert ("36" in printed.err) == (code == 2)
    assert run_command(["gate", suite, "--gate", str(gate), "--out", str(tmp_path)]) == 2


def test_compare_names_the_variants_without_a_partner(tmp_path, capsys):
    folders = []
    for name, policies in (("before", ("a", "gone")), ("after", ("a", "new"))):
        plan = Plan(("clean",), policies, ("s",), (0,), steps=5, clips=False)
        folders.append(str(make_run(tmp_path / name, plan)))
    run_command(["compare", *folders, "--json"])
    notes = json.loads(capsys.readouterr().out)["notes"]
    assert len(notes) == 2
    assert "clean/new of" in notes[0]
    assert "clean/gone of" in notes[1]
    run_command(["compare", folders[0], folders[0], "--json"])
    assert json.loads(capsys.readouterr().out)["notes"] == []
