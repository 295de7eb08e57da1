"""What a page is told of a run: poses, frames, road users, curves and events are those of the logs
and tables.
"""

import base64
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.types import Vehicle
from alpasim_plugin.log import read_asl, read_facts, write_facts, write_mp4
from alpasim_plugin.log.run_folder.rows import series_by_rollout
from evaluators.pages.cells import (
    Wanted,
    cell_data,
    cells_of,
    check_wanted,
    read_logs,
    shown_by_default,
)
from evaluators.pages.page import write_page
from evaluators.pages.rollouts import SERIES, events_of
from evaluators.statistics.opening import read_run
from tests.pages.make_run import DT_US, Plan
from tests.pages.make_watched import BARS, WATCHED, make_watched, picture

SMALL = Plan(renderers=("clean", "3dgs"), scenes=("smoke-straight",), seeds=(0,), steps=12)


def documents(html):
    """Return the JSON of a page by the id of its element."""
    found = re.findall(r'<script type="application/json" id="([\w-]+)">(.*?)</script>', html, re.S)
    return {name: json.loads(text) for name, text in found}


def number_of(jpeg):
    """Read which frame a picture is."""
    grey = cv2.imdecode(np.frombuffer(base64.b64decode(jpeg), dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
    wide = grey.shape[1] // BARS
    return sum(
        1 << (BARS - 1 - bit)
        for bit in range(BARS)
        if grey[4:-4, bit * wide + 2 : (bit + 1) * wide - 2].mean() > 127
    )


@pytest.fixture(scope="module")
def small_run(tmp_path_factory):
    return make_watched(tmp_path_factory.mktemp("small"), SMALL)


def only_cell(root):
    run = read_run(root)
    (cell,) = cells_of(run)
    return cell_data(run, cell, read_logs(run, cell))


def test_poses_are_those_of_the_log(watched_run):
    run = read_run(watched_run)
    cell = cells_of(run)[0]
    data = cell_data(run, cell, read_logs(run, cell))
    content = run.scene_data(cell.scene)
    origin = np.array([content["ego_log"][key][0] for key in ("x_m", "y_m")])
    for rollout, drive in zip(cell.rollouts, data["drives"], strict=True):
        log = read_asl(watched_run / rollout.path / "rollout.asl", images=False)
        drawn = np.column_stack([drive["ego"]["x"], drive["ego"]["y"]]) / 100 + origin
        assert np.abs(drawn - log.ego.xyz[:, :2]).max() < 0.006
        assert drive["ego"]["t"] == (log.ego.t_us // 1000).tolist()
        plan = np.column_stack(drive["plans"][3]["lines"][0]) / 100 + origin
        assert drive["plans"][3]["t"] == 300
        assert (
            np.abs(plan - log.plans[3].trajectory.xyz[::5, :2]).max() < 0.006
        )  # one point every half second
        assert len(drive["plans"][3]["lines"]) == 3  # the plan and two samples


def test_every_frame_comes_with_its_own_time(small_run):
    for drive in only_cell(small_run)["drives"]:
        (camera,) = drive["cameras"]
        assert (
            [number_of(jpeg) for jpeg in camera["jpeg"]]
            == [t // (DT_US // 1000) for t in camera["t"]]
            == list(range(SMALL.steps))
        )


def test_two_logs_of_one_cell_are_two_cells(small_run):
    run = read_run(small_run)
    twice = replace(
        run, rollouts=(*run.rollouts, *(replace(one, path=f"{one.path}-2") for one in run.rollouts))
    )
    first, second = cells_of(twice)
    assert (first.take, second.take) == (0, 1)
    assert [rollout.renderer for rollout in second.rollouts] == ["clean", "3dgs"]
    assert first.id != second.id
    assert second.name.endswith(", log 2")


def test_a_road_user_that_goes_the_same_way_everywhere_is_kept_once(small_run):
    data = only_cell(small_run)
    base, other = (set(drive["users"]) for drive in data["drives"])
    assert len(base) == len(other) == 6
    assert len(base & other) == 5  # of every third one, the first moves and the second stands
    assert len(data["users"]) == 7
    standing = next(user for user in data["users"] if user["id"] == "user-3")
    assert standing["x"][0] == standing["x"][-1]
    assert len(standing["t"]) == 2


def test_events_are_at_the_times_that_the_report_states(watched_run):
    run = read_run(watched_run)
    seen = 0
    for cell in cells_of(run):
        data = cell_data(run, cell, read_logs(run, cell))
        series = series_by_rollout(run.steps(SERIES, [cell.scene]))
        for rollout, drive in zip(cell.rollouts, data["drives"], strict=True):
            stated = [
                (event.kind, round(event.t_s * 1000))
                for event in events_of(rollout, series)
                if event.t_s is not None
            ]
            assert [
                (one["kind"], one["t"]) for one in drive["moments"] if one["kind"] != "frame"
            ] == stated
            frames = [(one["text"], one["t"]) for one in drive["moments"] if one["kind"] == "frame"]
            assert frames == [("frame: replaced", 100 * (WATCHED.steps // 3))]
            seen += len(stated)
    assert seen >= 3


def test_where_pictures_come_from_is_shown_and_said_before_an_event(watched_run, tmp_path):
    root = Path(shutil.copytree(watched_run, tmp_path / "run"))
    run = read_run(root)
    cell = next(one for one in cells_of(run) if one.flips)
    told = []
    for rollout in cell.rollouts:
        path = root / rollout.path / "frames.jsonl"
        cells = [f"1x1:{i % 10}f" for i, _ in enumerate(read_facts(path))]
        own = {"recorded_share": 0.75, "guessed_share": 0.125}
        write_facts(
            path,
            [
                row | own | {"trust_cells": text}
                for row, text in zip(read_facts(path), cells, strict=True)
            ],
        )
        told.append(cells)
    drives = cell_data(run, cell, read_logs(run, cell))["drives"]
    assert [drive["cameras"][0]["trust"] for drive in drives] == told
    words = [one["text"] for drive in drives for one in drive["moments"] if one["kind"] != "frame"]
    assert words
    assert all(
        "12 % of what it saw in the second before was made up by the fixer, 75 % was recorded"
        in text
        for text in words
    )


def test_what_is_not_valid_has_no_value_and_a_reason(small_run):
    curves = only_cell(small_run)["drives"][0]["curves"]
    assert curves["min_distance_to_obstacle_m"]["v"] == [None]
    assert curves["min_distance_to_obstacle_m"]["why"] == "no other road user within 50 m"
    assert len(curves["lateral_bias_m"]["v"]) == SMALL.steps
    assert "why" not in curves["lateral_bias_m"]
    assert "ego_x_m" not in curves


def test_without_frames_the_page_says_how_to_get_them_or_takes_the_video(tmp_path):
    root = make_watched(tmp_path, SMALL, cameras=())
    for drive in only_cell(root)["drives"]:
        assert drive["cameras"] == []
        assert "--video all" in drive["no_frames"]
    run = read_run(root)
    for rollout in run.rollouts:
        write_mp4(root / rollout.path / "front.mp4", [picture(k) for k in range(SMALL.steps)], 10)
    for drive in only_cell(root)["drives"]:
        assert [number_of(jpeg) for jpeg in drive["cameras"][0]["jpeg"]] == list(range(SMALL.steps))
        assert drive["cameras"][0]["t"] == [100 * k for k in range(SMALL.steps)]


def test_a_missing_or_damaged_log_is_told_in_its_place_and_the_others_are_shown(
    small_run, tmp_path
):
    root = Path(shutil.copytree(small_run, tmp_path / "run"))
    log = root / read_run(root).rollouts[0].path / "rollout.asl"
    log.write_bytes(b"no log")
    damaged, whole = only_cell(root)["drives"]
    assert damaged["failed"].startswith("its log cannot be read: ")
    assert len(whole["cameras"][0]["t"]) == SMALL.steps
    log.unlink()
    assert "is missing" in only_cell(root)["drives"][0]["failed"]


def test_a_scene_file_whose_lanes_lack_their_markings_is_refused(small_run, tmp_path):
    root = Path(shutil.copytree(small_run, tmp_path / "run"))
    (path,) = (root / "scenes").iterdir()
    path.write_text(path.read_text().replace("markings", "marks"))
    with pytest.raises(InputError):
        only_cell(root)


def test_changed_outcomes_come_first_and_quiet_cells_are_few(watched_run):
    run = read_run(watched_run)
    cells = cells_of(run)
    assert [cell.interest for cell in cells] == ["flip", "flip", "flip", "quiet"]
    many = [*cells, *(replace(cells[-1], seed=seed) for seed in range(10, 20))]
    assert [cell.seed for cell in shown_by_default(many, Wanted())] == [
        *(cell.seed for cell in cells),
        10,
        11,
    ]
    assert len(shown_by_default(many, Wanted(scenes=("smoke-straight",)))) == 14
    (chosen,) = cells_of(
        run, Wanted(scenes=("smoke/straight",), seeds=(1,), renderers=("clean", "3dgs"))
    )
    assert [rollout.renderer for rollout in chosen.rollouts] == ["clean", "3dgs"]
    far = replace(cells[-1].rollouts[0], metrics={"dist_traveled_m": 90.0})
    near = replace(
        cells[-1].rollouts[1], metrics={"dist_traveled_m": 20.0, "lateral_distance_m": 3.0}
    )
    assert replace(cells[-1], rollouts=(far, near)).apart_m == 73.0
    with pytest.raises(InputError, match=r"(?s)--renderer nobody.*clean, 3dgs, onefixer") as caught:
        check_wanted(run, Wanted(renderers=("nobody",)))
    assert caught.value.exit_code == 2


def test_a_page_is_one_file_that_asks_for_nothing(watched_run, tmp_path):
    made = write_page(read_run(watched_run), tmp_path / "view.html", Wanted())
    html = made.path.read_text()
    policy = re.search(r'Content-Security-Policy" content="([^"]+)"', html)
    assert "default-src 'none'" in policy[1]
    assert "unsafe" not in policy[1]
    assert "connect-src" not in policy[1]
    assert re.search(r"(src|href)=.(https?:|//)", html) is None
    assert re.search(r' style="| on\w+="', html) is None
    index = documents(html)["index"]
    assert [cell["here"] for cell in index["cells"]] == [True] * 4
    assert index["notes"] == []


def test_a_page_keeps_its_size_and_says_what_it_leaves_out(watched_run, tmp_path):
    run = read_run(watched_run)
    asked = Wanted(renderers=("clean", "3dgs"), seeds=(0,))
    size = write_page(run, tmp_path / "whole.html", asked).size
    smaller = write_page(run, tmp_path / "smaller.html", asked, size - 15_000)
    assert size - 400_000 < smaller.size <= size - 15_000
    assert len(smaller.cells) == 2
    assert any(re.match(r"Every \w+ camera frame is kept", note) for note in smaller.notes)
    least = write_page(run, tmp_path / "least.html", asked, size // 5)
    assert len(least.cells) == 1
    assert least.notes[0].startswith("No room for 1\u00a0")
    index = documents(least.path.read_text())["index"]
    assert sum(cell["here"] for cell in index["cells"]) == 1
    assert {f"cell-{cell.id}" for cell in least.cells} == set(documents(least.path.read_text())) - {
        "index"
    }


def test_names_cannot_leave_their_place(tmp_path):
    hostile = "</script><script>alert(1)</script><!--"
    root = make_watched(
        tmp_path, Plan(renderers=("clean", hostile), scenes=(hostile,), seeds=(0,), steps=6)
    )
    made = write_page(read_run(root), tmp_path / "view.html", Wanted())
    html = made.path.read_text()
    assert "alert(1)</script>" not in html
    assert html.count("<script") == 3
    assert documents(html)["index"]["cells"][0]["scene"] == hostile


def test_a_camera_says_how_the_road_is_projected_into_its_pictures(small_run):
    run = read_run(small_run)
    cell = cells_of(run)[0]
    drive = cell_data(run, cell, read_logs(run, cell))["drives"][0]
    assert drive["cameras"][0]["lens"] == {
        "kind": "pinhole",
        "k": [40.0, 40.0, 32.0, 18.0],
        "scale": 1.0,
        "T": np.eye(4)[:3].ravel().tolist(),
    }
    assert drive["rear"] == round(100 * Vehicle().rear_axle_to_centre_m)
