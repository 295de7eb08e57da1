"""What is wrong with a scenario file is said with file, line, column, what was found and what to
do.
"""

from __future__ import annotations

import pytest

from alpasim_plugin.core.errors import InputError
from scenarios.load import load_scenario

GOOD = """\
version: 1
road:
  segments:
    - {kind: straight, length_m: 200}
actors:
  - {kind: drive, id: lead, s_m: 60, speeds: [[0, 9]]}
timing: {duration_us: 6000000}
"""


TWICE = GOOD.replace("actors:", "actors:\n  - {kind: oncoming, id: lead, s_m: 90, speed_mps: 5}")
STRAIGHT = "    - {kind: straight, length_m: 200}"
FOLDED = f"    - {{kind: arc, length_m: 90, curvature_per_m: 0.2}}\n{STRAIGHT}"
SWERVE = f"    - {{kind: straight, length_m: 40}}\n    - {{kind: narrow_gap, length_m: 40, shift_m: -2}}\n{STRAIGHT}"
LATE = "kind: crossing_pedestrian, id: p, s_m: 150"


def fails(tmp_path, text):
    path = tmp_path / "scene.yaml"
    path.write_text(text)
    with pytest.raises(InputError) as e:
        load_scenario(path)
    for part in (e.value.message, e.value.hint):
        assert part.strip()
        assert "Traceback" not in part
    return e.value


def swap(old, new):
    assert old in GOOD
    return GOOD.replace(old, new)


@pytest.mark.parametrize(
    ("text", "at", "found", "do"),
    [
        (swap("length_m: 200}", "length_m: 200"), ":5:", "not valid YAML", "correct the syntax"),
        (
            swap("length_m: 200", "lenght_m: 200"),
            ":4:24",
            "unknown key 'lenght_m'",
            "did you mean 'length_m'?",
        ),
        (swap("length_m: 200", "length_m: long"), ":4:24", "length_m = 'long'", "number"),
        (
            swap("length_m: 200", "length_m: -5"),
            ":4:24",
            "length_m = -5",
            "greater than or equal to 0.1",
        ),
        (swap("version: 1\n", ""), ":1:1", "no 'version'", "add version"),
        (swap("version: 1", "version: 2"), ":1:1", "2", "valid: 1"),
        (
            swap("kind: drive", "kind: drives"),
            ":6:5",
            "actors[0].kind is 'drives'",
            "did you mean 'drive'?",
        ),
        (swap("kind: drive, ", ""), ":6:5", "actors[0] has no 'kind'", "crossing_pedestrian"),
        (swap("kind: straight, ", ""), ":4:7", "has no 'kind'", "narrow_gap"),
        (
            swap("    - {kind: straight, length_m: 200}", "    []"),
            ":3:3",
            "segments = []",
            "at least 1",
        ),
        (
            swap("[[0, 9]]", "[[1, 9], [0, 5]]"),
            ":6:5",
            "times of speeds do not increase",
            "order the rows",
        ),
        (
            GOOD + "rates: {camera_us: 150000}\n",
            ":8:9",
            "not a positive multiple of rates.control_us",
            "whole multiples",
        ),
        (
            GOOD + "rates: {control_us: 0}\n",
            ":8:9",
            "rates.control_us = 0",
            "greater than or equal to 1000",
        ),
        (swap("6000000", "50000"), ":7:10", "not a single control step fits", "timing.duration_us"),
        (
            GOOD.replace("6000000}", "600000, warmup_us: 600000}"),
            ":7:31",
            "nothing is left to drive",
            "shorten timing.warmup_us",
        ),
        (TWICE, ":7:19", "duplicate actor id 'lead'", "another id"),
        (
            swap("road:", "log: {commonroad: a.xml}\nroad:"),
            ":1:1",
            "exactly one of 'road', 'log' and 'map'",
            "add road",
        ),
        (GOOD + "log: {}\n", ":8:1", "0 sources", "give one of argoverse"),
        (GOOD + "cameras: []\n", ":8:1", "cameras = []", "at least 1"),
        (
            GOOD + "cameras: [{name: a}, {name: a}]\n",
            ":8:22",
            "two cameras named 'a'",
            "another name",
        ),
        (
            GOOD + "degradation: {kind: none, share: 0.5}\n",
            ":8:1",
            "share = 0.5 with kind: none",
            "say kind: reconstruction or cycle, or",
        ),
        (
            GOOD + "environment: {sky: claer}\n",
            ":8:15",
            "environment.sky is 'claer'",
            "did you mean 'clear'?",
        ),
        (
            GOOD + "background: {file: none.ply}\n",
            ":8:14",
            "none.ply does not exist",
            "correct the path",
        ),
        (GOOD + "scene_id: 'a b/c'\n", ":8:1", "scene_id = 'a b/c'", "match"),
        (GOOD + "seed: -1\n", ":8:1", "seed = -1", "greater than or equal to 0"),
        (GOOD + "seed: 1.5\n", ":8:1", "seed = 1.5", "integer"),
        ("", ":1:1", "empty", "object"),
        ("version: 1\nscenarios: [a.yaml]\n", ":2:1", "a suite, not a scenario", "load_suite"),
        ("just words\n", ":1:1", "'just words'", "object"),
    ],
)
def test_wrong_content_is_placed_and_explained(tmp_path, text, at, found, do):
    e = fails(tmp_path, text)
    assert f"scene.yaml{at}" in e.message
    assert found in e.message
    assert do in e.hint


@pytest.mark.parametrize(
    ("text", "at", "found"),
    [
        (swap("s_m: 60", "s_m: 600"), ":6:5", "s_m = 600.0 is not on the road"),
        (swap("s_m: 60", "s_m: 60, lane: 3"), ":6:5", "1 forward and 1 oncoming lanes"),
        (swap("s_m: 60", "s_m: 60, lane: nowhere"), ":6:5", "the road's lanes are s0_b0, s0_f0"),
        (swap("length_m: 200", "length_m: 85"), ":3:3", "the road is 85 m long"),
        (swap("road:\n", "ego: {lane: 1}\nroad:\n"), ":2:1", "no such forward lane"),
        (
            swap(STRAIGHT, FOLDED).replace("road:\n", "road:\n  lanes_backward: 3\n"),
            ":4:3",
            "would fold",
        ),
        (
            swap("length_m: 200}", "length_m: 200}\n    - {kind: intersection}"),
            ":3:3",
            "an intersection ends the road",
        ),
        (
            swap("    - {kind: straight", "    - {kind: merge}\n    - {kind: straight"),
            ":3:3",
            "the first is not a straight",
        ),
        (
            swap("kind: drive, id: lead, s_m: 60, speeds: [[0, 9]]", LATE),
            ":6:5",
            "the ego's front drives",
        ),
        (
            swap("s_m: 60, speeds: [[0, 9]]", "s_m: -15, speeds: [[0, 25]]"),
            ":6:5",
            "the gap to the ego is 0.00 m",
        ),
        (GOOD + "ego: {lane_changes: [{at_m: 900, to_lane: 0}]}\n", ":8:1", "the road ends"),
    ],
)
def test_scenes_that_cannot_be_built_are_placed_and_explained(tmp_path, text, at, found):
    e = fails(
        tmp_path,
        text + "jitter: {length: 0, position_m: 0, speed: 0, lane_width: 0, curvature: 0}\n",
    )
    assert f"scene.yaml{at}" in e.message
    assert found in e.message


def test_ego_that_would_leave_its_lane_is_refused(tmp_path):
    e = fails(tmp_path, swap(STRAIGHT, SWERVE))
    assert "leave the lanes" in e.message


def test_actors_beside_a_recording_are_refused(tmp_path, repo):
    xml = repo / "scenarios" / "data" / "USA_US101-3_3_T-1.xml"
    e = fails(
        tmp_path,
        f"version: 1\nlog: {{commonroad: {xml}}}\nactors:\n  - {{kind: parked, id: a, s_m: 3}}\n",
    )
    assert ":3:1" in e.message
    assert "recorded log" in e.message


@pytest.mark.parametrize(
    ("log", "at", "found"),
    [
        ("{commonroad: none.xml}", ":2:7", "none.xml does not exist"),
        ("{argoverse: nowhere}", ":2:7", "nowhere does not exist"),
        ("{commonroad: a.xml, usdz: b}", ":2:1", "2 sources (commonroad, usdz)"),
        ("{commonrode: a.xml}", ":2:7", "unknown key 'commonrode'"),
    ],
)
def test_bad_log_sections(tmp_path, log, at, found):
    e = fails(tmp_path, f"version: 1\nlog: {log}\n")
    assert f"scene.yaml{at}" in e.message
    assert found in e.message


def test_a_duration_beyond_the_recording_is_refused(repo):
    with pytest.raises(InputError) as e:
        load_scenario("real/us101", overrides=["timing.duration_us=9000000"])
    assert "--set timing.duration_us=9000000" in e.value.message
    assert "of a log 3.10 s long" in e.value.message


def test_missing_file_gives_the_nearest_shipped_names():
    with pytest.raises(InputError) as e:
        load_scenario("smoke/strait")
    assert "no such file or folder" in e.value.message
    assert "did you mean smoke/straight" in e.value.hint
    with pytest.raises(InputError, match="simrun list scenarios"):
        load_scenario("qqqqqq.yaml")


def test_usdz_and_unknown_files_are_refused_with_what_can_be_read(tmp_path):
    (tmp_path / "a.usdz").write_bytes(b"PK")
    with pytest.raises(InputError, match="no readable ZIP"):
        load_scenario(tmp_path / "a.usdz")
    (tmp_path / "a.bin").write_bytes(b"?")
    with pytest.raises(InputError) as e:
        load_scenario(tmp_path / "a.bin")
    assert "no reader recognises" in e.value.message
    assert "CommonRoad XML" in e.value.hint
    with pytest.raises(InputError, match="a folder with"):
        load_scenario(tmp_path)


def test_a_map_without_lanes_is_refused(tmp_path):
    path = tmp_path / "empty.xml"
    path.write_text(
        '<commonRoad timeStepSize="0.1" commonRoadVersion="2018b" benchmarkID="X"></commonRoad>'
    )
    with pytest.raises(InputError) as e:
        load_scenario(path)
    assert "empty.xml" in e.value.message
