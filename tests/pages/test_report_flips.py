import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from alpasim_plugin.log.run_folder.rows import Rollout
from evaluators.metrics.outcomes import in_words, outcomes_of
from evaluators.pages.cells import cells_of
from evaluators.pages.flips import find_flips, flip_rows
from evaluators.pages.html import write_report
from evaluators.statistics.opening import Run, read_run
from tests.run_records import MINIMAL, run_info


def rollout(renderer, seed=0, status="ok", **metrics):
    return Rollout(renderer, "p", "s", seed, status, metrics=metrics)


def run_of(*rollouts):
    return Run(Path(), run_info({**MINIMAL, "renderers": ["clean", "3dgs"]}), rollouts, ())


@pytest.mark.parametrize(
    ("was", "now", "tone", "words"),
    [
        ({}, {"offroad": 1.0}, "worse", ("no event", "off-road")),
        (
            {"collision_any": 1.0},
            {"collision_any": 1.0, "collision_at_fault": 1.0},
            "worse",
            ("collision", "at-fault collision"),
        ),
        (
            {"collision_any": 1.0, "collision_at_fault": 1.0},
            {},
            "better",
            ("at-fault collision", "no event"),
        ),
        ({"offroad": 1.0}, {"collision_any": 1.0}, "mixed", ("off-road", "collision")),
        (
            {"offroad": 1.0},
            {"offroad": 1.0, "collision_any": 1.0},
            "worse",
            ("off-road", "collision and off-road"),
        ),
    ],
)
def test_a_flip_has_a_side_and_words(was, now, tone, words):
    flips, compared = find_flips(run_of(rollout("clean", **was), rollout("3dgs", **now)))
    assert compared == 1
    (flip,) = flips
    assert (flip.tone, (flip.was, flip.now)) == (tone, words)


def test_equal_outcomes_failed_sides_and_missing_partners_are_no_flips():
    same = (rollout("clean", 0, offroad=1.0), rollout("3dgs", 0, offroad=1.0))
    failed = (rollout("clean", 1), rollout("3dgs", 1, "failed", offroad=1.0))
    alone = (rollout("3dgs", 2, offroad=1.0),)
    assert find_flips(run_of(*same, *failed, *alone)) == ([], 1)


def test_rows_show_both_frames_the_time_and_both_clips(usual_run):
    rows, more, compared = flip_rows(read_run(usual_run), 10**7)
    assert (more, compared) == (
        0,
        44 + 34,
    )  # 48 pairs of renderers, 36 of policies; two cells failed with both policies
    assert len(rows) > 3
    assert [name for name, *_ in rows[0].images] == list(rows[0].flip.sides)
    assert (rows[0].entry["after_us"], rows[0].entry["gap_m"]) == (1_000_000, 0.5)
    assert rows[1].entry["t_us"] is None
    assert rows[1].why_not == "the plans never diverge by more than 0.5 m"
    assert [
        tone for tone in ("worse", "mixed", "better") if any(r.flip.tone == tone for r in rows)
    ] == list(dict.fromkeys(row.flip.tone for row in rows))
    with_clip = next(row for row in rows if row.flip.other.seed == 0)
    assert all(clip is not None and clip.endswith("front.mp4") for _, _, clip, _ in with_clip.links)


def test_policies_behind_one_renderer_flip_as_renderers_do():
    rollouts = [
        Rollout("clean", policy, "s", 0, "ok", metrics={"offroad": value})
        for policy, value in (("a", 0.0), ("b", 1.0))
    ]
    (flip,), compared = find_flips(
        Run(Path(), run_info({**MINIMAL, "policies": ["a", "b"]}), rollouts, ())
    )
    assert (compared, flip.sides, flip.was, flip.now) == (1, ("a", "b"), "no event", "off-road")
    assert flip.key == ("clean", "b", "s", 0, "", "clean/a")


def test_of_two_logs_of_a_cell_the_first_is_compared_with_the_first():
    runs = [
        replace(rollout(renderer, offroad=harm), log=f"{renderer} {name}")
        for name, harm in (("log 1", 0.0), ("log 2", 1.0))
        for renderer in ("clean", "3dgs")
    ]
    assert find_flips(run_of(*runs)) == ([], 2)
    runs[-1] = replace(runs[-1], metrics={"offroad": 0.0})
    (flip,), _ = find_flips(run_of(*runs))
    assert (flip.base.log, flip.other.log, flip.tone) == ("clean log 2", "3dgs log 2", "better")
    first, second = cells_of(run_of(*runs))
    assert (first.take, first.flips, second.take, second.flips) == (1, (flip,), 0, ())


def test_a_drive_that_the_policy_broke_off_is_an_outcome():
    broken = Rollout("3dgs", "p", "s", 0, "failed", "policy")
    (flip,), _ = find_flips(run_of(rollout("clean"), broken))
    assert (flip.was, flip.now, flip.tone) == ("no event", "policy fault", "worse")


def test_a_run_without_logs_lists_flips_with_the_reason_why_nothing_is_known(usual_run, tmp_path):
    for name in ("run.json", "summary.json", "rollouts.parquet"):
        shutil.copy(usual_run / name, tmp_path / name)
    rows, _, _ = flip_rows(read_run(tmp_path), 10**7)
    assert {row.why_not for row in rows} == {"the run folder has no logs to look for it in"}
    text = write_report(tmp_path).read_text()
    assert "No frames: the run folder has no logs to look for it in." in text


def test_frames_outside_the_run_folder_are_not_read(usual_run, tmp_path):
    folder = tmp_path / "run"
    shutil.copytree(usual_run, folder)
    told = json.loads((folder / "flips.json").read_text())
    shutil.copy(folder / "flips/000-0.jpg", tmp_path / "secret.jpg")
    told["cells"][0]["frames"] = dict.fromkeys(told["cells"][0]["frames"], "../secret.jpg")
    (folder / "flips.json").write_text(json.dumps(told))
    assert not flip_rows(read_run(folder), 10**7)[0][0].images


def test_events_name_the_gravest_word_only():
    had = outcomes_of(rollout("clean", collision_any=1.0, collision_at_fault=1.0, offroad=1.0))
    assert in_words(had) == "at-fault collision and off-road"
