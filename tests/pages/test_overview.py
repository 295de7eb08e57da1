"""The first screen of a run: one table, printed in the terminal, report.html, summary.md and
gate.md.
"""

import base64
import dataclasses
import re
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from alpasim_plugin.core.errors import EvaluatorError
from alpasim_plugin.log import encode_image
from alpasim_plugin.log.run_folder.manifests import write_manifest
from evaluators.metrics import METRICS
from evaluators.pages import worst
from evaluators.pages.ci import write_summary_md
from evaluators.pages.html import write_report
from evaluators.pages.overview import decided, overview_of, tone_of
from evaluators.pages.terminal import overview_lines
from evaluators.results import Difference, Endings
from evaluators.statistics.numbers import DASH
from evaluators.statistics.opening import read_run
from tests.pages.make_run import Plan, make_run
from tests.run_records import manifest

PRIMARY = METRICS.primary


def pair(diff, low, high, verdict, **more):
    facts = {"baseline": "clean", "diff": diff, "ci95": (low, high), "p_value": 0.01}
    facts |= {"unit": "", "direction": "lower", "verdict": verdict, "margin": 0.02}
    return Difference(**facts | {"n_cells": 9, "n_scenes": 3} | more)


def with_pairs(folder, **entries):
    """Return a run of one policy with these primary differences."""
    run = read_run(folder)
    paired = {variant: {PRIMARY: entry} for variant, entry in entries.items()}
    summary = dataclasses.replace(run.summary, paired=paired, paired_with_base={})
    return dataclasses.replace(run, summary=summary)


@pytest.fixture(scope="module")
def three(tmp_path_factory):
    return make_run(tmp_path_factory.mktemp("three"), Plan(steps=40, clips=False))


def test_every_rollout_is_counted_once_under_its_variant(usual_run):
    shown = overview_of(read_run(usual_run))
    assert [row.n_rollouts for row in shown.rows] == [12] * 6
    for row in shown.rows:
        name, *cells = shown.cells(row)
        counts = [int(cell) for cell in cells[: len(shown.endings)]]
        assert name == row.name
        assert sum(counts) == row.n_rollouts
    assert [row for row in shown.rows if row.is_baseline] == [
        row for row in shown.rows if row.difference is None
    ]
    assert [row.name for row in shown.rows if row.difference is None] == [
        "clean/lane-camera",
        "clean/pure-pursuit",
    ]
    lost = [row.endings.get("not run", 0) for row in shown.rows]
    assert sum(lost) == 4
    assert all(row.where.endswith("not run") for row in shown.rows if row.endings.get("not run"))


def test_what_could_not_be_run_is_no_failure_of_the_driving(tmp_path):
    harm = {"clean": 0.15, "3dgs": 8.0}
    for renderers in (("clean", "3dgs"), ("3dgs",)):
        for fail in ((), (("3dgs", "scene-1", 0),)):
            scenes = tuple(f"scene-{k}" for k in range(5))
            plan = Plan(renderers, scenes=scenes, seeds=(0,), steps=30, clips=False,
                        harm=harm, fail=fail)  # fmt: skip
            folder = tmp_path / f"{len(renderers)}-{len(fail)}"
            shown = overview_of(read_run(make_run(folder, plan)))
            row = next(row for row in shown.rows if row.renderer == "3dgs")
            counts = shown.counts.replace("\u00a0", " ")
            n_bad = int(re.search(r"(\d+) fail", counts).group(1))
            assert row.n_lost == len(fail)
            assert f"fails in {n_bad} of {5 - len(fail)} rollouts" in shown.title.replace(
                "\u00a0", " "
            )
            if len(renderers) == 1:
                assert shown.badge[0].startswith(f"{n_bad} of 5")
    lost = dataclasses.replace(row, endings={"not run": 2, "reached the end": 3}, places={})
    only = dataclasses.replace(shown, rows=(lost,))
    assert only.badge[0].replace("\u00a0", " ") == "2 of 5 rollouts could not be run"
    assert only.title.replace("\u00a0", " ") == "3dgs: 2 of 5 rollouts not run"


def test_terminal_markdown_and_page_print_the_same_cells(three):
    shown = overview_of(read_run(three))
    terminal = "\n".join(line.plain for line in overview_lines(shown, 100))
    markdown = write_summary_md(read_run(three)).read_text()
    page = re.sub(r"<[^>]*>", " ", write_report(three).read_text())
    for row in shown.rows:
        numbers = [cell.replace("\u00a0", " ") for cell in shown.cells(row)]
        assert re.search(r"\s+".join(map(re.escape, numbers)), terminal)
        assert " | ".join(numbers).replace("*", "\\*") in markdown
        assert row.primary in page
        for name, n in row.endings.items():
            assert (
                f"{n} {'end' if name == 'reached the end' and len(row.endings) > 1 else name}"
                in page
            )
    for text in (shown.decision, shown.title):
        assert text.replace("\u00a0", " ") in " ".join(page.replace("\u00a0", " ").split())
    assert terminal.count("would decide") <= 1


@pytest.mark.parametrize("width", [80, 120])
def test_nothing_is_broken_or_wider_than_the_terminal_with_long_names(tmp_path, width):
    names = [f"drivers.py:PurePursuitWithALongName{letter * 12}" for letter in "abcd"]
    plan = Plan(("clean",), ("log-replay", *names), seeds=(0,), steps=30)
    shown = overview_of(read_run(make_run(tmp_path, plan)))
    lines = [line.plain for line in overview_lines(shown, width)]
    assert all(len(line) <= width for line in lines)
    assert all(any(name in line for line in lines) for name in names)


@pytest.mark.parametrize("width", [0, 1, 30])
def test_a_terminal_narrower_than_the_plot_shows_every_difference(three, width):
    shown = overview_of(read_run(three))
    lines = [line.plain for line in overview_lines(shown, width)]
    differences = [row.difference.text for row in shown.rows if row.difference is not None]
    assert differences
    assert all(text in "\n".join(lines) for text in differences)


def test_an_undecided_difference_names_the_scenes_once_and_is_never_called_equal(
    three,
):
    few = pair(0.25, -0.1, 0.6, "undecided", more_scenes=26, cut_mean=0.25, p_value=1.0)
    none = pair(0.0, -0.5, 0.5, "undecided", more_scenes=180, cut_mean=0.0, p_value=1.0)
    run = with_pairs(three, **{"3dgs": few, "onefixer": none})
    shown = overview_of(run)
    assert [row.difference and row.difference.tone for row in shown.rows] == [
        None,
        "unclear",
        "unclear",
    ]
    assert shown.decision.replace("\u00a0", " ").count("with 3 scenes") == 1
    assert shown.decision.replace("\u00a0", " ") == (
        "Not decided with 3 scenes: about 29 would show that 3dgs is worse than clean by more than "
        "2 points; about 183 would show that onefixer is within 2 points of clean"
    )


def test_two_questions_about_one_variant_have_a_number_each(three):
    entry = pair(0.25, -0.1, 0.6, "undecided", more_scenes=24, cut_mean=0.25, p_value=1.0)
    entry = dataclasses.replace(entry, more_scenes_to_differ=21)
    assert overview_of(with_pairs(three, **{"3dgs": entry})).decision.endswith(
        "about 24 would show that 3dgs is worse than clean and about 27 that it is by more than 2 points"
    )
    better = pair(-0.1, -0.6, 0.1, "undecided", more_scenes=57, cut_mean=-0.1, p_value=1.0)
    better = dataclasses.replace(better, more_scenes_to_differ=274)
    assert overview_of(with_pairs(three, **{"3dgs": better})).decision.endswith(
        "about 277 would show that 3dgs is better than clean and about 60 that it is within 2 points "
        "of clean"
    )


def test_the_shipped_scenes_are_named_where_they_are_enough_for_an_open_question(three):
    few = pair(0.25, -0.1, 0.6, "undecided", more_scenes=26, cut_mean=0.25, p_value=1.0)
    none = pair(0.0, -0.5, 0.5, "undecided", more_scenes=180, cut_mean=0.0, p_value=1.0)
    run = with_pairs(three, **{"3dgs": few, "onefixer": none})
    command = "simrun --renderer clean,3dgs --policy lane-camera suites/all drives 42"
    for asked, is_named in ((("suites/first",), True), (("mine.yaml",), False), (None, False)):
        info = dataclasses.replace(run.info, asked=asked)
        decision = overview_of(dataclasses.replace(run, info=info)).decision
        assert (command in decision) == is_named
    only_none = with_pairs(three, **{"onefixer": none})
    info = dataclasses.replace(run.info, asked=("suites/first",))
    assert "simrun" not in overview_of(dataclasses.replace(only_none, info=info)).decision


def test_what_is_decided_is_named_beside_what_is_not(three):
    run = with_pairs(
        three,
        **{
            "3dgs": pair(0.25, 0.1, 0.4, "worse"),
            "onefixer": pair(0.0, -0.1, 0.1, "undecided", p_value=1.0),
        },
    )
    shown = overview_of(run)
    assert [row.difference and row.difference.tone for row in shown.rows] == [
        None,
        "worse",
        "unclear",
    ]
    first, second = shown.decision.split(". ")
    assert first.startswith("3dgs drives worse than clean")
    assert "onefixer" in second
    assert decided(()) == ""


def test_with_several_policies_a_renderer_is_compared_with_the_baseline_of_its_own_policy(
    usual_run,
):
    shown = overview_of(read_run(usual_run))
    assert shown.baselines == "clean"
    assert {row.name for row in shown.rows if row.difference} == {
        f"{renderer}/{policy}"
        for renderer in ("3dgs", "onefixer")
        for policy in ("lane-camera", "pure-pursuit")
    }


def test_a_distance_that_an_event_cut_short_says_so(three):
    run = read_run(three)
    ledgers = {
        name: dataclasses.replace(entry, steps_after_event=5 * (name == "3dgs"))
        for name, entry in run.summary.censoring.items()
    }
    summary = dataclasses.replace(run.summary, censoring=ledgers)
    shown = overview_of(dataclasses.replace(run, summary=summary))
    assert [row.is_cut_short for row in shown.rows] == [False, True, False]
    assert [shown.cells(row)[-2].endswith("*") for row in shown.rows] == [False, True, False]


@pytest.mark.parametrize(
    ("verdict", "difference", "tone"),
    [
        ("undecided", None, "unclear"),
        ("undecided", "worse", "worse"),
        ("non-inferior", "worse", "neutral"),
        ("non-inferior", "better", "better"),
        ("worse", None, "worse"),
    ],
)
def test_tone_of_a_difference(verdict, difference, tone):
    assert tone_of(pair(0.1, 0.0, 0.2, verdict, difference=difference)) == tone


@pytest.mark.parametrize(("failed", "tone"), [({}, "unclear"), ({"off-road": 1}, "worse")])
def test_the_headline_counts_rollouts_that_do_not_reach_the_end(three, failed, tone):
    run = read_run(three)
    short = Endings(2, 2, 0, 0, endings={"end not reached": 2}, outcomes={})
    other = dataclasses.replace(short, endings=short.endings | failed)
    summary = dataclasses.replace(run.summary, outcomes={"clean/a": short, "clean/b": other})
    shown = overview_of(dataclasses.replace(run, summary=summary))
    assert shown.badge[1] == tone
    words = ["1 fails"] if failed else []
    words.append("4 stop short of the end without a failure")
    assert shown.counts == f"{4 + len(failed)}\u00a0rollouts: {', '.join(words)}"


def test_the_line_of_counts_adds_up_to_the_rollouts(usual_run, three):
    for folder in (usual_run, three):
        shown = overview_of(read_run(folder))
        total, parts = shown.counts.split(": ")
        assert int(total.split()[0]) == sum(int(part.split()[0]) for part in parts.split(", "))
        assert int(total.split()[0]) == sum(row.n_rollouts for row in shown.rows)
        lines = [line.plain for line in overview_lines(shown, 100)]
        assert shown.counts.replace("\u00a0", " ") in " ".join(lines).replace("\u00a0", " ")
        page = write_report(folder).read_text()
        assert page.count('data-ended="') == sum(len(row.endings) for row in shown.rows)


def test_an_evaluator_declares_no_second_primary_question():
    with pytest.raises(EvaluatorError, match=f"'{PRIMARY}' is primary"):
        METRICS.adding({"mine": dataclasses.replace(METRICS.info(PRIMARY), name="mine")})


def grey(value):
    return encode_image(np.full((9, 16, 3), value, dtype=np.uint8), "jpeg", 95)


def test_images_are_of_one_instant_baseline_variant_and_what_repairs_it(three, monkeypatch):
    run = read_run(three)
    scene = run.scenes[0]
    first = [one for one in run.rollouts if one.scene == scene][-1]  # of the last seed
    for one in run.rollouts:
        (run.folder / one.path / "rollout.asl").touch()
    every = []
    for one in run.rollouts:
        hit = float((one.scene, one.seed, one.renderer) == (scene, first.seed, "3dgs"))
        flags = {"collision_any": hit, "collision_at_fault": hit, "offroad": 0.0}
        every.append(dataclasses.replace(one, metrics={**one.metrics, **flags}))
    rollouts = [one for one in every if (one.scene, one.seed) == (scene, first.seed)]
    run = dataclasses.replace(
        run, rollouts=tuple(every), info=dataclasses.replace(run.info, bases={"onefixer": "3dgs"})
    )
    for one in rollouts:
        (run.folder / one.path / "rollout.asl").touch()
        events = [{"metric": "collision_front", "t_us": 3_300_000}]
        members = {"events": events, "path": one.path, "status": "failed"}
        write_manifest(run.folder / one.path, manifest(members))
    images = [
        SimpleNamespace(camera=camera, end_us=1_000_000 * k, data=grey(level * k))
        for k in range(6)
        for camera, level in (("front", 50), ("left", 20))
    ]
    log = SimpleNamespace(images=images, render_start_us=500_000)
    darker = [
        SimpleNamespace(camera=image.camera, end_us=image.end_us, data=grey(10)) for image in images
    ]
    of_other_seeds = SimpleNamespace(images=darker, render_start_us=500_000)
    folders = {run.folder / one.path for one in rollouts}
    monkeypatch.setattr(
        worst, "read_log", lambda path: log if path.parent in folders else of_other_seeds
    )
    shots = worst.worst_change(run)
    assert [shot.variant for shot in shots] == ["clean", "3dgs", "onefixer"]
    assert {(shot.scene, round(shot.t_s, 3)) for shot in shots} == {(scene, 2.8)}
    for shot in shots:
        data = np.frombuffer(base64.b64decode(shot.src.split(",")[1]), dtype=np.uint8)
        upper, lower = np.split(cv2.imdecode(data, cv2.IMREAD_COLOR), 2)
        np.testing.assert_allclose((upper.mean(), lower.mean()), (150.0, 60.0), atol=3)


def test_where_the_policy_broke_before_it_saw_anything_the_next_change_has_the_image(
    three, monkeypatch
):
    run = read_run(three)
    cell = [one for one in run.rollouts if (one.scene, one.seed) == (run.scenes[0], 0)]
    base, unseen, late = (dataclasses.replace(one, metrics={}) for one in cell)
    unseen, late = (
        dataclasses.replace(one, status="failed", failure_class="policy") for one in (unseen, late)
    )
    run = dataclasses.replace(run, rollouts=(base, unseen, late))
    images = [SimpleNamespace(camera="front", end_us=k * 100_000, data=grey(10)) for k in range(9)]
    ego = SimpleNamespace(t_us=np.arange(9) * 100_000)
    log = SimpleNamespace(images=images, render_start_us=0, ego=ego)
    for one in (unseen, late):
        (run.folder / one.path / "rollout.asl").unlink(missing_ok=True)
    for one, name in ((base, "rollout.asl"), (late, "rollout.asl.part")):
        (run.folder / one.path / name).touch()
    monkeypatch.setattr(worst, "read_log", lambda path: log)
    shots = worst.worst_change(run)
    assert [(shot.variant, shot.outcome) for shot in shots] == [
        (base.renderer, "no event"),
        (late.renderer, "policy fault"),
    ]
    assert [shot.t_s for shot in shots] == pytest.approx([0.8, 0.8])


def test_the_worst_rollout_failed_or_is_the_farthest_from_its_path(three):
    first = read_run(three).rollouts[0]
    unhurt = first.metrics | {"collision_any": 0.0, "collision_at_fault": 0.0, "offroad": 0.0}
    near, far, hit = (
        dataclasses.replace(first, metrics=unhurt | metrics)
        for metrics in (
            {"lateral_distance_m": 0.4},
            {"lateral_distance_m": 1.9},
            {"lateral_distance_m": 0.1, "collision_any": 1.0, "collision_at_fault": 1.0},
        )
    )
    assert sorted((near, far, hit), key=worst._rank) == [hit, far, near]


def test_a_missing_number_is_a_dash_and_never_zero(tmp_path):
    plan = Plan(("3dgs",), scenes=("a",), seeds=(0,), steps=3, fail=[("3dgs", "a", 0)])
    (row,) = overview_of(read_run(make_run(tmp_path, plan))).rows
    assert (row.primary, row.distance) == (DASH, DASH)
    assert row.endings == {"not run": 1}
