"""The gate at the head of the report: verdict, baseline, every check, the worst scenes first."""

import json
import shutil
from dataclasses import replace
from xml.etree import ElementTree

import pyarrow.parquet as pq
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.log.run_folder.checksums import sealed, stated_files
from evaluators.pages import html
from evaluators.pages.ci import write_gate_files
from evaluators.pages.gate import gate_section, worst_of
from evaluators.pages.overview import overview_of
from evaluators.results import Failures
from evaluators.statistics.baselines import table_of_run
from evaluators.statistics.gate import GateVerdict, check_gate, load_gate
from evaluators.statistics.opening import read_run
from evaluators.statistics.verdicts import outcome_of_failures


def test_a_red_gate_names_the_worst_scenes_first_and_only_for_these_rollouts(usual_run, tmp_path):
    root = tmp_path / "run"
    shutil.copytree(usual_run, root)
    run = read_run(root)
    spec, source = load_gate("default", run.table)
    verdict = check_gate(table_of_run(run), spec, None, "", run.table)
    files = write_gate_files(verdict, source, run, root)
    assert [file.name for file in files] == ["gate.md", "gate.junit.xml", "gate.json"]
    section = gate_section(run)
    assert (section["exit_code"], section["baseline"]) == (verdict.exit_code, verdict.baseline)
    assert len(section["checks"]) == len(verdict.checks)
    assert section["worst"]
    first = [row for row in section["worst"] if row["metric"] == section["worst"][0]["metric"]]
    assert all((run.folder / str(row["page"])).exists() for row in first)
    page = html.render_report(run)
    assert page.index('id="gate"') < page.index('id="results"')
    assert section["worst"][0]["scene"] in page[page.index('id="table-gate-worst"') :]
    text = (root / "gate.md").read_text()
    (size,) = verdict.sizes
    for place in (text, page, (root / "gate.junit.xml").read_text()):
        assert size.replace("\u00a0", " ") in place.replace("\u00a0", " ")
    assert section["worst"][0]["scene"] in text
    assert all(row.name in text for row in overview_of(run).rows)
    assert {file.name for file in files} <= stated_files(root).keys()
    stored = json.loads(files[2].read_text())
    passed = stored["outcome"] | {"cause": "pass", "exit_code": 0}
    del stored["sha256"]
    for edited in (stored | {"outcome": passed}, sealed(stored) | {"outcome": passed}):
        files[2].write_text(json.dumps(edited))
        with pytest.raises(InputError):
            gate_section(run)
    table = pq.read_table(root / "rollouts.parquet")
    pq.write_table(table.slice(0, table.num_rows - 1), root / "rollouts.parquet")
    assert gate_section(read_run(root)) is None


@pytest.mark.parametrize(("max_failed", "is_red"), [(0.0, True), (0.9, False)])
def test_junit_is_red_for_failed_rollouts_only_where_the_gate_is(
    usual_run, tmp_path, max_failed, is_red
):
    run = read_run(shutil.copytree(usual_run, tmp_path / "run"))
    failed = replace(run.rollouts[0], status="failed", failure_class="renderer", failure="it fell")
    run = replace(run, rollouts=[failed, *run.rollouts[1:]])
    n_failed = sum(not rollout.ok for rollout in run.rollouts)
    n_rollouts = len(run.rollouts)
    failures = Failures(n_failed, n_rollouts, {"renderer": n_failed})
    outcome = outcome_of_failures(failures, max_failed)
    verdict = GateVerdict(outcome, (), failures, "before", "", accepts_failures=not is_red)
    file = write_gate_files(verdict, "gate", run, tmp_path / "files")[1]
    root = ElementTree.parse(file).getroot()
    numbers = [int(root.get(name)) for name in ("errors", "failures", "skipped")]
    assert numbers == ([n_failed, 1, 0] if is_red else [0, 0, n_failed])


def test_what_breaks_a_rule_is_named_once_and_before_what_is_undecided():
    pair = {"scene": "bend", "seed": 0, "was": 0.0, "now": 1.0}
    undecided = {"metric": "progress", "renderer": "r", "policy": "p", "cause": "undecided"}
    broken = undecided | {"metric": "collision_any", "cause": "regression"}
    passed = undecided | {"cause": "pass"}
    checks = [check | {"entry": {"worst": [pair]}} for check in (passed, undecided, broken, broken)]
    assert [(one["metric"], one["scene"]) for one in worst_of(checks)] == [
        ("collision_any", "bend"),
        ("progress", "bend"),
    ]
