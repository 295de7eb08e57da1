"""Every page says what ``summary.json`` says: results are made once, by statistics."""

import ast
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from jinja2 import Environment, nodes

from alpasim_plugin.cli.main import run_command
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.log.run_folder.checksums import state_files
from alpasim_plugin.log.run_folder.manifests import (
    read_manifest,
    read_run_json,
    write_manifest,
    write_run_json,
)
from alpasim_plugin.log.run_folder.records import MetricValue
from alpasim_plugin.log.run_folder.schema import RUN_INFO, TABLES
from alpasim_plugin.runs.reports import write_reports
from alpasim_plugin.runs.summary import write_summary
from evaluators.metrics import METRICS
from evaluators.pages.overview import overview_of
from evaluators.pages.terminal import overview_lines
from evaluators.results import read_summary
from evaluators.statistics.opening import read_run
from evaluators.statistics.paired import paired
from tests.pages.make_run import Plan, make_run
from tests.statistics_imports import computing_imports

REPO = Path(__file__).resolve().parents[2]
PRIMARY = METRICS.primary
SCENES = tuple(f"scene-{k}" for k in range(6))
VARIANTS = ("3dgs", "other")


@pytest.fixture(scope="module")
def two_changes(tmp_path_factory):
    """Make a run in which two variants are worse in all of six scenes: each test by itself has
    p = 2 / 2 ** 6 = 0.03125, and with Holm's correction for the two of them 0.0625.
    """
    root = tmp_path_factory.mktemp("pages") / "run"
    renderers = ("clean", *VARIANTS)
    plan = Plan(renderers, scenes=SCENES, seeds=(0,), steps=30, clips=False)
    make_run(root, plan)
    manifests = []
    for rollout in read_run(root).rollouts:
        folder = root / rollout.path
        manifest = read_manifest(folder)
        value = 0.0 if rollout.renderer == "clean" else 1.0
        metrics = manifest.metrics | {PRIMARY: MetricValue(value, True, "", "", "lower")}
        manifest = replace(manifest, metrics=metrics)
        write_manifest(folder, manifest)
        manifests.append(manifest)
    info = read_run_json(root)
    write_summary(root, info, manifests, root)
    state_files(root, [RUN_INFO, *TABLES])
    write_reports(root)
    return root


def test_screen_report_file_and_compare_say_the_same_of_two_variants(two_changes, capsys):
    stored = json.loads((two_changes / "summary.json").read_text())
    for variant in VARIANTS:
        entry = stored["paired"][variant][PRIMARY]
        assert entry["p_value"] == pytest.approx(0.03125)
        assert entry["p_corrected"] == pytest.approx(0.0625)
        assert (entry["verdict"], entry["difference"]) == ("undecided", None)
    shown = overview_of(read_run(two_changes))
    assert {row.difference.tone for row in shown.rows if row.difference} == {"unclear"}
    assert shown.decision.replace("\u00a0", " ").startswith("Not decided with 6 scenes")
    screen = "\n".join(line.plain for line in overview_lines(shown, 120))
    page = (two_changes / "report.html").read_text()
    markdown = (two_changes / "summary.md").read_text()
    for text in (screen, page, markdown):
        assert "Not decided with 6" in text
        assert "drives worse than" not in text
    rows = [line for line in markdown.splitlines() if f"| clean | {PRIMARY} |" in line]
    assert [row.split(" | ")[0].strip("| ") for row in rows] == list(VARIANTS)
    for row in rows:
        assert row.rstrip(" |").endswith("| 0.062 | undecided")
    assert run_command(["compare", str(two_changes), "--json"]) == 0
    compared = json.loads(capsys.readouterr().out)
    assert compared["paired"] == stored["paired"]
    assert run_command(["compare", str(two_changes)]) == 0
    printed = capsys.readouterr().out
    assert "Not decided with 6" in printed
    assert "drives worse" not in printed


def test_one_variant_alone_is_decided_by_its_own_test(tmp_path, two_changes):
    run = read_run(two_changes)
    rows = [
        {
            "renderer": rollout.renderer,
            "policy": rollout.policy,
            "scene": rollout.scene,
            "seed": rollout.seed,
            PRIMARY: rollout.metrics[PRIMARY],
            f"{PRIMARY}_valid": True,
        }
        for rollout in run.rollouts
        if rollout.renderer != "other"
    ]
    entry = paired(rows, "clean")["3dgs"][PRIMARY]
    assert entry.p_value == entry.p_corrected == pytest.approx(0.03125)
    assert entry.difference == "worse"


@pytest.mark.slow
def test_variants_that_are_alike_are_called_different_on_few_pages():
    """Two renderers beside a baseline, all alike, and 20 metrics of twelve scenes."""
    names = [PRIMARY, "offroad", "collision_any", "stalled", "left_route"]
    names += [
        name
        for name, metric in METRICS.items()
        if metric.direction != "none" and not metric.is_flag and name not in names
    ][: 20 - len(names)]
    rng = np.random.default_rng(74)
    wrong = {"corrected": 0, "by itself": 0}
    pages = 60
    for _ in range(pages):
        rows = [
            {"renderer": renderer, "policy": "p", "scene": f"s{scene:02d}", "seed": 0}
            | {
                name: float(rng.random() < 0.3) if METRICS[name].is_flag else float(rng.random())
                for name in names
            }
            | {f"{name}_valid": True for name in names}
            for renderer in ("clean", "3dgs", "onefixer")
            for scene in range(12)
        ]
        entries = [entry for table in paired(rows, "clean").values() for entry in table.values()]
        assert len(entries) == 40
        wrong["corrected"] += any(
            entry.difference is not None or entry.verdict == "worse" for entry in entries
        )
        wrong["by itself"] += any(entry.p_value < 0.05 for entry in entries)
    assert wrong["corrected"] <= 0.1 * pages  # 5 % and what 60 pages may differ from it
    assert wrong["by itself"] > 0.5 * pages


def test_a_summary_of_the_first_schema_is_refused_with_the_command_that_writes_it_again(
    tmp_path, two_changes, capsys
):
    old = tmp_path / "old"
    shutil.copytree(two_changes, old)
    path = old / "summary.json"
    content = json.loads(path.read_text())
    del content["schema"]
    path.write_text(json.dumps(content))
    state_files(old, [RUN_INFO, *TABLES])
    with pytest.raises(InputError, match="schema 1") as caught:
        read_run(old)
    assert "simrun run --renderer clean,3dgs,other" in caught.value.hint
    for verb in ("compare", "report", "gate"):
        assert run_command([verb, str(old)]) == 2
        assert "simrun run --renderer clean,3dgs,other" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("path", "value", "member"),
    [
        (("preset",), None, "preset"),
        (("metrics", "clean", PRIMARY, "mean"), "0.3", "mean"),
        (("paired", "3dgs", PRIMARY, "verdict"), "fine", "verdict"),
        (("paired", "3dgs", PRIMARY, "ci95"), [0.1], "ci95"),
    ],
)
def test_a_member_of_another_type_is_refused_by_its_name(
    tmp_path, two_changes, path, value, member
):
    content = json.loads((two_changes / "summary.json").read_text())
    place = content
    for name in path[:-1]:
        place = place[name]
    place[path[-1]] = value
    file = tmp_path / "summary.json"
    file.write_text(json.dumps(content))
    with pytest.raises(InputError, match=member):
        read_summary(file, "write it again")


@pytest.mark.parametrize(
    ("member", "value", "problem"),
    [
        ("seeds", ["0"], "seeds.0"),
        ("key", None, "key"),
        ("scenes", {"one": {"ref": {"seed": 1}}}, "scenes.one.ref.path"),
        ("pool", {"workers": "two"}, "pool.workers"),
    ],
)
def test_a_run_json_with_a_member_of_another_type_is_refused_by_its_name(
    tmp_path, two_changes, capsys, member, value, problem
):
    damaged = tmp_path / "damaged"
    shutil.copytree(two_changes, damaged)
    path = damaged / RUN_INFO
    content = json.loads(path.read_text()) | {member: value}
    path.write_text(json.dumps(content))
    state_files(damaged, [RUN_INFO, *TABLES])
    assert run_command(["compare", str(damaged)]) == 2
    assert f"run.json: {problem}: " in capsys.readouterr().err


def test_what_run_json_says_survives_the_file(tmp_path, two_changes):
    info = read_run_json(two_changes)
    write_run_json(tmp_path, info)
    assert read_run_json(tmp_path) == info
    assert info.metrics == {}
    assert info.pool is not None


def test_what_a_summary_says_survives_the_file(two_changes):
    summary = read_run(two_changes).summary
    assert summary == read_summary(two_changes / "summary.json", "")
    assert isinstance(summary.paired["3dgs"][PRIMARY].ci95, tuple)


PAGES = sorted((REPO / "evaluators" / "pages").glob("*.py"))
TEMPLATES = sorted((REPO / "evaluators" / "pages" / "templates").glob("*.j2"))


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_pages_import_nothing_of_statistics_that_makes_a_result(path):
    assert computing_imports(ast.walk(ast.parse(path.read_text()))) == []


def test_a_page_that_corrects_p_values_is_found():
    source = "from evaluators.statistics.verdicts import holm"
    assert computing_imports(ast.walk(ast.parse(source))) == ["holm"]


@pytest.mark.parametrize("path", TEMPLATES, ids=lambda path: path.name)
def test_templates_print_and_do_not_compute(path):
    tree = Environment().parse(path.read_text())
    sums = (nodes.Add, nodes.Sub, nodes.Mul, nodes.Div, nodes.FloorDiv, nodes.Pow, nodes.Neg)
    found = [(type(node).__name__, node.lineno) for node in tree.find_all(sums)]
    found += [
        (node.name, node.lineno)
        for node in tree.find_all(nodes.Filter)
        if node.name in ("sum", "round", "abs", "min", "max")
    ]
    assert found == []
